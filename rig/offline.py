"""Run a scene as fast as it goes and keep everything as named arrays."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rig.channels import ChannelTable
from rig.kernels.signals import COLUMN, ROW
from rig.scenes import Scene, parse_scene
from rig.simulation import Frame, Simulation, energy_balance

UNITS = {signal.name: signal.unit for signal in ROW}


class SentCommand(NamedTuple):
    """A command that came from outside a scene, at the tick at which it was taken."""

    tick: int
    name: str
    request: dict[str, Any]


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        simulation: The simulation at its end (model, scene, engine memory).
        times_s: Instants of the signals [s], shape (n,).
        signals: Every state, force and energy of the model, SI, shape (n, N_ROW); `run["normal_force"]` is one column.
        sample_times_s: Instants of the samples [s], shape (m,).
        samples: What each sensor showed, in its own unit, by channel name, each shape (m,).
        counts: The same as the converter gave it, int32, by channel name.
        edges_s: Keyphasor edges [s], shape (turns,).
        events: What took effect, each with event, tick and time_s.
    """

    simulation: Simulation
    times_s: np.ndarray
    signals: np.ndarray
    sample_times_s: np.ndarray
    samples: dict[str, np.ndarray]
    counts: dict[str, np.ndarray]
    edges_s: np.ndarray
    events: list[dict[str, Any]]

    def __getitem__(self, name: str) -> np.ndarray:
        """One signal of the model [SI], shape (n,)."""
        return self.signals[:, COLUMN[name]]

    def unit(self, name: str) -> str:
        """Unit of one signal of the model, `run[name]`."""
        return UNITS[name]

    def sample_unit(self, name: str) -> str:
        """Unit of one channel, `run.samples[name]`."""
        return self.table.channels[name].unit

    @property
    def table(self) -> ChannelTable:
        """Channel table of the sensors that were on."""
        return self.simulation.table

    def energy(self) -> dict[str, np.ndarray]:
        """Energy ledger: stored, supplied, dissipated, residual [J], each shape (n,)."""
        return energy_balance(self.signals, self.signals[0])


def frames(simulation: Simulation, *, chunk_s: float = 0.1, commands: Iterable[SentCommand] = ()) -> Iterator[Frame]:
    """Advance a simulation to the end of its scene, chunk by chunk.

    Args:
        simulation: What to advance.
        chunk_s: Longest chunk [s].
        commands: What is sent on the way beside the scene's own commands, each at a tick that is a multiple of the
            simulation's `block_ticks`.
    """
    chunk = max(1, round(chunk_s * simulation.tick_rate_hz) // simulation.block_ticks) * simulation.block_ticks
    due = deque(sorted(commands, key=lambda command: command.tick))
    while simulation.tick < simulation.end_tick:
        while due and due[0].tick <= simulation.tick:
            command = due.popleft()
            simulation.submit(command.name, dict(command.request))
        stop = min(simulation.tick + chunk, simulation.end_tick, *(command.tick for command in list(due)[:1]))
        yield simulation.advance(stop - simulation.tick)


def simulate(
    scene: Scene,
    *,
    duration_s: float | None = None,
    commands: Iterable[SentCommand] = (),
    progress: Callable[[float], None] | None = None,
) -> Run:
    """Run a scene as fast as it goes.

    Args:
        scene: What to run.
        duration_s: Another duration than the scene's [s].
        commands: What is sent on the way, as for `frames`.
        progress: Called with the part done, 0 to 1.

    Returns:
        The run; signals are kept at the sensors' rate.

    Raises:
        InputError: The duration is none that a scene can have.
        SimulationError: The state became non-finite.

    Example:
        >>> from rig import load_scene, simulate
        >>> run = simulate(load_scene("hammer", {"drive.speed_hz": 5.2}), duration_s=0.05)
        >>> [event["event"] for event in run.events]
        ['hammer']
        >>> f"{run['normal_force'].max():.0e} {run.unit('normal_force')}"  # in the first impacts
        '3e+03 N'
        >>> run.samples["disk_x"].shape, run.sample_unit("disk_x")
        ((1000,), 'mm')
    """
    if duration_s is not None:
        scene = parse_scene({**scene.model_dump(), "duration_s": duration_s})
    simulation = Simulation(scene)
    every = simulation.tick_rate_hz // scene.sensors.rate_hz // simulation.row_ticks
    signals, edges, events = [], [], []
    counts: dict[str, list[np.ndarray]] = {group: [] for group in simulation.table.groups}
    for frame in frames(simulation, commands=commands):
        signals.append(frame.rows[::every].copy())
        for group, block in frame.samples.items():
            counts[group].append(block.values)
        if frame.edges is not None:
            edges.append((frame.edges.tick + frame.edges.values[:, 0]) / simulation.tick_rate_hz)
        events += frame.events
        if progress is not None:
            progress(simulation.tick / simulation.end_tick)
    table = simulation.table
    whole = {group: np.concatenate(blocks) for group, blocks in counts.items()}
    values = {group: table.groups[group].engineering(block) for group, block in whole.items()}
    columns = {name: (group, c) for group in whole for c, name in enumerate(table.groups[group].names)}
    rows = np.concatenate(signals)
    times_s = np.arange(len(rows)) / scene.sensors.rate_hz
    return Run(
        simulation=simulation,
        times_s=times_s,
        signals=rows,
        sample_times_s=times_s,
        samples={name: values[group][:, c] for name, (group, c) in columns.items()},
        counts={name: whole[group][:, c] for name, (group, c) in columns.items()},
        edges_s=np.concatenate(edges) if edges else np.empty(0),
        events=events,
    )
