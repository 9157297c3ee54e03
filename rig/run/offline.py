"""Offline runs: simulate a scene at full speed and keep the results as named arrays."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.files import whole_file
from rig.base.samples import Plottable, Samples, find_column, merge_samples
from rig.base.text import build_html_table
from rig.channels.formula import check_computed
from rig.channels.table import ChannelTable
from rig.physics.kernels.signals import COLUMN, N_ROW, ROW
from rig.run.motion import DISSIPATED, STORED, SUPPLIED, energy_balance
from rig.run.scenes import Scene, load_scene, parse_scene
from rig.run.simulation import Frame, Simulation

NAMES = tuple(COLUMN)
_MUST = "one of the signals it keeps of the model (those of the sensors are in run.samples)"
_MAX_ROWS = 100_000
"""Rows per part of the energy ledger; limits the memory."""


class SentCommand(NamedTuple):
    """A command sent to a run from outside the scene, with the tick at which it was accepted."""

    tick: int
    name: str
    request: dict[str, Any]


@dataclass(frozen=True, repr=False, eq=False)
class Run(Plottable):
    """A finished run: `run["disk_x"]` is the model's signal in SI, `run.samples["disk_x"]` the reading of the probe.

    Attributes:
        simulation: The simulation at its end (model, scene, engine memory).
        times_s: Instants of the signals [s], shape (n,); equal to those of the samples if rows coincide with them.
        signals: States, forces and energies of the model, SI, shape (n, columns); `run["normal_force"]` is one column.
        names: Names of the kept signals of the model, all by default; those of sensors: `run.samples.names`.
        sampled: Readings of the sensors, each in its own unit: a table for every rate.
        counted: The same in counts of the converter, int32.
        edges_s: Keyphasor edges [s], shape (turns,).
        events: Commands and warnings that took effect, each with event, tick and time_s.

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
        rig.base.errors.UnknownNameError: name must be one of the signals it keeps of the model (...), such as ...
        >>> run.energy()
        Samples(stored, supplied, dissipated, residual [J]; 1000 rows at 20000 Hz, 0 to 0.04995 s)
    """

    simulation: Simulation
    times_s: np.ndarray
    signals: np.ndarray
    names: tuple[str, ...]
    sampled: tuple[Samples, ...]
    counted: tuple[Samples, ...]
    edges_s: np.ndarray
    events: list[dict[str, Any]]

    def __getitem__(self, name: str) -> np.ndarray:
        """Return one signal of the model [SI], shape (n,).

        Raises:
            UnknownNameError: The signal does not exist or was not kept; also a KeyError.
        """
        return self.signals[:, find_column(name, self.names, must=_MUST)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def unit(self, name: str) -> str:
        """Return the SI unit of one signal of the model, `run[name]`."""
        return ROW[COLUMN[self.names[find_column(name, self.names, must=_MUST)]]].unit

    def __repr__(self) -> str:
        scene, rate = self.simulation.scene, _get_signal_rate(self.simulation)
        return (
            f"Run({scene.name}: {len(self.times_s) / rate:g} s, {len(self.times_s)} rows at "
            f"{rate:g} Hz of {len(self.names)} signals and {len(self.table.channels)} channels; "
            f"{scene.engine.name} {scene.engine.step_us} us, seed {scene.seed})"
        )

    def _repr_html_(self) -> str:
        events = [(f"{each['time_s']:g} s", each["event"], "", "", "") for each in self.events]
        rows = [*(row for table in self.sampled for row in table.describe()), *events]
        return build_html_table(repr(self), ("channel or event", "unit", "minimum", "mean", "maximum"), rows)

    @property
    def samples(self) -> Samples:
        """Readings of the sensors, each in its own unit; `run.samples.to_si()` has SI.

        Raises:
            InputError: Groups have different rates: use `run.groups`.
        """
        return merge_samples(self.sampled)

    @property
    def counts(self) -> Samples:
        """Readings of the sensors in counts of the converter, int32."""
        return merge_samples(self.counted)

    @property
    def groups(self) -> dict[str, Samples]:
        """Readings of the sensors by group."""
        groups = {}
        for name, group in self.table.groups.items():
            table = next(table for table in self.sampled if group.names[0] in table.names)
            first = table.names.index(group.names[0])
            part = slice(first, first + len(group.names))
            groups[name] = replace(
                table, name=name, values=table.values[:, part], names=group.names, units=table.units[part]
            )
        return groups

    @property
    def table(self) -> ChannelTable:
        """Channel table of the active sensors."""
        return self.simulation.table

    def energy(self) -> Samples:
        """Return the energy ledger: stored, supplied, dissipated, residual [J], shape (n, 4).

        Raises:
            InputError: The run did not keep all signals of the ledger.
        """
        missing = [name for name in (*STORED, *SUPPLIED, *DISSIPATED) if name not in self.names]
        if missing:
            raise InputError("signals", f"with {', '.join(missing)} for an energy ledger", list(self.names))
        columns, parts = [COLUMN[name] for name in self.names], []
        first = np.zeros(N_ROW)
        first[columns] = self.signals[0]
        for begin in range(0, len(self.signals), _MAX_ROWS):
            kept = self.signals[begin : begin + _MAX_ROWS]
            rows = np.zeros((len(kept), N_ROW))
            rows[:, columns] = kept
            parts.append(energy_balance(rows, first))
        names = tuple(parts[0])
        values = np.column_stack([np.concatenate([part[name] for part in parts]) for name in names])
        index, rate = np.arange(len(values)), _get_signal_rate(self.simulation)
        return Samples("energy", self.times_s, index, values, names, ("J",) * len(names), rate)


def frames(simulation: Simulation, *, chunk_s: float = 0.1, commands: Iterable[SentCommand] = ()) -> Iterator[Frame]:
    """Advance a simulation to the end of its scene, chunk by chunk, and yield the frames.

    Args:
        simulation: The simulation.
        chunk_s: Longest chunk [s].
        commands: Commands in addition to those of the scene, each at a tick that is a multiple of the simulation's
            `block_ticks`.
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
    """Simulate a scene at full speed.

    Args:
        scene: Name of a built-in scene, path of a .toml file, or a loaded scene.
        changes: Changed values by dotted key, of the scene or of its parameters, as for `rig.load_scene`.
        duration_s: Duration [s]; default: that of the scene.
        signals: Names of the model's signals to keep; default: all (none for test signals).
        folder: Folder for signals.npy, samples.npy and counts.npy (created if missing; with several rates, a file for
            each), which are then read row by row as they are used; default: in memory.
        commands: Additional commands, as for `frames`.
        progress: Called with the completed fraction, 0 to 1.

    Returns:
        The run; signals are kept at the sensors' rate, or at every row if samples fall between rows.

    Raises:
        InputError: A scene, signal or folder does not exist, or a value is invalid.
        SimulationError: The state became non-finite.
        DiskError: The disk is full or refused to write.

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
    scene = load_scene(scene, changes)
    if signals is not None:
        scene.check_physics()
    names = () if signals is None else _names(signals)
    if duration_s is not None:
        scene = parse_scene({**scene.model_dump(), "duration_s": duration_s})
    simulation = Simulation(scene)
    if signals is None and scene.generator is None:
        names = simulation.computed
    if names:
        check_computed({"signals": names}, simulation.first_row, engine=scene.engine.name)
    every, end = simulation.rows_per_kept_row, simulation.end_tick
    n, table = -(-end // (every * simulation.row_ticks)), simulation.table
    columns = slice(None) if names == NAMES else [COLUMN[name] for name in names]
    edges, events = [], []
    rates = dict.fromkeys(group.rate_hz for group in table.groups.values())
    groups_by_rate = {rate: [group for group in table.groups.values() if group.rate_hz == rate] for rate in rates}
    sample_rows, counts = dict[int, _Rows](), dict[int, _Rows]()
    with ExitStack() as stack:
        kept = _Rows(stack, folder, "signals", (n, len(names)), np.float64)
        for rate, groups in groups_by_rate.items():
            shape = (-(-end * rate // simulation.tick_rate_hz), sum(len(group.channels) for group in groups))
            suffix = f"-{rate}-hz" if len(groups_by_rate) > 1 else ""
            sample_rows[rate] = _Rows(stack, folder, f"samples{suffix}", shape, np.float64)
            counts[rate] = _Rows(stack, folder, f"counts{suffix}", shape, np.int32)
        for frame in frames(simulation, commands=commands):
            kept.add(frame.rows[-(frame.tick // simulation.row_ticks) % every :: every, columns])
            for rate, groups in groups_by_rate.items():
                blocks = [frame.samples[group.name].values for group in groups]
                counts[rate].add(np.hstack(blocks))
                sample_rows[rate].add(
                    np.hstack([group.engineering(block) for group, block in zip(groups, blocks, strict=True)])
                )
            if frame.edges is not None:
                edges.append((frame.edges.tick + frame.edges.values[:, 0]) / simulation.tick_rate_hz)
            events += frame.events
            if progress is not None:
                progress(simulation.tick / simulation.end_tick)
    sampled, counted = [], []
    for rate, groups in groups_by_rate.items():
        values, channels = sample_rows[rate].array(), [channel for group in groups for channel in group.channels]
        index = np.arange(len(values))
        table_name = "sensors" if len(groups_by_rate) == 1 else ", ".join(group.name for group in groups)
        labels, units = tuple(channel.name for channel in channels), tuple(channel.unit for channel in channels)
        sampled.append(Samples(table_name, index / rate, index, values, labels, units, float(rate)))
        counted.append(replace(sampled[-1], values=counts[rate].array(), units=("count",) * len(units)))
    return Run(
        simulation=simulation,
        times_s=np.arange(n) / _get_signal_rate(simulation),
        signals=kept.array(),
        names=names,
        sampled=tuple(sampled),
        counted=tuple(counted),
        edges_s=np.concatenate(edges) if edges else np.empty(0),
        events=events,
    )


def _get_signal_rate(simulation: Simulation) -> float:
    """Return the rate of the signals that a run keeps [Hz]."""
    return simulation.tick_rate_hz / (simulation.rows_per_kept_row * simulation.row_ticks)


def _names(signals: Iterable[str]) -> tuple[str, ...]:
    if isinstance(signals, str) or not isinstance(signals, Iterable):
        raise InputError("signals", "a list of names of the model's signals", signals)
    names = tuple(signals)
    for name in names:
        if name not in NAMES:
            raise UnknownNameError("signals", "names of the model's signals", name, NAMES)
    return names


class _Rows:
    """Rows added block by block, in memory or in a .npy file that is memory-mapped afterwards."""

    def __init__(
        self, stack: ExitStack, folder: str | Path | None, name: str, shape: tuple[int, int], dtype: type
    ) -> None:
        self._row_count, self._file = 0, None
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
            self._values[self._row_count : self._row_count + len(block)] = block
            self._row_count += len(block)
        else:
            self._file.write(block.tobytes())

    def array(self) -> np.ndarray:
        """Return all rows, after the last block."""
        return self._values if self._file is None else np.load(self._path, mmap_mode="r")
