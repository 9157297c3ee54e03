"""Conversion of stream blocks to arrays of samples."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rig.base.samples import Samples
from rig.base.wire import EDGES, Block


def build_samples(
    blocks: Iterable[Block], *, name: str, names: tuple[str, ...], units: tuple[str, ...], rate_hz: float
) -> Samples:
    """Return the rows of blocks in their order, values unconverted.

    Args:
        blocks: The blocks.
        name: Name of the stream.
        names: Column names.
        units: Column units.
        rate_hz: Sampling rate if there are no blocks; otherwise that of the first block [Hz].
    """
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
    return Samples(name, times_s, index, values, names, units, blocks[0].rate_hz if blocks else rate_hz)


def row_times_s(key: str, block: Block) -> np.ndarray:
    """Return the simulated time of each row of a block [s], shape (rows,); for edges the time of the edge."""
    if key == EDGES:
        return (block.tick + block.values[:, 0]) / block.tick_rate_hz
    return block.times_s
