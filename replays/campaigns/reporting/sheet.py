"""Sheet to hand in: identity of the device, verdict as found and as left, measurements, digests, and room to sign."""

from __future__ import annotations

from collections import Counter
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
    cases, found = results["cases"], as_found or {"cases": (), "identity": {}, "wall": {}}
    earlier = {case["id"]: case for case in found["cases"]}
    has_earlier = as_found is not None
    counts, wall = results["counts"], results["wall"]
    mark = judge_counts(counts)
    missing = _find_missing(results)
    if mark == "good" and (counts["skipped"] or missing):
        mark = "open"  # a sheet of a test that is not complete
    verdict = {"good": "PASS", "bad": "FAIL", "open": "INCONCLUSIVE"}[mark]
    serial = f", serial {identity['serial']}" if "serial" in identity else ""
    title = f"Test sheet: {'; '.join(results['titles'])}{serial}"
    replaced = ", ".join(results.get("replaced_limits", ()))
    lead = "; ".join([summarize_counts(counts), *missing, *([f"limits replaced: {replaced}"] if replaced else [])])
    report = Report(title, f"{verdict}: {lead}.", mark=mark)
    report.heading("Identity")
    fields = {name: identity.get(name, _LINE) for name in IDENTITY} | dict(identity)
    origin = {"tested": f"{wall['begun']} UTC", "machine": wall["machine"], "rig": wall["rig"]}
    before = {**found.get("identity", {}), "tested": f"{found['wall'].get('begun')} UTC"} if has_earlier else {}
    headings = ("field", *(["as found", "as left"] if has_earlier else ["text"]))
    report.table(headings, [
        (name, *([before.get(name, "")] if has_earlier else []), text) for name, text in {**fields, **origin}.items()
    ])  # fmt: skip
    versions = ", ".join(f"{name} {number}" for name, number in provenance.versions(*_LIBRARIES).items())
    report.text(f"Versions: {versions}. The virtual rig's sensor calibrations are assumed values.")
    _add_settings(report, results)
    report.heading("Verdicts")
    headings = ("case", "as found", "as left") if has_earlier else ("case", "verdict")
    report.table(headings, [
        Row((case["id"], *([earlier.get(case["id"], {}).get("outcome", "not tested")] if has_earlier else []),
             case["outcome"]), CASE_MARKS[case["outcome"]])
        for case in cases
    ])  # fmt: skip
    report.heading("Measurements")
    values = ("as found", "as left") if has_earlier else ("value",)
    for case in cases:
        report.heading(case["id"], level=2)
        if case["reason"]:
            report.text(case["reason"])
        if stimuli := case.get("setup", {}).get("stimuli"):
            report.text(f"Stimuli: {'; '.join(stimuli)}.")
        old = {each["name"]: _format_value(each) for each in earlier.get(case["id"], {}).get("measurements", ())}
        report.table(("measurement", *values, "must be", "source", "verdict"), [
            Row((each["name"], *([old.get(each["name"], "")] if has_earlier else []), _format_value(each),
                 format_limit(each), each["source"], each["outcome"]), OUTCOME_MARKS[each["outcome"]])
            for each in case["measurements"]
        ])  # fmt: skip
        add_picture(report, case, folder, f"Signals and events: {case['id']}.")
    report.heading("Digests (SHA-256)")
    digests = [each for case in wall["cases"].values() for each in case.get("digests", {}).items()]
    report.table(("file", "digest"), list(dict.fromkeys(digests)))
    report.heading("Signatures")
    report.table(
        ("", "name", "date", "signature"), [(who, _LINE, _LINE, _LINE) for who in ("tested by", "approved by")]
    )
    return report


def _format_value(each: Document) -> str:
    return format_number(each.get("value"), each["unit"], "nothing")


def _find_missing(results: Document) -> list[str]:
    """Return which files have cases that were not run, in words."""
    counts: Counter[str] = Counter()
    totals: dict[str, int] = {}
    for case in results["cases"]:
        file = case["id"].partition("::")[0]
        counts[file] += 1
        totals[file] = case.get("setup", {}).get("cases_in_file", 0)
    return [f"{total - counts[file]} of {total} cases of {file} were not selected"
            for file, total in totals.items() if counts[file] < total]  # fmt: skip


def _add_settings(report: Report, results: Document) -> None:
    """Add what the campaigns are about, command lines of devices, and limits, each with its cases."""
    setups = {case["id"]: case.get("setup", {}) for case in results["cases"]}
    rows: dict[tuple[str, str], list[str]] = {}
    for name, setup in setups.items():
        for setting in setup.get("settings", {}).items():
            rows.setdefault(setting, []).append(name.partition("::")[2])
    if not rows:
        return
    report.heading("Settings")
    for about in dict.fromkeys(setup.get("about", "") for setup in setups.values()):
        if about:
            report.text(" ".join(about.split()))
    shown = [(*row, "all" if len(names) == len(setups) else ", ".join(names)) for row, names in rows.items()]
    report.table(("setting", "value", "cases"), shown)
