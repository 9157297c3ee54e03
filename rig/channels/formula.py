"""Signals that a user makes of the model's: `signal = "along(shaft_x(0.3), shaft_y(0.3), 45) + runout(theta)"`.

A formula is an expression in the names of the model's signals, its parameters in SI (`shaft.arm_disk`), numbers, and
the functions below. It is read, never run as code: only what is listed here has a meaning.
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


def _along(x: Part, y: Part, degrees: Part) -> Part:
    """Return what a sensor at an angle measures of a horizontal and a vertical signal."""
    angle = apply(np.radians, degrees)
    return apply(np.add, apply(np.multiply, x, apply(np.cos, angle)), apply(np.multiply, y, apply(np.sin, angle)))


PLACES = {"shaft_x": "disk_x", "shaft_y": "disk_y"}
"""The shaft at a distance from the pivot [m]: it is rigid, so `shaft_x(arm)` is the disk's by the ratio of the arms."""
_FARTHEST = 2.0
"""No place is farther from the pivot than so many times the disk."""

Curve = Sequence[tuple[float, float]]


def names_in(signal: str) -> set[str]:
    """Return the names in a channel's signal, be it one of the model's or a formula, with those that places read."""
    names = set(re.findall(r"[^\W\d]\w*", signal))
    return names | {PLACES[name] for name in names & PLACES.keys()}


def check_computed(needed: Mapping[str, Iterable[str]], row: np.ndarray, *, engine: str) -> tuple[str, ...]:
    """Return the names of the model's signals that a run computes, and refuse others.

    Args:
        needed: Names by the field that asks for them; those that are no signals of the model are passed over.
        row: Observed row at the run's start, shape (N_ROW,): nan where no stage has written.
        engine: Name of its engine.

    Raises:
        InputError: A field asks for a signal that is not computed.
    """
    missing = {name for name, value in zip(COLUMN, row, strict=True) if math.isnan(value)}
    for field, names in needed.items():
        for name in sorted(missing.intersection(names)):
            must = f"a signal that engine {engine} computes (its line in rig/physics/kernels/observe.py is missing)"
            raise InputError(field, must, name)
    return tuple(name for name in COLUMN if name not in missing)


class Formulas(Grammar):
    """The formulas of some channels; a part of one takes observed rows, shape (n, N_ROW).

    Args:
        parameters: Values by name, SI.
        curves: Functions of an angle [rad], periodic in a turn: points (degrees, value).
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
            if name in {*FUNCTIONS, "along", *PLACES, *COLUMN, "pi"}:
                raise InputError(f"curves.{name}", "of a name that no signal and no function has", name)
        self._curves = {name: np.array(points, float).T for name, points in (curves or {}).items()}
        self._made: list[Part] = []

    def column(self, channel: str, signal: str) -> int:
        """Column of a signal: the model's, or that of a formula behind those.

        Raises:
            InputError: It is neither a signal of the model nor a formula.
        """
        if signal in COLUMN:
            return COLUMN[signal]
        field = f"channel {channel}.signal"
        if signal.isidentifier():
            raise UnknownNameError(field, "one of the model's, or a formula of them", signal, COLUMN)
        self._made.append(self.read(signal, field))
        return N_ROW + len(self._made) - 1

    def columns(self, groups: Iterable[Group]) -> list[int]:
        """Columns of the signals of all channels of some groups, in their order, as `column`."""
        return [self.column(channel.name, channel.signal) for group in groups for channel in group.channels]

    def check(self, table: ChannelTable) -> None:
        """Refuse channels that feel neither a signal of the model nor a formula.

        Raises:
            InputError: The first of them.
        """
        self.columns(table.groups.values())

    def knows(self, channel: str, signal: str) -> bool:
        """Whether there is such a signal, or it is a formula."""
        try:
            self.column(channel, signal)
        except InputError:
            return False
        return True

    def values(self, rows: np.ndarray) -> np.ndarray:
        """All formulas at observed rows, shape (n, formulas); where one is no finite number, it is 0."""
        found = np.empty((len(rows), len(self._made)))
        if self._made:
            with np.errstate(all="ignore"):
                for n, part in enumerate(self._made):
                    found[:, n] = part(rows) if callable(part) else part
            found[~np.isfinite(found)] = 0.0
        return found

    def name(self, name: str, field: str) -> Part:
        """Return a signal of the model."""
        if name not in COLUMN:
            raise UnknownNameError(field, "made of the model's signals", name, [*COLUMN, *self.functions()])
        column = COLUMN[name]
        return lambda rows: rows[:, column]

    def member(self, table: str, key: str, field: str) -> Part:
        """Return the value of a parameter."""
        name = f"{table}.{key}"
        if name not in self._parameters:
            raise UnknownNameError(field, "made of the parameters that are numbers", name, self._parameters)
        return np.float64(self._parameters[name])

    def functions(self) -> Mapping[str, int]:
        """Numbers of arguments of all functions, with places and curves."""
        return {**super().functions(), "along": 3, **dict.fromkeys([*PLACES, *self._curves], 1)}

    def call(self, name: str, of: list[Part], field: str) -> Part:
        """Return a function of parts."""
        if name == "along":
            return _along(*of)
        if name in PLACES:
            column, arm = COLUMN[PLACES[name]], self._parameters["shaft.arm_disk"]
            distance = of[0](np.zeros((1, len(COLUMN)))) if callable(of[0]) else of[0]
            place = float(np.ravel(distance)[0])
            if not abs(place) <= _FARTHEST * arm:  # so are millimetres told from metres
                raise InputError(field, f"{name} of a distance from the pivot within {_FARTHEST * arm:.3g} m", place)
            return apply(np.multiply, apply(np.divide, of[0], arm), lambda rows: rows[:, column])
        if name in self._curves:
            return apply(_periodic(self._curves[name]), apply(np.degrees, of[0]))
        return super().call(name, of, field)


def _periodic(curve: np.ndarray) -> Callable[[Any], Any]:
    """Return the straight lines through points (degrees, value), shape (2, n), periodic in a turn.

    The result is that of numpy.interp with a period, which sorts the points in every call.
    """
    degrees, values = curve[0] % 360.0, curve[1]
    order = np.argsort(degrees)
    degrees, values = degrees[order], values[order]
    degrees = np.concatenate([degrees[-1:] - 360.0, degrees, degrees[:1] + 360.0])
    values = np.concatenate([values[-1:], values, values[:1]])
    return lambda angle: np.interp(angle % 360.0, degrees, values)
