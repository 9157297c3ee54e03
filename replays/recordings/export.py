"""Export of runs to files, by the suffix: MCAP, Parquet, CSV, WAV.

Tables have one row per sample: `time [s]`, every signal of the model as `truth.NAME [unit]` (SI), and every sensor as
`NAME [unit]`; test signals have no truth. A WAV file has the sensors' volts, for an analogue output, as from `rig
export`. A file is written to a temporary name and renamed when it is complete.
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
from rig.base.errors import InputError, Words
from rig.base.files import PART_SUFFIX, whole_file
from rig.base.text import replace_nonfinite
from rig.physics.kernels.signals import ROW
from rig.run.commands.table import FaultCommand
from rig.run.offline import frames
from rig.run.simulation import Frame, Simulation

SUFFIXES = (".mcap", ".parquet", ".csv", ".wav")


class RunWriter(Protocol):
    """Writer for the frames of one run, in order; the file is complete on a clean exit, and removed on an error."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def write(self, frame: Frame) -> None:
        """Write the next frame."""
        ...


def check_run_output(path: Path, *, force: bool) -> None:
    """Check that a file can be written, before anything is simulated.

    Raises:
        InputError: Another suffix, a folder that is missing or read-only, or an existing file.
    """
    check_output(path, force=force, suffixes=SUFFIXES)


def make_writer(path: Path, simulation: Simulation, *, force: bool = False) -> RunWriter:
    """Return the writer for the suffix of a path."""
    check_run_output(path, force=force)
    if path.suffix == ".mcap":
        return McapRun(path, simulation, force=force)
    if path.suffix == ".wav":
        return _WavRun(path, simulation, force=force)
    if path.suffix == ".parquet":
        return _TableRun(path, simulation, columnar.ParquetRows)
    if path.suffix == ".csv":
        return _TableRun(path, simulation, lambda draft, schema: delimited.CsvRows(draft, schema.names))
    raise InputError("output", "a format with a writer", path.suffix)


def write_run(
    simulation: Simulation,
    path: Path,
    *,
    force: bool = False,
    progress: Callable[[float], None] = lambda part: None,
    observe: Callable[[Frame], None] = lambda frame: None,
) -> None:
    """Run a scene to its end at full speed, and write it to a file; remove the file on an error.

    Args:
        simulation: Simulation of the run.
        path: File that ends in .mcap (as from `rig record`), .parquet, .csv or .wav.
        force: Replace an existing file.
        progress: Callback for the completed fraction, 0 to 1.
        observe: Callback for each frame, whose rows the next frame overwrites.

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
    with make_writer(path, simulation, force=force) as writer:
        for frame in frames(simulation):
            writer.write(frame)
            observe(frame)
            progress(simulation.tick / simulation.end_tick)


def table_columns(simulation: Simulation) -> list[str]:
    """Return the column headings of a table of a run.

    Raises:
        InputError: Groups have different rates, or the scene has faults of blocks.
    """
    for timed in simulation.scene.commands:
        if isinstance(timed.request, FaultCommand) and timed.request.what.of_blocks:
            must = "an .mcap file for a scene with faults of blocks, as a table has no blocks"
            raise InputError("output", must, Words(timed.request.what.name()))
    rates = {name: group.rate_hz for name, group in simulation.table.groups.items()}
    if len(set(rates.values())) > 1:
        rates_text = ", ".join(f"{name} {rate} Hz" for name, rate in rates.items())
        raise InputError("output", "an .mcap file where groups have different rates", Words(rates_text))
    channels = simulation.table.channels.values()
    return [
        "time [s]",
        *(f"truth.{signal.name} [{signal.unit}]" for signal in (ROW if _has_truth(simulation) else ())),
        *(f"{channel.name} [{channel.unit}]" for channel in channels),
    ]


def _has_truth(simulation: Simulation) -> bool:
    """Return whether a table has truth: the scene has a model, and samples fall on its rows."""
    on_rows = all(simulation.tick_rate_hz % group.rate_hz == 0 for group in simulation.table.groups.values())
    return on_rows and simulation.scene.generator is None


def table_rows(simulation: Simulation, frame: Frame) -> np.ndarray:
    """Return the rows of one frame, shape (samples, columns)."""
    blocks = frame.samples
    first = next(iter(blocks.values()))
    times = (first.index + np.arange(len(first.values)))[:, None] / first.rate_hz
    step = simulation.rows_per_kept_row
    truth = [frame.rows[-(frame.tick // simulation.row_ticks) % step :: step]] if _has_truth(simulation) else []
    sensors = [simulation.table.groups[group].engineering(block.values) for group, block in blocks.items()]
    return np.hstack([times, *truth, *sensors])


class _TableRun:
    """Table that grows frame by frame in a temporary file."""

    def __init__(self, path: Path, simulation: Simulation, open_table: Callable[[Path, Any], Any]) -> None:
        self.path = path
        self.simulation = simulation
        self._open_table = open_table
        self._background = Background()

    def __enter__(self) -> Self:
        about = {"parameters": self.simulation.parameters_document(), "scene": self.simulation.scene_document()}
        documents = {f"{name}.json": json.dumps(document) for name, document in about.items()}
        schema = columnar.float_schema(table_columns(self.simulation)).with_metadata(documents)
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
        """Write the next frame."""
        self._background.call(self._append, table_rows(self.simulation, frame))

    def _append(self, rows: np.ndarray) -> None:
        self._writer.write(list(rows.T))


class _WavRun:
    """Recording in a temporary folder, exported at the end of the run."""

    def __init__(self, path: Path, simulation: Simulation, *, force: bool) -> None:
        self.path, self.simulation, self._force = path, simulation, force

    def __enter__(self) -> Self:
        table_columns(self.simulation)  # raises an error if there are several rates
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
        """Write the next frame."""
        self._run.write(frame)


class McapRun:
    """Recording as from `rig record`, on the simulated clock."""

    def __init__(
        self,
        path: Path,
        simulation: Simulation,
        *,
        force: bool = False,
        view_rate_hz: float = 500.0,
        epoch_ns: int | None = None,
    ) -> None:
        """Prepare the writer; the file is created on entering the context.

        Args:
            path: The file, ends in .mcap.
            simulation: Simulation of the run.
            force: Replace an existing file.
            view_rate_hz: Rate of the plottable messages [Hz of simulated time]; 0 writes none.
            epoch_ns: Wall time of the start [unix ns], at which the recorder's clocks stand still, so that equal runs
                give equal bytes; None: now.
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
                self._write_status()
                self._writer.finish("completed")
                whole = True
        finally:
            if not whole:
                self._writer.abandon()

    def write(self, frame: Frame) -> None:
        """Write the next frame."""
        self._background.call(self._write, frame)

    def _write(self, frame: Frame) -> None:
        for event in frame.events:
            self._event(event)
        for fault in frame.documents:
            self._writer.write(wire.FAULTS, wire.encode_document(fault), self._wall(frame.tick))
        for message in frame.messages:
            if "zenoh" in message.transports:
                self._writer.write(message.key, wire.encode_block(message.block), self._wall(frame.tick))
                self._rows.follow(message.key, message.row, len(message.block.values), late_rows=math.inf)

    def _write_status(self) -> None:
        """Write the final status of a live run, as far as it applies without a clock."""
        simulation, copied = self.simulation, ("spin_hz", "energy", "engine", "accuracy", "warnings")
        health = simulation.health()
        status = {
            "scene": simulation.scene.name,
            "tick": simulation.tick,
            "time_s": simulation.tick / simulation.tick_rate_hz,
            "state": "ended",
            "pace": "none",
            **{name: health[name] for name in copied if name in health},
        }
        self._writer.write(wire.STATUS, wire.encode_document(replace_nonfinite(status)), self._wall(simulation.tick))

    def _event(self, event: dict[str, Any]) -> None:
        tick = int(event.get("tick", self.simulation.tick))  # the frame's tick; the simulation is further ahead
        stamp = {"tick": tick, "time_s": tick / self.simulation.tick_rate_hz}
        payload = wire.encode_document(self._rows.add_row_counts({**stamp, **event}))
        self._writer.write(wire.EVENTS, payload, self._wall(tick))

    def _wall(self, tick: int) -> int:
        return self._wall_ns + tick * 1_000_000_000 // self.simulation.tick_rate_hz
