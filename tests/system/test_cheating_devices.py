"""Devices that cheat or fail in a campaign: none passes, none hangs it, none leaves a process, each has its reason.

A sample runs in the suite; `RIG_CHEATS=all pytest tests/system/test_cheating_devices.py` runs all of them, and
`RIG_CHEATS=hangs,leaves` some. Each is a case of one campaign: a device that trips in time, except for one thing, which
is named by a function of `device.py`. The wall clock of all programs steps by an hour, back and forth.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests import processes

pytestmark = [pytest.mark.wallclock]
CHOSEN = os.environ.get("RIG_CHEATS", "")
CLOCK = """
import time
def step(clock, hour):
    return lambda: clock() + hour * (int(4 * time.monotonic()) % 2)
time.time, time.time_ns = step(time.time, 3600), step(time.time_ns, 3600 * 10**9)
"""
SESSION = processes.ROOT / "replays/sessions/hammer-6.2.mcap"

DEVICE = r'''
import glob, os, shutil, signal, subprocess, sys, tempfile, time
import numpy as np
import psutil
import rig

url, name, folder, how, session = sys.argv[1:]
mine = os.path.join(folder, "daq.mcap")

def recording():
    (path,) = glob.glob(os.path.join(tempfile.gettempdir(), "rig-*", "session.mcap*"))
    return path

def write(data, position=None):
    with open(recording(), "r+b") as file:
        file.seek(*((0, 2) if position is None else (position,)))
        file.write(data)

def replace(path, with_link=False):
    os.rename(path, path + ".away")
    os.symlink(session, path) if with_link else shutil.copy(session, path)

def rigs():
    family = psutil.Process(os.getppid()).parent().children(recursive=True)
    return [each for each in family if each.status() != "zombie" and each.cmdline()[1:4] == ["-m", "rig", "run"]]

def start_child(code, *more):
    child = subprocess.Popen([sys.executable, "-c", code, *more], start_new_session=True, stdout=subprocess.PIPE)
    child.stdout.readline()
    return child

STUBBORN = "import signal, time; signal.signal(15, signal.SIG_IGN); print(flush=True); time.sleep(600)"
CLIENT = """
import sys, time, rig
with rig.connect(sys.argv[1], channels=(), name="other") as machine:
    print(flush=True)
    for _ in range(20):
        try:
            getattr(machine, sys.argv[2])(*map(int, sys.argv[4:]), device=sys.argv[3])
        except Exception as error:
            print(error, file=sys.stderr)
        time.sleep(0.1)
"""

def daemonize():
    if os.fork():
        os._exit(0)
    os.setsid()

# Before the device joins.
def starts_and_ends(): sys.exit(0)
def never_joins(): time.sleep(600)
def daemon(): daemonize()
def prints_much(): [sys.stdout.write("x" * 1_000_000) for _ in range(101)]
def swaps_part(): replace(recording())
def links_part(): replace(recording(), with_link=True)
def truncates_part(): os.truncate(recording(), 0)
def alters_part(): write(b"\0" * 100, 5000)
def alters_index(): write(b"\xff" * 8, 9)
def appends_to_part(): write(b"\0" * 50_000_000)
def removes_part(): os.unlink(recording())
def removes_records(): shutil.rmtree(os.path.dirname(recording()))
def hands_in_a_link(): os.symlink(recording(), mine)
def hands_in_a_folder_link(): os.symlink(os.path.dirname(recording()), os.path.join(folder, "sub"))
def hands_in_a_pipe(): os.mkfifo(mine)
def hands_in_nothing(): pass
def removes_folder(): shutil.rmtree(folder)
def links_folder(): os.rename(folder, folder + "-away"); os.symlink(os.path.dirname(__file__), folder)
def fills_folder(): [open(os.path.join(folder, str(n)), "w").close() for n in range(10_001)]
def locks_folder(): os.chmod(folder, 0)
def stubborn_child(): start_child(STUBBORN)

# At the trip, before (True) or after the note.
def killed(machine): os.kill(os.getpid(), signal.SIGKILL)
def stopped(machine): os.kill(os.getpid(), signal.SIGSTOP)
def hangs(machine): time.sleep(600)
def raises(machine): raise RuntimeError("out of order")
def exits_3(machine): sys.exit(3)
def interrupted(machine): raise KeyboardInterrupt
def vanishes(machine): os._exit(0)
def leaves(machine): machine.close(); sys.exit(0)
def leaves_and_stays(machine): machine.leave(); time.sleep(600)
def is_slow(machine): time.sleep(3.0)
def wrong_block(machine): machine.done(123)
def stops_the_rig(machine): machine.stop()
def steps_the_rig(machine): machine.step(10_000)
def clears_faults(machine): machine.clear()
def kills_the_rig(machine): [each.kill() for each in rigs()]
def kills_supervisor(machine): start_child(STUBBORN); os.kill(os.getppid(), signal.SIGKILL); time.sleep(600)
def stops_supervisor(machine): os.kill(os.getppid(), signal.SIGSTOP); time.sleep(600)
def stops_the_rigs_process(machine): [each.suspend() for each in rigs()]
def forged_leave(machine): start_child(CLIENT, url, "leave", name).wait()
def forged_done(machine): start_child(CLIENT, url, "done", name, "9990000").wait()
def many_children(machine): [start_child(STUBBORN) for _ in range(20)]; sys.exit(3)
def restarts_the_rig(machine):
    (old,) = rigs()
    words = old.cmdline()
    words[words.index("--listen") + 1] = url.partition(":")[2]
    old.kill()
    subprocess.Popen(words, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

# Instead of the trip.
def blind(machine): return True
def forges_evidence(machine):
    for each in ("event.png", "index.html", "rig.log", "a\nb<script>.log", b"\xff.txt", "../x.txt"):
        each = os.fsencode(each).replace(b"../", b"..")
        with open(os.path.join(os.fsencode(folder), each), "wb") as file:
            file.write(b"<script>forged</script>")
    os.symlink("/etc/passwd", os.path.join(folder, "passwd"))
    os.truncate(os.open(os.path.join(folder, "large"), os.O_CREAT | os.O_RDWR), 1 << 28)
    return True
def alters_program(machine):
    machine.speed(0.0)
    machine.note("trip", tags=["trip"])
    with open(__file__, "a") as file:
        file.write("# another program")
def notes_only(machine):
    machine.note("trip", tags=["trip"])
    return True

# After the run.
def swaps_session(): replace(recording())
def alters_session(): write(b"\0" * 100, 5000)
def ignores_sigterm(): signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)

EARLY = {starts_and_ends, never_joins, daemon, prints_much, swaps_part, links_part, truncates_part, alters_part,
         alters_index, appends_to_part, removes_part, removes_records, hands_in_a_link, hands_in_a_folder_link,
         hands_in_a_pipe, hands_in_nothing, removes_folder, links_folder, fills_folder, locks_folder, stubborn_child}
INSTEAD = {alters_program, blind, forges_evidence}
LATE = {swaps_session, alters_session, ignores_sigterm}
act = globals().get(how)
if act in EARLY:
    act()
with rig.connect(url, channels=["disk_x"], name=name) as machine:
    if act is notes_only:
        act(machine)
    is_done = act is notes_only
    for samples in machine.blocks(patience_s=1.0):
        if not is_done and (np.abs(samples["disk_x"]) > 0.5).any():
            is_done = True
            if act in INSTEAD:
                act(machine)
                continue
            machine.speed(0.0)
            machine.note("trip", tags=["trip"])
            if act and act not in EARLY | LATE:
                act(machine)
if act in LATE:
    for _ in range(500):
        if act is ignores_sigterm or not recording().endswith(".part"):
            act()
            break
        time.sleep(0.01)
'''
CAMPAIGN = """
title = "A device that trips"
scene = "stable-run"
duration_s = 0.3

[wait]
start_s = 600.0
join_s = 10.0
patience_s = 20.0
end_s = 2.0

[device]
command = "python device.py {{url}} {{name}} {{folder}} {{how}} {session}"
name = "protection"

[matrix.device]
how = {hows}

[[steps]]
at_s = 0.1
command = "hammer"

[[expect]]
name = "time to trip"
event = "note"
where = {{ tags = "trip" }}
since = {{ signal = "disk_x", beyond = "0.5 mm" }}
must = "0 to 20 ms"
"""
SCORED = """
[[expect]]
score = "all"
file = "{file}"
when = {{ how = {hows} }}
"""
TESTS = """
import os
import signal

import pytest

@pytest.mark.parametrize("how", {hows})
@pytest.mark.bench(scene="stable-run", duration_s=0.3, wait={{"start_s": 600.0, "end_s": 2.0}},
                   commands=[{{"at_s": 0.1, "command": "hammer"}}])
def test_python(bench, dut, how):
    device = dut(f"python device.py {{{{url}}}} {{{{name}}}} {{{{folder}}}} {{how.removesuffix('_allowed')}} {session}",
                 name="protection", may_end=how == "leaves_allowed")
    bench.advance_to(0.3)
    if how == "killed_by_test":
        device.program.kill()
"""
LOST = r"times that protection was lost (must be == 0; received 1 \()?it did not finish the block that ends at tick"
REPLACED = "the recording was replaced or altered during the test: "
ALTERED = r"changed program files of protection .*changed during the run: device\.py; output belongs in {folder}"
NO_LINK = "without symbolic links"
ENDED = "early ends of protection must be == 0; received 1 "
STOPPED = r"commands stop of devices must be == 0; received 1 \(by protection"
QUICK = {
    "clears_faults": r"commands clear of devices must be == 0; received 1 \(by protection",
    "swaps_part": REPLACED + "another file",
    "alters_program": ALTERED,
    "alters_index": REPLACED + "it was truncated or appended to, or its records cannot be read",
    "forges_evidence": "time to trip must be 0 to 20 ms; received nothing",
}  # fmt: skip
REASONS = {
    **QUICK,
    "sound": "",
    "stubborn_child": "",
    "hands_in_a_link": NO_LINK,
    "killed": "exit status of protection must be == 0; received 137",
    "raises": "exit status of protection must be == 0; received 1",
    "leaves": ENDED,
    "starts_and_ends": "device protection ended with status 0",
    "never_joins": r"device protection did not join within join_s = 10 s",
    "daemon": "device protection ended with status 0",
    "prints_much": "output of protection must be <= 100 MB; received 100 MB",
    "links_part": REPLACED + "another file has its name",
    "truncates_part": REPLACED,
    "alters_part": REPLACED + r"its \d+ bytes are not the \d+ bytes that were written",
    "appends_to_part": REPLACED,
    "removes_part": REPLACED + "(it was removed|another file)",
    "removes_records": REPLACED + "(it was removed|another file)",
    "hands_in_a_folder_link": NO_LINK,
    "hands_in_a_pipe": "file",
    "hands_in_nothing": "file",
    "removes_folder": "times that {folder} was removed or replaced must be == 0; received 1",
    "links_folder": "times that {folder} was removed or replaced must be == 0; received 1",
    "fills_folder": r"files in {folder} must be <= 10000; received 10001 \(or more\)",
    "stopped": LOST,
    "hangs": LOST,
    "exits_3": "exit status of protection must be == 0; received 3",
    "interrupted": "exit status of protection must be == 0; received 1",
    "vanishes": LOST,
    "leaves_and_stays": ENDED,
    "is_slow": LOST,
    "wrong_block": "times that protection was lost must be == 0; received 1 |exit status",
    "stops_the_rig": "end of the run must be >= 0.3 s",
    "steps_the_rig": "commands step of devices ",
    "kills_the_rig": "the rig exited with status 137",
    "restarts_the_rig": "the rig exited with status 137",
    "stops_the_rigs_process": "the rig did not complete a step within patience_s = 20 s",
    "kills_supervisor": LOST,
    "stops_supervisor": LOST,
    "forged_leave": f"{ENDED}|{LOST}",
    "forged_done": "times that protection was lost must be == 0; received 1 ",
    "many_children": "exit status of protection must be == 0; received 3",
    "blind": "time to trip must be 0 to 20 ms; received nothing",
    "notes_only": "time to trip must be 0 to 20 ms; received nothing",
    "swaps_session": REPLACED + "another file",
    "alters_session": REPLACED,
    "ignores_sigterm": r"exit status of protection must be == 0; received 137 \(it had to be killed: it did not end",
}  # fmt: skip
PYTHON = {"leaves": ENDED, "stops_the_rig": STOPPED}
if CHOSEN:
    PYTHON |= {how: REASONS[how] for how in ("sound", "killed", "hangs", "raises", "exits_3", "vanishes", "swaps_part")}
    PYTHON |= {"leaves_allowed": "", "killed_by_test": ""}
INCONCLUSIVE = {how for how, reason in REASONS.items() if reason.startswith((REPLACED, ALTERED))}
HOWS = {how: REASONS[how] for how in (QUICK if not CHOSEN else REASONS if CHOSEN == "all" else CHOSEN.split(","))}


def run(folder: Path, **environment: str) -> dict[str, Any]:
    """Run the campaign with its files in a folder; return the cases by name."""
    temporary = folder / "tmp"
    temporary.mkdir()
    scored = {
        "daq.mcap": ["hands_in_a_link", "hands_in_a_pipe", "hands_in_nothing"],
        "sub/session.mcap.part": ["hands_in_a_folder_link"],
    }
    text = CAMPAIGN.format(hows=json.dumps(list(HOWS)), session=SESSION)
    for file, hows in scored.items():
        if chosen := [how for how in hows if how in HOWS]:
            text += SCORED.format(file=file, hows=json.dumps(chosen))
    (folder / "x.campaign.toml").write_text(text, encoding="utf-8")
    (folder / "device.py").write_text(DEVICE, encoding="utf-8")
    (folder / "test_x.py").write_text(TESTS.format(hows=list(PYTHON), session=SESSION), encoding="utf-8")
    (folder / "clock").mkdir()
    (folder / "clock/sitecustomize.py").write_text(CLOCK, encoding="utf-8")
    path = f"{folder / 'clock'}{os.pathsep}{processes.ROOT}"
    settings = {**os.environ, "PYTHONPATH": path, "TMPDIR": str(temporary), **environment}
    with processes.start_rig(
        "campaign", "x.campaign.toml", "test_x.py", "-o", "out", cwd=folder, env=settings
    ) as child:
        out, err = child.communicate(timeout=processes.COMPILE_S)
    assert (folder / "out/results.json").is_file(), out + err
    document = json.loads((folder / "out/results.json").read_text(encoding="utf-8"))
    assert document["wall"]["containment"] == ("subreaper" if sys.platform == "linux" else "process group")
    names = {case["id"]: re.sub(r".*how=|.*\[|\]$", "", case["id"]) for case in document["cases"]}
    return {names[case["id"]] + " py" * (".py" in case["id"]): case for case in document["cases"]}


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Results of the cases, and of the tests in Python, by what the device does."""
    folder = tmp_path_factory.mktemp("cheats")
    found = run(folder)
    yield {**found, "folder": folder}
    shutil.rmtree(folder, ignore_errors=True)


def check(case: dict[str, Any], how: str, reason: str) -> None:
    lines = [case["reason"], *(f"{each['name']} {each['note']}" for each in case["measurements"])]
    expected = "passed" if not reason else "inconclusive" if how in INCONCLUSIVE else "failed"
    assert case["outcome"] == expected, lines
    assert re.search(reason, "\n".join(lines)), lines


@pytest.mark.parametrize("how", HOWS)
def test_a_device_that_cheats_or_fails_does_not_pass(cases: dict[str, Any], how: str) -> None:
    check(cases[how], how, HOWS[how])


@pytest.mark.parametrize("how", PYTHON)
def test_a_test_in_python_judges_its_device_in_the_same_way(cases: dict[str, Any], how: str) -> None:
    check(cases[f"{how} py"], how, PYTHON[how])


def test_no_process_of_a_device_is_left(cases: dict[str, Any]) -> None:
    import psutil

    folder = str(cases["folder"])
    left = [each.info["cmdline"] for each in psutil.process_iter(["cmdline"]) if folder in str(each.info["cmdline"])]
    stubborn = [each for each in psutil.process_iter(["cwd"]) if each.info["cwd"] == folder]
    assert (left, stubborn) == ([], [])


def test_forged_evidence_is_kept_apart_and_not_shown(cases: dict[str, Any]) -> None:
    if "forges_evidence" not in cases:
        pytest.skip("not chosen")
    folder, evidence = cases["folder"] / "out", cases["forges_evidence"]["evidence"]
    kept = {Path(file).name for file in evidence if "/files/" in file}
    assert {"event.png", "index.html", "rig.log", "a_b_script_.log", "_.txt"} < kept
    assert not any("passwd" in name for name in kept)
    assert (folder / evidence[0]).read_bytes() != b"<script>forged</script>"
    (trouble,) = cases["forges_evidence"]["troubles"]
    assert re.match(r"files of devices that were not kept \(.*\): 2: large, passwd", trouble)
    assert "<script>forged" not in (folder / "index.html").read_text(encoding="utf-8")


def test_an_altered_program_has_its_digests_of_before_and_after_the_run(cases: dict[str, Any]) -> None:
    if "alters_program" not in cases:
        pytest.skip("not chosen")
    document = json.loads((cases["folder"] / "out/results.json").read_text(encoding="utf-8"))
    (digests,) = (case["digests"] for name, case in document["wall"]["cases"].items() if "alters_program" in name)
    after = (cases["folder"] / "device.py").read_bytes()
    assert digests["device.py, after the run"] == hashlib.sha256(after).hexdigest()
    assert digests["device.py"] == hashlib.sha256(after.removesuffix(b"# another program")).hexdigest()
