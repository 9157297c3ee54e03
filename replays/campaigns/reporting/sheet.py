"""Sheet to hand in: identity of the device, verdict as found and as left, measurements, digests, and room to sign."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from replays.campaigns.reporting.page import (
    CASE_MARKS,
    Document,
    add_picture,
    format_limit,
    format_number,
    judge_counts,
    summarize_counts,
)  # fmt: skip
from replays.report import OUTCOME_MARKS, Report, Row
from replays.report.writing import check_suffix
from replays.studies.common import provenance
from rig.base.errors import InputError

IDENTITY = ("name", "serial", "firmware", "operator", "laboratory", "order")
"""Fields of the identity, in this order; others are allowed."""
_LINE = "_" * 24
_LIBRARIES = (provenance.RIG, "numpy", "scipy", "numba", "eclipse-zenoh", "mcap")


def parse_identity(texts: list[str]) -> dict[str, str]:
    """Parse texts such as "serial=123".

    Raises:
        InputError: If a text has no name or no value, or a name occurs twice.
    """
    identity: dict[str, str] = {}
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        if not name or not value or name in identity:
            raise InputError("--identity", "NAME=TEXT, each name once, such as serial=123", text)
        identity[name] = value
    return identity


def check_sheet(path: Path) -> None:
    """Raise an error unless a sheet can have this name.

    Raises:
        InputError: If it ends neither in .html nor in .pdf, or its folder does not exist.
    """
    try:
        check_suffix(path)
    except InputError as error:
        raise InputError("--sheet", error.must, error.received) from None
    if not path.absolute().parent.is_dir():
        raise InputError("--sheet", "in a folder that exists", str(path))


def make_sheet(
    results: Document, folder: Path, identity: Mapping[str, str], as_found: Document | None = None
) -> Report:
    """Return the sheet of a campaign's results.

    Args:
        results: Content of results.json, as left.
        folder: Folder that holds the evidence.
        identity: Fields of the identity by name; missing ones are left open to be filled in by hand.
        as_found: Results of the first campaign on this device, before it was adjusted.
    """
    counts, wall = results["counts"], results["wall"]
    mark = judge_counts(counts)
    if mark == "good" and counts["skipped"]:
        mark = "open"  # a sheet of a test that is not complete
    verdict = {"good": "PASS", "bad": "FAIL", "open": "INCONCLUSIVE"}[mark]
    title = f"Test sheet: {'; '.join(results['titles'])}"
    report = Report(title, f"{verdict}: {summarize_counts(counts)}.", mark=mark)
    report.heading("Identity")
    fields = {name: identity.get(name, _LINE) for name in IDENTITY} | dict(identity)
    origin = {"tested": f"{wall['begun']} UTC", "machine": wall["machine"], "rig": wall["rig"]}
    report.table(("field", "text"), [*fields.items(), *origin.items()])
    versions = ", ".join(f"{name} {number}" for name, number in provenance.versions(*_LIBRARIES).items())
    report.text(f"Versions: {versions}. The virtual rig's sensor calibrations are assumed values.")
    report.heading("Verdicts")
    earlier = {case["id"]: case["outcome"] for case in (as_found or {"cases": ()})["cases"]}
    headings = ("case", "as found", "as left") if as_found is not None else ("case", "verdict")
    report.table(headings, [
        Row((case["id"], *([earlier.get(case["id"], "not tested")] if as_found is not None else []), case["outcome"]),
            CASE_MARKS[case["outcome"]])
        for case in results["cases"]
    ])  # fmt: skip
    report.heading("Measurements")
    for case in results["cases"]:
        report.heading(case["id"], level=2)
        if case["reason"]:
            report.text(case["reason"])
        report.table(("measurement", "value", "must be", "source", "verdict"), [
            Row((each["name"], format_number(each["value"], each["unit"], "nothing"), format_limit(each),
                 each["source"], each["outcome"]), OUTCOME_MARKS[each["outcome"]])
            for each in case["measurements"]
        ])  # fmt: skip
        add_picture(report, case, folder, f"Signals and events: {case['id']}.")
    report.heading("Digests (SHA-256)")
    digests = {file: digest for case in wall["cases"].values() for file, digest in case.get("digests", {}).items()}
    report.table(("file", "digest"), list(digests.items()))
    report.heading("Signatures")
    report.table(
        ("", "name", "date", "signature"), [(who, _LINE, _LINE, _LINE) for who in ("tested by", "approved by")]
    )
    return report
