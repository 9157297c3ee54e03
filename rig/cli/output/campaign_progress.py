"""Progress of `rig campaign` while pytest runs the tests: a line per finished case, and a live line."""

from __future__ import annotations

import io
import os
import sys
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import pytest

from rig.base.text import printable
from rig.cli.output.tables import echo, plain_text

OUTCOME_WORDS = {
    "passed": "pass",
    "failed": "FAIL",
    "error": "ERROR",
    "inconclusive": "INCONCLUSIVE",
    "skipped": "skip",
}
"""Words printed for each outcome of a case."""


def bypass_capture(bar: Any) -> Any:
    """Return the bar, connected to the terminal although pytest captures stdout and stderr."""
    if bar.console.is_terminal:
        bar.console.file = os.fdopen(os.dup(sys.stderr.fileno()), "w", encoding="utf-8")
    return bar


@dataclass
class ProgressPlugin:
    """Plugin of pytest that prints a line per case and updates a live line."""

    bar: Any
    planned: dict[str, None] = field(default_factory=dict)
    outcomes: dict[str, str] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    done: set[str] = field(default_factory=set)
    running: dict[str, None] = field(default_factory=dict)
    collecting_failed: bool = False
    task: Any = None
    is_reader_closed: bool = False
    """The reader of the output has exited."""
    pytest_output: io.StringIO = field(default_factory=io.StringIO)
    """Output of pytest itself, which is not shown."""

    @pytest.hookimpl(trylast=True)
    def pytest_configure(self, config: Any) -> None:
        """Capture the output of pytest's terminal reporter."""
        reporter = config.pluginmanager.get_plugin("terminalreporter")
        config.pluginmanager.unregister(reporter)
        config.pluginmanager.register(type(reporter)(config, self.pytest_output), "terminalreporter")

    @property
    def counts(self) -> Counter[str]:
        """Number of finished cases by outcome."""
        return Counter(self.outcomes[name] for name in self.done)

    def pytest_collection_finish(self, session: Any) -> None:
        """Store the cases to run."""
        self.planned |= {item.nodeid: None for item in session.items}

    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """Store the cases to run with several processes."""
        self.planned |= dict.fromkeys(ids)

    def pytest_collectreport(self, report: Any) -> None:
        """Report a file that could not be collected."""
        if report.failed:
            self.collecting_failed = True
            echo(f"rig: {printable(str(report.longrepr).strip().splitlines()[-1])}", err=True)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Show a case that begins."""
        self.running[nodeid] = None
        self._show()

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Record the end of a phase of a case; print the case after its last phase."""
        from replays.campaigns.files.run import REPETITION_NAME
        from replays.campaigns.reporting.results import find_outcome, find_reason

        name = report.nodeid
        outcome = self.outcomes.get(name, "passed")
        if report.failed:
            outcome = find_outcome(report) if outcome in ("passed", "inconclusive") else "error"
        elif report.skipped:
            outcome = "skipped"
        self.outcomes[name] = outcome
        if outcome != "passed" and name not in self.reasons:
            # A campaign file has a line for each value that fails.
            lines = report.longrepr.splitlines() if isinstance(report.longrepr, str) else ()
            self.reasons[name] = "\n      ".join([find_reason(report), *map(printable, lines[1:])])
        if report.when == "teardown":
            self.done.add(name)
            self.running.pop(name, None)
            reason = f": {self.reasons[name]}" if name in self.reasons else ""
            for each in getattr(report, "rig", {}).get("measurements", ()) if outcome == "passed" else ():
                reason += f" ({each['note']})" if each["name"] == REPETITION_NAME else ""
            if late := getattr(report, "rig", {}).get("late_blocks"):
                reason += f" (the rig was late in {late} blocks)"
            for line in f"{OUTCOME_WORDS[outcome]:5} {name}{reason}".split("\n"):
                self._print_line(line)
            self._show()

    def _print_line(self, line: str) -> None:
        if self.bar.console.is_terminal and sys.stdout.isatty():
            self.bar.console.print(plain_text(printable(line)))  # above the live line
            return
        try:
            echo(line)
        except BrokenPipeError:
            self.is_reader_closed = True
            raise

    def _show(self) -> None:
        if self.task is None:
            self.task = self.bar.add_task("", total=len(self.planned) or None)
        unsuccessful = sum(self.counts[each] for each in ("failed", "error", "inconclusive"))
        current = next(iter(self.running), "").rpartition("::")[2]
        status = f"{len(self.done)} of {len(self.planned)} cases, {unsuccessful} not passed; {current}"
        self.bar.update(self.task, description=printable(status, 70), completed=len(self.done))
