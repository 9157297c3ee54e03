"""Rows of a stream as columns of numbers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from rig.errors import InputError
from rig.wire import EDGES, Block


@dataclass(frozen=True)
class Samples:
    """One sensor group or truth table as columns.

    Attributes:
        name: Name of the group or table.
        times_s: Simulated time of each row [s], shape (n,).
        index: Number of each row since the start of the stream, int64, shape (n,); a step other than 1 is a gap.
        values: Engineering values, shape (n, columns).
        names: Column names.
        units: Column units.
        rate_hz: Rows per simulated second [Hz].
    """

    name: str
    times_s: np.ndarray
    index: np.ndarray
    values: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    rate_hz: float

    @classmethod
    def of(
        cls, blocks: Iterable[Block], *, name: str, names: tuple[str, ...], units: tuple[str, ...], rate_hz: float
    ) -> Self:
        """The rows of blocks, in their order, with values as they stand there; the rate is that of the first block."""
        blocks = list(blocks)
        values = np.empty((sum(len(block.values) for block in blocks), len(names)))
        times_s = np.empty(len(values))
        index = np.empty(len(values), dtype=np.int64)
        start = 0
        for block in blocks:
            rows = slice(start, start + len(block.values))
            values[rows] = block.values
            times_s[rows] = block.times_s
            index[rows] = np.arange(block.index, block.index + len(block.values))
            start = rows.stop
        return cls(name, times_s, index, values, names, units, blocks[0].rate_hz if blocks else rate_hz)

    def column(self, name: str) -> np.ndarray:
        """Values of one column, shape (n,).

        Raises:
            InputError: There is no such column.
        """
        if name not in self.names:
            raise InputError("column", f"one of {', '.join(self.names)}", name)
        return self.values[:, self.names.index(name)]


def row_times_s(key: str, block: Block) -> np.ndarray:
    """Simulated time of each row of a stream's block [s], shape (rows,): of an edge, where it was."""
    if key == EDGES:
        return (block.tick + block.values[:, 0]) / block.tick_rate_hz
    return block.times_s
