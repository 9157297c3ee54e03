"""One rerun recording, with simulated and wall time under everything that is drawn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr

from recorder.viewer.clock import WallClock

APPLICATION = "rig"
SIMULATED = "simulated_time"
WALL = "wall_time"
PICTURE = "picture"
"""Counts what was drawn live, for a viewer to tell how far it is: simulated time may jump, as in a replay."""
Place = tuple[float, float]
RGB = tuple[int, int, int]


def new_stream(name: str, *, batch_s: float = 0.1) -> rr.RecordingStream:
    """A recording stream named `name` that is connected to nothing yet.

    What is drawn of one thing within `batch_s` [s] leaves together: a viewer takes long for many pieces, not for large
    ones.
    """
    stream = rr.RecordingStream(APPLICATION, batcher_config=rr.ChunkBatcherConfig(flush_tick=batch_s))
    # rerun's own time of logging would stand as a third time line that means nothing to the reader.
    stream.set_log_time_enabled(False)
    stream.send_recording_name(name)
    return stream


def pixels(size: float) -> list[float]:
    """A radius in points of the screen, whatever the zoom: rerun takes negative radii for that."""
    return [-size]


class Canvas:
    """Logs to a stream; every time is simulated time [s]."""

    def __init__(self, stream: rr.RecordingStream, clock: WallClock | None = None) -> None:
        self.stream = stream
        self.clock = WallClock() if clock is None else clock
        self.picture = 0
        """Number of the picture that is being drawn; 0 where pictures are not counted."""

    def fix(self, path: str, *what: Any) -> None:
        """Draw something that holds for all times."""
        self.stream.log(path, what[0], *what[1:], static=True)

    def draw(self, path: str, time_s: float, *what: Any) -> None:
        """Draw something that holds from an instant on."""
        self.stream.set_time(SIMULATED, duration=time_s)
        if self.picture:
            self.stream.set_time(PICTURE, sequence=self.picture)
        wall = self.clock.at(np.array([time_s]))
        if wall is not None:
            self.stream.set_time(WALL, timestamp=float(wall[0]))
        self.stream.log(path, what[0], *what[1:])

    def write(self, path: str, words: dict[Place, str], colors: Sequence[RGB], *, time_s: float | None = None) -> None:
        """Write words at places of a 2-D view; without a time [s] they hold for all times."""
        text = rr.Points2D(list(words), radii=pixels(0.0), colors=colors, labels=list(words.values()), show_labels=True)
        if time_s is None:
            self.fix(path, text)
        else:
            self.draw(path, time_s, text)

    def keeps_up(self, *, timeout_s: float) -> bool:
        """Whether all that was drawn so far leaves for the viewer within that time; what does not, piles up here."""
        try:
            self.stream.flush(timeout_sec=timeout_s)
        except (RuntimeError, ValueError):
            return False
        return True

    def plot(self, path: str, times_s: np.ndarray, columns: Iterable[Any]) -> None:
        """Draw many instants at once; `columns` comes from an archetype's `columns`."""
        indexes = [rr.TimeColumn(SIMULATED, duration=np.round(times_s * 1e9).astype("timedelta64[ns]"))]
        wall = self.clock.at(times_s)
        if wall is not None:
            indexes.append(rr.TimeColumn(WALL, timestamp=np.round(wall * 1e9).astype("datetime64[ns]")))
        self.stream.send_columns(path, indexes=indexes, columns=columns)
