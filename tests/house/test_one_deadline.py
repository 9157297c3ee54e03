"""Waiting with a deadline is implemented in one module, `rig.serve.waiting`: the syntax trees show no other."""

from __future__ import annotations

import ast

import pytest

from tests.house.test_sizes import paths, tree_of

HOME = "rig/serve/waiting.py"
CLOCKS = frozenset({"monotonic", "perf_counter", "monotonic_ns", "perf_counter_ns", "time", "time_ns"})
_SILENCE = "a silence, which every message begins again"
_PERIOD = "repeats something at a period, and does not wait for an end"
EXCEPTIONS = {
    "drivers/can/bus/endpoints.py:remove_departed": "looks once at the age of each node, and does not wait",
    "drivers/can/bus/outlets/outlet.py:_write_all": _SILENCE,
    "drivers/sources/can.py:_read": _SILENCE,
    "recorder/viewer/live.py:_draw_until_end": _PERIOD,
    "recorder/viewer/live.py:take_in": "drops blocks that are too old to be drawn, and does not wait",
    "replays/studies/chart/measure.py:_time_frames": "the budget of a measured computation; charts are tied to this",
    "rig/serve/service.py:_publish_all": _PERIOD,
    "rig/serve/service.py:_refresh_health": _PERIOD,
    "rig/serve/transport/clients.py:settle": _SILENCE,
}
"""Functions that compare the clock in a loop for another purpose, with the reason."""


def _reads_clock(node: ast.AST, names: set[str]) -> bool:
    """Return whether an expression reads a clock, or a variable with a stored reading."""
    if isinstance(node, ast.NamedExpr):
        node = node.value
    if isinstance(node, ast.Call):
        called = node.func
        return (
            isinstance(called, ast.Attribute)
            and called.attr in CLOCKS
            and isinstance(called.value, ast.Name)
            and called.value.id == "time"
        ) or (isinstance(called, ast.Name) and called.id in CLOCKS - {"time"})
    return isinstance(node, ast.Name) and node.id in names


def _readings(function: ast.AST) -> set[str]:
    """Return the variables in which a function stores readings of a clock."""
    found: set[str] = set()
    for node in ast.walk(function):
        if isinstance(node, ast.NamedExpr) and _reads_clock(node.value, set()):
            found.add(node.target.id)
        elif isinstance(node, ast.Assign):
            for target in node.targets:
                pairs = (
                    zip(target.elts, node.value.elts, strict=True)
                    if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
                    else [(target, node.value)]
                )
                found |= {to.id for to, value in pairs if isinstance(to, ast.Name) and _reads_clock(value, set())}
    return found


def _differs(node: ast.AST, names: set[str]) -> bool:
    """Return whether an expression is the time since, or until, an instant."""
    return (
        isinstance(node, ast.BinOp)
        and isinstance(node.op, ast.Sub)
        and (_reads_clock(node.left, names) or _reads_clock(node.right, names))
    )


def waits(tree: ast.AST) -> set[str]:
    """Return the functions of a tree that loop until an instant of a clock.

    Such a function adds a length of time to a reading of a clock and loops, or it loops while the time since a reading
    of a clock is short.
    """
    found = set()
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    for function in functions:
        names = _readings(function)
        inside = list(ast.walk(function))
        loops = [node for node in inside if isinstance(node, ast.While | ast.For | ast.comprehension)]
        ends = [
            node
            for node in inside
            if isinstance(node, ast.BinOp)
            and isinstance(node.op, ast.Add)
            and (_reads_clock(node.left, names) or _reads_clock(node.right, names))
        ]
        conditions = [loop.test for loop in loops if isinstance(loop, ast.While)]
        conditions += [node.test for loop in loops for node in ast.walk(loop) if isinstance(node, ast.If)]
        elapsed = [
            part
            for condition in conditions
            for compare in ast.walk(condition)
            if isinstance(compare, ast.Compare)
            for part in (compare.left, *compare.comparators)
            if _differs(part, names)
        ]
        if loops and (ends or elapsed):
            found.add(function.name)
    return found


def test_no_other_module_waits_until_a_deadline() -> None:
    found = {f"{path}:{name}" for path in paths() if path != HOME for name in waits(tree_of(path))}
    new, obsolete = sorted(found - set(EXCEPTIONS)), sorted(set(EXCEPTIONS) - found)
    assert not new, f"wait with Deadline or wait_until of {HOME}, not with a loop of your own: {', '.join(new)}"
    assert not obsolete, f"take these out of EXCEPTIONS: {', '.join(obsolete)}"


@pytest.mark.parametrize(
    "body",
    [
        "deadline = time.monotonic() + 3.0\n    while time.monotonic() < deadline: look()",
        "status, end = ask(), 3.0 + time.perf_counter()\n    while True:\n        if time.perf_counter() > end: return",
        "begin = time.monotonic()\n    while (now := time.monotonic()) - begin < 3.0: look()",
        "begin = monotonic()\n    for each in turns():\n        if monotonic() - begin > 3.0: return",
        "now = time.time()\n    end = now + 3.0\n    return all(look(end - time.time()) for _ in turns())",
    ],
)
def test_a_loop_until_a_deadline_is_found(body: str) -> None:
    assert waits(ast.parse(f"def wait():\n    {body}")) == {"wait"}


@pytest.mark.parametrize(
    "body",
    [
        "begin = time.monotonic()\n    work()\n    return time.monotonic() - begin",
        "for _ in Deadline(3.0).polls(): look()",
        "stamps.append(time.monotonic())\n    while stamps: drop(stamps.pop() + 1.0)",
    ],
)
def test_a_measured_time_is_no_deadline(body: str) -> None:
    assert not waits(ast.parse(f"def work():\n    {body}"))
