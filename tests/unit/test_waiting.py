"""Waits of the tests: a wait for a process ends with it, and its message contains the process's output."""

from __future__ import annotations

import pytest

from tests.processes import read_line, start_python
from tests.waiting import PATIENCE_S, time_limit, until

FAILING_PROGRAM = "print('out of order', flush=True); raise SystemExit(3)"


def test_a_wait_for_a_process_that_has_ended_fails_at_once_with_its_output() -> None:
    message = r"ended with status 3 before that:\nout of order"
    with (
        start_python("-S", "-c", FAILING_PROGRAM) as child,
        time_limit(PATIENCE_S),
        pytest.raises(AssertionError, match=message),
    ):
        until(lambda: False, of=child)


def test_a_condition_met_before_the_process_ended_is_no_failure() -> None:
    with start_python("-S", "-c", FAILING_PROGRAM) as child:
        until(lambda: child.poll() is not None, of=child)


def test_a_missing_line_is_reported_with_the_received_ones() -> None:
    message = r"status 0 and without 'listening on':\ncompiling"
    silent = start_python("-S", "-c", "import sys; print('compiling', file=sys.stderr)")
    with silent as child, pytest.raises(AssertionError, match=message):
        read_line(child, "listening on")
    with start_python("-S", "-c", "print('no rig'); print('ready')", stderr=None) as child:
        assert read_line(child, "ready") == "ready\n"
