"""Arrays in unnamed temporary files, written and read in blocks: memory does not depend on the length of a log."""

from __future__ import annotations

import math
import mmap
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import IO
from weakref import finalize

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
                self._file = tempfile.TemporaryFile()  # noqa: SIM115 - an array has a copy of its descriptor
                finalize(self, self._file.close)
            if self._file.fileno() > _MAX_FILES:
                self._file.close()
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


def transform(function: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """Return a function of arrays of equal length, computed and stored in blocks of rows."""
    rows = len(arrays[0])
    return spool(function(*(each[part] for each in arrays)) for part in blocks(rows, *arrays))


def find_rows(condition: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    """Return the numbers of the rows in which a condition holds."""
    return spool(rows.start + np.flatnonzero(condition(values[rows])) for rows in blocks(len(values), values))


def are_equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two arrays have equal rows."""
    return len(a) == len(b) and all(np.array_equal(a[rows], b[rows]) for rows in blocks(len(a), a, b))


def steps_of(values: np.ndarray) -> np.ndarray:
    """Return np.diff of values, shape (n,)."""
    return spool(np.diff(values[rows.start : rows.stop + 1]) for rows in blocks(len(values) - 1, values))


def running_sum(counts: np.ndarray) -> np.ndarray:
    """Return 0 and the sums of the first 1, 2, ... whole numbers, of their type, shape (n + 1,)."""
    sums, last = Spool(), counts[:0].sum()
    sums.add(np.array([last]))
    for rows in blocks(len(counts), counts):
        sums.add(last + np.cumsum(counts[rows]))
        last += counts[rows].sum()
    return sums.array()


def find_median(values: np.ndarray) -> float:
    """Return np.median of float64 values without nan, by the digits of their bits; nan if there is none."""
    if len(values) <= ROWS:
        return float(np.median(values)) if len(values) else math.nan
    middle = []
    for rank in ((len(values) - 1) // 2, len(values) // 2):
        key = 0
        for shift in (48, 32, 16, 0):
            counts = np.zeros(1 << 16, dtype=np.int64)
            for rows in blocks(len(values), values):
                bits = np.ascontiguousarray(values[rows]).view(np.uint64)
                keys = np.where(bits >> 63, ~bits, bits | 1 << 63)  # in the order of the values
                keys = keys if shift == 48 else keys[keys >> (shift + 16) == key]
                counts += np.bincount((keys >> shift & 0xFFFF).astype(np.int64), minlength=1 << 16)
            ends = np.cumsum(counts)
            digit = int(np.searchsorted(ends, rank, side="right"))
            rank, key = rank - int(ends[digit] - counts[digit]), key << 16 | digit
        middle.append(np.uint64(key ^ 1 << 63 if key >> 63 else ~key & (1 << 64) - 1).view(np.float64))
    return float(np.mean(middle))


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
    return add_up(values) / valid if valid else float("nan")


def add_up(values: np.ndarray) -> float:
    """Return np.nansum of values; the order of additions is that of numpy."""
    if len(values) > ROWS:
        half = len(values) // 2
        half -= half % 8
        return add_up(values[:half]) + add_up(values[half:])
    total = float(np.nansum(values))
    release(values)
    return total
