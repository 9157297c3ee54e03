"""Canvas: a rerun recording stream with simulated and wall time for everything drawn."""

from __future__ import annotations

import os
import select
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import IO, Any

import numpy as np
import rerun as rr

from recorder.viewer.clock import WallClock

APPLICATION = "rig"
VIEWING_BATCH_S = 0.1
"""Time over which data are sent to a viewer together [s]."""
SIMULATED = "simulated_time"
WALL = "wall_time"
PICTURE = "picture"
"""Timeline that counts live pictures, to measure the viewer's progress; simulated time may jump, as in a replay."""
Place = tuple[float, float]
RGB = tuple[int, int, int]


def new_stream(name: str, *, batch_s: float = VIEWING_BATCH_S) -> rr.RecordingStream:
    """Return an unconnected recording stream.

    Args:
        name: Name of the recording.
        batch_s: Time over which the data of an entity are sent together [s]; a viewer processes a few large pieces
            faster than many small ones.
    """
    stream = rr.RecordingStream(APPLICATION, batcher_config=rr.ChunkBatcherConfig(flush_tick=batch_s))
    # rerun's log time would appear as a third timeline without a meaning to the user.
    stream.set_log_time_enabled(False)
    stream.send_recording_name(name)
    return stream


@contextmanager
def piped(file: IO[bytes]) -> Iterator[Path]:
    """Yield a pipe whose data are written to a file: rerun waits for ever if the disk refuses a file of its own.

    Raises:
        OSError: The disk refused; the rest of the data was discarded.
    """
    failures: list[OSError] = []

    def copy() -> None:
        events = select.poll()
        events.register(number, select.POLLIN)
        while any(event & select.POLLIN for _, event in events.poll()):
            data = os.read(number, 1 << 20)
            try:
                file.write(b"" if failures else data)
            except OSError as error:
                failures.append(error)

    with TemporaryDirectory() as folder:
        pipe = Path(folder) / "pipe"
        os.mkfifo(pipe, 0o600)
        number = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
        copier = Thread(target=copy, name="file of the viewer", daemon=True)
        copier.start()
        try:
            yield pipe
        finally:
            os.close(os.open(pipe, os.O_WRONLY))  # ends the copier, also if rerun never opened the pipe
            copier.join()
            os.close(number)
    if failures:
        raise failures[0]


def pixels(size: float) -> list[float]:
    """Return a radius in screen points, independent of zoom; rerun encodes these as negative radii."""
    return [-size]


class Canvas:
    """Drawing functions on a stream; all times are simulated [s]."""

    def __init__(self, stream: rr.RecordingStream, clock: WallClock | None = None) -> None:
        self.stream = stream
        self.clock = WallClock() if clock is None else clock
        self.picture = 0
        """Number of the current picture; 0 if pictures are not counted."""

    def fix(self, path: str, *what: Any) -> None:
        """Draw an entity valid at all times."""
        self.stream.log(path, what[0], *what[1:], static=True)

    def draw(self, path: str, time_s: float, *what: Any) -> None:
        """Draw an entity valid from an instant on [s]."""
        self.stream.set_time(SIMULATED, duration=time_s)
        if self.picture:
            self.stream.set_time(PICTURE, sequence=self.picture)
        wall = self.clock.at(np.array([time_s]))
        if wall is not None:
            self.stream.set_time(WALL, timestamp=float(wall[0]))
        self.stream.log(path, what[0], *what[1:])

    def write(self, path: str, words: dict[Place, str], colors: Sequence[RGB], *, time_s: float | None = None) -> None:
        """Write labels at positions of a 2-D view, valid from an instant on [s], or at all times without one."""
        text = rr.Points2D(list(words), radii=pixels(0.0), colors=colors, labels=list(words.values()), show_labels=True)
        if time_s is None:
            self.fix(path, text)
        else:
            self.draw(path, time_s, text)

    def keeps_up(self, *, timeout_s: float) -> bool:
        """Return whether everything drawn is sent to the viewer within a timeout [s]."""
        try:
            self.stream.flush(timeout_sec=timeout_s)
        except (RuntimeError, ValueError):
            return False
        return True

    def plot(self, path: str, times_s: np.ndarray, columns: Iterable[Any]) -> None:
        """Draw many instants at once.

        Args:
            path: Entity path.
            times_s: Simulated times [s], shape (n,).
            columns: Result of an archetype's `columns`.
        """
        indexes = [rr.TimeColumn(SIMULATED, duration=np.round(times_s * 1e9).astype("timedelta64[ns]"))]
        wall = self.clock.at(times_s)
        if wall is not None:
            indexes.append(rr.TimeColumn(WALL, timestamp=np.round(wall * 1e9).astype("datetime64[ns]")))
        self.stream.send_columns(path, indexes=indexes, columns=columns)
