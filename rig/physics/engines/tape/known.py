"""What of the equations depends on the parameters alone: products and quotients of names, as text in the end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Known:
    """A number times and over parameters, by their names in the code that is made."""

    number: float = 1.0
    over: tuple[str, ...] = ()
    """Factors, sorted."""
    under: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """As an expression."""
        factors = [*([repr(self.number)] if self.number != 1.0 or not self.over else []), *self.over]
        product = " * ".join(factors)
        if not self.under:
            return product
        return f"{product} / {self.under[0]}" if len(self.under) == 1 else f"{product} / ({' * '.join(self.under)})"

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, int | float):
            return Known(self.number * other, self.over, self.under) if other else 0.0
        if not isinstance(other, Known):
            return NotImplemented
        over, under = list(self.over + other.over), list(self.under + other.under)
        for factor in [*over]:
            if factor in under:
                over.remove(factor)
                under.remove(factor)
        return Known(self.number * other.number, tuple(sorted(over)), tuple(sorted(under)))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        return self * inverse(other) if isinstance(other, int | float | Known) else NotImplemented

    def __rtruediv__(self, other: float) -> Any:
        return inverse(self) * other

    def __neg__(self) -> Known:
        return Known(-self.number, self.over, self.under)

    def __add__(self, other: Any) -> Any:
        if isinstance(other, int | float | Known):
            return self if other == 0.0 else named(f"({self.text} + {known(other).text})")
        return NotImplemented

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return self + (-other) if isinstance(other, int | float | Known) else NotImplemented

    def __rsub__(self, other: float) -> Any:
        return -self + other


def named(text: str) -> Known:
    """A parameter."""
    return Known(1.0, (text,))


def known(value: Any) -> Known:
    """A number or parameter as `Known`."""
    return Known(value.number, value.over, value.under) if isinstance(value, Known) else Known(float(value))


def inverse(value: Any) -> Known:
    """One over a number or parameter."""
    value = known(value)
    return Known(1.0 / value.number, value.under, value.over)
