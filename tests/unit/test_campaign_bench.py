"""Bench, recording, devices and evidence of a campaign, with stand-ins for the rig and the programs."""

from __future__ import annotations

import hashlib
import math
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from replays.campaigns import evidence
from replays.campaigns.equipment import bench
from replays.campaigns.equipment.bench import (
    Bench,
    BenchError,
    BenchSettings,
    LateRigError,
    Target,
    UnsupportedError,
    toml_value,
)
from replays.campaigns.equipment.device import Device, check_program
from replays.campaigns.equipment.record import Record, ReplacedRecordingError
from replays.campaigns.evidence import MeasurementError, Trial
from replays.campaigns.files.run import finish_run, note_early_ends
from replays.campaigns.mark_arguments import read_settings
from replays.campaigns.measurement import judge_value
from rig.base import wire
from rig.base.errors import InputError, RefusedError
from rig.base.outcome import InconclusiveError
from tests.processes import ROOT
from tests.waiting import PATIENCE_S

DEFAULT_TARGET = Target()
PARTS = {
    "settings": BenchSettings(), "target": DEFAULT_TARGET, "pace": "lockstep", "late": 0, "url": "", "name": "b",
    "can_url": None, "socketcand_url": None, "slcan_path": None,
}  # fmt: skip
"""Fields of a bench without a rig."""


LINES = {"listening on": "listening on 127.0.0.1:1;", "SLCAN adapter on ": "SLCAN adapter on /dev/pts/3"}
"""Lines of a rig."""


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Any, str]]:
    """Return a function that starts a bench on a stand-in for a rig, and returns it with the rig's command line."""
    words = list[str]()
    program = SimpleNamespace(wait_for=lambda text, _: LINES[text], end=lambda: None)
    monkeypatch.setattr(bench, "Program", lambda command, _: (words.extend(command[1:]), program)[1])

    def start_bench(settings: BenchSettings, target: Target = DEFAULT_TARGET, **console: Any) -> tuple[Any, str]:
        words.clear()
        rig = SimpleNamespace(**{"pace": "lockstep", "status": lambda: {"end_s": 0.6}, **console})
        monkeypatch.setattr(Bench, "connect", lambda *_, **__: rig)
        return Bench(settings, Path(), target), " ".join(words)

    return start_bench


def test_a_rig_in_lockstep_advances_by_whole_blocks_up_to_its_end(start: Callable[..., tuple[Any, str]]) -> None:
    steps = list[int]()

    def step(ticks: int, *, timeout_s: float) -> SimpleNamespace:
        assert timeout_s == 600.0
        steps.append(ticks)
        return SimpleNamespace(tick=sum(steps))

    for time_s, end_s, expected in (
        (0.105, None, [110_000]), (0.1, 2.505, [100_000]), (0.0, None, []),
        (3.0, 2.505, [1_000_000, 1_000_000, 505_000]),
    ):  # fmt: skip
        steps.clear()
        status = {"tick": 0, "block_ms": 10.0, "end_s": end_s}
        start(BenchSettings(), status=lambda status=status: status, step=step)[0].advance_to(time_s)
        assert steps == expected

    def refuse(_: int, *, timeout_s: float) -> None:
        raise RefusedError(f"{words} before {timeout_s:g} s")

    status = {"tick": 0, "block_ms": 10.0, "end_s": None}
    found, _ = start(BenchSettings(), status=lambda: status, step=refuse)
    words = f"{wire.ENDED}: stopped"
    found.advance_to(1.0)
    words = "busy"
    with pytest.raises(BenchError, match="does not advance: busy"):
        found.advance_to(1.0)


def test_the_command_of_a_rig_has_the_settings_of_its_case(
    start: Callable[..., tuple[Any, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for settings, words in (
        (
            BenchSettings("hammer", block_ms=2.5, set={"seed": 7}, duration_s=0.5, table=Path("t.csv")),
            "hammer --pace lockstep --block-ms 2.5 {} --set seed=7 --set duration_s=0.5 --channels t.csv",
        ),
        (BenchSettings(pace="real-time"), "stable-run --pace real-time --block-ms 10 {} --set duration_s=86400.0"),
        (BenchSettings(), "stable-run --pace lockstep --block-ms 10 {}"),
    ):
        found, command = start(settings)
        assert command == "-m rig run " + words.format(f"--listen 127.0.0.1:0 --name {found.name}")
        assert (found.url, found.slcan_path, found.can_url) == ("zenoh:127.0.0.1:1", None, None)
    monkeypatch.setattr(Bench, "scene_document", lambda _: SCENE)
    found, command = start(BenchSettings("hammer"), Target(replay=Path("a.mcap")))
    assert command == f"-m rig replay a.mcap --pause --listen 127.0.0.1:0 --name {found.name}"
    found, command = start(BenchSettings(can=True), status=lambda: {"congestion": {}})
    assert (found.slcan_path, found.links) == ("/dev/pts/3", 0)
    assert f" --can {found.can_url.partition(':')[2]} --can-socketcand {found.socketcand_url} --can-slcan" in command
    values = {"a": [1, True, "x"], "b": {"c": 0.5}}
    assert toml_value(values) == '{ "a" = [1, true, "x"], "b" = { "c" = 0.5 } }'
    for value in (None, object()):
        with pytest.raises(InputError, match="set must be numbers, texts, lists and tables"):
            toml_value(value)


SCENE = {"name": "hammer", "drive": {"speed_hz": 6.2}, "set": {"seed": 3}}


def test_an_existing_rig_or_recording_must_fit_the_case(
    start: Callable[..., tuple[Any, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Bench, "scene_document", lambda _: SCENE)
    rig, recording = Target(url="u"), Target(replay=Path("a.mcap"))
    for settings, target, problem in (
        (BenchSettings("x/hammer.toml", set={"drive.speed_hz": 6.2, "seed": 3}), rig, ""),
        (BenchSettings("drop"), rig, "the existing rig has scene hammer, not drop"),
        (BenchSettings(set={"drive.speed_hz": 5.2}), recording, "the recording has drive.speed_hz = 6.2, not 5.2"),
        (BenchSettings(set={"drive.speed_hz.x": 1}), rig, "the existing rig has drive.speed_hz.x = None, not 1"),
        (BenchSettings(duration_s=0.605), recording, ""), (BenchSettings(duration_s=0.62), rig, ""),
        (BenchSettings(duration_s=0.62), recording, "the recording ends at 0.6 s, before the test at 0.62 s"),
        (BenchSettings(can=True), rig, "the CAN bus address of the existing rig is not available"),
    ):  # fmt: skip
        found = ""
        try:
            start(settings, target)
        except UnsupportedError as error:
            found = str(error)
        assert found == problem


def test_arguments_of_the_marker_are_commands_and_faults_at_their_times() -> None:
    fault = {"channel": "disk_x", "kind": "stuck"}
    found = read_settings({"scene": "hammer", "faults": [fault, {**fault, "at_s": 0.2}], "channels": ["disk_x"]})
    assert [(each.at_s, each.request.command) for each in found.commands] == [(0.0, "fault"), (0.2, "fault")]
    expected = BenchSettings("hammer", channels=("disk_x",), commands=found.commands)
    assert found == expected
    assert (found.pace, found.block_ms, found.can, found.wait.join_s) == ("lockstep", 10.0, False, 30.0)
    assert [None in each["request"].values() for each in found.document()["commands"]] == [False, False]
    longest = read_settings({"block_ms": 1000.0, "duration_s": 86_400.0, "wait": {"join_s": 86_400.0}})
    assert (longest.block_ms, longest.duration_s, longest.wait.join_s) == (1000.0, 86_400.0, 86_400.0)
    for arguments, field in (
        ({"block_ms": 1000.5}, r"bench\.block_ms"), ({"wait": {"join_s": 86_401.0}}, r"bench\.wait\.join_s"),
        ({"faults": [fault, {"channel": "disk_x"}]}, r"bench\.faults\.1"), ({"commands": [{}]}, r"bench\.commands\.0"),
        ({"block_ms": 0.5}, r"bench\.block_ms"), ({"duration_s": 0.0}, r"bench\.duration_s"),
        ({"scene": "no"}, "scene"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"^{field}"):
            read_settings(arguments)


def test_a_program_or_script_that_is_missing_is_refused(tmp_path: Path) -> None:
    (tmp_path / "here.py").touch()
    (tmp_path / "tool").touch()
    for words in (["python"], ["python", "here.py"], ["tool", "-x"], ["python", "-m", "nowhere.py"]):
        check_program(words, tmp_path, field="command")
    for words, must in (
        (["python", "no.py"], "with a script that exists in"),
        (["tol"], "a program in PATH"),
        ([], "a command"),
    ):
        with pytest.raises(InputError, match=must):
            check_program(words, tmp_path, field="command")


def test_changes_of_the_files_of_a_device_are_noted(tmp_path: Path) -> None:
    script, words = tmp_path / "tool.py", "print('{name} {url} {{danger}}')"
    for change in ("", "open('tool.py', 'a').write('#')", "import os; os.unlink('tool.py')"):
        script.write_text(change)
        stand_in = SimpleNamespace(**{**PARTS, "url": "u"}, joined=[], lost={"guard": "it hangs"})
        device = Device(
            ["python", "tool.py", words], name="guard", bench=cast("Any", stand_in), log=tmp_path / "guard.log",
            where=tmp_path, files=tmp_path,
        )  # fmt: skip
        assert device.program.command == ["python", "tool.py", "print('guard u {danger}')"]
        assert device.digests["tool.py"] == hashlib.sha256(change.encode()).hexdigest()
        assert device.program.wait(PATIENCE_S) == 0
        with pytest.raises(BenchError, match="device guard ended with status 0: nothing"):
            device.check_running()
        by_test = not change
        if by_test:
            device.program.kill()
        device.end()
        assert (device.is_ended_by_test, device.was_lost) == (by_test, by_test)
        expected = {"": {}, "o": {"tool.py": hashlib.sha256(f"{change}#".encode()).hexdigest()}}
        assert device.changed_digests == expected.get(change[:1], {"tool.py": "removed"})


def test_an_altered_recording_is_not_judged(tmp_path: Path) -> None:
    path, record = tmp_path / "session.mcap", cast("Any", object.__new__(Record))
    data = shutil.copyfile(ROOT / "replays/sessions/hammer-6.2.mcap", path).read_bytes()
    digest, opened = hashlib.sha256(data).hexdigest(), os.open(path, os.O_RDONLY)
    summary = SimpleNamespace(path=path, error="", losses=[], size_bytes=len(data), sha256=digest)
    vars(record).update(path=path, _error=None, _descriptor=opened, _summary=summary)
    assert record.stop().complete
    for altered in (data[:1000] + bytes([data[1000] ^ 1]) + data[1001:], data + b"x", b""):
        path.write_bytes(altered)
        with pytest.raises(ReplacedRecordingError, match=f"its {len(altered)} bytes are not the"):
            record.stop()
    path.write_bytes(data)
    for field, problem in (("losses", ["a row"]), ("error", "no space")):
        vars(record)["_summary"] = SimpleNamespace(**{**vars(summary), field: problem})
        with pytest.raises(BenchError, match=r"the recording lacks (a row|no space)"):
            record.stop()
    path.unlink()
    with pytest.raises(ReplacedRecordingError, match="it was removed"):
        record.stop()
    path.write_bytes(data)
    with pytest.raises(ReplacedRecordingError, match="another file has its name"):
        record.stop()
    vars(record).update(_summary=None, _error=OSError("no space"))
    with pytest.raises(BenchError, match="the recording failed: no space"):
        record.stop()
    os.close(opened)


def judge_device(folder: Path, *events: dict[str, Any], lost: Any = (), **changes: Any) -> dict[str, Any]:
    """Finish a run of 0.5 s with a device; return the failed measurements with value and time."""
    program = SimpleNamespace(status=0, last_line="", is_output_cut=False)
    device = SimpleNamespace(
        name="guard", rig_name="guard", program=program, is_ended_by_test=False, was_lost=False, may_end=False,
        has_ended_early=False, changed_digests={}, bench=SimpleNamespace(**PARTS), end=lambda: None,
    )  # fmt: skip
    vars(device).update(changes)
    trial, end = Trial("a", folder=folder, records=folder), {"event": "end", "tick": 500_000}
    found = SimpleNamespace(catalogue={"tick_rate_hz": 1e6}, events=[*events, end])
    stand_in = SimpleNamespace(**PARTS, lost=dict(lost), stop=lambda: None)
    trial.bench, trial.devices = cast("Any", stand_in), [cast("Any", device)]
    trial.record = cast("Any", SimpleNamespace(wait=lambda: None, stop=lambda: found))
    finish_run(trial)
    return {each.name: (each.value, each.at_s) for each in trial.measurements if not each.good}


def test_a_device_may_end_or_leave_early_only_if_that_is_allowed(tmp_path: Path) -> None:
    early, lost = "early ends of guard", "times that guard was lost"
    left = {"event": "device", "device": "guard", "state": "left", "tick": 200_000}
    assert judge_device(tmp_path) == {}
    assert judge_device(tmp_path, has_ended_early=True) == {early: (1.0, None)}
    assert judge_device(tmp_path, left) == {early: (1.0, 0.2)}
    assert judge_device(tmp_path, {**left, "tick": 500_000}) == judge_device(tmp_path, {**left, "device": "b"}) == {}
    for allowed in ("may_end", "is_ended_by_test"):
        assert judge_device(tmp_path, left, has_ended_early=True, **{allowed: True}) == {}
    assert judge_device(tmp_path, {**left, "state": "lost"}) == {lost: (1.0, 0.2)}
    hangs = {"guard": "it hangs"}
    assert judge_device(tmp_path, lost=hangs) == {lost: (1.0, None)}
    assert judge_device(tmp_path, lost=hangs, is_ended_by_test=True) == {}
    assert judge_device(tmp_path, lost=hangs, is_ended_by_test=True, was_lost=True) == {lost: (1.0, None)}
    assert judge_device(tmp_path, changed_digests={"a.py": "0", "b": "1"}) == {
        "changed program files of guard": (2.0, None)
    }
    program = SimpleNamespace(status=3, last_line="", is_output_cut=True, output_bytes=3e6, max_output_bytes=2e6)
    failed = {"exit status of guard": (3.0, None), "output of guard": (3.0, None)}
    assert judge_device(tmp_path, program=program) == failed
    trial, expected = Trial("a", folder=tmp_path, records=tmp_path), [False, True, False]
    programs = [
        SimpleNamespace(is_ended=ended, status=status) for ended, status in ((False, None), (False, 0), (True, 0))
    ]
    trial.devices = [cast("Any", SimpleNamespace(program=each)) for each in programs]
    note_early_ends(trial)
    assert [each.has_ended_early for each in trial.devices] == expected


def test_files_of_devices_are_kept_up_to_their_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "MAX_KEPT_BYTES", 7)
    monkeypatch.setattr(evidence, "MAX_FILES", 5)
    files, records, out = tmp_path / "files", tmp_path / "records", tmp_path / "out/evidence"
    for keeps, failed in ((False, False), (True, False), (False, True)):
        for folder in (files / "a", records):
            folder.mkdir(parents=True)
        settings = BenchSettings()
        trial = Trial("x.py::case-a", out, folder=files, records=records, settings=settings, keeps_all=keeps)
        for name, text in (("a_x", "12"), ("a/x", "34567"), ("a/y", ""), ("b", "3456789"), ("c", "")):
            (files / name).write_text(text)
        (files / "link").symlink_to("/etc/passwd")
        (records / "rig.log").write_text("log")
        stopped = list[int]()
        trial.record = cast("Any", SimpleNamespace(stop=lambda stopped=stopped: stopped.append(1), sha256="0a"))
        trial.close(failed=failed)
        assert (stopped, trial.digests) == ([1], {"recording of x.py::case-a": "0a"})
        assert not files.exists()
        assert not records.exists()
        if not (keeps or failed):
            assert not out.exists()
            continue
        kept = [str(each.relative_to(out / "x.py_case-a")) for each in trial.kept]
        assert kept == ["rig.log", "files/a_x", "files/c", "files/4-a_x"]
        assert trial.troubles[0].endswith("no plain file): 3: b, link, a_y")
        shutil.rmtree(out)


def test_a_failure_takes_precedence_over_an_inconclusive_measurement(tmp_path: Path) -> None:
    trial = Trial("a", folder=tmp_path, records=tmp_path)
    trial.take(judge_value("good", 1.0, "mm", "<=", 1.0))
    trial.raise_outcome()
    trial.take(replace(judge_value("open", 1.0, "mm", "<=", 1.0), open_reason="why"))
    with pytest.raises(InconclusiveError, match=r"^open must be .*why"):
        trial.raise_outcome()
    trial.take(judge_value("bad", 2.0, "mm", "<=", 1.0))
    with pytest.raises(MeasurementError, match=r"^bad must be <= 1 mm; received 2 mm \[margin -1 mm\]$"):
        trial.raise_outcome()
    trial.take(judge_value("worse", math.nan, "mm", "<=", 1.0))
    with pytest.raises(MeasurementError, match=r"^bad must be .*; and 1 more$"):
        trial.raise_outcome()
    trial.bench = cast("Any", SimpleNamespace(**PARTS, late_blocks=lambda: 3))
    with pytest.raises(LateRigError, match="late in 3 blocks"):
        trial.raise_outcome()
