"""Formulas of the model's signals: `signal = "along(shaft_x(0.3), shaft_y(0.3), 45) + runout(theta)"`.

A formula is an expression of the model's signals, its parameters in SI (`shaft.arm_disk`), numbers, and the functions
below. It is parsed and never executed as code; only these names are valid.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rig.base.errors import InputError, UnknownNameError
from rig.base.maths.expression import FUNCTIONS, Grammar, Part, apply
from rig.channels.table import ChannelTable, Group
from rig.physics.kernels.signals import COLUMN, N_ROW


def _project(x: Part, y: Part, degrees: Part) -> Part:
    """Return the component of a horizontal and a vertical signal along a sensor at an angle."""
    angle = apply(np.radians, degrees)
    return apply(np.add, apply(np.multiply, x, apply(np.cos, angle)), apply(np.multiply, y, apply(np.sin, angle)))


SHAFT_FUNCTIONS = {"shaft_x": "disk_x", "shaft_y": "disk_y"}
"""Functions of a distance from the pivot [m]: the rigid shaft scales `disk_x` to `shaft_x(arm)` by the arms' ratio."""
_MAX_REACH = 2.0
"""Largest distance from the pivot, in multiples of the disk's; detects millimetres given as metres."""

Curve = Sequence[tuple[float, float]]


def find_names(signal: str) -> set[str]:
    """Return the names in a channel's signal or formula, including signals used by `SHAFT_FUNCTIONS`."""
    names = set(re.findall(r"[^\W\d]\w*", signal))
    return names | {SHAFT_FUNCTIONS[name] for name in names & SHAFT_FUNCTIONS.keys()}


def check_computed(needed: Mapping[str, Iterable[str]], row: np.ndarray, *, engine: str) -> tuple[str, ...]:
    """Return the names of the model's signals that a run computes, and refuse any other that is needed.

    Args:
        needed: Names by the field that needs them; names that are not signals of the model are ignored.
        row: Observed row at the start of the run, shape (N_ROW,), nan for signals that are not computed.
        engine: Name of the engine.

    Raises:
        InputError: A field needs a signal that is not computed.
    """
    missing = {name for name, value in zip(COLUMN, row, strict=True) if math.isnan(value)}
    for field, names in needed.items():
        for name in sorted(missing.intersection(names)):
            must = f"a signal that engine {engine} computes (its line in rig/physics/kernels/observe.py is missing)"
            raise InputError(field, must, name)
    return tuple(name for name in COLUMN if name not in missing)


class Formulas(Grammar):
    """Formulas of some channels. A compiled part maps observed rows, shape (n, N_ROW), to values.

    Args:
        parameters: Values by name, SI.
        curves: Periodic functions of an angle [rad] by name, as points (degrees, value).
    """

    what = "one of the model's signals, or a formula of them"
    made_of = "numbers, signals, parameters, + - * / ** and functions"

    def __init__(
        self,
        parameters: Mapping[str, float] | None = None,
        curves: Mapping[str, Curve] | None = None,
    ) -> None:
        super().__init__()
        self._parameters = parameters or {}
        for name in curves or {}:
            if name in {*FUNCTIONS, "along", *SHAFT_FUNCTIONS, *COLUMN, "pi"}:
                raise InputError(f"curves.{name}", "of a name that no signal and no function has", name)
        self._curves = {name: np.array(points, float).T for name, points in (curves or {}).items()}
        self._formulas: list[Part] = []

    def column(self, channel: str, signal: str) -> int:
        """Return the column of a signal: the model's own, or one after them for a formula.

        Raises:
            InputError: The text is neither a signal of the model nor a valid formula.
        """
        if signal in COLUMN:
            return COLUMN[signal]
        field = f"channel {channel}.signal"
        if signal.isidentifier():
            raise UnknownNameError(field, "one of the model's, or a formula of them", signal, COLUMN)
        self._formulas.append(self.read(signal, field))
        return N_ROW + len(self._formulas) - 1

    def columns(self, groups: Iterable[Group]) -> list[int]:
        """Return the columns of all channels of some groups, in order; see `column`."""
        return [self.column(channel.name, channel.signal) for group in groups for channel in group.channels]

    def check(self, table: ChannelTable) -> None:
        """Refuse channels whose signal is neither one of the model nor a valid formula.

        Raises:
            InputError: The message names the first such channel.
        """
        self.columns(table.groups.values())

    def is_valid(self, channel: str, signal: str) -> bool:
        """Return whether a signal exists or is a valid formula."""
        try:
            self.column(channel, signal)
        except InputError:
            return False
        return True

    def values(self, rows: np.ndarray) -> np.ndarray:
        """Return all formulas at observed rows, shape (n, formulas); values that are not finite become 0."""
        values = np.empty((len(rows), len(self._formulas)))
        if self._formulas:
            with np.errstate(all="ignore"):
                for n, part in enumerate(self._formulas):
                    values[:, n] = part(rows) if callable(part) else part
            values[~np.isfinite(values)] = 0.0
        return values

    def name(self, name: str, field: str) -> Part:
        """Return a signal of the model."""
        if name not in COLUMN:
            raise UnknownNameError(field, "a formula with signals of the model", name, [*COLUMN, *self.functions()])
        column = COLUMN[name]
        return lambda rows: rows[:, column]

    def member(self, table: str, key: str, field: str) -> Part:
        """Return the value of a parameter."""
        name = f"{table}.{key}"
        if name not in self._parameters:
            raise UnknownNameError(field, "a formula with numeric parameters", name, self._parameters)
        return np.float64(self._parameters[name])

    def functions(self) -> Mapping[str, int]:
        """Return the number of arguments of each function, including `SHAFT_FUNCTIONS` and curves."""
        return {**super().functions(), "along": 3, **dict.fromkeys([*SHAFT_FUNCTIONS, *self._curves], 1)}

    def call(self, name: str, of: list[Part], field: str) -> Part:
        """Return the result of a function of parts."""
        if name == "along":
            return _project(*of)
        if name in SHAFT_FUNCTIONS:
            column, arm = COLUMN[SHAFT_FUNCTIONS[name]], self._parameters["shaft.arm_disk"]
            distance = of[0](np.zeros((1, len(COLUMN)))) if callable(of[0]) else of[0]
            arm_m = float(np.ravel(distance)[0])
            if not abs(arm_m) <= _MAX_REACH * arm:  # probably millimetres
                raise InputError(field, f"{name} of a distance from the pivot within {_MAX_REACH * arm:.3g} m", arm_m)
            return apply(np.multiply, apply(np.divide, of[0], arm), lambda rows: rows[:, column])
        if name in self._curves:
            return apply(_interpolate(self._curves[name]), apply(np.degrees, of[0]))
        return super().call(name, of, field)


def _interpolate(curve: np.ndarray) -> Callable[[Any], Any]:
    """Return the linear interpolation of points (degrees, value), shape (2, n), periodic in one turn.

    Equivalent to numpy.interp with a period, which would sort the points in every call.
    """
    degrees, values = curve[0] % 360.0, curve[1]
    order = np.argsort(degrees)
    degrees, values = degrees[order], values[order]
    degrees = np.concatenate([degrees[-1:] - 360.0, degrees, degrees[:1] + 360.0])
    values = np.concatenate([values[-1:], values, values[:1]])
    return lambda angle: np.interp(angle % 360.0, degrees, values)
