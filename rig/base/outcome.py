"""Outcome of a judgement: pass, fail or inconclusive, and the exit status of the command that judged.

A verdict needs evidence: where nothing failed but too little was shown, the outcome is inconclusive and not a pass.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum


class Outcome(StrEnum):
    """Outcome of a judgement."""

    PASS = "pass"
    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"

    @property
    def exit_status(self) -> int:
        """Exit status of a command with this outcome."""
        return _EXIT_STATUS[self]

    @classmethod
    def of(cls, *, failed: bool, shown: bool) -> Outcome:
        """Return FAIL if something failed, else PASS if enough was shown, else INCONCLUSIVE."""
        if failed:
            return cls.FAIL
        return cls.PASS if shown else cls.INCONCLUSIVE

    @classmethod
    def worst(cls, outcomes: Iterable[Outcome]) -> Outcome:
        """Return the worst of some outcomes: FAIL before INCONCLUSIVE before PASS; INCONCLUSIVE for none at all."""
        found = set(outcomes)
        return cls.of(failed=cls.FAIL in found, shown=found == {cls.PASS})


class InconclusiveError(Exception):
    """A test in which nothing failed, but which shows too little for a pass; one line."""


_EXIT_STATUS = {Outcome.PASS: 0, Outcome.FAIL: 1, Outcome.INCONCLUSIVE: 3}
"""2 is wrong input, in every command."""
