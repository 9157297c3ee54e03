"""Lattice of classes: points of a square grid, refined only in cells at a border between classes.

A cell is divided if any two known points in it, or on its edges, have different classes. Its neighbours are divided
once with it, down to a given level, as a border may pass through them between their corners. A region without a corner
in it is not found.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

UNKNOWN = -1


class Lattice:
    """Classes on the finest grid of each panel, and the cells in use.

    Attributes:
        size: Number of the finest cells along an axis.
        levels: Number of times that a cell can be divided.
        codes: Class of each point, shape (panels, size + 1, size + 1); `UNKNOWN` where it was not evaluated.
    """

    def __init__(self, panels: int, cells: int, levels: int, *, margins: int) -> None:
        """Create a lattice without points.

        Args:
            panels: Number of panels.
            cells: Number of coarse cells along an axis.
            levels: Number of times that a cell can be divided.
            margins: Number of levels at which the neighbours of border cells are divided too.
        """
        self.size, self.levels, self._margins = cells << levels, levels, margins
        self.codes = np.full((panels, self.size + 1, self.size + 1), UNKNOWN, np.int16)
        self._divided = [np.zeros((panels, cells << level, cells << level), bool) for level in range(levels)]

    def refine(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield level and missing points (panel, row, column), shape (n, 3), whose classes must be set before the next.

        The last passes go through all levels again, as points of fine cells lie on edges of coarse ones.
        """
        needed, step = np.zeros(self.codes.shape, bool), 1 << self.levels
        needed[:, ::step, ::step] = True
        yield 0, np.argwhere(needed)
        changed = True
        while changed:
            changed = False
            for level, divided in enumerate(self._divided):
                marked = self._is_border(level)
                marked = (_widen(marked) if level < self._margins else marked) & self._exists(level) & ~divided
                if marked.any():
                    changed = True
                    divided |= marked
                    yield level + 1, np.argwhere(self._find_points(marked, level) & (self.codes == UNKNOWN))

    def paint(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the class of each finest cell, and whether it is a border cell, both of shape (panels, size, size).

        The class of a border cell is that of its first corner.
        """
        classes, border = self.codes[:, :-1, :-1].copy(), np.zeros_like(self.codes[:, :-1, :-1], bool)
        for level in range(self.levels + 1):
            leaves = self._exists(level)
            if level < self.levels:
                leaves = leaves & ~self._divided[level]
            step = 1 << (self.levels - level)
            fine = leaves.repeat(step, 1).repeat(step, 2)
            classes[fine] = self.codes[:, :-1:step, :-1:step].repeat(step, 1).repeat(step, 2)[fine]
            border[fine] = self._is_border(level).repeat(step, 1).repeat(step, 2)[fine]
        return classes, border

    def shares(self, classes: np.ndarray, border: np.ndarray, count: int) -> np.ndarray:
        """Return the share of each class, shape (panels, count); corners share the area of a border cell."""
        shares = np.zeros((len(classes), count))
        corners = [self.codes[:, i : self.size + i, j : self.size + j] for i, j in product((0, 1), (0, 1))]
        for code in range(count):
            parts = np.mean([corner == code for corner in corners], axis=0)
            shares[:, code] = np.where(border, parts, classes == code).mean(axis=(1, 2))
        return shares

    def _exists(self, level: int) -> np.ndarray:
        if level == 0:
            cells = self.size >> self.levels
            return np.ones((len(self.codes), cells, cells), bool)
        return self._divided[level - 1].repeat(2, 1).repeat(2, 2)

    def _is_border(self, level: int) -> np.ndarray:
        step = 1 << (self.levels - level)
        known = np.where(self.codes == UNKNOWN, np.iinfo(np.int16).max, self.codes)
        return _reduce(known, step, np.minimum) != _reduce(self.codes, step, np.maximum)

    def _find_points(self, marked: np.ndarray, level: int) -> np.ndarray:
        half, points = 1 << (self.levels - level - 1), np.zeros(self.codes.shape, bool)
        panel, row, column = np.nonzero(marked)
        for down, right in product(range(3), range(3)):
            points[panel, (2 * row + down) * half, (2 * column + right) * half] = True
        return points


def _reduce(values: np.ndarray, step: int, function: Any) -> np.ndarray:
    """Reduce the points of each cell of a size, those on its edges included."""
    for axis in (1, 2):
        lines = np.moveaxis(values, axis, -1)
        inner = lines[..., :-1].reshape(*lines.shape[:-1], -1, step)
        values = np.moveaxis(function(function.reduce(inner, axis=-1), lines[..., step::step]), -1, axis)
    return values


def _widen(cells: np.ndarray) -> np.ndarray:
    padded = np.pad(cells, ((0, 0), (1, 1), (1, 1)))
    rows, columns = cells.shape[1:]
    return np.any([padded[:, i : rows + i, j : columns + j] for i, j in product(range(3), range(3))], axis=0)
