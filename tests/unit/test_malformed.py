"""User errors: each gives one line on stderr that names the field and its valid values, and status 2.

Nothing is printed on stdout, no traceback is shown, and no file is created or changed.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

import rig
from rig.base.errors import InputError
from rig.cli.main import main
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

HAMMER = '[[commands]]\nat_s = 0.1\ncommand = "hammer"\n'
SCENE = ("simulate", "scene.toml", "-o", "out.csv")
DROP = ("simulate", "drop", "-o", "out.csv")


@dataclass(frozen=True)
class Case:
    """Files to create, the command line, and the text that the line must contain: the field, then the requirement."""

    what: str
    arguments: tuple[str, ...]
    field: str
    must: str
    files: dict[str, str | bytes | None] = field(default_factory=dict)  # None: a folder


def scene(what: str, text: str | bytes, field: str, must: str, *options: str) -> Case:
    return Case(what, (*SCENE, *options), field, must, {"scene.toml": text})


def parameters(what: str, text: str, field: str, must: str) -> Case:
    name = f"{what.replace(' ', '-')}.toml"
    return Case(f"set: {what}", ("params", name), field, must, {name: text})


def change(text: str, field: str, must: str) -> Case:
    return Case(f"--set {text}", (*DROP, "--set", text), field, must)


CASES = [
    # Scene files.
    scene("bad TOML", "duration_s = ", "scene.toml", "a TOML file"),
    scene("not text", b"\xff\xfe\x00", "scene.toml", "a TOML file"),
    scene("unknown field", "bogus = 1", "bogus", "a known field, such as "),
    scene("unknown field in a part", "[drive]\nspeed = 1", "scene.toml: drive.speed", "such as speed_hz (3 in all)"),
    scene("part is no table", "drive = 3", "drive", "a valid dictionary"),
    scene("true for a number", "duration_s = true", "scene.toml: duration_s", "something else than true or false"),
    scene("true in a part", "[drive]\nspeed_hz = true", "scene.toml: drive.speed_hz", "something else than true"),
    scene("true in a list", "[[commands]]\nat_s = true\ncommand = 'hammer'", "scene.toml: commands.0.at_s", "true or"),
    scene(
        "a number that the fault does not take",
        "[[faults]]\nat_s = 0.1\nchannel = 'disk_x'\nkind = 'stuck'\nvalue = 3",
        "scene.toml: commands.0.fault.stuck.value",
        "left out: stuck takes no numbers",
    ),
    Case(
        "true in a law",
        ("laws", "--law", "law.toml"),
        "law.toml.stiffness",
        "something else than true or false",
        {"law.toml": "title = 'a'\nstiffness = true"},
    ),
    scene("text for a number", 'duration_s = "long"', "duration_s", "a valid number"),
    scene("nan", "duration_s = nan", "duration_s", "a finite number"),
    scene("inf", "duration_s = inf", "duration_s", "a finite number"),
    scene("zero duration", "duration_s = 0", "duration_s", "greater than 0"),
    scene("more than a day", "duration_s = 86401", "duration_s", "less than or equal to 86400"),
    scene("negative seed", "seed = -1", "seed", "greater than or equal to 0"),
    scene("seed in parts", "seed = 1.5", "seed", "a valid integer"),
    scene("negative speed", "[drive]\nspeed_hz = -1", "drive.speed_hz", "greater than or equal to 0"),
    scene("speed above the drive's", "[drive]\nspeed_hz = 99", "drive.speed_hz", "at most drive.top_speed = 15 Hz"),
    scene("speed is nan", "[drive]\nspeed_hz = nan", "drive.speed_hz", "a finite number"),
    scene("no such mode", '[drive]\nmode = "steam"', "drive.mode", "'torque' or 'ideal'"),
    scene(
        "profile not ascending",
        "[drive]\nprofile = [[0.0, 1.0], [2.0, 3.0], [1.0, 2.0]]",
        "drive.profile",
        "ascending time",
    ),
    scene("profile begins late", "[drive]\nprofile = [[1.0, 1.0]]", "drive.profile", "the first at 0"),
    scene("profile backward", "[drive]\nprofile = [[0.0, -1.0]]", "drive.profile", "points of speed >= 0"),
    scene("profile of triples", "[drive]\nprofile = [[0.0, 1.0, 2.0]]", "drive.profile.0", "at most 2 items"),
    scene("profile too fast", "[drive]\nprofile = [[0.0, 99.0]]", "drive", "at most drive.top_speed = 15 Hz"),
    scene(
        "profile within a row",
        "[drive]\nprofile = [[0.0, 1.0], [1e-7, 3.0]]",
        "drive.profile",
        "",
    ),
    scene("rate of too many places", "[sensors]\nrate_hz = 19997", "sensors.rate_hz", "such as 19995 or 20000"),
    scene("rate too low", "[sensors]\nrate_hz = 50", "sensors.rate_hz", "at least 100, or 0"),
    scene(
        "truth rate does not divide",
        "[sensors]\ntruth_rate_hz = 300",
        "sensors.truth_rate_hz",
        "a whole number of microseconds",
    ),
    scene("no such group", '[sensors]\ngroups = ["probs"]', "sensors.groups", "names out of probes, forces"),
    scene("a group twice", '[sensors]\ngroups = ["probes", "probes"]', "sensors.groups", "names out of probes, forces"),
    scene("noise maybe", '[sensors]\nnoise = "maybe"', "sensors.noise", "a valid boolean"),
    scene("no such engine", '[engine]\nname = "euler"', "engine.name", "one of split, rk8"),
    scene("step of zero", "[engine]\nstep_us = 0", "engine.step_us", "greater than or equal to 1"),
    scene(
        "no such position",
        '[initial]\nposition = "left"',
        "initial.position",
        "'equilibrium', 'top', 'bottom' or 'given'",
    ),
    scene(
        "outside the ring",
        '[initial]\nposition = "given"\nx_mm = 5.0',
        "initial.position",
        "inside the ring (r0 = 0.926 mm)",
    ),
    scene("position is nan", '[initial]\nposition = "given"\ny_mm = nan', "initial.y_mm", "a finite number"),
    scene("impact too hard", HAMMER + "force_n = 1e6", "force_n", "less than or equal to 1000"),
    scene("impact too long", HAMMER + "duration_ms = 51", "duration_ms", "less than or equal to 50"),
    scene("impact to nowhere", HAMMER + 'direction = "up"', "direction", "x, y, -x, -y, or an angle"),
    scene("impact with a colour", HAMMER + "colour = 1", "colour", "such as command, force_n, duration_ms, direction"),
    scene(
        "speed command above the drive's",
        '[[commands]]\nat_s = 0.1\ncommand = "speed"\nspeed_hz = 99',
        "speed_hz",
        "at most drive.top_speed",
    ),
    scene("speed command without speed", '[[commands]]\nat_s = 0.1\ncommand = "speed"', "speed_hz", "given"),
    scene("no such command", '[[commands]]\nat_s = 0.1\ncommand = "kick"', "command", "'hammer', 'speed', 'release'"),
    scene("no command", "[[commands]]\nat_s = 0.1", "command", "must be"),
    scene(
        "command before the start",
        '[[commands]]\nat_s = -0.1\ncommand = "release"',
        "commands.0.at_s",
        "greater than or equal to 0",
    ),
    scene("command without time", '[[commands]]\ncommand = "release"', "commands.0.at_s", "a valid number"),
    scene("commands are no list", "commands = 3", "commands", "each headed [[commands]]"),
    scene("command is no table", "commands = [3]", "commands.0", "a valid dictionary"),
    scene(
        "two releases",
        '[[commands]]\nat_s = 0.1\ncommand = "release"\n[[commands]]\nat_s = 0.2\ncommand = "release"',
        "release",
        "",
    ),
    scene("no such set", 'parameters = "nosuch"', "parameters", "one of corrected, as-printed, dtu-2019"),
    scene("parameters are a number", "parameters = 4", "parameters", "a valid string"),
    scene("changes are a number", "set = 4", "set", "a valid dictionary"),
    scene(
        "changed parameter out of range", '[set]\n"contact.friction" = 9.0', "contact.friction", "a number from 0 to 2"
    ),
    scene("changed parameter unknown", '[set]\n"contact.frict" = 0.1', "contact.frict", "such as contact.friction"),
    scene("changed parameter nan", '[set]\n"contact.friction" = nan', "contact.friction", "a number from 0 to 2"),
    scene(
        "changed parameter true",
        '[set]\n"contact.friction" = true',
        "contact.friction",
        "a number from 0 to 2",
    ),
    scene(
        "part is no table, changed inside",
        "drive = 3",
        "drive",
        "must be",
        "--set",
        "drive.speed_hz=1",
    ),
    # Parameter files.
    parameters("bad TOML", 'base = "corrected"\n[contact]\nfriction = [', ".toml", "a TOML file"),
    parameters("missing base", "[contact]\nfriction = 0.1", "base", "one of corrected, as-printed, dtu-2019"),
    parameters("unknown base", 'base = "nosuch"', "base", "one of corrected, as-printed, dtu-2019"),
    parameters("base is a number", "base = 4", "base", "must be"),
    parameters("base is itself", 'base = "base-is-itself.toml"', "base", "a set other than the file itself"),
    parameters(
        "unknown key", 'base = "corrected"\n[contact]\nfrict = 0.1', "contact.frict", "such as contact.friction"
    ),
    parameters(
        "wrong unit", 'base = "corrected"\n[shaft]\nmass = { value = 1.0, unit = "N" }', "shaft.mass.unit", "must be kg"
    ),
    parameters(
        "bad kind", 'base = "corrected"\n[shaft]\nmass = { value = 1.0, kind = "guess" }', "shaft.mass.kind", "'paper'"
    ),
    parameters(
        "bad rule",
        'base = "corrected"\n[contact]\nstiffness = "hertz"',
        "contact.stiffness",
        "one of internal-sphere, external-sphere",
    ),
    parameters(
        "rule where none is",
        'base = "corrected"\n[contact]\nfriction = "slippery"',
        "contact.friction",
        "a number from 0 to 2",
    ),
    parameters(
        "out of range", 'base = "corrected"\n[contact]\nfriction = 9.0', "contact.friction", "a number from 0 to 2"
    ),
    parameters("nan", 'base = "corrected"\n[contact]\nfriction = nan', "contact.friction", "a number from 0 to 2"),
    parameters("inf", 'base = "corrected"\n[shaft]\nmass = inf', "shaft.mass", "a number from 0.01 to 100 kg"),
    parameters("list", 'base = "corrected"\n[contact]\nfriction = [0.1]', "contact.friction", "a valid number"),
    parameters(
        "unknown field",
        'base = "corrected"\n[contact]\nfriction = { value = 0.1, colour = 1 }',
        "friction.colour",
        "a known field, such as",
    ),
    parameters("section is a number", 'base = "corrected"\ncontact = 3', "contact", "a table of parameters"),
    # Changes on the command line.
    change("novalue", "--set", "KEY=VALUE, such as drive.speed_hz=5.2"),
    change("=3", "--set", "KEY=VALUE"),
    change("drive.speed_hz=", "--set", "KEY=VALUE"),
    change("drive.speed=3", "drive.speed", "a field of a scene or a parameter, such as drive.speed_hz"),
    change("drive.speed_hz.x=3", "drive.speed_hz.x", "a field of a scene or a parameter"),
    change("contact.frictoin=0.1", "contact.frictoin", "such as contact.friction"),
    change("contact.friction=slippery", "contact.friction", "a number from 0 to 2"),
    change("contact.friction=9", "contact.friction", "a number from 0 to 2"),
    change("contact.friction=inf", "contact.friction", "a number from 0 to 2"),
    change("contact.friction=[1]", "contact.friction", "a number from 0 to 2"),
    change("contact.stiffness=hertz", "contact.stiffness", "one of internal-sphere, external-sphere"),
    change("contact.restitution=0.01", "contact.restitution", "must be"),
    change("magnet.stiffness=0.001", "magnet.stiffness", "enough to carry the shaft within 20 mm"),
    change("magnet.bearing_radius=10", "magnet.bearing_radius", "above the sum of both magnets' radii"),
    change("drive.speed_hz=fast", "drive.speed_hz", "a valid number"),
    change("drive.speed_hz=1e9", "drive.speed_hz", "at most drive.top_speed = 15 Hz"),
    change("engine.step_us=3.5", "engine.step_us", "a valid integer"),
    change("sensors.groups=probes", "sensors.groups", "a list"),
    change("set=3", "set", "a valid dictionary"),
    # Options.
    Case(
        "no such scene",
        ("simulate", "nosuch", "-o", "out.csv"),
        "scene",
        "one of coast-down, critical-speed, drop, hammer, hammer-house",
    ),
    Case("scene is a folder", ("simulate", ".", "-o", "out.csv"), "scene", "the path of a .toml file"),
    Case(
        "scene of another suffix",
        ("simulate", "scene.txt", "-o", "out.csv"),
        "scene",
        "the path of a .toml file",
        {"scene.txt": "seed = 1"},
    ),
    Case("no such set in an option", (*DROP, "--parameters", "nosuch"), "parameters", "one of corrected"),
    Case("no such engine in an option", (*DROP, "--engine", "euler"), "--engine", "one of split, rk8"),
    Case("duration of -1", (*DROP, "--duration-s", "-1"), "--duration-s", "greater than 0"),
    Case("duration of nan", (*DROP, "--duration-s", "nan"), "--duration-s", "a number"),
    Case("duration of x", (*DROP, "--duration-s", "x"), "--duration-s", "valid"),
    Case("seed of x", (*DROP, "--seed", "x"), "--seed", "valid integer"),
    Case("no output", ("simulate", "drop"), "--output", "given: file: .mcap"),
    Case("unknown option", (*DROP, "--bogus"), "option", "one of `rig simulate -h`"),
    Case("unknown command", ("fly",), "command", "one of `rig -h`"),
    Case("no such pace", ("run", "drop", "--pace", "warp"), "--pace", "lockstep"),
    Case("listen without port", ("run", "drop", "--listen", "abc"), "listen", "HOST:PORT with a port of 0 to 65535"),
    Case(
        "listen on another host",
        ("run", "drop", "--listen", "0.0.0.0:7460"),
        "listen",
        "on 127.0.0.1, since",
    ),
    Case(
        "connect to no port", ("hammer", "--connect", "127.0.0.1:0"), "connect", "HOST:PORT with a port of 1 to 65535"
    ),
    Case("force of x", ("hammer", "--force-n", "x"), "--force-n", "valid"),
    Case("speed of nothing", ("speed",), "HZ", "given: spin speed"),
    Case("step of a half", ("step", "1.5"), "TICKS", "valid integer"),
    Case("bench of no runs", ("bench", "--runs", "0"), "--runs", "1"),
    Case("demo too fast", ("demo", "--speed-hz", "99"), "--speed-hz", "15"),
    Case("nothing to view", ("view",), "view", "either a FILE or --live"),
    Case("picture of no suffix", ("view", "x.mcap", "--save", "x.txt"), "--save", "ends in .rrd"),
    Case("time without picture", ("view", "x.mcap", "--at-s", "1"), "--at-s", "used with --screenshot"),
    Case("view rate", ("record", "-o", "x.mcap", "--view-rate-hz", "-1"), "--view-rate-hz", "between 0 (none) and 1e6"),
    # Files.
    Case(
        "output of another suffix",
        ("simulate", "drop", "-o", "out.txt"),
        "output",
        "ends in .mcap, .parquet, .csv or .wav",
    ),
    Case("output in no folder", ("simulate", "drop", "-o", "nodir/out.csv"), "output", "in a folder that exists"),
    Case("output exists", DROP, "output", "a new file (--force replaces one)", {"out.csv": "precious"}),
    Case("output is a folder", (*DROP, "--force"), "output", "a file, not a folder", {"out.csv": None}),
    Case("recording of another suffix", ("record", "-o", "x.txt"), "output", "ends in .mcap"),
    Case("recording exists", ("record", "-o", "x.mcap"), "output", "a new file", {"x.mcap": b"precious"}),
    Case("demo in a file", ("demo", "-o", "taken"), "--output", "a new folder", {"taken": "precious"}),
    Case("no such recording", ("info", "none.mcap"), "file", "a file that can be read"),
    Case("recording is a folder", ("info", "dir.mcap"), "file", "a file that can be read", {"dir.mcap": None}),
    Case("recording is empty", ("info", "empty.mcap"), "file", "a recording made by", {"empty.mcap": b""}),
    Case("recording is something else", ("info", "x.mcap"), "file", "a recording made by", {"x.mcap": b"junk" * 99}),
    Case("recording is only a magic", ("info", "x.mcap"), "file", "a recording made by", {"x.mcap": b"\x89MCAP0\r\n"}),
    Case(
        "view of something else",
        ("view", "x.mcap", "--save", "x.rrd"),
        "file",
        "a recording made by",
        {"x.mcap": b"junk" * 99},
    ),
]


def prepare(case: Case, folder: Path) -> dict[str, tuple[int, bytes]]:
    for name, content in case.files.items():
        path = folder / name
        if content is None:
            path.mkdir()
        else:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return state(folder)


def state(folder: Path) -> dict[str, tuple[int, bytes]]:
    paths = sorted(folder.rglob("*"))
    return {str(p): (p.stat().st_mtime_ns, b"" if p.is_dir() else p.read_bytes()) for p in paths}


def check_line(line: str, case: Case) -> None:
    assert line.endswith("\n")
    assert line.count("\n") == 1, line
    assert line.strip()
    assert line.startswith("rig: ")
    assert "Traceback" not in line
    assert case.field in line
    assert case.must in line
    assert len(line) < 400, "one line that can be read"


TWO_FILE_CASES = ("outside the ring", *(f"set: {each}" for each in ("bad rule", "rule where none is", "out of range",
                                                                  "nan", "inf")))  # fmt: skip


def test_the_number_of_cases_is_sufficient() -> None:
    assert len(CASES) >= 36
    assert len({case.what for case in CASES}) == len(CASES)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.what)
def test_is_refused_in_one_line(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = prepare(case, tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(list(case.arguments))
    printed = capsys.readouterr()
    assert end.value.code == 2
    assert printed.out == ""
    # A range is in the set below the file's, and the ring in the set of the scene.
    read = [name for name in case.files if name in case.arguments and case.what not in TWO_FILE_CASES]
    assert not read or any(name in printed.err for name in read), "the file is not named"
    check_line(printed.err, case)
    assert state(tmp_path) == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ring.offset_x": 5.0}, r"^ring\.offset must be within 0\.926 mm"),
        ({"ring.offset_y": 0.0}, r"^ring\.offset must be within 0\.926 mm"),
        (
            {"initial.position": "top", "shaft.arm_ring": 0.01, "ring.offset_y": 20.0},
            r"^shaft\.arm_ring must be above 0\.0209",
        ),
    ],
    ids=["beside", "around the axis", "out of reach"],
)
def test_a_start_outside_the_ring_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Simulation(load_scene("stable-run", changes))


@pytest.mark.wallclock
@pytest.mark.parametrize(
    "what", ["unknown field", "set: out of range", "--set novalue", "output exists", "recording is something else"]
)
def test_is_refused_by_the_command_itself(what: str, tmp_path: Path) -> None:
    (case,) = [case for case in CASES if case.what == what]
    before = prepare(case, tmp_path)
    place = os.pathsep.join([str(Path(rig.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    done = subprocess.run(
        [sys.executable, "-m", "rig", *case.arguments],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": place},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    check_line(done.stderr, case)
    assert state(tmp_path) == before


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    """Spinning, the magnets on; no test of this module advances it."""
    return Simulation(load_scene("stable-run"))


@pytest.mark.parametrize(
    ("name", "request_", "field", "must"),
    [
        ("kick", {}, "command", "one of hammer, speed, release"),
        ("", {}, "command", "one of hammer, speed, release"),
        ("hammer", {"force_n": 0.0}, "hammer.force_n", "greater than or equal to 1"),
        ("hammer", {"force_n": 1e6}, "hammer.force_n", "less than or equal to 1000"),
        ("hammer", {"force_n": float("nan")}, "hammer.force_n", "a finite number"),
        ("hammer", {"force_n": "hard"}, "hammer.force_n", "a valid number"),
        ("hammer", {"force_n": None}, "hammer.force_n", "a valid number"),
        ("hammer", {"force_n": [1]}, "hammer.force_n", "a valid number"),
        ("hammer", {"duration_ms": 0.4}, "hammer.duration_ms", "greater than or equal to 0.5"),
        ("hammer", {"duration_ms": float("inf")}, "hammer.duration_ms", "a finite number"),
        ("hammer", {"direction": "up"}, "hammer.direction", "x, y, -x, -y, or an angle"),
        ("hammer", {"direction": 361.0}, "hammer.direction", ""),
        ("hammer", {"colour": "red"}, "hammer.colour", "a known field, such as "),
        ("hammer", {1: 2}, "hammer", "a set of named fields"),
        ("hammer", None, "hammer", "a set of named fields"),
        ("hammer", [1], "hammer", "a set of named fields"),
        ("speed", {}, "speed.speed_hz", "given"),
        ("speed", {"speed_hz": -1.0}, "speed.speed_hz", "greater than or equal to 0"),
        ("speed", {"speed_hz": 15.001}, "speed.speed_hz", "at most drive.top_speed = 15 Hz"),
        ("speed", {"speed_hz": float("inf")}, "speed.speed_hz", "a finite number"),
        ("release", {"now": True}, "release.now", "a known field, such as "),
    ],
)
def test_command_is_refused_and_changes_nothing(
    simulation: Simulation, name: str, request_: Any, field: str, must: str
) -> None:
    with pytest.raises(InputError) as caught:
        simulation.submit(name, request_)
    line = str(caught.value)
    assert line.startswith(field)
    assert f" must be {must}" in line
    assert "\n" not in line
    assert simulation.advance(simulation.block_ticks).events == [], "a refused command is not kept"


def test_commands_that_are_not_possible_now_are_refused() -> None:
    simulation = Simulation(load_scene("stable-run"))
    simulation.submit("hammer", {"duration_ms": 5.0})
    simulation.submit("release", {})
    simulation.advance(500)
    with pytest.raises(InputError, match=r"^hammer must be idle \(it is in a pulse until 0\.005000 s\)"):
        simulation.submit("hammer", {})
    with pytest.raises(InputError, match=r"^release must be given once"):
        simulation.submit("release", {})
    simulation.advance(5_000)
    assert simulation.submit("hammer", {}) == 5_500, "the impact is over"


@pytest.mark.parametrize("command", ["hammer", "release"])
def test_a_waiting_command_refuses_another_of_its_kind(command: str) -> None:
    simulation = Simulation(load_scene("stable-run"))
    simulation.submit(command, {})
    with pytest.raises(InputError, match=f"^{command} must be"):
        simulation.submit(command, {})


@pytest.mark.parametrize("ticks", [0, -500, 1, 499, 501, 750])
def test_advance_by_no_whole_block_is_refused(simulation: Simulation, ticks: int) -> None:
    before = simulation.tick
    with pytest.raises(InputError, match=r"^ticks must be a positive multiple of 500"):
        simulation.advance(ticks)
    assert simulation.tick == before
