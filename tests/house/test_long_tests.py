"""The long tests are those that take long, and all of them exist."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests import long_tests
from tests.processes import ROOT


def make_item(nodeid: str) -> Any:
    return SimpleNamespace(nodeid=nodeid)


def test_names_stand_for_all_parameters_only_if_all_take_long() -> None:
    costs = [("a.py::f[1]", 2.0), ("a.py::f[2]", 9.0), ("a.py::g[1]", 2.0), ("a.py::g[2]", 0.1), ("a.py::h", 0.1)]
    assert long_tests.choose([*costs, ("a.py::g[2]", 0.3)])[:2] == ["a.py::f", "a.py::g[1]"]
    assert "a.py::h" in long_tests.choose([*costs, ("a.py::h", 3.0)])
    kept = long_tests.KEPT_TESTS[0]
    assert kept not in long_tests.choose([(kept, 99.0)])


def test_long_tests_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long_tests, "read_list", lambda: ["a.py::f", "a.py::g[1]", "b.py"])
    items = [make_item(name) for name in ("a.py::f[1]", "a.py::f[2]", "a.py::g[1]", "a.py::g[2]", "b.py::x", "c.py::f")]
    short, long = long_tests.split(items)
    assert [each.nodeid for each in short] == ["a.py::g[2]", "c.py::f"]
    assert len(short) + len(long) == len(items)


def test_every_name_is_that_of_a_test() -> None:
    for name in [*long_tests.read_list(), *long_tests.KEPT_TESTS]:
        module, _, test = name.partition("::")
        assert f"def {test.partition('[')[0]}" in (ROOT / module).read_text(encoding="utf-8"), name
