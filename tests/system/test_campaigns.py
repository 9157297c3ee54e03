"""Campaigns as processes: a device in the loop in lockstep, the fixtures, several at once, and Ctrl-C."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from recorder.reader import Recording
from tests import processes, waiting
from tests.unit.test_campaign_results import check_junit
from tests.waiting import PATIENCE_S

pytestmark = [pytest.mark.wallclock]

DEVICE = """
import sys
import numpy as np
import rig

url, name, level_mm, how = sys.argv[1:]
with rig.connect(url, channels=["disk_x"], name=name) as machine:
    for samples in machine.blocks():
        if how != "deaf" and (np.abs(samples["disk_x"]) > float(level_mm)).any():
            if how == "dies":
                raise SystemExit("out of order")
            machine.speed(0.0)
            machine.note("trip", tags=["trip"])
            how = "deaf"
print("ended")
"""
CAMPAIGN = """
title = "A device that trips"
scene = "stable-run"
duration_s = 0.4
limits = { danger = "500 um" }

[device]
command = "python device.py {url} {name} {danger:mm} {how}"
name = "protection"

[matrix.device]
how = ["well", "dies", "again"]

[[steps]]
at_s = 0.2
command = "hammer"

[[steps]]
at_s = 0.205
note = "hit"

[[expect]]
name = "time to trip"
event = "note"
where = { tags = "trip" }
since = { signal = "disk_x", beyond = "{danger}" }
must = "<= 20 ms"
source = "two blocks"

[[expect]]
event = "command"
where = { command = "speed", from = "protection", "request.speed_hz" = 0.0 }

[[expect]]
order = [{ event = "hammer" }, { event = "note", text = "hit" }, { event = "note", where = { tags = "trip" } }]
"""
TESTS = """
import time

import psutil
import pytest

@pytest.mark.bench(scene="stable-run", block_ms=20, channels=["disk_x", "P_E"], duration_s=0.3,
                   faults=[{"at_s": 0.1, "channel": "disk_x", "kind": "stuck"}])
def test_fixtures(bench, dut, record, measure):
    device = dut("python device.py {url} {name} 9.0 well", name="watcher")
    with bench.connect(truth=["contact"]) as machine:
        rows = machine.advance(0.2)
        measure("moves while it is sound", rows["disk_x"][:1500].std(), "mm", ">", 0.0)
        measure("moves while it is stuck", rows["disk_x"][2500:].std(), "mm", "<=", 2, unit_of_limit="um")
        recording = record.stop()
        assert len(recording.samples("disk_x")) == 4000
        assert device.program.status is None
        measure("force", rows["P_E"].max(), "N", "<=", 1.0, at_s=0.15, channels=["P_E"])

@pytest.mark.bench(scene="stable-run", pace="real-time")
def test_behind(bench, measure):
    (rig,) = psutil.Process(bench._program._supervisor.pid).children()
    rig.suspend()
    time.sleep(0.1)
    rig.resume()
    bench.advance_to(bench.status()["time_s"] + 0.05)
    measure("time to trip", 2.0, "ms", "<=", 1.0)
"""


FOREIGN_SETTINGS = """
[tool.pytest.ini_options]
addopts = "--strict-config"
timeout_of_a_plugin_that_is_not_installed = 900
"""
"""Settings of a project around a campaign, which must not have an effect."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    files = {"device.py": DEVICE, "x.campaign.toml": CAMPAIGN, "test_x.py": TESTS, "pyproject.toml": FOREIGN_SETTINGS}
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def run_campaign(folder: Path, *arguments: str, status: int) -> tuple[str, dict[str, Any]]:
    """Run a campaign; return its output, and its results by case."""
    with processes.start_rig("campaign", *arguments, "-o", "out", cwd=folder) as child:
        out, err = child.communicate(timeout=processes.COMPILE_S)
    assert child.returncode == status, out + err
    document = json.loads((folder / "out/results.json").read_text(encoding="utf-8"))
    return out, document


REPEATED = """
from pathlib import Path

import pytest

def count_runs():
    with Path("runs").open("a") as file:
        file.write("x")
    return len(Path("runs").read_text())

@pytest.fixture
def number(measure):
    Path("runs").write_text("") if Path("runs").exists() and len(Path("runs").read_text()) == 3 else None
    yield count_runs()

def test_same(number, measure):
    measure("time", 3.0, "ms", "<=", 10.0)

def test_other_value(number, measure):
    measure("time", 30.0 if number == 2 else 3.0, "ms", "<=", 10.0)

def test_fails(number, measure):
    measure("time", 30.0, "ms", "<=", 10.0)

def test_error(number, measure):
    measure("time", 3.0, "ms", "<=", 10.0)
    assert number != 3, "in the last run"

def test_same_error(number, measure):
    assert not number, f"in run {number}"

@pytest.fixture
def rare(number):
    assert number != 1

def test_setup(rare, measure):
    measure("time", 3.0, "ms", "<=", 10.0)
"""


def test_a_test_in_python_is_repeated_and_its_runs_are_compared(folder: Path) -> None:
    (folder / "test_x.py").write_text(REPEATED, encoding="utf-8")
    _, document = run_campaign(folder, "test_x.py", "--repeat", "3", status=1)
    found = {case["id"].partition("::test_")[2]: case for case in document["cases"]}
    assert {name: case["outcome"] for name, case in found.items()} == {
        "same": "passed", "other_value": "inconclusive", "fails": "failed", "error": "inconclusive",
        "same_error": "failed", "setup": "inconclusive",
    }  # fmt: skip
    notes = {name: case["measurements"][-1]["note"] for name, case in found.items() if case["measurements"]}
    assert notes == {
        "same": "3 of 3 alike", "other_value": "2 of 3 alike: run 2: time is fail, not pass", "fails": "3 of 3 alike",
        "error": "2 of 3 alike: run 3: error is AssertionError, not missing",
        "setup": notes["setup"],
    }  # fmt: skip
    assert notes["setup"].startswith("1 of 3 alike: run 2: error is missing, not ")
    assert "in run 3" in found["same_error"]["reason"]


def test_a_device_in_lockstep_gets_the_same_verdict_each_time(folder: Path) -> None:
    out, both = run_campaign(folder, "x.campaign.toml", "test_x.py", status=1)
    well, dies, again, fixtures, behind = both["cases"]
    assert [case["outcome"] for case in both["cases"]] == ["passed", "failed", "passed", "failed", "inconclusive"]
    measurements = {each["name"]: each for each in well["measurements"]}
    assert measurements["time to trip"]["good"]
    assert measurements["time to trip"]["resolution"] == "1 tick, 1 us; 10 ms blocks, in lockstep"
    assert 1e3 * measurements["time to trip"]["at_s"] % 10.0 == 0.0  # the end of a block
    assert "exit status of protection must be == 0; received 1 (its last line: out of order)" in out
    assert "\n      time to trip must be <= 20 ms; received nothing (no note tags=trip occurred)" in out
    assert dies["reason"].startswith("exit status of protection must be == 0")
    assert [each["good"] for each in fixtures["measurements"]] == [True, True, False]
    assert fixtures["reason"].startswith("force must be <= 1 N; received ")
    assert fixtures["resolution"] == "20 ms blocks, in lockstep"
    # A rig that was stopped for a tenth of a second gives no verdict on a device.
    assert behind["reason"].startswith("not judged because the rig was late in ")
    assert behind["reason"].partition(": ")[2].startswith("time to trip must be <= 1 ms; received 2 ms")
    # The evidence of the failed case, about the moment of the failure.
    logs = folder / "out/evidence/test_x.py_test_fixtures"
    assert [Path(file).name for file in fixtures["evidence"]] == ["rig.log", "watcher.log", "event.mcap", "event.png"]
    assert Recording.open(logs / "event.mcap").span_s == (0.0, pytest.approx(0.2, abs=1e-3))
    assert len(check_junit(folder / "out/junit.xml")) == 5
    assert "<img" in (folder / "out/index.html").read_text(encoding="utf-8")
    # A repeated run is identical, byte for byte.
    assert well["repeat"] == "rig campaign x.campaign.toml::how=well"
    assert json.dumps(again).replace("how=again", "how=well").replace(" again", " well") == json.dumps(well)


CAN_DEVICE = """
import sys
import rig

url, kind, text = sys.argv[1:]
assert text == "{url}", text
with rig.connect(url, channels=["disk_x"], name="over CAN") as machine:
    sent = False
    for samples in machine.blocks():
        if not sent and abs(samples["disk_x"]).max() > 0.3:
            machine.note(kind + " disk_x", tags=[kind])
            if kind == "alert":
                machine.speed(4.0)
            sent = True
"""
CAN_CAMPAIGN = """
title = "Devices on a bus, in three ways"
scene = "stable-run"
duration_s = 0.3
can = true

[[devices]]
command = "./plain_device {socketcand} 500"
name = "c"

[[devices]]
command = "python can_device.py {can}&node=3 alert {{url}}"
name = "node3"

[[devices]]
command = "python can_device.py can:slcan:{slcan}?node=4 not-ok {{url}}"
name = "node4"

[[steps]]
at_s = 0.1
command = "hammer"

[[expect]]
event = "note"
where = { tags = "danger", from = "CAN 7" }
text = "danger disk_x "
since = { signal = ["disk_x", "disk_y"], beyond = "500 um" }
must = "<= 10 ms"

[[expect]]
event = "command"
where = { command = "speed", from = "CAN 7", "request.speed_hz" = 0.0 }

[[expect]]
event = "command"
where = { command = "speed", from = "CAN 3", "request.speed_hz" = 4.0 }

[[expect]]
order = [
  { event = "note", where = { tags = "alert", from = "CAN 3" }, text = "alert disk_x" },
  { event = "note", where = { tags = "danger" } },
  { event = "note", where = { tags = "trip", from = "CAN 7" } },
]

[[expect]]
event = "note"
where = { tags = "not-ok", from = "CAN 4" }

[[expect]]
event = "device"
where = { state = "joined" }
take = "count"
must = "== 3"
"""


def test_devices_on_a_bus_take_part_by_socketcand_slcan_and_zenoh(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("this machine has no C compiler (cc)")
    source = processes.ROOT / "docs/plain_device.c"
    warnings = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
    subprocess.run([compiler, *warnings, "-o", "plain_device", source, "-lm"], cwd=tmp_path, check=True)
    (tmp_path / "can_device.py").write_text(CAN_DEVICE, encoding="utf-8")
    (tmp_path / "can.campaign.toml").write_text(CAN_CAMPAIGN, encoding="utf-8")
    out, document = run_campaign(tmp_path, "can.campaign.toml", status=0)
    (case,) = document["cases"]
    assert [each["good"] for each in case["measurements"]] == [True] * len(case["measurements"])
    names = [each["name"] for each in case["measurements"]]
    assert [f"times that {name} was lost" for name in ("c", "node3", "node4")] == [
        name for name in names if name.startswith("times that")
    ]
    assert "1 passed" in out


SLOW_CAMPAIGN = """
title = "It takes long"
scene = "stable-run"
pace = "real-time"
duration_s = 600.0

[device]
command = "python -c 'import time; print(1, flush=True); time.sleep(600.0)'"

[matrix.set]
seed = [1, 2, 3]

[[expect]]
signal = "disk_x"
must = "<= 2 mm"
"""


def descendants(pid: int) -> list[Any]:
    import psutil

    return list(psutil.Process(pid).children(recursive=True))


def test_ctrl_c_ends_all_processes_and_reports_finished_cases(tmp_path: Path) -> None:
    import psutil

    (tmp_path / "long.campaign.toml").write_text(SLOW_CAMPAIGN, encoding="utf-8")
    (tmp_path / "test_a.py").write_text("def test_a(measure):\n    measure('a', 1, 'mm', '<=', 2)\n", encoding="utf-8")
    arguments = ("campaign", "test_a.py", "long.campaign.toml", "-j", "2", "-o", "out")
    with processes.start_rig(*arguments, cwd=tmp_path, start_new_session=True) as child:

        def devices() -> int:
            lines = []
            for each in descendants(child.pid):
                with suppress(psutil.Error):  # it has just ended
                    lines.append(" ".join(each.cmdline()))
            return sum("time.sleep" in line for line in lines)

        waiting.until(
            lambda: devices() >= 4, timeout_s=processes.COMPILE_S, every_s=0.1
        )  # each with its cleanup process
        remaining = descendants(child.pid)
        os.killpg(child.pid, signal.SIGINT)
        out, err = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 130, out + err
    waiting.until(lambda: not any(each.is_running() and each.status() != "zombie" for each in remaining), every_s=0.1)
    assert "1 passed, 3 not run" in out
    results = json.loads((tmp_path / "out/results.json").read_text(encoding="utf-8"))
    assert results["counts"] == {
        "failed": 0, "error": 0, "interrupted": 3, "inconclusive": 0, "skipped": 0, "passed": 1,
    }  # fmt: skip
    assert (tmp_path / "out/index.html").is_file()


OPEN = """
import math

import pytest
from replays.campaigns.measurement import Measurement, Must

def take(trial, value, reason):
    return trial.take(Measurement("gap", value, Must("<=", 1.0, "mm"), open_reason=reason))

def test_pass(measure):
    measure("gap", 0.5, "mm", "<=", 1.0)

def test_open(rig_trial):
    take(rig_trial, math.nan, "nothing moved")

def test_open_and_fail(rig_trial):
    take(rig_trial, math.nan, "nothing moved")
    take(rig_trial, 2.0, "")

def test_skip():
    pytest.skip("no bus")
"""


def test_an_inconclusive_case_is_an_error_of_that_type_and_ends_with_status_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTEST_ADDOPTS", "--collect-only")  # options of somebody else's tests
    (tmp_path / "test_open.py").write_text(OPEN, encoding="utf-8")
    out, document = run_campaign(
        tmp_path, "test_open.py", "-k", "test_pass or test_skip or (test_open and not fail)", status=3
    )
    assert [case["outcome"] for case in document["cases"]] == ["passed", "inconclusive", "skipped"]
    assert "INCONCLUSIVE test_open.py::test_open: gap must be <= 1 mm; inconclusive: nothing moved" in out
    (error,) = ElementTree.parse(tmp_path / "out/junit.xml").getroot().iter("error")
    assert error.get("type") == "inconclusive"
    run_campaign(tmp_path, "test_open.py", "-k", "test_skip", status=3)
    run_campaign(tmp_path, "test_open.py", "-k", "test_pass", status=0)
    _, document = run_campaign(tmp_path, "test_open.py", status=1)
    assert document["cases"][2]["reason"].startswith("gap must be <= 1 mm; received 2 mm")
    monkeypatch.delenv("PYTEST_ADDOPTS")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--junitxml=plain.xml", "test_open.py"]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "1 failed, 1 passed, 1 skipped, 1 error" in found.stdout, found.stdout + found.stderr
    cases = list(ElementTree.parse(tmp_path / "plain.xml").getroot().iter("testcase"))
    tags = [[each.tag for each in case if each.tag != "properties"] for case in cases]
    assert tags == [[], ["error"], ["failure"], ["skipped"]]


EXTERNAL_CAMPAIGN = """
title = "On a rig that is there"
duration_s = 3.0

[device]
command = "python device.py {url} {name} 0.5 well"
name = "protection"

[matrix]
scene = ["stable-run", "hammer"]

[[steps]]
at_s = 0.1
command = "hammer"

[[expect]]
event = "hammer"
must = "0.1 to 2.5 s"

[[expect]]
event = "note"
where = { tags = "trip" }
since = { signal = "disk_x", beyond = "0.5 mm" }
must = "<= 2 s"
"""


def test_a_campaign_runs_on_a_recording_and_on_a_running_rig(folder: Path) -> None:
    session = processes.ROOT / "replays/sessions/hammer-6.2.mcap"
    _, played = run_campaign(folder, "hammer", "--replay", str(session), status=0)
    assert [(case["outcome"], case["reason"]) for case in played["cases"]] == [
        ("skipped", "the recording has drive.speed_hz = 6.2, not 5.2"),
        ("passed", ""),
    ]
    assert played["cases"][1]["measurements"][2]["value"] == pytest.approx(-81.7, abs=0.5)
    (folder / "there.campaign.toml").write_text(EXTERNAL_CAMPAIGN, encoding="utf-8")
    name = f"there-{os.getpid()}"  # other tests may run on this computer
    with processes.start_rig("run", "stable-run", "--listen", "127.0.0.1:0", "--name", name) as rig:
        processes.read_line(rig, "listening on")
        arguments = ("there.campaign.toml", "--url", name)
        try:
            _, there = run_campaign(folder, *arguments, status=0)
        except AssertionError as error:  # a busy computer: the verdict is inconclusive, and says so
            if "the rig was late" not in str(error):
                raise
            _, there = run_campaign(folder, *arguments, status=0)
        rig.terminate()
        rig.communicate(timeout=PATIENCE_S)
    assert [(case["outcome"], case["reason"]) for case in there["cases"]] == [
        ("passed", ""),
        ("skipped", "the existing rig has scene stable-run, not hammer"),
    ]
    median_ms, longest_ms = there["wall"]["cases"]["there.campaign.toml::stable-run"]["floor_ms"]
    assert 0.0 < median_ms <= longest_ms
