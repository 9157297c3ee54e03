"""Page of a campaign: failures with their reasons and pictures first, then changes, then all measurements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from replays.campaigns.measurement import with_unit
from replays.report import OUTCOME_MARKS, Mark, Report, Row
from replays.report.document import Picture

Document = Mapping[str, Any]
CASE_MARKS: dict[str, Mark] = {
    "failed": "bad", "error": "bad", "inconclusive": "open", "interrupted": "open", "skipped": "open", "passed": "good",
}  # fmt: skip
"""Mark of each outcome of a case, the worst first."""
_UNCHANGED_MARGIN = 1e-9
"""Relative change of a margin below which it counts as unchanged."""

_MAX_LISTED = 20
"""Number of evidence files that the page lists for a case."""


def make_page(results: Document, folder: Path, earlier: Sequence[Document] = ()) -> Report:
    """Return the page of a campaign's results.

    Args:
        results: Content of results.json.
        folder: Folder that holds the evidence.
        earlier: Results of earlier campaigns to compare with, the oldest first.
    """
    counts, cases = results["counts"], results["cases"]
    bad = [case for case in cases if CASE_MARKS[case["outcome"]] == "bad"]
    unsure = [case for case in cases if case["outcome"] == "inconclusive"]
    wall = results["wall"]
    origin = {
        "begun": f"{wall['begun']} UTC, {wall['duration_s']:.1f} s",
        "machine": wall["machine"],
        "rig": wall["rig"],
        "processes found by": wall["containment"],
    }
    title = "; ".join(results["titles"]) or "Campaign"
    report = Report(title, f"{summarize_counts(counts)}.", origin=origin, mark=judge_counts(counts))
    report.table(tuple(counts), [[str(count) for count in counts.values()]])
    for case in [*bad, *unsure]:
        _failure(report, case, folder)
    if earlier:
        _trend(report, results, earlier[-1])
    if earlier[1:]:
        _history(report, [*earlier, results])
    report.heading("Cases")
    rows = sorted(cases, key=lambda case: list(CASE_MARKS).index(case["outcome"]))
    report.table(
        ("case", "why", "time [s]", "late blocks", "outcome"),
        [Row((case["id"], case["reason"], _seconds(results, case), str(_wall(results, case).get("late_blocks") or 0),
              case["outcome"]), CASE_MARKS[case["outcome"]])
         for case in rows],
    )  # fmt: skip
    report.heading("Measurements")
    for case in cases:
        if case["measurements"]:
            report.heading(case["id"], level=2)
            _measurements(report, results, case)
    return report


def _seconds(results: Document, case: Document) -> str:
    return f"{_wall(results, case).get('duration_s', 0.0):.1f}"


def _wall(results: Document, case: Document) -> Document:
    return results["wall"]["cases"].get(case["id"], {})


def _failure(report: Report, case: Document, folder: Path) -> None:
    report.heading(f"{case['outcome']}: {case['id']}", note=case["reason"].partition(" [")[0])
    failed = [each for each in case["measurements"] if each["outcome"] != "pass"]
    if not failed:
        report.text(case["reason"])
    for each in failed:
        limit, value = format_limit(each), format_number(each["value"], each["unit"], "nothing")
        margin = f", margin {format_number(each['margin'], each['unit'])}" if each["margin"] is not None else ""
        source = f" Source: {each['source']}." if each["source"] else ""
        note = f" ({each['note']})" if each["note"] else ""
        verdict = "inconclusive" if each["outcome"] == "inconclusive" else f"it is {value}{margin}"
        report.text(f"{each['name']} must be {limit}; {verdict}{note}.{source}")
    add_picture(report, case, folder, "Signals and events around the failure.")
    for trouble in case["troubles"]:
        report.text(trouble)
    files = ", ".join(f"`{file}`" for file in case["evidence"][:_MAX_LISTED])
    files += f", and {more} more" if (more := len(case["evidence"]) - _MAX_LISTED) > 0 else ""
    report.text(f"Repeat with: `{case['repeat']}`" + (f". Evidence: {files}" if files else ""))


def _measurements(report: Report, results: Document, case: Document) -> None:
    floor, late = _wall(results, case).get("floor_ms"), _wall(results, case).get("late_blocks", 0)
    live = "" if floor is None else f" Round trip: median {floor[0]:g} ms, maximum {floor[1]:g} ms."
    live += f" The rig was late in {late} blocks." if late else ""
    caption = f"Resolution of reaction times: {case['resolution']}.{live}" if case["resolution"] else ""
    rows = [
        Row((
            each["name"], format_number(each["value"], each["unit"], "nothing"), format_limit(each),
            "" if each["margin"] is None else format_number(each["margin"], each["unit"]), each["source"], each["note"],
            each["outcome"],
        ), OUTCOME_MARKS[each["outcome"]])
        for each in case["measurements"]
    ]  # fmt: skip
    headings = ("measurement", "value", "must be", "margin", "source", "note", "verdict")
    report.table(headings, rows, caption=caption)


def summarize_counts(counts: Mapping[str, int]) -> str:
    """Return the number of cases of each outcome, in words."""
    return ", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count) or "no case"


def judge_counts(counts: Mapping[str, int]) -> Mark:
    """Return the mark of a campaign from its number of cases of each outcome."""
    if counts["failed"] or counts["error"]:
        return "bad"
    return "open" if counts["inconclusive"] or counts["interrupted"] or not counts["passed"] else "good"


def add_picture(report: Report, case: Document, folder: Path, caption: str) -> None:
    """Add the picture that the campaign drew of a case, if there is one; a device's pictures are not shown."""
    for file in case["evidence"]:
        path = folder / file
        if path.match("evidence/*/event.png") and path.is_file():
            report.parts.append(Picture(path.read_bytes(), caption))


def format_number(value: float | None, unit: str, none: str = "") -> str:
    """Return a number with its unit, or `none`."""
    return none if value is None else with_unit(f"{value:.6g}", unit)


def format_limit(each: Document) -> str:
    """Return the limit of a measurement, with its unit."""
    limit = each["limit"]
    if isinstance(limit, list):
        return with_unit(f"{limit[0]:.6g} to {limit[1]:.6g}", each["unit"])
    return with_unit(f"{each['op']} {limit:.6g}", each["unit"])


def _trend(report: Report, results: Document, earlier: Document) -> None:
    report.heading("Comparison with the earlier campaign")
    rows = sorted(changes(earlier, results), key=lambda row: ("worse", "gone", "new", "better").index(row.cells[-1]))
    begun = earlier.get("wall", {}).get("begun", "")
    if not rows:
        report.text(f"Nothing changed since the campaign of {begun}.")
        return
    caption = f"Changes of outcomes and margins since the campaign of {begun}."
    report.table(("case", "quantity", "earlier", "now", "change"), rows, caption=caption)


def _history(report: Report, campaigns: Sequence[Document]) -> None:
    """Add a table of outcomes and margins with a column for each campaign."""
    report.heading("Trend")
    rows: dict[tuple[str, str], list[str]] = {}
    for number, campaign in enumerate(campaigns):
        for case in campaign["cases"]:
            cells = {"outcome": case["outcome"]}
            for each in case["measurements"]:
                if each["margin"] is not None:
                    cells[f"margin of {each['name']}"] = format_number(each["margin"], each["unit"])
            for of, cell in cells.items():
                rows.setdefault((case["id"], of), [""] * len(campaigns))[number] = cell
    begun = [f"{n}: {each['wall']['begun']}" for n, each in enumerate(campaigns, 1)]
    caption = "Outcomes and margins of each campaign, the oldest first; the last one is this campaign."
    report.table(("case", "quantity", *begun), [(*name, *cells) for name, cells in rows.items()], caption=caption)


def changes(then: Document, now: Document) -> Iterator[Row]:
    """Yield a row for each case or margin that got better or worse, is new, or is gone."""
    old, new = ({case["id"]: case for case in each["cases"]} for each in (then, now))
    for name in [*new, *(name for name in old if name not in new)]:
        if name not in old or name not in new:
            there, change = (new[name], "new") if name in new else (old[name], "gone")
            cells = ("", there["outcome"]) if name in new else (there["outcome"], "")
            yield Row((name, "outcome", *cells, change), "plain")
            continue
        before, after = old[name], new[name]
        if before["outcome"] != after["outcome"]:
            order = list(CASE_MARKS)
            better = order.index(after["outcome"]) > order.index(before["outcome"])
            yield _row(name, "outcome", before["outcome"], after["outcome"], better=better)
        margins = {each["name"]: each for each in before["measurements"]}
        for each in after["measurements"]:
            past = margins.get(each["name"])
            if past is None or each["unit"] != past["unit"] or None in (past["margin"], each["margin"]):
                continue
            moved = each["margin"] - past["margin"]
            if abs(moved) > _UNCHANGED_MARGIN * max(abs(each["margin"]), abs(past["margin"])):
                shown = (format_number(one["margin"], one["unit"]) for one in (past, each))
                yield _row(name, f"margin of {each['name']}", *shown, better=moved > 0.0)


def _row(case: str, of: str, then: str, now: str, *, better: bool) -> Row:
    return Row((case, of, then, now, "better" if better else "worse"), "good" if better else "bad")
