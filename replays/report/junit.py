"""JUnit XML, as read by Jenkins and other CI servers: suites with properties, and cases with outcomes."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rig.base.files import whole_file

_NOT_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
Outcome = Literal["passed", "failure", "error", "inconclusive", "skipped"]


@dataclass(frozen=True)
class JunitCase:
    """A test case.

    Attributes:
        classname: Dotted name of the module or class.
        name: Name within it.
        outcome: Outcome.
        message: Reason on one line.
        text: Details; for a passed case, its output.
        time_s: Duration [s].
    """

    classname: str
    name: str
    outcome: Outcome = "passed"
    message: str = ""
    text: str = ""
    time_s: float = 0.0


@dataclass(frozen=True)
class Suite:
    """Cases with a common name and properties.

    Attributes:
        name: Name of the suite.
        cases: Cases.
        properties: Names and values.
        timestamp: Start in ISO 8601 without a zone; empty: left out.
    """

    name: str
    cases: Sequence[JunitCase]
    properties: Sequence[tuple[str, str]] = ()
    timestamp: str = ""


def write_junit(path: Path, suites: Sequence[Suite], *, name: str = "") -> None:
    """Write suites as XML.

    Properties belong to suites, since the common schema has none in cases.

    Raises:
        DiskError: If the file cannot be written.
    """
    from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

    root = Element("testsuites", {"name": _xml(name)} if name else {})
    for suite in suites:
        element = SubElement(root, "testsuite", {"name": _xml(suite.name), **_counts(suite.cases)})
        if suite.timestamp:
            element.set("timestamp", suite.timestamp)
        if suite.properties:
            held = SubElement(element, "properties")
            for key, value in suite.properties:
                SubElement(held, "property", {"name": _xml(key), "value": _xml(value)})
        for case in suite.cases:
            about = {"classname": _xml(case.classname), "name": _xml(case.name), "time": _seconds(case.time_s)}
            one = SubElement(element, "testcase", about)
            if case.outcome == "inconclusive":  # the schema has no such element
                about = {"message": _xml(case.message), "type": "inconclusive"}
                SubElement(one, "error", about).text = _xml(case.text) or None
            elif case.outcome != "passed":
                SubElement(one, case.outcome, {"message": _xml(case.message)}).text = _xml(case.text) or None
            elif case.text:
                SubElement(one, "system-out").text = _xml(case.text)
    indent(root)
    with whole_file(path) as draft:
        ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True)


def _counts(cases: Sequence[JunitCase]) -> dict[str, str]:
    counts = Counter(case.outcome for case in cases)
    errors = counts["error"] + counts["inconclusive"]
    totals = {"tests": len(cases), "failures": counts["failure"], "errors": errors, "skipped": counts["skipped"]}
    return {**{key: str(count) for key, count in totals.items()}, "time": _seconds(sum(case.time_s for case in cases))}


def _seconds(time_s: float) -> str:
    return f"{time_s:.3f}"


def _xml(text: str) -> str:
    """Return a text without characters that XML 1.0 does not allow."""
    return _NOT_XML.sub("", text)
