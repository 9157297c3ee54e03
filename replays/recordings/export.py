"""Runs as files for other tools: MCAP, Parquet, CSV, WAV, by the suffix.

Tables have one row a sample: `time [s]`, every signal of the model as `truth.NAME [unit]` (SI), and every sensor as
`NAME [unit]`; of test signals there is no model. A WAV has the sensors' volts, for an analogue output, as `rig export`
makes it. A file is written beside its place and moved there when it is whole.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from recorder.reader import Recording
from replays.recordings.formats.exporting.export import check_output, export
from replays.recordings.formats.exporting.selection import select
from replays.recordings.formats.readers import columnar, delimited
from replays.recordings.resimulation.background import Background
from rig.base import wire
from rig.base.errors import PART_SUFFIX, InputError, Words, whole_file
from rig.base.text import finite
from rig.physics.kernels.signals import ROW
from rig.run.commands.table import FaultCommand
from rig.run.offline import frames
from rig.run.simulation import Frame, Simulation

SUFFIXES = (".mcap", ".parquet", ".csv", ".wav")


class RunWriter(Protocol):
    """Takes the frames of one run, in order; whole on a clean exit, nothing left behind on an error."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def write(self, frame: Frame) -> None:
        """Take the next frame."""
        ...


def check_run_output(path: Path, *, force: bool) -> None:
    """Refuse a file that cannot be written, before anything is simulated.

    Raises:
        InputError: Another suffix, a folder that is missing or read-only, or an existing file.
    """
    check_output(path, force=force, suffixes=SUFFIXES)


def writer_for(path: Path, simulation: Simulation, *, force: bool = False) -> RunWriter:
    """The writer that the suffix asks for."""
    check_run_output(path, force=force)
    if path.suffix == ".mcap":
        return McapRun(path, simulation, force=force)
    if path.suffix == ".wav":
        return _WavRun(path, simulation, force=force)
    if path.suffix == ".parquet":
        return _TableRun(path, simulation, columnar.ParquetRows)
    if path.suffix == ".csv":
        return _TableRun(path, simulation, lambda draft, schema: delimited.CsvRows(draft, schema.names))
    raise InputError("output", "of a format that has a writer", path.suffix)


def write_run(
    simulation: Simulation, path: Path, *, force: bool = False, progress: Callable[[float], None] = lambda part: None
) -> None:
    """Run a scene to its end as fast as it goes, into a file that grows with it; nothing is left behind on an error.

    Args:
        simulation: What is run, from where it is.
        path: File that ends in .mcap (as `rig record` would have made it), .parquet, .csv or .wav.
        force: Replace an existing file.
        progress: Told the part done, 0 to 1.

    Raises:
        InputError: The destination cannot be used.
        SimulationError: The state became non-finite.

    Example:
        >>> import rig, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "run.mcap"
        ...     write_run(rig.Simulation(rig.load_scene("hammer", {"duration_s": 0.1})), path)
        ...     path.stat().st_size > 100_000
        True
    """
    with writer_for(path, simulation, force=force) as writer:
        for frame in frames(simulation):
            writer.write(frame)
            progress(simulation.tick / simulation.end_tick)


def table_columns(simulation: Simulation) -> list[str]:
    """Column headings of a table of a run.

    Raises:
        InputError: Groups have rates of their own, or the scene has faults of blocks.
    """
    for timed in simulation.scene.commands:
        if isinstance(timed.request, FaultCommand) and timed.request.what.of_blocks:
            must = "an .mcap file where a scene has faults of blocks, of which a table has none"
            raise InputError("output", must, Words(timed.request.what.name()))
    rates = {name: group.rate_hz for name, group in simulation.table.groups.items()}
    if len(set(rates.values())) > 1:
        told = ", ".join(f"{name} {rate} Hz" for name, rate in rates.items())
        raise InputError("output", "an .mcap file where groups have rates of their own", Words(told))
    channels = simulation.table.channels.values()
    return [
        "time [s]",
        *(f"truth.{signal.name} [{signal.unit}]" for signal in (ROW if _on_rows(simulation) else ())),
        *(f"{channel.name} [{channel.unit}]" for channel in channels),
    ]


def _on_rows(simulation: Simulation) -> bool:
    """Whether there is truth beside the samples: of a model, whose rows they fall on."""
    on_rows = all(simulation.tick_rate_hz % group.rate_hz == 0 for group in simulation.table.groups.values())
    return on_rows and simulation.scene.generator is None


def table_rows(simulation: Simulation, frame: Frame) -> np.ndarray:
    """The rows of one frame, shape (samples, columns)."""
    blocks = frame.samples
    first = next(iter(blocks.values()))
    times = (first.index + np.arange(len(first.values)))[:, None] / first.rate_hz
    every = simulation.kept_every
    truth = [frame.rows[-(frame.tick // simulation.row_ticks) % every :: every]] if _on_rows(simulation) else []
    sensors = [simulation.table.groups[group].engineering(block.values) for group, block in blocks.items()]
    return np.hstack([times, *truth, *sensors])


class _TableRun:
    """A table that grows frame by frame in a file of its own until it is whole."""

    def __init__(self, path: Path, simulation: Simulation, open_table: Callable[[Path, Any], Any]) -> None:
        self.path = path
        self.simulation = simulation
        self._open_table = open_table
        self._background = Background()

    def __enter__(self) -> Self:
        about = {"parameters": self.simulation.parameters_document(), "scene": self.simulation.scene_document()}
        told = {f"{name}.json": json.dumps(document) for name, document in about.items()}  # where a format has a place
        schema = columnar.float_schema(table_columns(self.simulation)).with_metadata(told)
        with ExitStack() as stack:
            self._writer = self._open_table(stack.enter_context(whole_file(self.path)), schema)
            stack.callback(self._writer.close)
            stack.callback(self._background.finish)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def write(self, frame: Frame) -> None:
        """Take the next frame."""
        self._background.call(self._append, table_rows(self.simulation, frame))

    def _append(self, rows: np.ndarray) -> None:
        self._writer.write(list(rows.T))


class _WavRun:
    """A recording in a folder of its own until the run is whole, then exported."""

    def __init__(self, path: Path, simulation: Simulation, *, force: bool) -> None:
        self.path, self.simulation, self._force = path, simulation, force

    def __enter__(self) -> Self:
        table_columns(self.simulation)  # refused where there are several rates
        with ExitStack() as stack:
            folder = Path(
                stack.enter_context(
                    TemporaryDirectory(dir=self.path.parent, prefix=f"{self.path.name}.", suffix=PART_SUFFIX)
                )
            )
            self._recording = folder / self.path.with_suffix(".mcap").name
            self._run = McapRun(self._recording, self.simulation, view_rate_hz=0.0).__enter__()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            self._run.__exit__(kind, error, trace)
            if kind is None:
                volts = select(Recording.open(self._recording), unit="volts", merged=True)
                export(volts, self.path, force=self._force)

    def write(self, frame: Frame) -> None:
        """Take the next frame."""
        self._run.write(frame)


class McapRun:
    """The same file as `rig record` would have made, with the simulated clock for the wall clock."""

    def __init__(
        self,
        path: Path,
        simulation: Simulation,
        *,
        force: bool = False,
        view_rate_hz: float = 500.0,
        epoch_ns: int | None = None,
    ) -> None:
        """Prepare; the file begins where the context does.

        Args:
            path: The file, ends in .mcap.
            simulation: What is run.
            force: Replace an existing file.
            view_rate_hz: Rate of the plottable messages [Hz of simulated time]; 0 writes none.
            epoch_ns: Wall time at which the run begins [unix ns], at which the recorder's clocks stand still: the same
                run gives the same bytes. None for now.
        """
        self.path, self.simulation, self._force = path, simulation, force
        self._view_rate_hz, self._epoch_ns = view_rate_hz, epoch_ns
        self._background = Background()

    def __enter__(self) -> Self:
        from recorder.contents.metadata import Beginning
        from recorder.writer import RecordingWriter

        epoch_ns = self._epoch_ns
        self._wall_ns = time.time_ns() if epoch_ns is None else epoch_ns
        simulation = self.simulation
        self._writer = RecordingWriter(
            self.path,
            catalogue=simulation.catalogue(),
            parameters=simulation.parameters_document(),
            scene=simulation.scene_document(),
            view_rate_hz=self._view_rate_hz,
            beginning=Beginning(from_start=True),
            force=self._force,
            wall_ns=time.time_ns if epoch_ns is None else lambda: epoch_ns,
            monotonic_s=time.monotonic if epoch_ns is None else lambda: 0.0,
        )
        self._rows = wire.Continuity()
        self._event({"event": "start", "scene": simulation.scene.name, "seed": simulation.scene.seed, "pace": "none"})
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        whole = False
        try:
            self._background.finish()
            if kind is None and not self._writer.closed:
                self._event({"event": "end", "reason": "completed"})
                self._tell_health()
                self._writer.finish("completed")
                whole = True
        finally:
            if not whole:
                self._writer.abandon()

    def write(self, frame: Frame) -> None:
        """Take the next frame."""
        self._background.call(self._write, frame)

    def _write(self, frame: Frame) -> None:
        for event in frame.events:
            self._event(event)
        for told in frame.told:
            self._writer.write(wire.FAULTS, wire.encode_document(told), self._wall(frame.tick))
        for message in frame.messages:
            if "zenoh" in message.doors:
                self._writer.write(message.key, wire.encode_block(message.block), self._wall(frame.tick))
                self._rows.follow(message.key, message.row, len(message.block.values), late_rows=math.inf)

    def _tell_health(self) -> None:
        """Write the status that a live run would end with, as far as a run without a clock has one."""
        simulation, told = self.simulation, ("spin_hz", "energy", "engine", "accuracy", "warnings")
        health = simulation.health()
        status = {
            "scene": simulation.scene.name,
            "tick": simulation.tick,
            "time_s": simulation.tick / simulation.tick_rate_hz,
            "state": "ended",
            "pace": "none",
            **{name: health[name] for name in told if name in health},
        }
        self._writer.write(wire.STATUS, wire.encode_document(finite(status)), self._wall(simulation.tick))

    def _event(self, event: dict[str, Any]) -> None:
        tick = int(event.get("tick", self.simulation.tick))  # a frame's own: the simulation is further on by now
        stamp = {"tick": tick, "time_s": tick / self.simulation.tick_rate_hz}
        payload = wire.encode_document(self._rows.tell({**stamp, **event}))
        self._writer.write(wire.EVENTS, payload, self._wall(tick))

    def _wall(self, tick: int) -> int:
        return self._wall_ns + tick * 1_000_000_000 // self.simulation.tick_rate_hz
