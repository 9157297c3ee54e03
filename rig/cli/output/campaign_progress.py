"""What `rig campaign` tells of tests that pytest runs: a line for each that is done, and a live one."""

from __future__ import annotations

import io
import os
import sys
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import pytest

from rig.base.text import printable
from rig.cli.output.tables import echo, plain

WORDS = {"passed": "pass", "failed": "FAIL", "error": "ERROR", "inconclusive": "OPEN", "skipped": "skip"}
"""What is said of a case that came to this."""


def beside_pytest(bar: Any) -> Any:
    """A bar that shows on the terminal while pytest holds stdout and stderr back."""
    if bar.console.is_terminal:
        bar.console.file = os.fdopen(os.dup(sys.stderr.fileno()), "w", encoding="utf-8")
    return bar


@dataclass
class Progress:
    """Tells how it goes, a line a case and a live one; a plugin of pytest."""

    bar: Any
    planned: dict[str, None] = field(default_factory=dict)
    outcomes: dict[str, str] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    done: set[str] = field(default_factory=set)
    running: dict[str, None] = field(default_factory=dict)
    collecting_failed: bool = False
    task: Any = None
    unheard: bool = False
    """Whoever read what is told has gone."""
    said: io.StringIO = field(default_factory=io.StringIO)
    """What pytest itself would have printed."""

    @pytest.hookimpl(trylast=True)
    def pytest_configure(self, config: Any) -> None:
        """Keep what pytest prints: this is what tells."""
        reporter = config.pluginmanager.get_plugin("terminalreporter")
        config.pluginmanager.unregister(reporter)
        config.pluginmanager.register(type(reporter)(config, self.said), "terminalreporter")

    @property
    def counts(self) -> Counter[str]:
        """How many cases came to what."""
        return Counter(self.outcomes[name] for name in self.done)

    def pytest_collection_finish(self, session: Any) -> None:
        """What is to be run."""
        self.planned |= {item.nodeid: None for item in session.items}

    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """The same where several processes run it."""
        self.planned |= dict.fromkeys(ids)

    def pytest_collectreport(self, report: Any) -> None:
        """What could not be collected."""
        if report.failed:
            self.collecting_failed = True
            echo(f"rig: {printable(str(report.longrepr).strip().splitlines()[-1])}", err=True)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """A case begins."""
        self.running[nodeid] = None
        self._show()

    def pytest_runtest_logreport(self, report: Any) -> None:
        """A phase of a case is over."""
        from replays.campaigns.reporting.results import outcome_of, reason_of

        name = report.nodeid
        before = self.outcomes.get(name, "passed")
        if report.failed:
            before = outcome_of(report) if before in ("passed", "inconclusive") else "error"
        elif report.skipped:
            before = "skipped"
        self.outcomes[name] = before
        if before != "passed" and name not in self.reasons:
            # Of a campaign's file a line for each value that is not as it must be.
            lines = report.longrepr.splitlines() if isinstance(report.longrepr, str) else ()
            self.reasons[name] = "\n      ".join([reason_of(report), *map(printable, lines[1:])])
        if report.when == "teardown":
            self.done.add(name)
            self.running.pop(name, None)
            reason = f": {self.reasons[name]}" if name in self.reasons else ""
            for line in f"{WORDS[before]:5} {name}{reason}".split("\n"):
                self._tell(line)
            self._show()

    def _tell(self, line: str) -> None:
        if self.bar.console.is_terminal and sys.stdout.isatty():
            self.bar.console.print(plain(printable(line)))  # above what is live
            return
        try:
            echo(line)
        except BrokenPipeError:
            self.unheard = True
            raise

    def _show(self) -> None:
        if self.task is None:
            self.task = self.bar.add_task("", total=len(self.planned) or None)
        bad = sum(self.counts[each] for each in ("failed", "error", "inconclusive"))
        now = next(iter(self.running), "").rpartition("::")[2]
        told = f"{len(self.done)} of {len(self.planned)} cases, {bad} bad; {now}"
        self.bar.update(self.task, description=printable(told, 70), completed=len(self.done))
