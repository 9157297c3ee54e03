"""Run a scene as fast as it goes and keep everything as named arrays."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rig.channels import ChannelTable
from rig.errors import InputError, UnknownNameError, Words, whole_file
from rig.kernels.signals import COLUMN, N_ROW, ROW
from rig.motion import DISSIPATED, STORED, SUPPLIED, energy_balance
from rig.samples import Samples, place
from rig.scenes import Scene, load_scene, parse_scene
from rig.simulation import Frame, Simulation

NAMES = tuple(COLUMN)
_MUST = "one of the signals it keeps of the model (those of the sensors are in run.samples)"
_MOST_ROWS = 100_000
"""Rows of which the energy ledger is drawn up at a time."""


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
        signals: States, forces and energies of the model, SI, shape (n, columns); `run["normal_force"]` is one column.
        names: Names of the model's signals that were kept, all by default; the sensors' are `run.samples.names`.
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
        rig.errors.UnknownNameError: name must be one of the signals it keeps of the model (...), such as disk_y, ...
        >>> run.energy()
        Samples(stored, supplied, dissipated, residual [J]; 1000 rows at 20000 Hz, 0 to 0.04995 s)
    """

    simulation: Simulation
    times_s: np.ndarray
    signals: np.ndarray
    names: tuple[str, ...]
    samples: Samples
    counts: Samples
    edges_s: np.ndarray
    events: list[dict[str, Any]]

    def __getitem__(self, name: str) -> np.ndarray:
        """One signal of the model [SI], shape (n,).

        Raises:
            UnknownNameError: There is no such signal, or it was not kept; it is a KeyError.
        """
        return self.signals[:, place(name, self.names, must=_MUST)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def unit(self, name: str) -> str:
        """SI unit of one signal of the model, `run[name]`."""
        return ROW[COLUMN[self.names[place(name, self.names, must=_MUST)]]].unit

    def __repr__(self) -> str:
        scene = self.simulation.scene
        return (
            f"Run({scene.name}: {len(self.times_s) / scene.sensors.rate_hz:g} s, {len(self.times_s)} rows at "
            f"{scene.sensors.rate_hz} Hz of {len(self.names)} signals and {len(self.samples.names)} channels; "
            f"{scene.engine.name} {scene.engine.step_us} us, seed {scene.seed})"
        )

    @property
    def table(self) -> ChannelTable:
        """Channel table of the sensors that were on."""
        return self.simulation.table

    def energy(self) -> Samples:
        """Energy ledger: stored, supplied, dissipated, residual [J], shape (n, 4).

        Raises:
            InputError: The run does not keep all signals of the ledger.
        """
        lacking = [name for name in (*STORED, *SUPPLIED, *DISSIPATED) if name not in self.names]
        if lacking:
            raise InputError("signals", f"with {', '.join(lacking)} for an energy ledger", list(self.names))
        columns, parts = [COLUMN[name] for name in self.names], []
        first = np.zeros(N_ROW)
        first[columns] = self.signals[0]
        for begin in range(0, len(self.signals), _MOST_ROWS):
            kept = self.signals[begin : begin + _MOST_ROWS]
            rows = np.zeros((len(kept), N_ROW))
            rows[:, columns] = kept
            parts.append(energy_balance(rows, first))
        names = tuple(parts[0])
        values = np.column_stack([np.concatenate([part[name] for part in parts]) for name in names])
        return replace(self.samples, name="energy", values=values, names=names, units=("J",) * len(names))


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
    signals: Iterable[str] | None = None,
    folder: str | Path | None = None,
    commands: Iterable[SentCommand] = (),
    progress: Callable[[float], None] | None = None,
) -> Run:
    """Run a scene as fast as it goes.

    Args:
        scene: What to run: a scene that comes with the rig by its name, the path of a .toml file, or a loaded one.
        changes: Other values by dotted key, of the scene or of its parameters, as for `rig.load_scene`.
        duration_s: Another duration than the scene's [s].
        signals: Names of the model's signals to keep; all of them unless given.
        folder: Where signals.npy, samples.npy and counts.npy are written (a new one is made), to be read from there row
            by row as they are used; in memory unless given.
        commands: What is sent on the way, as for `frames`.
        progress: Called with the part done, 0 to 1.

    Returns:
        The run; signals are kept at the sensors' rate.

    Raises:
        InputError: There is no such scene, signal or folder, or a value is none that it can have.
        SimulationError: The state became non-finite.
        DiskError: The disk refused.

    Example:
        >>> import rig
        >>> run = rig.simulate("hammer", {"drive.speed_hz": 5.2}, duration_s=0.05)
        >>> [event["event"] for event in run.events]
        ['hammer']
        >>> f"{run['normal_force'].max():.0e} {run.unit('normal_force')}"  # in the first impacts
        '3e+03 N'
        >>> run.samples["disk_x"].shape, run.samples.unit("disk_x")
        ((1000,), 'mm')
        >>> rig.simulate("hammer", duration_s=0.05, signals=["normal_force"])
        Run(hammer: 0.05 s, 1000 rows at 20000 Hz of 1 signals and 15 channels; split 25 us, seed 1)
    """
    names = NAMES if signals is None else _names(signals)
    scene = load_scene(scene, changes)
    if duration_s is not None:
        scene = parse_scene({**scene.model_dump(), "duration_s": duration_s})
    simulation = Simulation(scene)
    every = simulation.tick_rate_hz // scene.sensors.rate_hz // simulation.row_ticks
    n = simulation.end_tick // (every * simulation.row_ticks)
    table = simulation.table
    channels = [channel for group in table.groups.values() for channel in group.channels]
    columns = slice(None) if names == NAMES else [COLUMN[name] for name in names]
    edges, events = [], []
    with ExitStack() as stack:
        kept = _Rows(stack, folder, "signals", (n, len(names)), np.float64)
        shown = _Rows(stack, folder, "samples", (n, len(channels)), np.float64)
        counts = _Rows(stack, folder, "counts", (n, len(channels)), np.int32)
        for frame in frames(simulation, commands=commands):
            kept.add(frame.rows[::every, columns])
            blocks = {name: frame.samples[name].values for name in table.groups}
            counts.add(np.hstack(list(blocks.values())))
            shown.add(np.hstack([table.groups[name].engineering(block) for name, block in blocks.items()]))
            if frame.edges is not None:
                edges.append((frame.edges.tick + frame.edges.values[:, 0]) / simulation.tick_rate_hz)
            events += frame.events
            if progress is not None:
                progress(simulation.tick / simulation.end_tick)
    index = np.arange(n)
    times_s = index / scene.sensors.rate_hz
    samples = Samples(
        name="sensors",
        times_s=times_s,
        index=index,
        values=shown.array(),
        names=tuple(channel.name for channel in channels),
        units=tuple(channel.unit for channel in channels),
        rate_hz=float(scene.sensors.rate_hz),
    )
    return Run(
        simulation=simulation,
        times_s=times_s,
        signals=kept.array(),
        names=names,
        samples=samples,
        counts=replace(samples, values=counts.array(), units=("count",) * len(channels)),
        edges_s=np.concatenate(edges) if edges else np.empty(0),
        events=events,
    )


def _names(signals: Iterable[str]) -> tuple[str, ...]:
    if isinstance(signals, str) or not isinstance(signals, Iterable):
        raise InputError("signals", "a list of names of the model's signals", signals)
    names = tuple(signals)
    for name in names:
        if name not in NAMES:
            raise UnknownNameError("signals", "names of the model's signals", name, NAMES)
    return names


class _Rows:
    """Rows that come block by block, into memory or into a .npy file that is then read where it lies."""

    def __init__(
        self, stack: ExitStack, folder: str | Path | None, name: str, shape: tuple[int, int], dtype: type
    ) -> None:
        self._seen, self._file = 0, None
        if folder is None:
            self._values = np.empty(shape, dtype)
            return
        try:
            Path(folder).mkdir(exist_ok=True)
        except (OSError, TypeError, ValueError) as error:
            raise InputError("folder", "a folder, or a new one in a folder that exists", Words(error)) from None
        self._path = Path(folder) / f"{name}.npy"
        self._file = stack.enter_context(stack.enter_context(whole_file(self._path)).open("wb"))
        header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(self._file, header)

    def add(self, block: np.ndarray) -> None:
        """Add a block of rows."""
        if self._file is None:
            self._values[self._seen : self._seen + len(block)] = block
            self._seen += len(block)
        else:
            self._file.write(block.tobytes())

    def array(self) -> np.ndarray:
        """All of them, when the last has come."""
        return self._values if self._file is None else np.load(self._path, mmap_mode="r")
