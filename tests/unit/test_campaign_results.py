"""Measurements of a recording, and their output: JUnit, JSON, the page, comparison of results."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np
import pytest

from recorder.reader import Recording
from replays.campaigns import plugin
from replays.campaigns.equipment.bench import (
    Bench,
    BenchError,
    BenchSettings,
    Target,
    UnsupportedError,
    validate_replay,
)
from replays.campaigns.evidence import Trial, case_folder
from replays.campaigns.files.campaign import Step, find_shipped, load_campaign
from replays.campaigns.files.case_results import CaseRecording
from replays.campaigns.files.expectation import KINDS, ExpectEvent
from replays.campaigns.files.run import end_device, measure_end, measure_interference, run_repeatedly, send_step
from replays.campaigns.measurement import Measurement, Must, judge_value
from replays.campaigns.reporting.file_names import name_files
from replays.campaigns.reporting.page import changes, make_page
from replays.campaigns.reporting.picture import draw
from replays.campaigns.reporting.results import Results, load_results, write_junit
from replays.campaigns.reporting.sheet import check_sheet, make_sheet, parse_identity
from replays.report import junit, write_report
from replays.report.document import Picture, Table
from rig.base.checks import check
from rig.base.errors import InputError, RefusedError
from rig.base.outcome import Outcome
from rig.channels.orbit import whirl_frequency
from rig.channels.table import default_table
from rig.run.commands.channel import ClearCommand
from rig.run.commands.table import TimedCommand
from tests.processes import ROOT
from tests.score_daqs import make_counts, write_parquet, write_session


@pytest.fixture(scope="module")
def seen() -> CaseRecording:
    """A hammer at 0.02 s, 0.6 s at 5 kHz."""
    return CaseRecording(Recording.open(ROOT / "replays/sessions/hammer-6.2.mcap"), Path())


def one(seen: CaseRecording, **given: Any) -> Measurement:
    kind = next(key for key in KINDS if key in given)
    (found,) = check(KINDS[kind], given, field="").measure(seen, seen.units)
    return found


def test_values_of_signals_are_those_of_their_rows(seen: CaseRecording) -> None:
    rows = seen.recording.samples("disk_x", "disk_y", "P_E")
    x, y, times_s = rows["disk_x"], rows["disk_y"], rows.times_s
    late = (times_s >= 0.3) & (times_s < 0.5)
    window: dict[str, Any] = {"signal": "disk_x", "from_s": 0.3, "to_s": 0.5}
    for take, value in (
        ("peak", np.abs(x[late]).max()), ("max", x[late].max()), ("min", x[late].min()), ("mean", x[late].mean()),
        ("rms", math.sqrt(np.mean(x[late] ** 2))), ("std", x[late].std()), ("peak to peak", np.ptp(x[late])),
    ):  # fmt: skip
        assert one(seen, **window, take=take, must="<= 9 mm").value == pytest.approx(value, rel=1e-11)
    assert one(seen, signal="disk_x", take="value", at_s=0.3, must="<= 9 mm").value == pytest.approx(x[1500], rel=1e-11)
    radius = np.hypot(x, y)
    first = times_s[np.argmax(radius > 0.5)]
    measurement = one(seen, signal=["disk_x", "disk_y"], take="first beyond", beyond="500 um", must="< 1 s")
    assert (measurement.value, measurement.at_s, measurement.resolution) == (
        pytest.approx(first),
        pytest.approx(first),
        "1 row, 200 us",
    )
    since = one(
        seen,
        signal=["disk_x", "disk_y"],
        take="first beyond",
        beyond="0.5 mm",
        must="<= 9 ms",
        since={"event": "hammer"},
    )
    assert since.value == pytest.approx(1e3 * (first - 0.02))
    beyond = one(seen, signal="P_E", take="time beyond", beyond="3.2 kN", must="<= 1 s")
    assert beyond.value == pytest.approx(np.count_nonzero(np.abs(rows["P_E"]) > 3200.0) / 5000.0)
    whirl = one(seen, signal=["disk_x", "disk_y"], take="whirl frequency", from_s=0.45, must="-100 to -60 Hz")
    assert whirl.value == pytest.approx(whirl_frequency(x[2250:], y[2250:], times_s[2250:]), rel=1e-6)
    assert (whirl.good, whirl.must.unit) == (True, "Hz")
    force = one(seen, signal="normal_force", truth="contact", take="max", must=">= 0.1 kN")
    assert force.value == pytest.approx(1e-3 * seen.recording.truth("contact")["normal_force"].max())
    never = one(seen, signal="disk_x", take="first beyond", beyond="9 mm", must="<= 1 s")
    assert (math.isnan(never.value), never.good, never.note) == (True, False, "it never exceeds 9 mm")
    assert "nothing" in never.line
    ended = one(seen, signal="disk_x", take="value", at_s=0.7, must="<= 9 mm")
    assert (math.isnan(ended.value), ended.note) == (True, "no row at this time")


def test_expected_events_are_checked_for_time_and_order(seen: CaseRecording) -> None:
    assert one(seen, event="hammer").value == 1.0
    assert not one(seen, event="hammer", appears=False).good
    assert one(seen, event="note", appears=False).good
    assert one(seen, event="hammer", must="== 20 ms").good
    assert not one(seen, event="hammer", must="== 20.001 ms").good
    assert one(seen, event="hammer", where={"force_n": 100.0}, take="count", must="== 1").good
    assert one(seen, event="hammer", where={"force_n": 50.0}, take="count", must="== 0").good
    late = one(seen, event="hammer", since={"at_s": 0.1}, must="<= 1 s")
    assert (late.good, late.note) == (False, "no hammer occurred after 0.1 s; 1 before, at 0.02 s")
    level = {"signal": "disk_x", "beyond": "99 mm"}
    assert one(seen, event="hammer", since=level, must="<= 1 s").note == "the origin of the time never occurred"
    start, hammer = {"event": "start"}, {"event": "hammer", "where": {"direction": "x"}}
    assert one(seen, order=[start, hammer]).good
    turned = one(seen, order=[hammer, start])
    assert (turned.good, turned.value) == (False, 1.0)
    assert one(seen, order=[start, start], to_s=0.02).value == 2.0
    assert one(seen, order=[start, hammer], to_s=0.02).value == 1.0
    for window, count in (({"from_s": 0.02}, 1), ({"from_s": 0.021}, 0), ({"to_s": 0.02}, 0), ({"to_s": 0.021}, 1)):
        assert one(seen, event="hammer", take="count", must="== 1", **window).value == count
    hidden = one(seen, event="hammer", since=start, from_s=0.01, must="<= 1 s")
    assert hidden.note == "the origin of the time never occurred"
    hit = one(seen, event="end", since=hammer, must="<= 600 ms")
    assert (hit.value, hit.at_s, hit.since_s, hit.resolution) == (580.0, 0.6, 0.02, "1 tick, 1 us")


def test_selectors_search_lists_and_times_count_from_the_origin(seen: CaseRecording) -> None:
    late, noted = CaseRecording(seen.recording, Path(), origin_s=0.015), CaseRecording(seen.recording, Path())
    assert one(late, event="hammer", must="== 5 ms").good
    value = one(late, signal="disk_x", take="value", at_s=0.285, must="<= 9 mm").value
    assert value == one(seen, signal="disk_x", take="value", at_s=0.3, must="<= 9 mm").value
    noted.events = [
        (0.1, {"event": "note", "tags": ["trip", "x"], "text": "x trips"}),
        (0.2, {"event": "note", "tags": ["y"], "text": "", "what": {"kind": "gain"}}),
    ]
    for where, text, count in (
        ({"tags": "trip"}, "", 1), ({"tags": ["trip", "x"]}, "", 1), ({"tags": "z"}, "", 0), ({}, "trips", 1),
        ({"what": {"kind": "gain"}}, "", 1), ({"tags": "y"}, "trips", 0), ({}, "", 2),
    ):  # fmt: skip
        assert one(noted, event="note", where=where, text=text, take="count", must="== 1").value == count


def test_a_level_is_exceeded_on_either_side(seen: CaseRecording) -> None:
    rows = seen.recording.samples("disk_y")
    radius, times_s = np.abs(rows["disk_y"]), rows.times_s
    assert rows["disk_y"][np.argmax(radius > 0.5)] < 0.0
    since = {"signal": "disk_y", "beyond": "0.5 mm"}
    begins_s, first_s = (float(times_s[np.argmax(radius > level)]) for level in (0.5, 1.0))
    found = one(seen, signal="disk_y", take="first beyond", beyond="1 mm", since=since, must="<= 9 ms")
    assert (found.value, found.at_s) == (pytest.approx(1e3 * (first_s - begins_s)), first_s)
    begins_s, last_s = times_s[np.argmax((radius > 0.5) & (times_s >= 0.4))], times_s[np.flatnonzero(radius > 1.0)[-1]]
    found = one(seen, signal="disk_y", take="last beyond", beyond="1 mm", since=since, from_s=0.4, must="<= 1 s")
    assert (found.value, found.level) == (pytest.approx(last_s - begins_s), 1.0)
    peak = one(seen, signal="disk_y", to_s=0.04, must="<= 9 mm")
    assert (peak.value, peak.at_s) == (pytest.approx(radius[:200].max()), times_s[np.argmax(radius[:200])])
    assert rows["disk_y"][np.argmax(radius[:200])] < 0.0
    caused = one(seen, event="end", since=since, must="<= 1 s")
    assert (caused.level, caused.channels) == (0.5, ("disk_y",))
    assert caused.value == pytest.approx(0.6 - times_s[np.argmax(radius > 0.5)])


def test_a_device_on_a_can_bus_has_its_name_of_the_campaign_too() -> None:
    recording = cast("Any", SimpleNamespace(
        catalogue={"tick_rate_hz": 1e6}, events=[{"event": "note", "tick": 1000, "from": "CAN 7", "tags": ["trip"]}]
    ))  # fmt: skip
    named = CaseRecording(recording, Path(), device_names={"CAN 7": "guard"})
    trip: dict[str, Any] = {"event": "note", "must": "<= 1 s"}
    measure = ExpectEvent(**trip, where={"from": "guard", "tags": "trip"}).measure
    assert next(measure(named, {})).value == 0.001
    other = next(measure(CaseRecording(recording, Path()), {}))
    assert (other.good, other.note) == (False, "no note from=guard tags=trip occurred, only from CAN 7")
    for sender, is_found in (("CAN 7", True), ("CAN 8", False)):
        assert next(ExpectEvent(**trip, where={"from": sender}).measure(named, {})).good is is_found


def test_a_scorecard_is_an_expectation(seen: CaseRecording) -> None:
    itself = CaseRecording(seen.recording, seen.recording.path.parent)
    assert one(itself, score="missing rows", file="hammer-6.2.mcap").good
    assert one(itself, score="all", file="hammer-6.2.mcap").good
    absent = one(itself, score="all", file="nothing.csv")
    assert not absent.good
    assert "nothing.csv" in absent.note


def test_missing_rows_can_be_expected(tmp_path: Path) -> None:
    counts = make_counts("probes", np.cumsum(np.random.default_rng(1).normal(size=(4000, 4)), axis=0) * 1e-3, None)
    session = CaseRecording(Recording.open(write_session(tmp_path / "sent.mcap", {"probes": counts})), tmp_path)
    names = default_table().groups["probes"].names
    kept = np.delete(counts, slice(1000, 1100), axis=0)
    write_parquet(tmp_path / "daq.parquet", dict(zip(names, kept.T, strict=True)))
    for must, good, margin in (("== 100", True, 0.0), (">= 1", True, 99.0), ("<= 50", False, -50.0)):
        measurement = one(session, score="missing rows", file="daq.parquet", must=must)
        assert (measurement.value, measurement.good, measurement.must.margin(measurement.value)) == (
            100.0,
            good,
            margin,
        )
        assert measurement.note == "rows 1000 to 1099"
    assert not one(session, score="missing rows", file="daq.parquet").good
    scale = one(session, score="scale", channel="disk_x", file="daq.parquet", must="-1 to 1 ppm")
    assert (scale.value, scale.good) == (0.0, True)
    absent = one(session, score="gain", channel="disk_x", file="daq.parquet", must="-1 to 1 ppm")
    assert (absent.outcome, absent.open_reason) == (Outcome.INCONCLUSIVE, "the scorecard has no such quantity")


def test_all_requires_every_sent_channel_and_row_except_allowed_losses(tmp_path: Path) -> None:
    counts = make_counts("probes", np.cumsum(np.random.default_rng(1).normal(size=(4000, 4)), axis=0) * 1e-3, None)
    session = CaseRecording(Recording.open(write_session(tmp_path / "sent.mcap", {"probes": counts})), tmp_path)
    names, times_s = default_table().groups["probes"].names, np.arange(4000) / 20_000

    def told(rows: slice, columns: list[str], **more: Any) -> tuple[bool, str]:
        file = write_parquet(
            tmp_path / f"{rows}{columns}.parquet",
            {"time_s": times_s[rows], **dict(zip(columns, counts[rows].T, strict=False))},
        )
        measurement = one(session, score="all", file=file.name, **more)
        return measurement.good, measurement.note

    whole, part, half = slice(None), slice(1000, 3600), slice(None, None, 2)
    assert told(whole, list(names))[0]
    good, note = told(whole, list(names)[:3])
    assert (good, note.partition(";")[0]) == (False, "recorded ring_y no fail not in the file, or not found in it")
    assert told(whole, list(names)[:3], channel=["disk_x", "ring_x"])[0]
    good, note = told(whole, ["disk_y", "disk_x", *names[2:]])
    assert (good, "mapping disk_y disk_x fail" in note) == (False, True)
    assert told(half, list(names)) == (False, "row step of probes: 2, not 1")
    assert told(half, list(names), every=2)[0]
    assert told(part, list(names)) == (
        False,
        "rows before the first of probes: 1000; rows after the last of probes: 400",
    )
    assert told(part, list(names), begins_s=0.05, ends_s=0.01) == (False, "rows after the last of probes: 400")
    assert told(part, list(names), begins_s=0.05, ends_s=0.02)[0]


def test_a_run_stopped_early_fails_unless_expected(tmp_path: Path) -> None:
    stop = {"event": "command", "command": "stop", "from": "guard", "tick": 10_000, "time_s": 0.01}
    end = {"event": "end", "reason": "stopped", "tick": 10_000, "time_s": 0.01}
    counts = make_counts("probes", np.zeros((200, 4)), None)
    recording = Recording.open(write_session(tmp_path / "sent.mcap", {"probes": counts}))
    case = next(iter(load_campaign(find_shipped()["hammer"]).cases))

    def told(*events: dict[str, Any], **expected: Any) -> list[str]:
        trial, session = Trial("a", folder=tmp_path), CaseRecording(recording, tmp_path)
        session.events = [(event["time_s"], event) for event in events]
        expects = (check(KINDS["event"], expected, field=""),) if expected else ()
        measure_end(session, trial, replace(case, duration_s=0.5, expects=expects))
        return [each.line for each in trial.measurements]

    (line,) = told(stop, end)
    assert line == (
        "end of the run must be >= 0.5 s; received 0.01 s (stopped by guard, before the case was over) [margin -0.49 s]"
    )
    assert told(stop, end, event="note") == [line]
    assert told(stop, end, event="end") == told(stop, end, event="command", where={"command": "stop"}) == []
    assert told({**end, "reason": "completed"}) == told({**end, "time_s": 0.5}) == told() == []


def test_commands_of_the_test_fail_a_device_that_sends_them(tmp_path: Path) -> None:
    counts = make_counts("probes", np.zeros((200, 4)), None)
    session = CaseRecording(Recording.open(write_session(tmp_path / "sent.mcap", {"probes": counts})), tmp_path)
    commands = [(name, sender) for name in ("speed", "stop", "clear", "step") for sender in ("guard", "test-1")]
    session.events = [(0.0, {"event": "command", "command": name, "from": sender}) for name, sender in commands]
    expected = check(KINDS["event"], {"event": "command", "where": {"command": "clear"}}, field="")
    for expects, may_end, wrong in (
        ((), False, ["clear", "step"]), ((expected,), False, ["step"]), (None, False, ["stop", "clear", "step"]),
        (None, True, ["clear", "step"]),
    ):  # fmt: skip
        trial = Trial("a", folder=tmp_path, devices=[cast("Any", SimpleNamespace(may_end=may_end))])
        trial.bench = cast(
            "Any",
            SimpleNamespace(
                client_names={"campaign", "test-1"},
                can_url=None,
                url="",
                socketcand_url="",
                slcan_path="",
                name="",
            ),
        )
        measure_interference(session, trial, expects)
        assert [each.name for each in trial.measurements] == [f"commands {name} of devices" for name in wrong]
        assert {each.note for each in trial.measurements} == {"by guard; it is up to the test"}


def test_a_step_that_the_rig_refuses_is_no_reason_to_skip_unless_it_is_somebody_elses_rig() -> None:
    def send(*_: object, **__: object) -> None:
        raise RefusedError("clear.id must be the number of an active fault (none), or all; received 1")

    step = Step(0.5, TimedCommand(at_s=0.5, request=ClearCommand(id=1)))
    for owns_rig, kind in ((True, BenchError), (False, UnsupportedError)):
        with pytest.raises(kind, match=r"the rig refuses a step at 0\.5 s: clear\.id must be"):
            send_step(cast("Any", SimpleNamespace(send=send)), step, owns_rig=owns_rig)


def test_cases_have_different_folders_for_their_evidence() -> None:
    long = "a" * 200
    names = [f"x.campaign.toml::{each}" for each in ("a", f"b{long}", f"c{long}", "a b", "a_b", "a\nb")]
    folders = [case_folder(name) for name in names]
    assert len({*folders}) == len(names)
    assert folders[0] == "x.campaign.toml_a"
    assert all(re.fullmatch(r"[\w.=-]{1,150}", each) for each in folders)


def test_only_a_device_that_must_be_killed_fails(tmp_path: Path) -> None:
    for status, notes in (
        (137, ["it had to be killed: it did not end within end_s = 5 s of a SIGTERM"]),
        (143, []),
        (0, []),
    ):
        program = SimpleNamespace(status=None, last_line="", is_output_cut=False)
        device = SimpleNamespace(
            name="guard", program=program, is_ended_by_test=False, bench=SimpleNamespace(settings=BenchSettings()),
            end=lambda program=program, status=status: setattr(program, "status", status),
        )  # fmt: skip
        trial = Trial("a", folder=tmp_path, records=tmp_path, target=Target(url="zenoh:elsewhere"))
        end_device(cast("Any", device), trial)
        assert [each.note for each in trial.measurements if not each.good] == notes


@pytest.mark.parametrize(("op", "limit", "value", "margin", "good"), [
    ("<=", 3.0, 3.0, 0.0, True), ("<", 3.0, 3.0, 0.0, False), (">=", 3.0, 2.5, -0.5, False),
    (">", 3.0, 3.5, 0.5, True), ("==", 3.0, 3.0, 0.0, True), ("==", 3.0, 3.5, -0.5, False),
    ("==", 3.0, 2.5, -0.5, False), ("!=", 3.0, 2.5, 0.5, True), ("between", (1.0, 3.0), 1.25, 0.25, True),
    ("between", (1.0, 3.0), 3.5, -0.5, False),
    ("!=", 3.0, 3.0, 0.0, False), ("between", (1.0, 3.0), 2.5, 0.5, True), ("between", (1.0, 3.0), 0.5, -0.5, False),
])  # fmt: skip
def test_margin_and_verdict(op: str, limit: Any, value: float, margin: float, good: bool) -> None:
    judged = judge_value("time", value, "ms", op, limit)
    assert (judged.good, judged.document()["margin"]) == (good, margin)
    text = f"{limit[0]} to {limit[1]} ms" if op == "between" else f"{op} {limit} ms"
    assert Must.parse(text, field="") == judged.must


def test_a_measurement_takes_units_and_refuses_wrong_ones() -> None:
    judged = judge_value("gap", 0.15, "mm", "<=", 200, unit_of_limit="um", source="datasheet")
    assert (judged.good, judged.must.limit, judged.document()["margin"]) == (
        True,
        pytest.approx(0.2),
        pytest.approx(0.05),
    )
    assert dict(judged.properties())["gap.source"] == "datasheet"
    for given, says in (
        (("gap", 0.15, "mm", "<=", 2.0, "N"), "unit_of_limit must be in a unit of length, as gap is in mm"),
        (("gap", 0.15, "mm", "=<", 2.0, None), "op must be one of"),
        (("gap", 0.15, "mm", "between", 2.0, None), "two numbers, the lower first"),
        (("gap", 0.15, "mm", "<=", "much", None), "limit must be a number"),
        (("gap", 0.15, "mm", "between", (3.0, 1.0), None), "two numbers, the lower first"),
        (("gap", 0.15, "mm", "between", (0.1, math.nan), None), "two numbers, the lower first"),
        (("gap", 0.15, "mm", "between", (0.1, 0.2, 0.3), None), "two numbers, the lower first"),
        (("gap", 0.15, "mm", "<=", 2.0, "1"), "must be with a unit, as gap is in mm"),
        (("turns", 0.15, "1", "<=", 2.0, "mm"), "must be without a unit, as turns has none"),
        (("gap", 0.15, "mm", "<=", math.inf, None), "limit must be with finite numbers only"),
        (("gap", 0.15, "mm", "between", (0.0, math.inf), None), "limit must be with finite numbers only"),
        (("gap", 0.15, "mm", "<=", 1.5e308, "m"), "unit_of_limit must be with finite numbers only"),
    ):
        with pytest.raises(InputError, match=re.escape(says)):
            judge_value(*given[:5], unit_of_limit=given[5])
    for value in (math.nan, math.inf):
        assert not judge_value("gap", value, "mm", ">=", 1.0).good


def results(**margins: float) -> dict[str, Any]:
    cases = []
    for name, margin in margins.items():
        judged = judge_value("peak", 1.0 - margin, "mm", "<=", 1.0, source="a datasheet", note="a <note>\x1b", at_s=0.3)
        outcome = "passed" if judged.good else "failed"
        cases.append({
            "id": f"x.campaign.toml::{name}", "outcome": outcome, "reason": "" if judged.good else judged.line,
            "title": "T", "measurements": [judged.document()], "evidence": [], "bench": None,
            "resolution": "10 ms blocks, in lockstep",
            "troubles": [], "repeat": f"rig campaign x.campaign.toml::{name}",
        })  # fmt: skip
    cases.append({**cases[0], "id": "x.py::skipped", "outcome": "skipped", "reason": "no bus", "measurements": []})
    cases.append({**cases[0], "id": "x.py::broken", "outcome": "error", "reason": "no rig", "measurements": []})
    wall = {case["id"]: {"duration_s": 1.25, "floor_ms": [0.3, 0.9], "late_blocks": 3} for case in cases}
    return {
        "format": 1, "titles": ["T"],
        "counts": {"failed": 1, "error": 1, "interrupted": 0, "inconclusive": 0, "skipped": 1, "passed": 1},
        "cases": cases,
        "wall": {"begun": "2026-01-01T08:00:00", "duration_s": 2.5, "machine": "M", "rig": "0",
                 "containment": "subreaper", "cases": wall},
    }  # fmt: skip


# The common schema, that of Jenkins, as rules: required and optional attributes of each element, and its content.
_SCHEMA: dict[str, tuple[set[str], set[str], set[str]]] = {
    "testsuites": (set(), {"name", "time", "tests", "failures", "errors"}, {"testsuite"}),
    "testsuite": (
        {"name", "tests", "failures", "errors"},
        {"group", "time", "skipped", "timestamp", "hostname", "id", "package", "file", "log", "url"},
        {"testsuite", "properties", "testcase", "system-out", "system-err"},
    ),
    "properties": (set(), set(), {"property"}),
    "property": ({"name", "value"}, set(), set()),
    "testcase": ({"name"}, {"time", "classname", "group"}, {"skipped", "error", "failure", "system-out", "system-err"}),
    **{name: (set(), {"message", "type"}, set()) for name in ("skipped", "error", "failure")},
    **{name: (set(), set(), set()) for name in ("system-out", "system-err")},
}


def check_junit(path: Path) -> list[ElementTree.Element]:
    """Check a file by the schema, and return its suites."""
    root = ElementTree.parse(path).getroot()
    assert root.tag == "testsuites"
    for element in root.iter():
        must, may, within = _SCHEMA[element.tag]
        assert must <= set(element.keys()) <= must | may, element.attrib
        assert {each.tag for each in element} <= within, element.tag
        if (time_s := element.get("time")) and element.tag != "testcase":
            assert re.fullmatch(r"(([0-9]{0,3},)*[0-9]{3}|[0-9]{0,3})*(\.[0-9]*)?", time_s)
    for suite in root:
        cases = suite.findall("testcase")
        for count, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
            assert int(suite.get(count, "")) == sum(case.find(tag) is not None for case in cases)
        assert int(suite.get("tests", "")) == len(cases)
    return list(root)


def test_junit_follows_its_schema(tmp_path: Path) -> None:
    write_junit(results(good=0.4, bad=-0.25), tmp_path / "junit.xml")
    good, bad, skipped, broken = check_junit(tmp_path / "junit.xml")
    properties = {each.get("name"): each.get("value") for each in bad.iter("property")}
    assert properties["peak.margin"] == "-0.25"
    assert properties["peak.source"] == "a datasheet"
    assert properties["peak.note"] == "a <note>"  # without the characters that XML excludes
    failure = bad.find("testcase/failure")
    assert failure is not None
    assert str(failure.get("message")).startswith("peak must be <= 1 mm; received 1.25 mm (a <note>")
    assert good.find("testcase/system-out") is not None
    assert skipped.get("skipped") == "1"
    assert broken.get("errors") == "1"
    junit.write_junit(tmp_path / "empty.xml", [junit.Suite("s", [])])
    check_junit(tmp_path / "empty.xml")


def test_the_page_lists_failures_first_then_changes(tmp_path: Path) -> None:
    then, now = results(good=0.4, bad=0.1, gone=0.2), results(good=0.5, bad=-0.25, fresh=0.1)
    rows = {row.cells[:2]: row.cells[2:] for row in changes(then, now)}
    assert rows == {
        ("x.campaign.toml::good", "margin of peak"): ("0.4 mm", "0.5 mm", "better"),
        ("x.campaign.toml::bad", "outcome"): ("passed", "failed", "worse"),
        ("x.campaign.toml::bad", "margin of peak"): ("0.1 mm", "-0.25 mm", "worse"),
        ("x.campaign.toml::fresh", "outcome"): ("", "passed", "new"),
        ("x.campaign.toml::gone", "outcome"): ("passed", "", "gone"),
    }
    assert not list(changes(results(bad=-0.25), results(bad=-0.25 * (1.0 + 1e-12))))
    assert [row.cells[-1] for row in changes(results(bad=-0.25), results(bad=-0.2))] == ["better"]
    folder = tmp_path / "evidence/bad"
    folder.mkdir(parents=True)
    session = Recording.open(ROOT / "replays/sessions/hammer-6.2.mcap")
    failed = judge_value("peak", 1.5, "mm", "<=", 1.0, channels=("disk_x",))
    draw(session, folder / "event.png", [failed], origin_s=0.0, about_s=0.03)
    now["cases"][1]["evidence"] = ["evidence/bad/event.png"]
    write_report(make_page(now, tmp_path, [then]), tmp_path / "index.html")
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    order = (
        "1 failed, 1 error, 1 skipped, 1 passed.", "</a>: no rig</li>", "failed: x.campaign.toml::bad</h2>",
        "it is 1.25 mm", "<img",
        "rig campaign x.campaign.toml::bad", "Comparison with the earlier campaign</h2>",
        "Measurements</h2>", "median 0.3 ms", "late in 3 blocks",
    )  # fmt: skip
    places = [page.index(words) for words in order]
    assert places == sorted(places)
    assert page.count("x.campaign.toml::good</h") == 1
    assert "x.py::skipped</h" not in page
    for count, text in ((20, "`evidence/20`"), (22, "`evidence/20`, and 2 more")):
        now["cases"][1]["evidence"] = [f"evidence/{number}" for number in range(1, count + 1)]
        texts = [str(part) for part in make_page(now, tmp_path).parts]
        assert any(each.rstrip("')").endswith(text) for each in texts), texts


def test_a_sheet_in_pdf_has_room_for_words_without_spaces(tmp_path: Path) -> None:
    found = results(good=0.4)
    found["cases"][0]["measurements"][0] |= {"name": "a" * 300, "source": "b" * 80}
    write_report(make_sheet(found, tmp_path, {"c" * 200: "d" * 200}), tmp_path / "s.pdf")
    assert (tmp_path / "s.pdf").read_bytes().startswith(b"%PDF")


def test_the_sheet_has_identity_verdicts_digests_and_room_to_sign(tmp_path: Path) -> None:
    found, left = results(good=0.4, bad=-0.25), results(good=0.4, bad=0.1, fresh=0.2)
    left["cases"], left["counts"] = left["cases"][:3], {**dict.fromkeys(left["counts"], 0), "passed": 3}
    left["wall"]["cases"]["x.campaign.toml::good"]["digests"] = {
        "x.campaign.toml": "0a1b",
        "session.mcap of good": "2c3d",
    }
    write_report(make_sheet(left, tmp_path, parse_identity(["serial=A7", "site = Lyngby"]), found), tmp_path / "s.html")
    page = " ".join(re.sub(r"<[^>]*>", " ", (tmp_path / "s.html").read_text(encoding="utf-8")).split())
    for text in (
        "serial A7", "site Lyngby", "x.campaign.toml 0a1b", "session.mcap of good 2c3d", "approved by",
        "x.campaign.toml::bad failed passed", "x.campaign.toml::fresh not tested passed", "PASS: 3 passed.",
    ):  # fmt: skip
        assert text in page, text
    assert "FAIL: " in make_sheet(found, tmp_path, {}).lead
    for verdict, counts in (
        ("FAIL", {"error": 1}), ("FAIL", {"failed": 1, "inconclusive": 1}), ("INCONCLUSIVE", {"interrupted": 1}),
        ("INCONCLUSIVE", {"inconclusive": 1}), ("INCONCLUSIVE", {"skipped": 1}), ("INCONCLUSIVE", {"passed": 0}),
        ("PASS", {}),
    ):  # fmt: skip
        assert make_sheet({**left, "counts": {**left["counts"], **counts}}, tmp_path, {}).lead.startswith(verdict)
    setup = {"settings": {"command line of m": "m {url}", "alert": "5 um"}, "stimuli": ["0.1 s: hammer"],
             "about": "About\nit", "cases_in_file": 5}  # fmt: skip
    left["cases"] = [{**case, "setup": setup} for case in left["cases"]]
    left["cases"][2]["setup"] = {**setup, "settings": {"alert": "6 um"}}
    left["replaced_limits"], found["identity"] = ["alert=5 um"], {"firmware": "0.9"}
    report = make_sheet(left, tmp_path, {"firmware": "1.0", "serial": "A7"}, found)
    assert report.title == "Test sheet: T, serial A7"
    lead = "INCONCLUSIVE: 3 passed; 2 of 5 cases of x.campaign.toml were not selected; limits replaced: alert=5 um."
    assert report.lead == lead
    write_report(report, tmp_path / "t.html")
    page = " ".join(re.sub(r"<[^>]*>", " ", (tmp_path / "t.html").read_text(encoding="utf-8")).split())
    for text in (
        "firmware 0.9 1.0", "tested 2026-01-01T08:00:00 UTC 2026-01-01T08:00:00 UTC", "Settings About it",
        "command line of m m {url} good, bad", "alert 5 um good, bad alert 6 um fresh", "Stimuli: 0.1 s: hammer.",
        "peak 1.25 mm 0.9 mm &lt;= 1 mm",
    ):  # fmt: skip
        assert text in page, text
    folder = tmp_path / "evidence/good"
    (folder / "files").mkdir(parents=True)
    for file in (folder / "event.png", folder / "files/event.png", folder / "mine.png"):
        file.write_bytes(b"a picture")
    left["cases"][0]["evidence"] = [str(file.relative_to(tmp_path)) for file in folder.rglob("*.png")]
    pictures = [part for part in make_sheet(left, tmp_path, {}).parts if isinstance(part, Picture)]
    assert len(pictures) == 1, "a device's pictures are not shown"
    for texts in (["serial"], ["=A7"], ["serial="], ["serial=1", "serial=2"]):
        with pytest.raises(InputError, match="--identity must be NAME=TEXT"):
            parse_identity(texts)
    for path in (tmp_path / "s.txt", tmp_path / "none/s.pdf"):
        with pytest.raises(InputError, match="--sheet must be"):
            check_sheet(path)


def test_the_outcome_of_a_case_is_that_of_its_first_failed_phase(tmp_path: Path) -> None:
    options = {"rig_url": "u v", "rig_limit": ["a=1 mm"]}
    config = SimpleNamespace(
        option=SimpleNamespace(rig_sheet=None), rootpath=tmp_path, getoption=options.get,
        invocation_params=SimpleNamespace(dir=tmp_path / "sub"),
    )  # fmt: skip
    skip = ("x.py", 1, "Skipped: no bus")
    for phases, outcome, reason in (
        ((("setup", "passed"), ("call", "passed"), ("teardown", "passed")), "passed", ""),
        ((("call", "failed", "\nE: a\nb"), ("teardown", "passed")), "failed", "E: a"),
        ((("setup", "failed", "a"), ("teardown", "passed")), "error", "a"),
        ((("call", "failed", "a"), ("teardown", "failed", "b")), "error", "a"),
        ((("verdict", "open", "a"), ("teardown", "passed")), "inconclusive", "a"),
        ((("setup", "skipped", skip), ("teardown", "passed")), "skipped", "no bus"),
        ((("call", "passed"),), "interrupted", "the run ended before this case was finished"),
        ((), "interrupted", "not run"),
    ):
        with end_results(Results(tmp_path / "out", (), cast("Any", config))) as found:
            found.pytest_collection_finish(cast("Any", SimpleNamespace(items=[
                SimpleNamespace(nodeid="x.py::a", location=("x.py", 1, "a"))
            ])))  # fmt: skip
            if phases:
                found.pytest_runtest_logstart("x.py::a", ("x.py", 1, "a"))
            for when, how, *text in phases:
                report = SimpleNamespace(
                    nodeid="x.py::a", when=when, duration=0.25, longrepr=(text or [""])[0], skipped=how == "skipped",
                    failed=how in ("failed", "open"), rig_inconclusive=how == "open",
                )  # fmt: skip
                found.pytest_runtest_logreport(cast("Any", report))
            document = found.document()
        (case,) = document["cases"]
        assert (case["outcome"], case["reason"]) == (outcome, reason)
        assert document["counts"] == {**dict.fromkeys(document["counts"], 0), outcome: 1}
        assert document["wall"]["cases"]["x.py::a"]["duration_s"] == 0.25 * len(phases)
        assert case["repeat"] == "rig campaign ../x.py::a --url 'u v' --limit 'a=1 mm'"
    started = Results(tmp_path / "out", (), cast("Any", config))
    started.pytest_runtest_logstart("hammer.campaign.toml::b", (str(find_shipped()["hammer"]), None, ""))
    assert started.document()["cases"][0]["repeat"].startswith("rig campaign hammer::b --url")


def test_a_truncated_recording_cannot_be_a_bench(tmp_path: Path) -> None:
    data, half = (ROOT / "replays/sessions/hammer-6.2.mcap").read_bytes(), tmp_path / "half.mcap"
    half.write_bytes(data[: len(data) // 2])
    validate_replay(ROOT / "replays/sessions/hammer-6.2.mcap")
    with pytest.raises(InputError, match=r"^--replay must be a complete recording; received.*half.mcap, which"):
        validate_replay(half)


def test_two_campaigns_cannot_write_into_one_folder(tmp_path: Path) -> None:
    config = cast("Any", SimpleNamespace(option=SimpleNamespace(rig_sheet=None)))
    first = Results(tmp_path / "new/out", (), config)
    with pytest.raises(InputError, match=r"^--output must be a folder that no other running campaign writes to"):
        Results(tmp_path / "new/out", (), config)
    first.pytest_sessionfinish(cast("Any", None))
    Results(tmp_path / "new/out", (), config).pytest_sessionfinish(cast("Any", None))


def test_a_campaign_that_is_killed_leaves_a_folder_of_its_own(tmp_path: Path) -> None:
    config = cast("Any", SimpleNamespace(option=SimpleNamespace(rig_sheet=None)))
    with end_results(Results(tmp_path / "out", (), config)):
        (tmp_path / "out/evidence/a").mkdir(parents=True)
        shutil.copytree(tmp_path / "out", tmp_path / "killed")
    with end_results(Results(tmp_path / "killed", (), config)):
        assert not (tmp_path / "killed/evidence").exists()


@contextmanager
def end_results(started: Results) -> Iterator[Results]:
    yield started
    started.pytest_sessionfinish(cast("Any", None))


def test_late_blocks_and_inconclusive_cases_are_shown(tmp_path: Path) -> None:
    document = results(good=0.4, open=0.1)
    document["cases"][1]["outcome"] = "inconclusive"
    document["counts"] |= {"inconclusive": 1, "failed": 0}
    document["wall"]["cases"]["x.campaign.toml::good"]["late_blocks"] = 7
    (counts, *_), cases = (
        [part for part in make_page(document, tmp_path).parts if isinstance(part, Table) and name in part.headings]
        for name in ("inconclusive", "late blocks")
    )
    assert counts.rows[0].cells[counts.headings.index("inconclusive")] == "1"
    assert [row.cells[-2:] for row in cases[0].rows if row.cells[0].endswith("good")] == [("7", "passed")]
    write_junit(document, tmp_path / "junit.xml")
    good, unsure, *_ = check_junit(tmp_path / "junit.xml")
    properties = [{each.get("name"): each.get("value") for each in suite.iter("property")} for suite in (good, unsure)]
    assert (properties[0]["late blocks"], properties[0]["inconclusive"]) == ("7", "0")
    assert (properties[1]["outcome"], properties[1]["inconclusive"]) == ("inconclusive", "1")


def test_a_late_rig_of_somebody_else_is_counted_until_the_test_ends() -> None:
    bench, overruns = object.__new__(Bench), iter((10, 13, 15, 99))
    bench.target, bench.pace, bench.late = Target(url="zenoh:elsewhere"), "real-time", 0
    cast("Any", bench).status = lambda: {"overruns": next(overruns), "time_s": 1.5}
    assert bench.begin() == 1.5
    assert bench.late_blocks() == 3
    bench.stop()
    assert bench.late_blocks() == 5


def test_the_trend_has_a_column_for_each_campaign(tmp_path: Path) -> None:
    first, second, now = results(good=0.4), results(good=0.3, fresh=0.2), results(good=-0.1)
    for number, each in enumerate((first, second), 1):
        each["wall"]["begun"] = f"2025-01-0{number}"
    (trend,) = (
        part for part in make_page(now, tmp_path, [first, second]).parts
        if isinstance(part, Table) and "2: 2025-01-02" in part.headings
    )  # fmt: skip
    rows = {row.cells[:2]: row.cells[2:] for row in trend.rows}
    assert rows["x.campaign.toml::good", "outcome"] == ("passed", "passed", "failed")
    assert rows["x.campaign.toml::good", "margin of peak"] == ("0.4 mm", "0.3 mm", "-0.1 mm")
    assert rows["x.campaign.toml::fresh", "margin of peak"] == ("", "0.2 mm", "")


def test_texts_of_devices_cannot_break_the_documents(tmp_path: Path) -> None:
    hostile = "</td><script>alert(1)</script>]]>&\ud800\x00\x1b[2J\u202e$\\frac{$"
    document = results(good=0.4, bad=-0.1)
    for case in document["cases"]:
        case |= {"reason": hostile, "title": hostile, "troubles": [hostile], "repeat": hostile}
        for each in case["measurements"]:
            each |= {"name": hostile, "note": hostile, "source": hostile}
    document["titles"] = [hostile]
    write_report(make_page(document, tmp_path, [document]), tmp_path / "index.html")
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert not {"\x00", "\x1b", "\u202e"} & set(page)
    write_junit(document, tmp_path / "junit.xml")
    good, *_ = check_junit(tmp_path / "junit.xml")
    name = next(each.get("name") for each in good.iter("property") if ".note" in str(each.get("name")))
    assert name == "</td><script>alert(1)</script>]]>&[2J\u202e$\\frac{$.note"


def test_invalid_results_are_reported(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    file.write_text(json.dumps(results(good=0.4)), encoding="utf-8")
    assert load_results(tmp_path) == load_results(file)
    file.write_text('{"format": 7}', encoding="utf-8")
    with pytest.raises(InputError, match="campaign results written by this version"):
        load_results(tmp_path)
    with pytest.raises(InputError, match="a file that can be read"):
        load_results(tmp_path / "nowhere")
    for place, value, field in (
        (["cases", 0, "measurements", 0, "margin"], "0.4", r"cases\.0\.measurements\.0\.margin"),
        (["cases", 0, "outcome"], "great", r"cases\.0\.outcome"),
        (["cases", 0, "id"], None, r"cases\.0\.id"), (["cases"], {}, "cases"), (["wall"], [], "wall"),
        (["wall", "cases", "x.campaign.toml::good", "duration_s"], "1", "wall.cases"),
    ):  # fmt: skip
        altered: Any = results(good=0.4)
        holder = altered
        for key in place[:-1]:
            holder = holder[key]
        holder[place[-1]] = value
        file.write_text(json.dumps(altered), encoding="utf-8")
        with pytest.raises(InputError, match=field):
            load_results(tmp_path)


@pytest.mark.parametrize("name", ["results.json", "junit.xml", "index.html", "evidence/of_mine.txt"])
def test_a_folder_with_files_of_others_is_left_as_it_is(name: str, tmp_path: Path) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("{}", encoding="utf-8")
    config = cast("Any", SimpleNamespace(option=SimpleNamespace(rig_sheet=None)))
    with pytest.raises(InputError, match=f"--output must be a folder without {name.partition('/')[0]}") as caught:
        Results(tmp_path, (), config)
    assert ("unless --force is given" in str(caught.value)) == ("evidence" not in name)
    assert file.read_text(encoding="utf-8") == "{}"
    if "evidence" in name:
        with pytest.raises(InputError, match="--output must be a folder without evidence"):
            Results(tmp_path, (), config, force=True)
        assert file.read_text(encoding="utf-8") == "{}"
        return
    with end_results(Results(tmp_path, (), config, force=True)):
        assert not (tmp_path / "evidence").exists()


def test_evidence_is_not_written_through_a_link(tmp_path: Path) -> None:
    config = cast("Any", SimpleNamespace(option=SimpleNamespace(rig_sheet=None)))
    with end_results(Results(tmp_path / "out", (), config)):
        pass
    (tmp_path / "mine").mkdir()
    (tmp_path / "out" / "evidence").symlink_to(tmp_path / "mine")
    with pytest.raises(InputError, match="evidence is no symbolic link"):
        Results(tmp_path / "out", (), config, force=True)


def repeat(monkeypatch: pytest.MonkeyPatch, pace: str, *runs: dict[str, float] | str) -> list[Measurement]:
    """Run a case once for each element: its times [ms] by name, or the error of the bench."""
    left = iter(runs)

    def run_case(_: Any, trial: Trial) -> None:
        found = next(left)
        trial.bench = cast("Any", SimpleNamespace(pace=pace, close=lambda: None, can_url="", url="", name="",
                                                  socketcand_url="", slcan_path=""))  # fmt: skip
        if isinstance(found, str):
            raise BenchError(found)
        for name, value in found.items():
            trial.take(judge_value(name, value, "ms", "<=", 10.0))

    monkeypatch.setattr("replays.campaigns.files.run.run_case", run_case)
    trial = Trial("a")
    try:
        run_repeatedly(cast("Any", None), trial, len(runs), lambda: Trial("a"))
    finally:
        trial.close(failed=False)
    return trial.measurements


def test_runs_that_are_alike_keep_their_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    time, alike = repeat(monkeypatch, "lockstep", {"time": 3.0}, {"time": 3.0}, {"time": 3.0})
    assert (time.outcome, alike.outcome, alike.note) == (Outcome.PASS, Outcome.PASS, "3 of 3 alike")
    time, alike = repeat(monkeypatch, "lockstep", {"time": 30.0}, {"time": 30.0})
    assert (time.outcome, alike.outcome) == (Outcome.FAIL, Outcome.PASS)
    time, alike = repeat(monkeypatch, "real-time", {"time": 3.0}, {"time": 4.0})  # only the verdict counts
    assert (time.outcome, alike.note) == (Outcome.PASS, "2 of 2 alike")
    (time,) = repeat(monkeypatch, "lockstep", {"time": 3.0})
    assert time.good
    with pytest.raises(BenchError, match="no rig"):
        repeat(monkeypatch, "lockstep", "no rig", "no rig")


def test_what_differs_between_runs_is_inconclusive(monkeypatch: pytest.MonkeyPatch) -> None:
    last = math.nextafter(3.0, 4.0)
    runs = {"time": 3.0, "count": 1.0}, {"time": 3.0, "count": 1.0}, {"time": last, "count": 1.0}
    time, count, alike = repeat(monkeypatch, "lockstep", *runs)
    assert [each.outcome for each in (time, count, alike)] == [Outcome.INCONCLUSIVE, Outcome.PASS, Outcome.INCONCLUSIVE]
    assert alike.open_reason == f"2 of 3 alike: run 3: time is {last!r} ms, pass, not 3.0 ms, pass"
    time, alike = repeat(monkeypatch, "real-time", {"time": 30.0}, {"time": 3.0})
    assert (time.outcome, alike.open_reason) == (
        Outcome.INCONCLUSIVE,
        "1 of 2 alike: run 2: time is pass, not fail",
    )
    (time, alike) = repeat(monkeypatch, "lockstep", {"time": 30.0}, "the rig exited")
    assert [each.outcome for each in (time, alike)] == [Outcome.INCONCLUSIVE] * 2
    assert "run 2: error is the rig exited, not missing" in alike.open_reason
    (alike,) = repeat(monkeypatch, "lockstep", "the rig exited", {})
    assert "run 2: error is missing, not the rig exited" in alike.open_reason


def test_names_of_cases_depend_on_the_file_alone() -> None:
    paths = [Path(each) for each in ("/a/x.py", "/b/x.py", "/b/y.py", "/c/b/x.py")]
    assert list(map(name_files(paths).get, paths)) == ["a/x.py", "/b/x.py", "y.py", "c/b/x.py"]
    assert name_files(paths[:1]) == {paths[0]: "x.py"}
    items: Any = [SimpleNamespace(path=path, nodeid=f"far/{path.name}::C::case=1") for path in paths[:3]]
    plugin.pytest_collection_modifyitems(cast("Any", SimpleNamespace(option=SimpleNamespace(rig_results=""))), items)
    assert not hasattr(items[0], "_nodeid")
    plugin.pytest_collection_modifyitems(cast("Any", SimpleNamespace(option=SimpleNamespace(rig_results="out"))), items)
    assert [vars(each)["_nodeid"] for each in items] == [
        "a/x.py::C::case=1",
        "b/x.py::C::case=1",
        "y.py::C::case=1",
    ]
