"""Waveform played by a generator: read from a CSV file in the format of `rig export`, interpolated by a spline."""

from __future__ import annotations

import csv
from fractions import Fraction
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from rig.base.checks import Written
from rig.base.errors import InputError, Words
from rig.base.files import read_file

_MAX_VALUES, _MAX_FILE_BYTES = 200_000, 8 << 20
"""Limits of a waveform's values and of its file size [bytes]; each recording contains the waveform."""
_FIELD = "generator.file"


def exact(number: float) -> Fraction:
    """Return a number as the exact fraction of its shortest decimal form."""
    return Fraction(repr(float(number)))


class Waveform(Written):
    """Values of channels in their own units at one rate, played repeatedly."""

    rate_hz: Annotated[FiniteFloat, Field(ge=1e-6, le=1e6)]
    units: dict[str, str]
    values: dict[str, tuple[FiniteFloat, ...]]

    @model_validator(mode="after")
    def _check_lengths(self) -> Waveform:
        lengths = {len(values) for values in self.values.values()}
        if len(lengths) != 1 or min(lengths) < 4 or self.units.keys() != self.values.keys():
            raise InputError(_FIELD, "of columns of one length, at least 4 rows, each with its unit", sorted(lengths))
        return self

    @property
    def period(self) -> Fraction:
        """Length [s]."""
        return len(next(iter(self.values.values()))) / exact(self.rate_hz)

    def spline(self, name: str) -> np.ndarray:
        """Return the coefficients of a channel's periodic cubic spline, highest power first, shape (4, n)."""
        from scipy.interpolate import CubicSpline

        closed = np.array([*self.values[name], self.values[name][0]])
        return CubicSpline(np.arange(len(closed)), closed, bc_type="periodic").c


def read_waveform(path: Path) -> Waveform:
    """Return the waveform of a CSV file with the headings `time [s]` and `NAME [unit]`, and rows at one rate.

    Raises:
        InputError: The file cannot be read or is not such a file.
    """
    try:
        data = read_file(path, _MAX_FILE_BYTES)
    except OSError as error:
        raise InputError(_FIELD, "a file that can be read", Words(f"{path} ({error.strerror})")) from None
    try:
        headings, *rows = [row for row in csv.reader(data.decode("utf-8-sig").splitlines()) if row]
        numbers = np.array(rows, dtype=float)
    except (ValueError, csv.Error) as error:
        raise InputError(_FIELD, "a CSV file of headings and rows of numbers", Words(f"{path} ({error})")) from None
    if numbers.ndim != 2 or not headings[0].startswith("time") or not np.isfinite(numbers).all():
        raise InputError(_FIELD, "with a first column `time [s]` and a number in every field", str(path))
    if len(numbers) < 4 or numbers[:, 1:].size > _MAX_VALUES:
        received = Words(f"{len(numbers)} rows of {numbers.shape[1] - 1}")
        raise InputError(_FIELD, f"of 4 rows at least, and {_MAX_VALUES} numbers at most", received)
    times_s = numbers[:, 0]
    rate_hz = round((len(times_s) - 1) / float(times_s[-1] - times_s[0] or 1.0), 6)
    if not 1e-6 <= rate_hz <= 1e6 or np.ptp(times_s - np.arange(len(times_s)) / rate_hz) > 0.01 / rate_hz:
        raise InputError(_FIELD, "of rows at one rate", str(path))
    columns = [heading.partition(" [") for heading in headings[1:]]
    return Waveform(
        rate_hz=rate_hz,
        units={name: unit.removesuffix("]") for name, _, unit in columns},
        values={name: tuple(numbers[:, c + 1].tolist()) for c, (name, _, _) in enumerate(columns)},
    )
