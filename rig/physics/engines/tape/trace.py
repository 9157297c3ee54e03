"""The equations of motion as a tape: `rig.physics.kernels.dynamics.evaluate` runs as it is, on symbols.

A symbol is a series in time times a coefficient; an operation on symbols enters a node. Nodes that are equal are one.
What depends on the parameters alone stays a text, `Known`, worked out once a series. A stage that asks for a flag of
the model is run once for each answer; where the answers differ, the tape branches.

The kernels must be plain Python here: NUMBA_DISABLE_JIT=1, as `rig.physics.engines.tape.taylor` asks for. What comes
out knows nothing of how a series is marched or in which language the code that is made of it is written.
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

from rig.physics.engines.tape.columns import PULSE_COSINE, PULSE_SINE, ROOT, TIME, TURNS
from rig.physics.engines.tape.known import Known, inverse, known, named
from rig.physics.kernels import dynamics, forces, ledger
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import Constants, Contact, House, Inputs, Levels, Magnet, Shaft
from rig.physics.kernels.frames import geometry
from rig.physics.kernels.laws import contact, house, magnet

PHASES = {"flight": ("FLIGHT",), "sliding": ("TOUCHING", "FORWARD", "BACKWARD"), "rolling": ("ROLLING",)}
"""The phases that each tape is for."""


class Choice(Known):
    """A parameter that is compared with: a flag of the model, or a number that decides between forms of a law."""

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

    __hash__ = Known.__hash__


@dataclass(frozen=True, eq=False)
class Node:
    """One operation. Equal nodes of one scope are the same object."""

    number: int
    kind: str
    arguments: tuple[Any, ...]
    """Nodes, coefficients, column numbers: by kind."""

    @property
    def sources(self) -> Iterator[Node]:
        """The nodes it is made of."""
        for each in self.arguments:
            if isinstance(each, Node | Symbol):
                yield each if isinstance(each, Node) else each.node


@dataclass
class Fork:
    """Nodes that exist by the answer to a condition, and what is the same name in both answers."""

    condition: str
    yes: list[Node | Fork]
    no: list[Node | Fork]
    joined: list[Node] = field(default_factory=list)
    """Of kind "either": arguments are both answers, each a `Symbol` or a number."""


class Symbol:
    """A coefficient times the series of a node."""

    def __init__(self, tape: Tape, node: Node, coefficient: Known | float = 1.0) -> None:
        self.tape, self.node, self.coefficient = tape, node, known(coefficient)

    def scaled(self, factor: Any) -> Any:
        """Times a number or parameter."""
        product = self.coefficient * factor
        return Symbol(self.tape, self.node, product) if isinstance(product, Known) else 0.0

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
        if kind == "shifted" and self.coefficient == Known() and known(other) == -arguments[2]:
            return Symbol(self.tape, arguments[1], arguments[0])
        return self.tape.enter("shifted", self.coefficient, self.node, known(other))

    def _factored(self, other: Symbol) -> Symbol | None:
        """A f + b f as (a + b) f: one product less."""
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

    def __pow__(self, exponent: Known) -> Symbol:
        node = self.node
        if node.kind == "product" and node.arguments[0] is node.arguments[1]:
            node, exponent = node.arguments[0], 2.0 * exponent
        assert self.coefficient == Known()
        return self.tape.enter("power", node, exponent)

    # The state decides nothing but through a phase: touching is not in flight, and its distance is not 0.
    def __le__(self, other: float) -> bool:
        return False

    def __gt__(self, other: float) -> bool:
        return True

    def __eq__(self, other: object) -> bool:
        return False

    __hash__ = None  # type: ignore[assignment]


class Tape:
    """Nodes in the order in which they can be worked out, in branches."""

    def __init__(self, phase: str) -> None:
        self.phase = phase
        self.items: list[Node | Fork] = []
        self.turns: dict[int, str] = {}
        """Angles whose sine and cosine are columns: how they begin. Their rates are nodes."""
        self.rates: dict[int, Any] = {}
        """Of every other column, by number."""
        self.events: dict[str, Any] = {}
        """What events are made of, by name."""
        self.lost: list[str] = []
        """Conditions under which the transducers of the pair at hand have lost their preload, in turn."""
        self.held: list[Any] = []
        self.motion: Any = None
        self._scopes: list[dict[Any, Node]] = [{}]
        self._open: list[list[Node | Fork]] = [self.items]
        self._numbers = count()
        self._answers: dict[str, bool] = {}

    def enter(self, kind: str, *arguments: Any) -> Symbol:
        """The symbol of an operation, entered where it is new."""
        there = self.find(kind, *arguments)
        if there is not None:
            return Symbol(self, there)
        node = Node(next(self._numbers), kind, arguments)
        self._scopes[-1][_key(kind, arguments)] = node
        self._open[-1].append(node)
        return Symbol(self, node)

    def find(self, kind: str, *arguments: Any) -> Node | None:
        """The node of an operation that is there already, in this branch or before it."""
        key = _key(kind, arguments)
        return next((scope[key] for scope in self._scopes if key in scope), None)

    def product(self, one: Node, two: Node) -> Symbol:
        """The symbol of a product, of products that are there already where a b x or a b c d can be put together so."""
        pairs = [node.arguments for node in (one, two) if node.kind == "product"]
        if len(pairs) == 2:
            (a, b), (c, d) = pairs
            for left, right in (((a, c), (b, d)), ((a, d), (b, c))):
                first, second = self.find("product", *_sorted(*left)), self.find("product", *_sorted(*right))
                if first is not None and second is not None:
                    return self.enter("product", *_sorted(first, second))
        for chain, factor in ((one, two), (two, one)):
            if chain.kind == "product":
                for kept, other in (chain.arguments, chain.arguments[::-1]):
                    there = self.find("product", *_sorted(kept, factor))
                    if there is not None and there is not chain:
                        return self.enter("product", *_sorted(other, there))
        return self.enter("product", *_sorted(one, two))

    def column(self, number: int) -> Symbol:
        """A column of the series."""
        return self.enter("column", number)

    def decide(self, condition: str) -> bool:
        """The answer that is being tried."""
        if condition not in self._answers:
            raise _UndecidedError(condition)
        return self._answers[condition]

    def decide_among(self, name: str, values: tuple[str, ...], value: str) -> bool:
        """Whether a parameter has one of its values."""
        left = [each for each in values if self._answers.get(f"{name} == {each}", True)]
        taken = [each for each in values if self._answers.get(f"{name} == {each}", False)]
        if taken or len(left) == 1:
            return value in (taken or left)
        return value in left and self.decide(f"{name} == {value}")

    def stage(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A stage that is run for each answer to what it asks."""

        def staged(*arguments: Any) -> Any:
            before, self._answers = self._answers, {}
            try:
                return self._branch(function, arguments)
            finally:
                self._answers = before

        return staged

    def either(self, condition: str, yes: Any, no: Any) -> Any:
        """One or the other, both known by now."""
        fork = Fork(condition, [], [])
        self._open[-1].append(fork)
        return self._join(fork, yes, no)

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
        return self._join(fork, *answers)

    def _join(self, fork: Fork, yes: Any, no: Any) -> Any:
        if isinstance(yes, tuple):
            joined = [self._join(fork, *pair) for pair in zip(yes, no, strict=True)]
            return type(yes)(*joined) if hasattr(yes, "_fields") else tuple(joined)
        if isinstance(yes, Symbol) and isinstance(no, Symbol) and yes.node is no.node:
            if yes.coefficient == no.coefficient:
                return yes
            return Symbol(self, yes.node, self._join(fork, yes.coefficient, no.coefficient))
        if isinstance(yes, Symbol) or isinstance(no, Symbol):
            node = Node(next(self._numbers), "either", (yes, no))
            fork.joined.append(node)
            return Symbol(self, node)
        if known(yes) == known(no):
            return yes
        return named(f"({known(yes).text} if {fork.condition} else {known(no).text})")


def _key(kind: str, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    return (kind, *(each.number if isinstance(each, Node) else each for each in arguments))


def _sorted(one: Node, two: Node) -> tuple[Node, Node]:
    return (one, two) if one.number <= two.number else (two, one)


class _UndecidedError(Exception):
    def __init__(self, condition: str) -> None:
        self.condition = condition


def record(phase: str) -> Tape:
    """The tape of a phase: rates of all columns, and what its events are made of."""
    tape = Tape(phase)
    columns = [tape.column(number) for number in range(S.N_VECTOR)]
    rates: list[Any] = [0.0] * S.N_VECTOR
    # Shared by two terms that would not find it by themselves.
    tape.product(columns[S.GAMMA_RATE].node, tape.column(TURNS[S.BETA] + 1).node)
    phases = {getattr(contact, name): name for name in PHASES[phase]}
    with _on_symbols(tape):
        dynamics.evaluate(
            _constants(tape), _inputs(tape), 0, 0.0, named("onset"), Choice(tape, "phase", phases), False, columns,
            rates, [0.0] * S.N_OBSERVED,
        )  # fmt: skip
        if tape.held:
            constants, state, pose, e, ring = tape.held
            tape.events["residual"] = dynamics.sliding_acceleration(constants, state, pose, e, ring, tape.motion)
    tape.rates.update(enumerate(rates))
    tape.rates[TIME] = 1.0
    tape.rates[PULSE_SINE] = tape.column(PULSE_COSINE).scaled(named("pulse"))
    tape.rates[PULSE_COSINE] = tape.column(PULSE_SINE).scaled(-named("pulse"))
    return tape


_COMPARED = ("exponent", "gap_counts_outer")
"""Numbers of the contact that laws are chosen by."""


def _fields(kind: type, prefix: str, **given: Any) -> Any:
    return kind(**{name: given.get(name, named(f"{prefix}.{name}")) for name in kind._fields})


def _constants(tape: Tape) -> Constants:
    laws = {getattr(contact, name): name for name in ("NO_FRICTION", "SMOOTHED", "EXACT")}
    flags = {name: Choice(tape, f"levels.{name}") for name in ("euler", "inner_house", "outer_house", "compliant")}
    maps = {getattr(magnet, name): name for name in ("LINEAR", "RADIAL", "RIPPLED")}
    return Constants(
        levels=Levels(**flags, friction=Choice(tape, "levels.friction", laws)),  # type: ignore[arg-type]
        shaft=_fields(Shaft, "shaft"),
        magnet=_fields(Magnet, "magnet", terms=Choice(tape, "magnet.terms", maps)),
        contact=_fields(Contact, "contact", **{name: Choice(tape, f"contact.{name}") for name in _COMPARED}),
        house=_fields(House, "house"),
        torque_gain=named("constants.torque_gain"),  # type: ignore[arg-type]
    )


def _inputs(tape: Tape) -> Inputs:
    flags = {name: Choice(tape, f"inputs.{name}") for name in ("ideal_drive", "magnet_engaged")}
    return _fields(Inputs, "inputs", **flags)


@contextmanager
def _on_symbols(tape: Tape) -> Iterator[None]:
    """What of the kernels has another meaning for series; everything else runs as it stands, stage by stage."""
    before: list[tuple[ModuleType, str, Any]] = []

    def replace(module: ModuleType, name: str, value: Any) -> None:
        before.append((module, name, vars(module).get(name)))
        setattr(module, name, value)

    modules = (geometry, forces, house, magnet, contact, ledger, dynamics)
    for module in modules:
        for name, value in list(vars(module).items()):
            if isinstance(value, FunctionType) and value.__module__.startswith(__name__.partition(".")[0]):
                meaning = getattr(_Meanings, name, None)
                staged = tape.stage(value)
                replace(module, name, partial(meaning, tape, staged) if meaning else staged)
    for module in (contact, forces):
        functions = {name: partial(function, tape) for name, function in _FUNCTIONS.items()}
        replace(module, "math", SimpleNamespace(**functions, pi=math.pi))
    for module in (contact, house):
        replace(module, "max", partial(_larger, tape))
    try:
        yield
    finally:
        for module, name, value in before:
            if value is None:
                delattr(module, name)
            else:
                setattr(module, name, value)


class _Meanings:
    """Stages by name that are something else, or are to be remembered, for series. The plain stage comes along."""

    @staticmethod
    def sines_of(tape: Tape, plain: Any, levels: Any, angle: Symbol) -> tuple[Symbol, Symbol]:
        """Columns for small angles too: the sine's rate is the angle's where the cosine stays 1."""
        return _turn(tape, angle, geometry.large_of(levels))

    @staticmethod
    def hammer_force(tape: Tape, plain: Any, inputs: Inputs, *when: Any) -> Any:
        return tape.column(PULSE_SINE) * inputs.hammer_force

    @staticmethod
    def drive_speed(tape: Tape, plain: Any, inputs: Inputs, *when: Any) -> Any:
        return tape.column(TIME) * inputs.speed_slope + named("aim")

    @staticmethod
    def complex_power(tape: Tape, plain: Any, x: Symbol, y: Symbol, exponent: Known) -> tuple[Symbol, Symbol]:
        wave = tape.enter("complex_power", x.coefficient, x.node, y.coefficient, y.node, known(exponent)).node
        return tape.enter("part", wave, "x"), tape.enter("part", wave, "y")

    @staticmethod
    def pair_readings(tape: Tape, plain: Any, displacement: Any, stiffness: Known, preload: Any) -> Any:
        lost = "north" if "vertical" in stiffness.text else "east"
        tape.lost = [f"{lost} < 0.0", f"{lost} > 0.0"]
        return plain(displacement, stiffness, preload)

    @staticmethod
    def ring_force(tape: Tape, plain: Any, ex: Symbol, ey: Symbol, *others: Any) -> Any:
        tape.events["square"] = ex * ex + ey * ey
        force = plain(ex, ey, *others)
        tape.events["ring"] = force
        return force

    @staticmethod
    def penetration_of(tape: Tape, plain: Any, distance: Symbol, law: Contact) -> Any:
        """Of a series in slowed time, whose root is a column."""
        depth = tape.column(ROOT) * tape.column(ROOT) if tape.phase == "sliding" else plain(distance, law)
        tape.events["depth"] = depth
        return depth

    @staticmethod
    def damping_ratio(tape: Tape, plain: Any, *arguments: Any) -> Any:
        tape.events["ratio"] = plain(*arguments)
        return tape.events["ratio"]

    @staticmethod
    def holding_friction(tape: Tape, plain: Any, constants: Any, inputs: Any, phase: Any, *others: Any) -> Any:
        """Unknown: what it keeps at 0 is worked out of the accelerations with it."""
        *tape.held, _ = (constants, *others)
        return tape.enter("unknown")

    @staticmethod
    def accelerations(tape: Tape, plain: Any, *arguments: Any) -> Any:
        tape.motion = plain(*arguments)
        return tape.motion


def _turn(tape: Tape, angle: Symbol, large: Any = 1.0) -> tuple[Symbol, Symbol]:
    """Sine and cosine of an angle of the state, which may be shifted: two columns with rates of their own."""
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


def _root(tape: Tape, value: Symbol) -> Symbol:
    kind, arguments = value.node.kind, value.node.arguments
    if kind == "product" and arguments[0] is arguments[1] and value.coefficient == Known():
        return Symbol(tape, arguments[0])
    return tape.enter("root", value.coefficient, value.node)


def _larger(tape: Tape, nothing: float, value: Any) -> Any:
    """The larger of 0 and a value: which one that is, an event has told."""
    if tape.lost:
        return tape.either(tape.lost.pop(0), nothing, value)
    tape.events["normal"] = value
    return tape.either("slack", nothing, value)


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sqrt": _root,
    "sin": lambda tape, angle: _turn(tape, angle)[0],
    "cos": lambda tape, angle: _turn(tape, angle)[1],
    "tanh": lambda tape, value: tape.enter("tanh", value.coefficient, value.node),
}
