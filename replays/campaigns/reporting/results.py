"""Results of a campaign: results.json, junit.xml, index.html and the evidence, in one folder.

In lockstep, repeated runs of a campaign write the same results.json byte for byte, except for the `wall` section.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from replays.campaigns.equipment.cleanup import find_containment
from replays.report import junit, write_report
from replays.studies.common import provenance
from rig.base.checks import DOCUMENT_BYTES, StrictModel, check, read_json
from rig.base.errors import InputError
from rig.base.files import build_read_error, lock_folder, read_file, write_file
from rig.base.text import printable, replace_nonfinite

if TYPE_CHECKING:
    import pytest

FORMAT = 1
OUTCOMES = ("failed", "error", "interrupted", "inconclusive", "skipped", "passed")
"""Possible outcomes of a case, worst first."""
_JUNIT: dict[str, junit.Outcome] = {
    "failed": "failure", "error": "error", "interrupted": "error", "inconclusive": "inconclusive",
    "skipped": "skipped", "passed": "passed",
}  # fmt: skip
_WALL_FIELDS = ("floor_ms", "late_blocks", "digests")
"""Fields of a case that depend on the wall clock; a recording has its times of arrival."""
_OUTPUT = ("results.json", "junit.xml", "index.html", "evidence")
"""Files and folder that a campaign writes, and replaces."""
_MAX_REASON_LENGTH = 2000
_UNFINISHED = "the run ended before this case was finished"


class _EarlierMeasurement(StrictModel, extra="ignore"):
    name: str
    unit: str
    margin: float | None
    value: float | None = None


class _EarlierCase(StrictModel, extra="ignore"):
    id: str
    outcome: Literal["failed", "error", "interrupted", "inconclusive", "skipped", "passed"]
    measurements: list[_EarlierMeasurement]


class _EarlierTime(StrictModel, extra="ignore"):
    duration_s: float


class _EarlierWall(StrictModel, extra="ignore"):
    begun: str
    cases: dict[str, _EarlierTime]


class _EarlierResults(StrictModel, extra="ignore"):
    """What is read of the results of an earlier campaign."""

    cases: list[_EarlierCase]
    wall: _EarlierWall
    identity: dict[str, str] = Field(default={})


class Results:
    """pytest plugin that collects the test reports and writes the results at the end.

    Args:
        folder: Output folder, created if missing.
        against: Results of earlier campaigns, the oldest first.
        config: Configuration of the pytest run.
        force: Whether a folder that no campaign wrote may be used.

    Raises:
        InputError: If another campaign writes to the folder, the folder has files that no campaign wrote, or the
            earlier results cannot be read.
        DiskError: If the folder cannot be created.
    """

    def __init__(self, folder: Path, against: Sequence[Path], config: pytest.Config, *, force: bool = False) -> None:
        self._earlier = [load_results(each) for each in against]
        check_output(folder, force=force)
        self._lock = lock_folder(folder, "campaign")
        self._folder, self._config = folder, config
        shutil.rmtree(folder / "evidence", ignore_errors=True)  # of the results that are overwritten
        self._cases: dict[str, dict[str, Any]] = {}
        self._planned: dict[str, None] = {}
        self._files: dict[str, str] = {}
        self._begun_s = time.time()
        self._write_results()  # a campaign that is killed leaves a folder that the next one recognises

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Record the collected tests."""
        self._planned |= {item.nodeid: None for item in session.items}
        self._files |= {item.nodeid: item.location[0] for item in session.items}

    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """Record the tests that a worker process of pytest-xdist collected."""
        self._planned |= dict.fromkeys(ids)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Record a collection error."""
        if report.failed:
            self._case(report.nodeid).update(outcome="error", reason=_line(str(report.longrepr)))

    def pytest_runtest_logstart(self, nodeid: str, location: tuple[str, int | None, str]) -> None:
        """Mark a test as started."""
        self._files[nodeid] = location[0]
        self._case(nodeid)["reason"] = _UNFINISHED

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Record the outcome of one phase of a test."""
        case = self._case(report.nodeid)
        case["duration_s"] += report.duration
        case |= getattr(report, "rig", {})
        if report.failed:
            outcome = find_outcome(report)
            case["outcome"] = outcome if case["outcome"] in ("interrupted", "inconclusive") else "error"
            case["reason"] = find_reason(report) if case["reason"] == _UNFINISHED else case["reason"]
        elif report.skipped:
            case |= {"outcome": "skipped", "reason": find_reason(report)}
        elif report.when == "teardown" and case["outcome"] == "interrupted":
            case |= {"outcome": "passed", "reason": ""}

    def _case(self, name: str) -> dict[str, Any]:
        return self._cases.setdefault(name, {
            "outcome": "interrupted", "reason": "", "duration_s": 0.0, "title": "", "measurements": [],
            "evidence": [], "bench": None, "setup": {}, "resolution": "", "troubles": [],
            "floor_ms": None, "late_blocks": 0, "digests": {},
        })  # fmt: skip

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write all result files."""
        if hasattr(self._config, "workerinput"):
            return
        document = self._write_results()
        write_junit(document, self._folder / "junit.xml")
        from replays.campaigns.reporting.page import make_page

        write_report(make_page(document, self._folder, self._earlier), self._folder / "index.html")
        for sheet in self._config.option.rig_sheet or ():
            from replays.campaigns.reporting.sheet import make_sheet

            as_found = self._earlier[0] if self._earlier else None
            write_report(make_sheet(document, self._folder, document["identity"], as_found), Path(sheet))
        os.close(self._lock)

    def _write_results(self) -> dict[str, Any]:
        document = self.document()
        write_file(self._folder / "results.json", json.dumps(document, indent=1, allow_nan=False) + "\n")
        return document

    def document(self) -> dict[str, Any]:
        """Return the results as a JSON document."""
        from replays.campaigns.reporting.sheet import parse_identity

        cases, wall = [], {}
        # Parallel workers finish in any order; the planned order is always the same.
        for name in [*self._planned, *(name for name in self._cases if name not in self._planned)]:
            if name not in self._cases:
                self._case(name)["reason"] = "not run"
            case = self._cases[name]
            clock = {key: case[key] for key in _WALL_FIELDS}
            reported = {key: value for key, value in case.items() if key not in ("duration_s", *clock)}
            cases.append({"id": name, **reported, "repeat": self._repeat(name)})
            wall[name] = {"duration_s": round(case["duration_s"], 3), **clock}
        counts = {outcome: sum(case["outcome"] == outcome for case in cases) for outcome in OUTCOMES}
        titles = list(dict.fromkeys(case["title"] for case in cases if case["title"]))
        return replace_nonfinite({
            "format": FORMAT, "titles": titles, "counts": counts, "cases": cases,
            "identity": parse_identity(getattr(self._config.option, "rig_identity", None) or []),
            "replaced_limits": getattr(self._config.option, "rig_limit", None) or [],
            "wall": {
                "begun": datetime.fromtimestamp(self._begun_s, UTC).strftime("%Y-%m-%dT%H:%M:%S"),
                "duration_s": round(time.time() - self._begun_s, 3), "machine": provenance.machine(),
                "rig": " ".join(filter(None, (*provenance.versions(provenance.RIG).values(), provenance.commit()))),
                "containment": find_containment(), "cases": wall,
            },
        })  # fmt: skip

    def _repeat(self, name: str) -> str:
        """Return the command that repeats this case."""
        path, colons, rest = name.partition("::")
        whole = self._config.rootpath / self._files.get(name, path)
        file = os.path.relpath(whole, self._config.invocation_params.dir)
        if whole.parent == Path(__file__).parents[1]:  # a shipped campaign has a name
            file = whole.name.partition(".")[0]
        more = [(f"--{name}", self._config.getoption(f"rig_{name}")) for name in ("url", "replay", "device")]
        more += [("--limit", each) for each in self._config.getoption("rig_limit") or ()]
        options = [word for option, value in more if value for word in (option, value)]
        return shlex.join(["rig", "campaign", f"{file}{colons}{rest}", *options])


def find_outcome(report: Any) -> str:
    """Return the outcome of a failed test phase: failed, error or inconclusive."""
    if getattr(report, "rig_inconclusive", False):
        return "inconclusive"
    return "failed" if report.when == "call" else "error"


def find_reason(report: Any) -> str:
    """Return why a test phase failed or was skipped, on one line."""
    longrepr = report.longrepr
    if isinstance(longrepr, tuple):  # a skip: file, line, reason
        return _line(str(longrepr[2]).removeprefix("Skipped: "))
    crash = getattr(longrepr, "reprcrash", None)
    return _line(str(longrepr) if crash is None else crash.message.split(": ", 1)[-1])


def _line(text: str) -> str:
    return printable(next((line for line in text.splitlines() if line.strip()), ""), _MAX_REASON_LENGTH)


def load_results(folder: Path) -> dict[str, Any]:
    """Read the results of an earlier campaign.

    Args:
        folder: Folder of the campaign, or its results.json.

    Raises:
        InputError: If the file is missing or has another format.
    """
    path = folder if folder.suffix == ".json" else folder / "results.json"
    try:
        document = read_json(read_file(path, DOCUMENT_BYTES), field=str(path))
    except OSError as error:
        raise build_read_error(path, error) from None
    if document.get("format") != FORMAT:
        raise InputError(str(path), "campaign results written by this version of rig", document.get("format"))
    check(_EarlierResults, document, field=str(path))
    return document


def check_output(folder: Path, *, force: bool) -> None:
    """Raise an error for a folder with files of a campaign's names that no campaign wrote.

    Raises:
        InputError: If there are such files and `force` is not set, or the folder for evidence is not a campaign's.
    """
    found = [name for name in _OUTPUT if os.path.lexists(folder / name)]
    evidence = os.path.lexists(folder / "evidence")
    if not found or (force and not evidence):
        return
    try:
        load_results(folder)
    except InputError:
        own = "" if evidence else ", unless --force is given"
        name = "evidence" if evidence else found[0]
        must = f"a folder without {name}, or one with the results of an earlier campaign{own}"
        raise InputError("--output", must, str(folder)) from None
    if (folder / "evidence").is_symlink():
        raise InputError("--output", "a folder whose evidence is no symbolic link", str(folder))


def write_junit(document: dict[str, Any], path: Path) -> None:
    """Write the results as JUnit XML, one suite per case because only a suite can hold a case's measurements.

    Raises:
        DiskError: If the file cannot be written.
    """
    suites = []
    for case in document["cases"]:
        file, _, name = case["id"].partition("::")
        wall = document["wall"]["cases"].get(case["id"], {})
        lines = [_measurement_line(each) for each in case["measurements"]] + [f"repeat: {case['repeat']}"]
        one = junit.JunitCase(
            file.replace("/", "."), name or file, _JUNIT[case["outcome"]], case["reason"], "\n".join(lines),
            wall.get("duration_s", 0.0),
        )  # fmt: skip
        properties = [("outcome", case["outcome"]), ("inconclusive", str(int(case["outcome"] == "inconclusive")))]
        properties += [("late blocks", str(late))] if (late := wall.get("late_blocks")) else []
        suites.append(junit.Suite(case["id"], [one], [*properties, *_properties(case)], document["wall"]["begun"]))
    junit.write_junit(path, suites, name="; ".join(document["titles"]))


def _properties(case: dict[str, Any]) -> Any:
    for each in case["measurements"]:
        for key in ("value", "unit", "limit", "margin", "source", "resolution", "note"):
            value = f"{each['op']} {each['limit']}" if key == "limit" else each[key]
            if value not in ("", None):
                yield f"{each['name']}.{key}", str(value)
    for file in case["evidence"]:
        yield "evidence", file


def _measurement_line(each: dict[str, Any]) -> str:
    return f"{each['outcome']}: {each['name']}: {each['value']} {each['unit']}, {each['op']} {each['limit']}"
