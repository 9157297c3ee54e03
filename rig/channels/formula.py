"""Signals that a user makes of the model's: `signal = "along(shaft_x(0.3), shaft_y(0.3), 45) + runout(theta)"`.

A formula is an expression in the names of the model's signals, its parameters in SI (`shaft.arm_disk`), numbers, and
the functions below. It is read, never run as code: only what is listed here has a meaning.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rig.base.errors import InputError, UnknownNameError
from rig.channels.table import ChannelTable, Group
from rig.physics.kernels.signals import COLUMN, N_ROW

_LONGEST = 500
_DEEPEST = 30

_Part = Callable[[np.ndarray], Any] | float
"""Part of a formula: its values at rows, or a number."""


def _apply(act: Callable[..., Any], *parts: _Part) -> _Part:
    """Return a function of parts as a part; it is computed once, now, if each of them is a number."""
    if not any(map(callable, parts)):
        with np.errstate(all="ignore"):
            return act(*parts)
    return lambda rows: act(*[part(rows) if callable(part) else part for part in parts])


def _along(x: _Part, y: _Part, degrees: _Part) -> _Part:
    """Return what a sensor at an angle measures of a horizontal and a vertical signal."""
    angle = _apply(np.radians, degrees)
    return _apply(np.add, _apply(np.multiply, x, _apply(np.cos, angle)), _apply(np.multiply, y, _apply(np.sin, angle)))


FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "abs": (1, np.abs),
    "atan2": (2, np.arctan2),
    "cos": (1, np.cos),
    "exp": (1, np.exp),
    "hypot": (2, np.hypot),
    "max": (2, np.maximum),
    "min": (2, np.minimum),
    "sign": (1, np.sign),
    "sin": (1, np.sin),
    "sqrt": (1, np.sqrt),
    "along": (3, _along),
}
"""Functions of a formula: how many arguments they take, and what they do; `along` takes and returns parts."""
PLACES = {"shaft_x": "disk_x", "shaft_y": "disk_y"}
"""The shaft at a distance from the pivot [m]: it is rigid, so `shaft_x(arm)` is the disk's by the ratio of the arms."""
_FARTHEST = 2.0
"""No place is farther from the pivot than so many times the disk."""
_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.USub: np.negative,
    ast.UAdd: np.positive,
}

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


class Formulas:
    """The formulas of some channels.

    Args:
        parameters: Values by name, SI.
        curves: Functions of an angle [rad], periodic in a turn: points (degrees, value).
    """

    def __init__(
        self,
        parameters: Mapping[str, float] | None = None,
        curves: Mapping[str, Curve] | None = None,
    ) -> None:
        self._parameters = parameters or {}
        for name in curves or {}:
            if name in {*FUNCTIONS, *PLACES, *COLUMN, "pi"}:
                raise InputError(f"curves.{name}", "of a name that no signal and no function has", name)
        self._curves = {name: np.array(points, float).T for name, points in (curves or {}).items()}
        self._made: list[_Part] = []

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
        if len(signal) > _LONGEST:
            raise InputError(field, f"a formula of at most {_LONGEST} characters", len(signal))
        try:
            tree = ast.parse(signal.strip(), mode="eval").body
        except (SyntaxError, ValueError, MemoryError, RecursionError):
            raise InputError(field, "one of the model's signals, or a formula of them", signal) from None
        self._made.append(self._read(tree, field, signal, 0))
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

    def _read(self, node: ast.AST, field: str, signal: str, depth: int) -> _Part:
        def inner(each: ast.AST) -> _Part:
            return self._read(each, field, signal, depth + 1)

        if depth > _DEEPEST:
            raise InputError(field, f"nested at most {_DEEPEST} deep", signal[:60])
        match node:
            case ast.Constant(value=bool()):
                pass
            case ast.Constant(value=int() | float() as value) if abs(value) < 1e300:
                return np.float64(value)
            case ast.Name(id=name) if name in COLUMN:
                column = COLUMN[name]
                return lambda rows: rows[:, column]
            case ast.Name(id="pi"):
                return math.pi
            case ast.Name(id=name):
                raise UnknownNameError(field, "made of the model's signals", name, [*COLUMN, *FUNCTIONS, *PLACES])
            case ast.Attribute(value=ast.Name(id=table), attr=key):
                name = f"{table}.{key}"
                if name not in self._parameters:
                    raise UnknownNameError(field, "made of the parameters that are numbers", name, self._parameters)
                return np.float64(self._parameters[name])
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
                return _apply(_OPERATORS[type(op)], inner(operand))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                return _apply(_OPERATORS[type(op)], inner(left), inner(right))
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                return self._call(name, [inner(each) for each in args], field)
        raise InputError(field, "made of numbers, signals, parameters, + - * / ** and functions", signal[:60])

    def _call(self, name: str, of: list[_Part], field: str) -> _Part:
        known = {**{key: count for key, (count, _) in FUNCTIONS.items()}, **dict.fromkeys([*PLACES, *self._curves], 1)}
        if name not in known:
            raise UnknownNameError(field, "made of the functions", name, known)
        if len(of) != known[name]:
            raise InputError(field, f"{name} of {known[name]} argument{'s' * (known[name] > 1)}", len(of))
        if name in FUNCTIONS:
            act = FUNCTIONS[name][1]
            return act(*of) if act is _along else _apply(act, *of)
        if name in PLACES:
            column, arm = COLUMN[PLACES[name]], self._parameters["shaft.arm_disk"]
            distance = of[0](np.zeros((1, len(COLUMN)))) if callable(of[0]) else of[0]
            place = float(np.ravel(distance)[0])
            if not abs(place) <= _FARTHEST * arm:  # so are millimetres told from metres
                raise InputError(field, f"{name} of a distance from the pivot within {_FARTHEST * arm:.3g} m", place)
            return _apply(np.multiply, _apply(np.divide, of[0], arm), lambda rows: rows[:, column])
        return _apply(_periodic(self._curves[name]), _apply(np.degrees, of[0]))


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
