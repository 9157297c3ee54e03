"""Outcome of a judgement: pass, fail or inconclusive, with the exit status of a command.

A pass needs evidence: without failures and with too little evidence, the outcome is inconclusive.
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
    def judge(cls, *, failed: bool, has_evidence: bool) -> Outcome:
        """Return FAIL after a failure, otherwise PASS with enough evidence, otherwise INCONCLUSIVE."""
        if failed:
            return cls.FAIL
        return cls.PASS if has_evidence else cls.INCONCLUSIVE

    @classmethod
    def worst(cls, outcomes: Iterable[Outcome]) -> Outcome:
        """Return the worst outcome: FAIL, then INCONCLUSIVE, then PASS; INCONCLUSIVE without outcomes."""
        kinds = set(outcomes)
        return cls.judge(failed=cls.FAIL in kinds, has_evidence=kinds == {cls.PASS})


class InconclusiveError(Exception):
    """A test without failures and with too little evidence for a pass; one line."""


_EXIT_STATUS = {Outcome.PASS: 0, Outcome.FAIL: 1, Outcome.INCONCLUSIVE: 3}
"""Status 2 is wrong input, in every command."""
