"""Run a scene as fast as it goes and keep everything as named arrays."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rig.channels import ChannelTable
from rig.kernels.signals import COLUMN, ROW
from rig.motion import energy_balance
from rig.samples import Samples, place
from rig.scenes import Scene, load_scene, parse_scene
from rig.simulation import Frame, Simulation

NAMES = tuple(COLUMN)
_MUST = "one of the model's signals (those of the sensors are in run.samples)"


class SentCommand(NamedTuple):
    """A command that came from outside a scene, at the tick at which it was taken."""

    tick: int
    name: str
    request: dict[str, Any]


@dataclass(frozen=True, repr=False, eq=False)
class Run:
    """A finished run: `run["disk_x"]` is what the model had, in SI, and `run.samples["disk_x"]` what the probe showed.

    Attributes:
        simulation: The simulation at its end (model, scene, engine memory).
        times_s: Instants of the signals [s], shape (n,).
        signals: Every state, force and energy of the model, SI, shape (n, N_ROW); `run["normal_force"]` is one column.
        samples: What each sensor showed, at the same instants, in its own unit; `run.samples.to_si()` has SI.
        counts: The same as the converter gave it, int32.
        edges_s: Keyphasor edges [s], shape (turns,).
        events: What took effect, each with event, tick and time_s.

    Example:
        >>> import rig
        >>> run = rig.simulate("hammer", duration_s=0.05)
        >>> run
        Run(hammer: 0.05 s, 1000 rows at 20000 Hz of 66 signals and 15 channels; split 25 us, seed 1)
        >>> f"{run['disk_x'].max():.5f} {run.unit('disk_x')}"
        '0.00157 m'
        >>> f"{run.samples['disk_x'].max():.2f} {run.samples.unit('disk_x')}"
        '1.57 mm'
        >>> run["disk_z"]
        Traceback (most recent call last):
        rig.errors.UnknownNameError: name must be one of the model's signals (...), such as disk_y, ...
        >>> run.energy()
        Samples(stored, supplied, dissipated, residual [J]; 1000 rows at 20000 Hz, 0 to 0.04995 s)
    """

    simulation: Simulation
    times_s: np.ndarray
    signals: np.ndarray
    samples: Samples
    counts: Samples
    edges_s: np.ndarray
    events: list[dict[str, Any]]

    def __getitem__(self, name: str) -> np.ndarray:
        """One signal of the model [SI], shape (n,).

        Raises:
            UnknownNameError: There is no such signal; it is a KeyError.
        """
        return self.signals[:, place(name, NAMES, must=_MUST)]

    def __iter__(self) -> Iterator[str]:
        return iter(NAMES)

    def unit(self, name: str) -> str:
        """SI unit of one signal of the model, `run[name]`."""
        return ROW[place(name, NAMES, must=_MUST)].unit

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the model's signals; those of the sensors are `run.samples.names`."""
        return NAMES

    def __repr__(self) -> str:
        scene = self.simulation.scene
        return (
            f"Run({scene.name}: {len(self.times_s) / scene.sensors.rate_hz:g} s, {len(self.times_s)} rows at "
            f"{scene.sensors.rate_hz} Hz of {len(NAMES)} signals and {len(self.samples.names)} channels; "
            f"{scene.engine.name} {scene.engine.step_us} us, seed {scene.seed})"
        )

    @property
    def table(self) -> ChannelTable:
        """Channel table of the sensors that were on."""
        return self.simulation.table

    def energy(self) -> Samples:
        """Energy ledger: stored, supplied, dissipated, residual [J], shape (n, 4)."""
        ledger = energy_balance(self.signals, self.signals[0])
        values, units = np.column_stack(list(ledger.values())), ("J",) * len(ledger)
        return replace(self.samples, name="energy", values=values, names=tuple(ledger), units=units)


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
    scene: Scene | str | Path,
    changes: dict[str, Any] | None = None,
    *,
    duration_s: float | None = None,
    commands: Iterable[SentCommand] = (),
    progress: Callable[[float], None] | None = None,
) -> Run:
    """Run a scene as fast as it goes.

    Args:
        scene: What to run: a scene that comes with the rig by its name, the path of a .toml file, or a loaded one.
        changes: Other values by dotted key, of the scene or of its parameters, as for `rig.load_scene`.
        duration_s: Another duration than the scene's [s].
        commands: What is sent on the way, as for `frames`.
        progress: Called with the part done, 0 to 1.

    Returns:
        The run; signals are kept at the sensors' rate.

    Raises:
        InputError: There is no such scene, or a value is none that it can have.
        SimulationError: The state became non-finite.

    Example:
        >>> import rig
        >>> run = rig.simulate("hammer", {"drive.speed_hz": 5.2}, duration_s=0.05)
        >>> [event["event"] for event in run.events]
        ['hammer']
        >>> f"{run['normal_force'].max():.0e} {run.unit('normal_force')}"  # in the first impacts
        '3e+03 N'
        >>> run.samples["disk_x"].shape, run.samples.unit("disk_x")
        ((1000,), 'mm')
    """
    scene = load_scene(scene, changes)
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
    rows = np.concatenate(signals)
    index = np.arange(len(rows))
    times_s = index / scene.sensors.rate_hz
    channels = [channel for group in whole for channel in table.groups[group].channels]
    samples = Samples(
        name="sensors",
        times_s=times_s,
        index=index,
        values=np.hstack([table.groups[group].engineering(block) for group, block in whole.items()]),
        names=tuple(channel.name for channel in channels),
        units=tuple(channel.unit for channel in channels),
        rate_hz=float(scene.sensors.rate_hz),
    )
    return Run(
        simulation=simulation,
        times_s=times_s,
        signals=rows,
        samples=samples,
        counts=replace(samples, values=np.hstack(list(whole.values())), units=("count",) * len(channels)),
        edges_s=np.concatenate(edges) if edges else np.empty(0),
        events=events,
    )
