"""JUnit's XML as Jenkins and others read it: suites with their properties, and cases with their outcomes."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rig.base.errors import whole_file

_NOT_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
Outcome = Literal["passed", "failure", "error", "inconclusive", "skipped"]


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        classname: What it belongs to, with dots between.
        name: Its name there.
        outcome: What came of it.
        message: Why, in a line.
        text: More of that; of one that passed, what it says.
        time_s: How long it took [s].
    """

    classname: str
    name: str
    outcome: Outcome = "passed"
    message: str = ""
    text: str = ""
    time_s: float = 0.0


@dataclass(frozen=True)
class Suite:
    """Cases under a name, with properties of all of them.

    Attributes:
        name: The name.
        cases: The cases.
        properties: By name.
        timestamp: When it began, ISO 8601 without a zone; empty: left out.
    """

    name: str
    cases: Sequence[Case]
    properties: Sequence[tuple[str, str]] = ()
    timestamp: str = ""


def write_junit(path: Path, suites: Sequence[Suite], *, name: str = "") -> None:
    """Write suites as XML.

    Properties stand in suites: in a case, where some write them, the common schema has none.

    Raises:
        DiskError: The disk refused.
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


def _counts(cases: Sequence[Case]) -> dict[str, str]:
    found = Counter(case.outcome for case in cases)
    errors = found["error"] + found["inconclusive"]
    told = {"tests": len(cases), "failures": found["failure"], "errors": errors, "skipped": found["skipped"]}
    return {**{key: str(count) for key, count in told.items()}, "time": _seconds(sum(case.time_s for case in cases))}


def _seconds(time_s: float) -> str:
    return f"{time_s:.3f}"


def _xml(text: str) -> str:
    """A text without what XML 1.0 cannot hold."""
    return _NOT_XML.sub("", text)
