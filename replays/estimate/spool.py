"""Arrays in unnamed temporary files, written and read in blocks: memory does not depend on the length of a log."""

from __future__ import annotations

import math
import mmap
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from typing import IO

import numpy as np

from rig.base.errors import InputError, Words

ROWS = 1 << 16
"""Rows of a block."""
_MEMORY_BYTES, _MAX_FILES = 1 << 20, 500
"""Size from which an array is in a file, and largest file number: a process may have 1024 files."""


class Spool:
    """Array that grows at its end; from 1 MB on it is in a temporary file, which is removed with the array."""

    def __init__(self) -> None:
        self._parts: list[np.ndarray] = []
        self._file: IO[bytes] | None = None
        self._rows = self._bytes = 0

    def add(self, part: np.ndarray) -> None:
        """Add rows; integers become floating point once a part is.

        Raises:
            InputError: The folder of temporary files cannot take them.
        """
        if self._parts and (kind := np.result_type(self._parts[0], part)) != self._parts[0].dtype:
            earlier = self.array()
            self.__init__()
            for rows in blocks(len(earlier), earlier):
                self.add(earlier[rows].astype(kind))
        self._parts.append(part.astype(self._parts[0].dtype if self._parts else part.dtype, copy=False))
        self._rows, self._bytes = self._rows + len(part), self._bytes + self._parts[-1].nbytes
        if self._file is None and self._bytes <= _MEMORY_BYTES:
            return
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115 - the array keeps it open
            if self._file.fileno() > _MAX_FILES:
                self._file = None
                return
            for each in self._parts:
                self._file.write(np.ascontiguousarray(each).tobytes())
            self._file.flush()
        except OSError as error:
            must = "a folder with room for the samples of the log (set TMPDIR)"
            raise InputError(tempfile.gettempdir(), must, Words(error)) from None
        self._parts = [self._parts[0][:0]]

    def array(self) -> np.ndarray:
        """Return all rows; pages of a file that were read stay in memory until `release`."""
        if self._file is None:
            return np.concatenate(self._parts)
        return np.memmap(self._file, self._parts[0].dtype, "r", shape=(self._rows, *self._parts[0].shape[1:]))


def spool(parts: Iterable[np.ndarray]) -> np.ndarray:
    """Return the rows of one part or more, in a temporary file if they are many.

    Raises:
        InputError: The folder of temporary files cannot take them.
    """
    spooled = Spool()
    for part in parts:
        spooled.add(part)
    return spooled.array()


def release(*arrays: np.ndarray) -> None:
    """Remove from memory what was read of spooled arrays."""
    for array in arrays:
        if (mapped := getattr(array, "_mmap", None)) is not None:
            mapped.madvise(mmap.MADV_DONTNEED)


def blocks(rows: int, *arrays: np.ndarray, size: int = ROWS) -> Iterator[slice]:
    """Yield slices of rows, one or more, and release the arrays after each."""
    for start in range(0, max(rows, 1), size):
        yield slice(start, min(start + size, rows))
        release(*arrays)


def find_extent(values: np.ndarray, offset: float = 0.0) -> tuple[float, float]:
    """Return the lowest and the highest value above an offset, without nan; nan if there is none."""
    with warnings.catch_warnings(action="ignore"):  # of blocks without values
        ends = [
            (np.nanmin(part), np.nanmax(part))
            for rows in blocks(len(values), values)
            if len(part := values[rows] - offset)
        ]
        return (float(np.nanmin(ends)), float(np.nanmax(ends))) if ends else (math.nan, math.nan)


def nan_mean(values: np.ndarray) -> float:
    """Return np.nanmean of values, shape (n,), to the last digit."""
    valid = sum(np.count_nonzero(~np.isnan(values[rows])) for rows in blocks(len(values), values))
    return _add_up(values) / valid if valid else float("nan")


def _add_up(values: np.ndarray) -> float:
    """Return np.nansum of values; the order of additions is that of numpy."""
    if len(values) > ROWS:
        half = len(values) // 2
        half -= half % 8
        return _add_up(values[:half]) + _add_up(values[half:])
    total = float(np.nansum(values))
    release(values)
    return total
