"""Expressions that a user writes, such as `1.5 * (1 - e)`: read, never run as code.

Only what is listed here, and the names that a grammar adds, has a meaning.
"""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from rig.base.errors import InputError, UnknownNameError

LONGEST = 500
"""Characters of an expression."""
_LARGEST = 1e300
"""Numbers of an expression are below this."""
_DEEPEST = 30
"""Parts of an expression inside each other."""

Part = Callable[[Any], Any] | float
"""Part of an expression: a function of the variables, as the grammar hands them on, or a number."""


def apply(act: Callable[..., Any], *parts: Part) -> Part:
    """Return a function of parts as a part; it is computed once, now, if each of them is a number."""
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
"""Functions of an expression: how many arguments they take, and what they do with numbers or arrays."""
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
    """What the names in an expression mean; this one knows variables, numbers, operators and functions.

    Args:
        variables: Names of the variables, whose values come as a mapping by name.
    """

    what = "a formula"
    """What a user is told to write."""
    made_of = "numbers, variables, + - * / ** and functions"

    def __init__(self, variables: Iterable[str] = ()) -> None:
        self._variables = tuple(variables)

    def read(self, text: str, field: str) -> Part:
        """Return an expression as a function of its variables, or as a number.

        Args:
            text: The expression.
            field: What it is the value of, for errors.

        Raises:
            InputError: It is none, or has names without a meaning.
        """
        if len(text) > LONGEST:
            raise InputError(field, f"a formula of at most {LONGEST} characters", len(text))
        try:
            with warnings.catch_warnings(action="ignore"):  # of what it reads, such as `1if`, and refuses below
                tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, MemoryError, RecursionError):
            raise InputError(field, self.what, text) from None
        return self._part(tree, field, text, 0)

    def name(self, name: str, field: str) -> Part:
        """Return the meaning of a name.

        Raises:
            UnknownNameError: It has none.
        """
        if name not in self._variables:
            raise UnknownNameError(field, f"made of {self.made_of}", name, [*self._variables, *FUNCTIONS])
        return lambda given: given[name]

    def member(self, table: str, key: str, field: str) -> Part:
        """Return the meaning of a name with a dot.

        Raises:
            InputError: It has none.
        """
        raise InputError(field, f"made of {self.made_of}", f"{table}.{key}")

    def functions(self) -> Mapping[str, int]:
        """Numbers of arguments of all functions."""
        return {name: count for name, (count, _) in FUNCTIONS.items()}

    def call(self, name: str, of: list[Part], field: str) -> Part:
        """Return a function of parts, of which there are as many as it takes.

        Raises:
            InputError: A part is not what the function takes.
        """
        return apply(FUNCTIONS[name][1], *of)

    def _part(self, node: ast.AST, field: str, text: str, depth: int) -> Part:
        def inner(each: ast.AST) -> Part:
            return self._part(each, field, text, depth + 1)

        if depth > _DEEPEST:
            raise InputError(field, f"nested at most {_DEEPEST} deep", text[:60])
        match node:
            case ast.Constant(value=bool()):
                pass
            case ast.Constant(value=int() | float() as value):
                if abs(value) >= _LARGEST:
                    raise InputError(field, f"made of numbers below {_LARGEST:g}", text[:60])
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
                known = self.functions()
                if name not in known:
                    raise UnknownNameError(field, "made of the functions", name, known)
                if len(args) != known[name]:
                    raise InputError(field, f"{name} of {known[name]} argument{'s' * (known[name] > 1)}", len(args))
                return self.call(name, [inner(each) for each in args], field)
        raise InputError(field, f"made of {self.made_of}", text[:60])


def value_of(part: Part, **variables: float) -> float:
    """Return the value of an expression; nan where it has none."""
    with np.errstate(all="ignore"):
        return float(part(variables) if callable(part) else part)
