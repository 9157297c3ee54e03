"""Code of Taylor series, made of the tapes.

`NUMBA_DISABLE_JIT=1 python -m rig.physics.engines.tape.taylor` writes `rig/physics/engines/taylor/series.py`.

For every order the code works out the next coefficient of all nodes in turn. What the coefficients below give to a
product's next is a sum over lanes, one a product, worked out for all lanes at once.

Under rolling the friction is unknown. It enters the k-th coefficient of what it keeps at 0 with one factor for all k:
everything is worked out with that coefficient left at 0, then once more with the coefficient that this asks for.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from rig.physics.engines.tape.columns import EVENTS, FORCE, ROOT, TURNS, WIDTH
from rig.physics.engines.tape.known import Known, known
from rig.physics.engines.tape.trace import PHASES, Fork, Node, Symbol, Tape, record
from rig.physics.kernels import signals as S

SERIES = Path(__file__).parents[1] / "taylor" / "series.py"
"""Where the code lies."""
WAVE_LANES = 36
"""Lanes of a complex power: enough for 64 magnets."""
_VECTOR = 4
"""Lanes come in multiples of this many."""

_HEAD = '''"""Coefficients of the Taylor series, by phase.

Made by `NUMBA_DISABLE_JIT=1 python -m rig.physics.engines.tape.taylor`: do not edit; tests/physics/test_taylor.py
compares it.
"""

# pyright: reportPossiblyUnboundVariable=false

from __future__ import annotations

import math

from rig.physics.engines.common.memory import ONSET, PHASE
from rig.physics.engines.taylor.lanes import complex_power, is_wide, product, quotient, sum_below
from rig.physics.engines.taylor.place import EAST, NORTH, SLACK
from rig.physics.kernels.laws.contact import BACKWARD, EXACT, FLIGHT, FORWARD  # noqa: F401
from rig.physics.kernels.laws.contact import NO_FRICTION, ROLLING, SMOOTHED, TOUCHING  # noqa: F401
from rig.physics.kernels.frames.geometry import sines_of
from rig.physics.kernels.laws.magnet import LINEAR, RADIAL, RIPPLED  # noqa: F401
from rig.physics.kernels.stage import kernel
'''


class _Code:
    """Lines of one function."""

    def __init__(self, tape: Tape) -> None:
        self._tape = tape
        self._needed: set[int] = set()
        self._constants: dict[str, str] = {}
        self._begin: list[str] = []
        self._unknown: set[int] = set()
        """Numbers of nodes that depend on the unknown friction."""
        self._first: set[int] = set()
        """Numbers of nodes that what it keeps at 0 is made of."""
        self._lane_of: dict[int, int] = {}
        self._inside: set[int] = set()
        """Numbers of sums that stand in the one expression that they are for."""
        self._named: dict[int, str] = {}
        """Names of nodes that have another's: what a branch gives it."""
        self.widest = self.rarest = 0

    def function(self) -> str:
        """The function's source."""
        tape = self._tape
        outputs = self._outputs()
        residual = tape.events.get("residual")
        if residual is not None:
            self._mark(tape.items, [residual])
            self._first = set(self._needed)
            self._depend(tape.items)
        self._mark(tape.items, [*outputs.values(), residual])
        self._number_lanes(tape.items, 0, rare=False)
        self.rarest = _whole(self.widest)
        self._number_lanes(tape.items, self.rarest, rare=True)
        self._place(tape.items, [*outputs.values(), residual])
        body = list(self._lines(tape.items, first=residual is not None))
        if residual is not None:
            body += [f"friction = {self._value(residual)} * per_friction", *self._lines(tape.items, again=True)]
        for text, value in outputs.items():
            body.append(f"{text} = {self._value(value)}")
        lanes, wide = _whole(self.widest), _whole(self.rarest + WAVE_LANES)
        body = [line.replace("WAVE", str(self.rarest)) for line in body]
        lines = [
            "", "", "@kernel",
            f"def {tape.phase}(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):",
            f'    """{tape.phase.capitalize()}: {self.widest} lanes."""',
            "    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet",
            "    contact, house = constants.contact, constants.house",
            "    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0",
            "    north, east, order = memory[NORTH], memory[EAST], len(Y) - 1",
            *(f"    {name} = {text}" for text, name in self._constants.items()),
            *(f"    {line}" for line in self._begin),
            f"    Y[0, {S.N_VECTOR}] = 0.0",
            f"    Y[0, {S.N_VECTOR + 1}], Y[0, {S.N_VECTOR + 2}] = math.sin(along), math.cos(along)",
        ]  # fmt: skip
        for angle in sorted(tape.turns):
            begin = tape.turns[angle]
            value = f"math.sin({begin}), math.cos({begin})" if angle == S.THETA else f"sines_of(levels, {begin})"
            lines.append(f"    Y[0, {TURNS[angle]}], Y[0, {TURNS[angle] + 1}] = {value}")
        lines += [
            "    wide = is_wide(constants, inputs)",
            f"    for p in range({wide}):",
            "        A[0, p] = B[0, p] = 0.0",
            "    z, later = 1.0, 0.0",
            "    for k in range(order):",
            "        if wide:",
            f"            sum_below(A, B, acc, k, {wide})",
            "        else:",
            f"            sum_below(A, B, acc, k, {lanes})",
            *(f"        {line}" for line in body),
            "        portion = 1.0 / (k + 1.0)",
        ]
        if tape.phase == "sliding":
            lines += [
                f"        for i in range({ROOT}):",
                "            Y[k + 1, i] = 0.0",
                "        for j in range(k + 1):",
                f"            slow = Y[k - j, {ROOT}] * portion",
                f"            for i in range({ROOT}):",
                "                Y[k + 1, i] += slow * D[j, i]",
                f"        Y[k + 1, {ROOT}] = 0.5 * {self._value(tape.events['ring'].rate)} * portion",
            ]
        else:
            lines += [f"        for i in range({ROOT}):", "            Y[k + 1, i] = D[k, i] * portion"]
            lines += [f"        Y[k + 1, {ROOT}] = 0.0"]
        lines += ["        z, later = 0.0, 1.0", f"    for i in range({FORCE}, {WIDTH}):", "        Y[order, i] = 0.0"]
        return "\n".join(lines)

    def _outputs(self) -> dict[str, Any]:
        tape, force = self._tape, self._tape.events["ring"]
        events: list[Any] = [tape.events["square"], 0.0, 0.0]
        if tape.phase == "sliding":
            pull = tape.either("contact.viscous_damping == 0.0", tape.events["ratio"], tape.events["normal"])
            events = [0.0, force.sliding, pull]
        elif tape.phase == "rolling":
            events = [tape.events["depth"], tape.enter("unknown"), 0.0]
        outputs = {f"D[k, {column}]": rate for column, rate in tape.rates.items()}
        outputs[f"Y[k, {FORCE}]"] = force.Fn
        return outputs | {f"Y[k, {EVENTS + i}]": event for i, event in enumerate(events)}

    # What is needed, and what waits for the friction.

    def _mark(self, items: list[Node | Fork], outputs: Iterable[Any]) -> None:
        self._needed |= {value.node.number for value in outputs if isinstance(value, Symbol)}
        for item in reversed(list(_all(items))):
            if item.kind == "rate" or item.number in self._needed:
                self._needed.add(item.number)
                self._needed |= {source.number for source in item.sources}

    def _depend(self, items: list[Node | Fork]) -> None:
        for item in _all(items):
            if item.kind == "unknown" or any(source.number in self._unknown for source in item.sources):
                self._unknown.add(item.number)

    def _wanted(self, item: Node | Fork, again: bool) -> bool:
        if isinstance(item, Fork):
            return any(self._wanted(each, again) for each in (*item.yes, *item.no, *item.joined))
        late = item.number in self._unknown
        return item.number in self._needed and (late if again else not late or item.number in self._first)

    def _number_lanes(self, items: list[Node | Fork], lane: int, *, rare: bool, now: bool = False) -> int:
        """Both branches of a fork share their lanes. What few scenes ask for comes behind the others."""
        for item in items:
            if isinstance(item, Fork):
                sides = [
                    self._number_lanes(branch, lane, rare=rare, now=now or _RARE.get(item.condition) is answer)
                    for branch, answer in ((item.yes, True), (item.no, False))
                ]
                lane = max(sides)
            elif item.number in self._needed and item.kind in _LANES and now is rare:
                self._lane_of[item.number] = lane
                lane += _LANES[item.kind]
        if rare:
            self.rarest = max(self.rarest, lane)
        else:
            self.widest = max(self.widest, lane)
        return lane

    def _place(self, items: list[Node | Fork], outputs: Iterable[Any]) -> None:
        """What is used once, and in its own branch, needs no name of its own; nor what a branch gives a name."""
        uses = Counter(source.number for item in _all(items) if item.number in self._needed for source in item.sources)
        uses.update(value.node.number for value in outputs if isinstance(value, Symbol))

        def alike(source: Node, user: Node) -> bool:
            return (source.number in self._unknown) == (user.number in self._unknown)

        def once(source: Node, branch: list[Node | Fork], user: Node) -> bool:
            here = any(source is each for each in _own(branch))
            single = uses[source.number] == 1 and user.number in self._needed
            return here and single and source.kind in _WRITTEN and alike(source, user)

        def place_in(branch: list[Node | Fork]) -> None:
            for item in branch:
                if isinstance(item, Node):
                    for one in (item.arguments[place] for place in _INLINE.get(item.kind, ())):
                        if not once(one, branch, item):
                            continue
                        self._inside.add(one.number)
                        called = item.kind in _CALLS and _CALLS[0] in self._expression(one)
                        if called or (item.kind in _WRITTEN and len(self._expression(item)) > _LONG):
                            self._inside.remove(one.number)
                    continue
                for side, answer in enumerate((item.yes, item.no)):
                    own = {node.number for node in _own(answer)}
                    for joined in item.joined:
                        value = joined.arguments[side]
                        if not isinstance(value, Symbol) or joined.number not in self._needed:
                            continue
                        number = value.node.number
                        scaled = value.coefficient != Known()
                        inside = scaled and once(value.node, answer, joined)
                        # A product fills its lane, whichever way the fork goes.
                        before = once(value.node, branch, joined) and _CALLS[0] not in self._expression(value.node)
                        if inside or before:
                            self._inside.add(number)
                        elif not scaled and number in own and alike(value.node, joined):
                            self._named.setdefault(number, self._name(joined))
                    place_in(answer)

        place_in(items)

    # Code.

    def _name(self, node: Node) -> str:
        if node.kind == "column":
            return f"Y[k, {node.arguments[0]}]"
        return self._named.get(node.number, f"v{node.number}")

    def _constant(self, value: Known) -> str:
        if not value.over and not value.under:
            return repr(value.number)
        if value.number < 0.0:
            return f"-{self._constant(-value)}"
        if (value.number, len(value.over), value.under) == (1.0, 1, ()) and "(" not in value.text:
            return value.text
        return self._constants.setdefault(value.text, f"c{len(self._constants)}")

    def _term(self, coefficient: Known, factor: Node | str, *, first: bool = False) -> str:
        """A coefficient times a node; `first`: nothing stands before it, so that a sum needs no brackets."""
        if isinstance(factor, Node):
            bare = first and coefficient == Known()
            factor = self._name(factor) if factor.number not in self._inside else self._expression(factor, bare=bare)
        if coefficient == Known():
            return factor
        return f"-{factor}" if coefficient == Known(-1.0) else f"{self._constant(coefficient)} * {factor}"

    def _value(self, value: Any) -> str:
        if isinstance(value, Symbol):
            return self._term(value.coefficient, value.node, first=True)
        return "0.0" if value == 0.0 else self._term(known(value), "z")

    def _expression(self, node: Node, *, bare: bool = True) -> str:
        if node.kind == "product":
            left, right = (self._term(Known(), each, first=True) for each in node.arguments)
            return f"product(A, B, acc, k, later, {self._lane_of[node.number]}, {left}, {right})"
        coefficient, part, other, *rest = node.arguments
        before = self._term(coefficient, part, first=True)
        text = f"{before} + {self._term(other, rest[0] if rest else 'z')}".replace("+ -", "- ")
        return text if bare else f"({text})"

    def _lines(self, items: list[Node | Fork], *, first: bool = False, again: bool = False) -> Iterator[str]:
        for item in items:
            if not self._wanted(item, again):
                continue
            if isinstance(item, Node):
                if item.number not in self._inside and item.kind != "column":
                    yield from self._node(item, first)
                continue
            joined = [each for each in item.joined if self._wanted(each, again)]
            yes, no = ([*self._lines(branch, first=first, again=again)] for branch in (item.yes, item.no))
            if len(joined) == 1 and not yes and not no:
                one, two = map(self._value, joined[0].arguments)
                line = f"{self._name(joined[0])} = {one} if {item.condition} else {two}"
                if len(line) <= _LONG:
                    yield line
                    continue
            for side, lines in enumerate((yes, no)):
                given = ((self._name(each), self._value(each.arguments[side])) for each in joined)
                lines += [f"{name} = {value}" for name, value in given if name != value]
            yield f"if {item.condition}:"
            yield from (f"    {line}" for line in yes or ["pass"])
            if no and no[0].startswith("if ") and all(line.startswith((" ", "el")) for line in no[1:]):
                yield f"el{no[0]}"
                yield from no[1:]
            elif no:
                yield "else:"
                yield from (f"    {line}" for line in no)

    def _node(self, node: Node, first: bool) -> Iterator[str]:
        name, arguments, p = self._name(node), node.arguments, self._lane_of.get(node.number, -1)
        match node.kind:
            case "rate":
                yield f"D[k, {arguments[0]}] = {self._term(arguments[1], arguments[2], first=True)}"
            case "unknown":
                yield f"{name} = {'0.0' if first else 'friction'}"
            case "sum" | "shifted" | "product":
                yield f"{name} = {self._expression(node)}"
            case "quotient" | "reciprocal":
                dividend = "z" if node.kind == "reciprocal" else self._term(Known(), arguments[0], first=True)
                divisor = self._name(arguments[-1])
                self._keep(f"i{node.number} = 0.0")
                yield f"i{node.number} = 1.0 / {divisor} if k == 0 else i{node.number}"
                yield f"{name} = quotient(A, B, acc, k, later, {p}, {divisor}, {dividend}, i{node.number})"
            case "root":
                square = self._term(*arguments)
                yield f"{name} = math.sqrt({square}) if k == 0 else ({square} - acc[{p}]) * (0.5 / A[0, {p}])"
                yield f"A[k, {p}] = B[k, {p}] = {name}"
            case "tanh":
                # T' = (1 - T^2) v'.
                value = self._term(*arguments)
                yield f"{name} = math.tanh({value}) if k == 0 else (acc[{p}] + k * ({value}) * B[0, {p}]) / k"
                yield f"A[k, {p}] = k * ({value})"
                yield f"B[k, {p}] = z - product(A, B, acc, k, later, {p + 1}, {name}, {name})"
            case "power":
                # x P' = n P x'.
                x, exponent = self._name(arguments[0]), self._constant(arguments[1])
                yield (
                    f"{name} = {x} ** {exponent} if k == 0 else "
                    f"({exponent} * (acc[{p}] + k * {x} * B[0, {p}]) - acc[{p + 1}]) / (k * B[0, {p + 1}])"
                )
                yield f"A[k, {p}], B[k, {p}], A[k, {p + 1}], B[k, {p + 1}] = k * {x}, {name}, k * {name}, {x}"
            case "complex_power":
                x, y, power = self._term(*arguments[:2]), self._term(*arguments[2:4]), f"int({arguments[4].text})"
                yield "power_x, power_y = complex_power("
                yield f"    A, B, acc, k, later, WAVE, {x}, {y}, {power}"
                yield ")"
            case "part":
                yield f"{name} = power_{arguments[1]}"
            case _:
                raise AssertionError(node.kind)

    def _keep(self, line: str) -> None:
        if line not in self._begin:
            self._begin.append(line)


_INLINE = {"sum": (1, 3), "shifted": (1,), "rate": (2,), "quotient": (0,), "product": (0, 1)}
"""Arguments, by kind, that may be written in place."""
_RARE = {
    "contact.exponent == 1.0": False,
    "contact.gap_counts_outer == 0.0": False,
    "levels.friction == SMOOTHED": True,
    "magnet.terms == RADIAL": False,
}
"""Conditions by which few scenes go, and the answer then: what `rig.physics.engines.taylor.lanes.is_wide` asks for."""
_CALLS = ("product", "quotient")
"""What takes no product in place."""
_LONG = 96
"""Characters of an expression at the most."""
_WRITTEN = ("sum", "shifted", "product")
"""What needs no name where it is used once."""
_LANES = {"product": 1, "quotient": 1, "reciprocal": 1, "root": 1, "tanh": 2, "power": 2}


def _whole(lanes: int) -> int:
    return -(-lanes // _VECTOR) * _VECTOR


def _own(items: list[Node | Fork]) -> Iterator[Node]:
    """The nodes of a branch, without those of the branches in it."""
    for item in items:
        yield from item.joined if isinstance(item, Fork) else [item]


def _all(items: list[Node | Fork]) -> Iterator[Node]:
    """All nodes, each after what it is made of."""
    for item in items:
        if isinstance(item, Fork):
            yield from _all(item.yes)
            yield from _all(item.no)
            yield from item.joined
        else:
            yield item


def source() -> str:
    """The text of `series.py`."""
    assert os.environ.get("NUMBA_DISABLE_JIT") == "1", "the tapes need kernels in plain Python: NUMBA_DISABLE_JIT=1"
    codes = [_Code(record(phase)) for phase in PHASES]
    functions = [code.function() for code in codes]
    lanes = max(_whole(code.rarest + WAVE_LANES) for code in codes)
    return f"{_HEAD}\n\nLANES = {lanes}\n" + "\n".join(functions) + "\n"


if __name__ == "__main__":
    SERIES.write_text(source())
