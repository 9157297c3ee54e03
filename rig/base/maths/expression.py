"""Expressions written by users, such as `1.5 * (1 - e)`; parsed, never executed as code.

Only the functions listed here, and the names of a grammar, are allowed.
"""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from rig.base.errors import InputError, UnknownNameError

MAX_LENGTH = 500
"""Longest expression [characters]."""
_MAX_NUMBER = 1e300
"""Limit of the numbers in an expression."""
_MAX_DEPTH = 30
"""Deepest nesting of an expression."""

Part = Callable[[Any], Any] | float
"""Part of an expression: a function of the variables, or a number."""


def apply(act: Callable[..., Any], *parts: Part) -> Part:
    """Return a function of parts as a part; it is evaluated now if all parts are numbers."""
    if not any(map(callable, parts)):
        with np.errstate(all="ignore"):
            return act(*parts)
    return lambda given: act(*[part(given) if callable(part) else part for part in parts])


FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "abs": (1, np.abs),
    "atan2": (2, np.arctan2),
    "cos": (1, np.cos),
    "exp": (1, np.exp),
    "hypot": (2, np.hypot),
    "log": (1, np.log),
    "max": (2, np.maximum),
    "min": (2, np.minimum),
    "sign": (1, np.sign),
    "sin": (1, np.sin),
    "sqrt": (1, np.sqrt),
}
"""Functions of an expression: number of arguments, and implementation for numbers or arrays."""
_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.USub: np.negative,
    ast.UAdd: np.positive,
}


class Grammar:
    """Meaning of the names in an expression: here variables, numbers, operators and functions.

    Args:
        variables: Names of the variables; their values are passed as a mapping.
    """

    what = "a formula"
    """Description for error messages."""
    made_of = "numbers, variables, + - * / ** and functions"

    def __init__(self, variables: Iterable[str] = ()) -> None:
        self._variables = tuple(variables)

    def read(self, text: str, field: str) -> Part:
        """Return an expression as a function of its variables, or as a number.

        Args:
            text: The expression.
            field: Field that has the expression, for errors.

        Raises:
            InputError: The expression is invalid, or has unknown names.
        """
        if len(text) > MAX_LENGTH:
            raise InputError(field, f"a formula of at most {MAX_LENGTH} characters", len(text))
        try:
            with warnings.catch_warnings(action="ignore"):  # about texts such as `1if`, which are refused below
                tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, MemoryError, RecursionError):
            raise InputError(field, self.what, text) from None
        return self._part(tree, field, text, 0)

    def name(self, name: str, field: str) -> Part:
        """Return the meaning of a name.

        Raises:
            UnknownNameError: The name is unknown.
        """
        if name not in self._variables:
            raise UnknownNameError(field, f"a formula with {self.made_of}", name, [*self._variables, *FUNCTIONS])
        return lambda given: given[name]

    def member(self, table: str, key: str, field: str) -> Part:
        """Return the meaning of a name with a dot.

        Raises:
            InputError: The name is unknown.
        """
        raise InputError(field, f"a formula with {self.made_of}", f"{table}.{key}")

    def functions(self) -> Mapping[str, int]:
        """Return the number of arguments of each function."""
        return {name: count for name, (count, _) in FUNCTIONS.items()}

    def call(self, name: str, of: list[Part], field: str) -> Part:
        """Return a function of the given number of parts.

        Raises:
            InputError: A part is not a valid argument.
        """
        return apply(FUNCTIONS[name][1], *of)

    def _part(self, node: ast.AST, field: str, text: str, depth: int) -> Part:
        def inner(each: ast.AST) -> Part:
            return self._part(each, field, text, depth + 1)

        if depth > _MAX_DEPTH:
            raise InputError(field, f"nested at most {_MAX_DEPTH} deep", text[:60])
        match node:
            case ast.Constant(value=bool()):
                pass
            case ast.Constant(value=int() | float() as value):
                if abs(value) >= _MAX_NUMBER:
                    raise InputError(field, f"a formula with numbers below {_MAX_NUMBER:g}", text[:60])
                return np.float64(value)
            case ast.Name(id="pi"):
                return math.pi
            case ast.Name(id=name):
                return self.name(name, field)
            case ast.Attribute(value=ast.Name(id=table), attr=key):
                return self.member(table, key, field)
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
                return apply(_OPERATORS[type(op)], inner(operand))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                return apply(_OPERATORS[type(op)], inner(left), inner(right))
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                arity = self.functions()
                if name not in arity:
                    raise UnknownNameError(field, "a formula with the functions", name, arity)
                if len(args) != arity[name]:
                    raise InputError(field, f"{name} of {arity[name]} argument{'s' * (arity[name] > 1)}", len(args))
                return self.call(name, [inner(each) for each in args], field)
        raise InputError(field, f"a formula with {self.made_of}", text[:60])


def value_of(part: Part, **variables: float) -> float:
    """Return the value of an expression; NaN if undefined."""
    with np.errstate(all="ignore"):
        return float(part(variables) if callable(part) else part)
