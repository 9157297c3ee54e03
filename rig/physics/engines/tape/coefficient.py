"""Coefficients of the equations that depend on the parameters alone: products and quotients of names, as text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Coefficient:
    """Number times a quotient of parameters, by their names in the generated code."""

    number: float = 1.0
    over: tuple[str, ...] = ()
    """Factors of the numerator, sorted."""
    under: tuple[str, ...] = ()
    """Factors of the denominator, sorted."""

    @property
    def text(self) -> str:
        """Expression in the generated code."""
        factors = [*([repr(self.number)] if self.number != 1.0 or not self.over else []), *self.over]
        product = " * ".join(factors)
        if not self.under:
            return product
        return f"{product} / {self.under[0]}" if len(self.under) == 1 else f"{product} / ({' * '.join(self.under)})"

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, int | float):
            return Coefficient(self.number * other, self.over, self.under) if other else 0.0
        if not isinstance(other, Coefficient):
            return NotImplemented
        over, under = list(self.over + other.over), list(self.under + other.under)
        for factor in [*over]:
            if factor in under:
                over.remove(factor)
                under.remove(factor)
        return Coefficient(self.number * other.number, tuple(sorted(over)), tuple(sorted(under)))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        return self * inverse(other) if isinstance(other, int | float | Coefficient) else NotImplemented

    def __rtruediv__(self, other: float) -> Any:
        return inverse(self) * other

    def __neg__(self) -> Coefficient:
        return Coefficient(-self.number, self.over, self.under)

    def __add__(self, other: Any) -> Any:
        if isinstance(other, int | float | Coefficient):
            return self if other == 0.0 else parameter(f"({self.text} + {as_coefficient(other).text})")
        return NotImplemented

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return self + (-other) if isinstance(other, int | float | Coefficient) else NotImplemented

    def __rsub__(self, other: float) -> Any:
        return -self + other


def parameter(text: str) -> Coefficient:
    """Return a parameter as `Coefficient`."""
    return Coefficient(1.0, (text,))


def as_coefficient(value: Any) -> Coefficient:
    """Return a number or parameter as `Coefficient`."""
    number, over, under = (value.number, value.over, value.under) if isinstance(value, Coefficient) else (value, (), ())
    return Coefficient(float(number), over, under)


def inverse(value: Any) -> Coefficient:
    """Return one over a number or parameter."""
    value = as_coefficient(value)
    return Coefficient(1.0 / value.number, value.under, value.over)
