"""Tape of the equations of motion: `rig.physics.kernels.dynamics.evaluate`, unchanged, is run on symbols.

A symbol is a series in time times a coefficient. An operation on symbols adds a node, unless an equal node exists.
Expressions of the parameters alone are `Coefficient`s, evaluated once per series. A stage that depends on a flag of the
model is run for each of its values; where the results differ, the tape branches.

The kernels must be plain Python here: NUMBA_DISABLE_JIT=1, as for `rig.physics.engines.tape.taylor`. The tape depends
neither on the march of the series nor on the language of the generated code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

from rig.physics.engines.tape.coefficient import Coefficient, as_coefficient, inverse, parameter
from rig.physics.engines.tape.columns import PULSE_COSINE, PULSE_SINE, ROOT, TIME, TURNS
from rig.physics.kernels import dynamics, forces, ledger
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import Constants, Contact, House, Inputs, Levels, Magnet, Shaft
from rig.physics.kernels.frames import geometry
from rig.physics.kernels.laws import contact, house, magnet

PHASES = {"flight": ("FLIGHT",), "sliding": ("TOUCHING", "FORWARD", "BACKWARD"), "rolling": ("ROLLING",)}
"""Contact phases of each tape."""


class Choice(Coefficient):
    """Parameter used in comparisons: a flag of the model, or a number that selects the form of a law."""

    def __init__(self, tape: Tape, text: str, among: dict[int, str] | None = None) -> None:
        super().__init__(1.0, (text,))
        object.__setattr__(self, "_tape", tape)
        object.__setattr__(self, "_among", among)

    _tape: Tape
    _among: dict[int, str] | None

    def __bool__(self) -> bool:
        return self._tape.decide(self.over[0])

    def __eq__(self, other: object) -> bool:
        among = self._among
        if among is None:
            return self._tape.decide(f"{self.over[0]} == {other}")
        return other in among and self._tape.decide_among(self.over[0], tuple(among.values()), among[other])  # type: ignore[index]

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = Coefficient.__hash__


@dataclass(frozen=True, eq=False)
class Node:
    """Operation of a tape. Equal nodes of one scope are the same object."""

    number: int
    kind: str
    arguments: tuple[Any, ...]
    """Nodes, coefficients and column numbers, depending on the kind."""

    @property
    def sources(self) -> Iterator[Node]:
        """Nodes that are arguments."""
        for each in self.arguments:
            if isinstance(each, Node | Symbol):
                yield each if isinstance(each, Node) else each.node


@dataclass
class Fork:
    """Branches of nodes by a condition, and the results that both branches define."""

    condition: str
    yes: list[Node | Fork]
    no: list[Node | Fork]
    merged: list[Node] = field(default_factory=list)
    """Nodes of kind "either", whose arguments are both results, each a `Symbol` or a number."""


class Symbol:
    """Coefficient times the series of a node."""

    def __init__(self, tape: Tape, node: Node, coefficient: Coefficient | float = 1.0) -> None:
        self.tape, self.node, self.coefficient = tape, node, as_coefficient(coefficient)

    def scaled(self, factor: Any) -> Any:
        """Return the product with a number or parameter."""
        product = self.coefficient * factor
        return Symbol(self.tape, self.node, product) if isinstance(product, Coefficient) else 0.0

    def __mul__(self, other: Any) -> Any:
        if not isinstance(other, Symbol):
            return self.scaled(other)
        for one, two in ((self, other), (other, self)):
            if one.node.kind == "reciprocal":
                quotient = self.tape.enter("quotient", two.node, one.node.arguments[0])
                return quotient.scaled(one.coefficient * two.coefficient)
        return self.tape.product(self.node, other.node).scaled(self.coefficient * other.coefficient)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        if not isinstance(other, Symbol):
            return self.scaled(inverse(other))
        quotient = self.tape.enter("quotient", self.node, other.node)
        return quotient.scaled(self.coefficient * inverse(other.coefficient))

    def __rtruediv__(self, other: Any) -> Any:
        return self.tape.enter("reciprocal", self.node).scaled(other * inverse(self.coefficient))

    def __neg__(self) -> Symbol:
        return self.scaled(-1.0)

    def __add__(self, other: Any) -> Any:
        if isinstance(other, Symbol):
            if other.node is self.node:
                return self.scaled((self.coefficient + other.coefficient) * inverse(self.coefficient))
            return self._factored(other) or self.tape.enter(
                "sum", self.coefficient, self.node, other.coefficient, other.node
            )
        if isinstance(other, int | float) and other == 0.0:
            return self
        # (x - c) + c
        kind, arguments = self.node.kind, self.node.arguments
        if kind == "shifted" and self.coefficient == Coefficient() and as_coefficient(other) == -arguments[2]:
            return Symbol(self.tape, arguments[1], arguments[0])
        return self.tape.enter("shifted", self.coefficient, self.node, as_coefficient(other))

    def _factored(self, other: Symbol) -> Symbol | None:
        """Return A f + b f as (a + b) f, which saves a product."""
        one, two = self.node, other.node
        if one.kind == two.kind == "product":
            for factor in one.arguments:
                if factor in two.arguments:
                    left, right = (
                        each.arguments[0] if each.arguments[1] is factor else each.arguments[1] for each in (one, two)
                    )
                    total = Symbol(self.tape, left, self.coefficient) + Symbol(self.tape, right, other.coefficient)
                    return total * Symbol(self.tape, factor)
        return None

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return self + (-other)

    def __rsub__(self, other: Any) -> Any:
        return (-self) + other

    def __pow__(self, exponent: Coefficient) -> Symbol:
        node = self.node
        if node.kind == "product" and node.arguments[0] is node.arguments[1]:
            node, exponent = node.arguments[0], 2.0 * exponent
        assert self.coefficient == Coefficient()
        return self.tape.enter("power", node, exponent)

    # The phase decides comparisons with states: in contact, the penetration is positive and the distance is not 0.
    def __le__(self, other: float) -> bool:
        return False

    def __gt__(self, other: float) -> bool:
        return True

    def __eq__(self, other: object) -> bool:
        return False

    __hash__ = None  # type: ignore[assignment]


class Tape:
    """Nodes in the order of evaluation, in branches."""

    def __init__(self, phase: str) -> None:
        self.phase = phase
        self.items: list[Node | Fork] = []
        self.turns: dict[int, str] = {}
        """Initial values of angles whose sine and cosine are columns. Nodes hold their rates."""
        self.rates: dict[int, Any] = {}
        """Rates of all other columns, by number."""
        self.events: dict[str, Any] = {}
        """Quantities for the event functions, by name."""
        self.preload_conditions: list[str] = []
        """Conditions for a lost preload of the current pair's transducers, in order of evaluation."""
        self.friction_arguments: list[Any] = []
        self.motion: Any = None
        self._scopes: list[dict[Any, Node]] = [{}]
        self._open: list[list[Node | Fork]] = [self.items]
        self._numbers = count()
        self._answers: dict[str, bool] = {}

    def enter(self, kind: str, *arguments: Any) -> Symbol:
        """Return the symbol of an operation; add its node if it is new."""
        there = self.find(kind, *arguments)
        if there is not None:
            return Symbol(self, there)
        node = Node(next(self._numbers), kind, arguments)
        self._scopes[-1][_node_key(kind, arguments)] = node
        self._open[-1].append(node)
        return Symbol(self, node)

    def find(self, kind: str, *arguments: Any) -> Node | None:
        """Return the existing node of an operation in this branch or before it."""
        key = _node_key(kind, arguments)
        return next((scope[key] for scope in self._scopes if key in scope), None)

    def product(self, one: Node, two: Node) -> Symbol:
        """Return the symbol of a product, reusing existing products for a b x and a b c d where possible."""
        pairs = [node.arguments for node in (one, two) if node.kind == "product"]
        if len(pairs) == 2:
            (a, b), (c, d) = pairs
            for left, right in (((a, c), (b, d)), ((a, d), (b, c))):
                first, second = self.find("product", *_order_nodes(*left)), self.find("product", *_order_nodes(*right))
                if first is not None and second is not None:
                    return self.enter("product", *_order_nodes(first, second))
        for chain, factor in ((one, two), (two, one)):
            if chain.kind == "product":
                for kept, other in (chain.arguments, chain.arguments[::-1]):
                    there = self.find("product", *_order_nodes(kept, factor))
                    if there is not None and there is not chain:
                        return self.enter("product", *_order_nodes(other, there))
        return self.enter("product", *_order_nodes(one, two))

    def column(self, number: int) -> Symbol:
        """Return the symbol of a column of the series."""
        return self.enter("column", number)

    def decide(self, condition: str) -> bool:
        """Return the value of a condition in the current branch."""
        if condition not in self._answers:
            raise _UndecidedError(condition)
        return self._answers[condition]

    def decide_among(self, name: str, values: tuple[str, ...], value: str) -> bool:
        """Return whether a parameter has one of its values."""
        left = [each for each in values if self._answers.get(f"{name} == {each}", True)]
        chosen = [each for each in values if self._answers.get(f"{name} == {each}", False)]
        if chosen or len(left) == 1:
            return value in (chosen or left)
        return value in left and self.decide(f"{name} == {value}")

    def stage(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a stage that is run for each value of its conditions."""

        def staged(*arguments: Any) -> Any:
            before, self._answers = self._answers, {}
            try:
                return self._branch(function, arguments)
            finally:
                self._answers = before

        return staged

    def either(self, condition: str, yes: Any, no: Any) -> Any:
        """Return one of two existing values, depending on a condition."""
        fork = Fork(condition, [], [])
        self._open[-1].append(fork)
        return self._merge(fork, yes, no)

    def _branch(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        size, scope = len(self._open[-1]), dict(self._scopes[-1])
        try:
            return function(*arguments)
        except _UndecidedError as undecided:
            condition = undecided.condition
        del self._open[-1][size:]
        self._scopes[-1].clear()
        self._scopes[-1].update(scope)
        fork = Fork(condition, [], [])
        answers = []
        for items, answer in ((fork.yes, True), (fork.no, False)):
            self._answers[condition] = answer
            self._scopes.append({})
            self._open.append(items)
            answers.append(self._branch(function, arguments))
            self._scopes.pop()
            self._open.pop()
            del self._answers[condition]
        self._open[-1].append(fork)
        return self._merge(fork, *answers)

    def _merge(self, fork: Fork, yes: Any, no: Any) -> Any:
        if isinstance(yes, tuple):
            merged = [self._merge(fork, *pair) for pair in zip(yes, no, strict=True)]
            return type(yes)(*merged) if hasattr(yes, "_fields") else tuple(merged)
        if isinstance(yes, Symbol) and isinstance(no, Symbol) and yes.node is no.node:
            if yes.coefficient == no.coefficient:
                return yes
            return Symbol(self, yes.node, self._merge(fork, yes.coefficient, no.coefficient))
        if isinstance(yes, Symbol) or isinstance(no, Symbol):
            node = Node(next(self._numbers), "either", (yes, no))
            fork.merged.append(node)
            return Symbol(self, node)
        if as_coefficient(yes) == as_coefficient(no):
            return yes
        return parameter(f"({as_coefficient(yes).text} if {fork.condition} else {as_coefficient(no).text})")


def _node_key(kind: str, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    return (kind, *(each.number if isinstance(each, Node) else each for each in arguments))


def _order_nodes(one: Node, two: Node) -> tuple[Node, Node]:
    return (one, two) if one.number <= two.number else (two, one)


class _UndecidedError(Exception):
    def __init__(self, condition: str) -> None:
        self.condition = condition


def record_tape(phase: str) -> Tape:
    """Return the tape of a phase: rates of all columns, and the quantities for its events."""
    tape = Tape(phase)
    columns = [tape.column(number) for number in range(S.N_VECTOR)]
    rates: list[Any] = [0.0] * S.N_VECTOR
    # Common factor of two terms, which the factorisation does not detect.
    tape.product(columns[S.GAMMA_RATE].node, tape.column(TURNS[S.BETA] + 1).node)
    phases = {getattr(contact, name): name for name in PHASES[phase]}
    with _replace_stages(tape):
        dynamics.evaluate(
            _constants(tape), _inputs(tape), 0, 0.0, parameter("onset"), Choice(tape, "phase", phases), False, columns,
            rates, [0.0] * S.N_OBSERVED,
        )  # fmt: skip
        if tape.friction_arguments:
            constants, state, pose, e, ring = tape.friction_arguments
            tape.events["residual"] = dynamics.sliding_acceleration(constants, state, pose, e, ring, tape.motion)
    tape.rates.update(enumerate(rates))
    tape.rates[TIME] = 1.0
    tape.rates[PULSE_SINE] = tape.column(PULSE_COSINE).scaled(parameter("pulse"))
    tape.rates[PULSE_COSINE] = tape.column(PULSE_SINE).scaled(-parameter("pulse"))
    return tape


_COMPARED_KEYS = ("exponent", "gap_counts_outer")
"""Numbers of the contact that select a form of the law."""


def _symbols(kind: type, prefix: str, **changed: Any) -> Any:
    return kind(**{name: changed.get(name, parameter(f"{prefix}.{name}")) for name in kind._fields})


def _constants(tape: Tape) -> Constants:
    laws = {getattr(contact, name): name for name in ("NO_FRICTION", "SMOOTHED", "EXACT")}
    flags = {name: Choice(tape, f"levels.{name}") for name in ("euler", "inner_house", "outer_house", "compliant")}
    maps = {getattr(magnet, name): name for name in ("LINEAR", "RADIAL", "RIPPLED")}
    return Constants(
        levels=Levels(**flags, friction=Choice(tape, "levels.friction", laws)),  # type: ignore[arg-type]
        shaft=_symbols(Shaft, "shaft"),
        magnet=_symbols(Magnet, "magnet", terms=Choice(tape, "magnet.terms", maps)),
        contact=_symbols(Contact, "contact", **{name: Choice(tape, f"contact.{name}") for name in _COMPARED_KEYS}),
        house=_symbols(House, "house"),
        torque_gain=parameter("constants.torque_gain"),  # type: ignore[arg-type]
    )


def _inputs(tape: Tape) -> Inputs:
    flags = {name: Choice(tape, f"inputs.{name}") for name in ("ideal_drive", "magnet_engaged")}
    return _symbols(Inputs, "inputs", **flags)


@contextmanager
def _replace_stages(tape: Tape) -> Iterator[None]:
    """Replace the kernel functions that have another meaning for series; stages branch, and the rest is unchanged."""
    before: list[tuple[ModuleType, str, Any]] = []

    def replace(module: ModuleType, name: str, value: Any) -> None:
        before.append((module, name, vars(module).get(name)))
        setattr(module, name, value)

    modules = (geometry, forces, house, magnet, contact, ledger, dynamics)
    for module in modules:
        for name, value in list(vars(module).items()):
            if isinstance(value, FunctionType) and value.__module__.startswith(__name__.partition(".")[0]):
                meaning = getattr(_SeriesStages, name, None)
                staged = tape.stage(value)
                replace(module, name, partial(meaning, tape, staged) if meaning else staged)
    for module in (contact, forces):
        functions = {name: partial(function, tape) for name, function in _FUNCTIONS.items()}
        replace(module, "math", SimpleNamespace(**functions, pi=math.pi))
    for module in (contact, house):
        replace(module, "max", partial(_positive_part, tape))
    try:
        yield
    finally:
        for module, name, value in before:
            if value is None:
                delattr(module, name)
            else:
                setattr(module, name, value)


class _SeriesStages:
    """Stages, by name, that are replaced or recorded for series. `plain` is the original stage."""

    @staticmethod
    def tilt_sines(tape: Tape, plain: Any, levels: Any, angle: Symbol) -> tuple[Symbol, Symbol]:
        """Return columns for small angles too: the sine's rate is the angle's where the cosine stays 1."""
        return _turn_columns(tape, angle, geometry.large_tilt_factor(levels))

    @staticmethod
    def hammer_force(tape: Tape, plain: Any, inputs: Inputs, *when: Any) -> Any:
        return tape.column(PULSE_SINE) * inputs.hammer_force

    @staticmethod
    def drive_speed(tape: Tape, plain: Any, inputs: Inputs, *when: Any) -> Any:
        return tape.column(TIME) * inputs.speed_slope + parameter("aim")

    @staticmethod
    def complex_power(tape: Tape, plain: Any, x: Symbol, y: Symbol, exponent: Coefficient) -> tuple[Symbol, Symbol]:
        wave = tape.enter("complex_power", x.coefficient, x.node, y.coefficient, y.node, as_coefficient(exponent)).node
        return tape.enter("part", wave, "x"), tape.enter("part", wave, "y")

    @staticmethod
    def pair_readings(tape: Tape, plain: Any, displacement: Any, stiffness: Coefficient, preload: Any) -> Any:
        side = "north" if "vertical" in stiffness.text else "east"
        tape.preload_conditions = [f"{side} < 0.0", f"{side} > 0.0"]
        return plain(displacement, stiffness, preload)

    @staticmethod
    def ring_force(tape: Tape, plain: Any, ex: Symbol, ey: Symbol, *others: Any) -> Any:
        tape.events["square"] = ex * ex + ey * ey
        force = plain(ex, ey, *others)
        tape.events["ring"] = force
        return force

    @staticmethod
    def penetration_at(tape: Tape, plain: Any, distance: Symbol, law: Contact) -> Any:
        """Return the penetration; in tau, the variable of sliding contacts, its root is a column."""
        depth = tape.column(ROOT) * tape.column(ROOT) if tape.phase == "sliding" else plain(distance, law)
        tape.events["depth"] = depth
        return depth

    @staticmethod
    def damping_ratio(tape: Tape, plain: Any, *arguments: Any) -> Any:
        tape.events["ratio"] = plain(*arguments)
        return tape.events["ratio"]

    @staticmethod
    def holding_friction(tape: Tape, plain: Any, constants: Any, inputs: Any, phase: Any, *others: Any) -> Any:
        """Return the unknown friction; the accelerations determine it from the residual that it keeps at 0."""
        *tape.friction_arguments, _ = (constants, *others)
        return tape.enter("unknown")

    @staticmethod
    def accelerations(tape: Tape, plain: Any, *arguments: Any) -> Any:
        tape.motion = plain(*arguments)
        return tape.motion


def _turn_columns(tape: Tape, angle: Symbol, large: Any = 1.0) -> tuple[Symbol, Symbol]:
    """Return sine and cosine of an angle of the state, possibly shifted: two columns with separate rates."""
    node, begin = angle.node, ""
    if node.kind == "shifted":
        begin = f" + {node.arguments[2].text}"
        node = node.arguments[1]
    (state,) = node.arguments
    sine, cosine = tape.column(TURNS[state]), tape.column(TURNS[state] + 1)
    rate = tape.column(S.GAMMA_RATE + state)
    tape.turns[state] = f"Y[0, {state}]{begin}"
    for column, value in ((TURNS[state], cosine * rate), (TURNS[state] + 1, -(sine * rate) * large)):
        tape.enter("rate", column, value.coefficient, value.node)
    return sine, cosine


def _take_root(tape: Tape, value: Symbol) -> Symbol:
    kind, arguments = value.node.kind, value.node.arguments
    if kind == "product" and arguments[0] is arguments[1] and value.coefficient == Coefficient():
        return Symbol(tape, arguments[0])
    return tape.enter("root", value.coefficient, value.node)


def _positive_part(tape: Tape, nothing: float, value: Any) -> Any:
    """Return the larger of 0 and a value; an event determines which one that is."""
    if tape.preload_conditions:
        return tape.either(tape.preload_conditions.pop(0), nothing, value)
    tape.events["normal"] = value
    return tape.either("slack", nothing, value)


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sqrt": _take_root,
    "sin": lambda tape, angle: _turn_columns(tape, angle)[0],
    "cos": lambda tape, angle: _turn_columns(tape, angle)[1],
    "tanh": lambda tape, value: tape.enter("tanh", value.coefficient, value.node),
}
