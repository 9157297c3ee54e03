"""The command line: its help, its options, completion, and errors."""

from __future__ import annotations

import inspect
import io
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rig.base.errors import InputError
from rig.channels.generators import Generator
from rig.cli.app import COMMANDS, GROUPS, rig
from rig.cli.command import Group
from rig.cli.commands.completion import SCENE_KEYS, complete
from rig.cli.main import main
from rig.cli.options import parse_pairs, split_names
from rig.physics.engine_choice import Limits
from rig.physics.engines import ENGINES
from rig.run.scenes import Scene
from tests.commands import run_captured, run_for_output

ROOT = Path(__file__).parents[2]
SHARED = ("--from", "--to", "--force", "--report", "--connect")


def list_commands() -> dict[str, Any]:
    """Return every command and subcommand, by its name after `rig`."""
    root = rig()
    found = {name: root.get_command(None, name) for name in root.list_commands(None)}
    return found | {f"{name} {part}": found[name].get_command(None, part) for name in GROUPS for part in GROUPS[name]}


COMMAND = list_commands()
COMMAND_COUNT = sum(map(len, COMMANDS.values()))


def list_options() -> list[tuple[str, str, Any]]:
    """Return command, flag and parameter of every option."""
    return [
        (name, flag, parameter)
        for name, command in COMMAND.items()
        for parameter in command.params
        for flag in parameter.opts
        if flag.startswith("--")
    ]


@pytest.mark.parametrize("shared", SHARED)
def test_a_shared_option_is_worded_once(shared: str) -> None:
    found = [parameter for _, flag, parameter in list_options() if flag == shared]
    assert len(found) > 1
    assert len({(one.help, one.metavar, *one.opts, *one.secondary_opts) for one in found}) == 1


def test_one_option_has_one_name_in_all_commands() -> None:
    others = {"--from-s", "--to-s", "--window", "--channel", "--overwrite", "--out", "--html"}
    assert [(name, flag) for name, flag, _ in list_options() if flag in others] == []


def test_names_and_pairs() -> None:
    assert split_names(None, "--only") == []
    assert split_names("a, b,,c", "--only") == ["a", "b", "c"]
    for none in ("", " , "):
        with pytest.raises(InputError, match="--only must be one or more names, separated by commas"):
            split_names(none, "--only")
    assert parse_pairs("--set", None, "KEY=VALUE") == {}
    assert parse_pairs("--set", ["a = 1", "b=c=d"], "KEY=VALUE") == {"a": "1", "b": "c=d"}
    for wrong in ("a", "=1", "a=", " = "):
        with pytest.raises(InputError, match="--set must be KEY=VALUE"):
            parse_pairs("--set", [wrong], "KEY=VALUE")
    with pytest.raises(InputError, match="--set must be given once for a"):
        parse_pairs("--set", ["a=1", "a=2"], "KEY=VALUE")


def test_the_help_lists_the_summary_of_each_command() -> None:
    listed = {name: line for lines in COMMANDS.values() for name, line in lines.items()}
    listed |= {f"{name} {part}": line for name, lines in GROUPS.items() for part, line in lines.items()}
    assert listed.keys() == COMMAND.keys()
    for name, line in listed.items():
        assert inspect.cleandoc(COMMAND[name].help).startswith(line), name


def test_help_is_told_once_and_fits_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    alone = run_for_output(capsys)
    assert alone == run_for_output(capsys, "-h") == run_for_output(capsys, "--help")
    assert alone.count("Usage:") == 1
    assert {line.split()[0] for line in alone.splitlines() if line.startswith("  ")} > set(rig().list_commands(None))
    for name, command in COMMAND.items():
        page = run_for_output(capsys, *name.split(), "-h")
        assert f"Usage: rig {name} " in page
        assert max(map(len, page.splitlines())) < 80, name
        assert isinstance(command, Group) or page.count("-h, --help") == 1


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (
            "rnu",
            f"command must be one of `rig -h`, such as run ({COMMAND_COUNT} in all); received 'rnu'",
        ),
        ("can lod", "command must be one of `rig can -h`, such as load (3 in all); received 'lod'"),
        (
            "run x --sed 1",
            "option must be one of `rig run -h`, such as --seed, --set, --listen (22 in all); received '--sed'",
        ),
        ("can -z", "option must be one of `rig can -h`; received '-z'"),
        (
            "stop -z",
            "option must be one of `rig stop -h`, such as --connect, --tls, --wait-s; received '-z'",
        ),
        (
            "info a.mcap -1 --frm 2",
            "option must be one of `rig info -h`, such as --quick, --json, --wide; received '--frm'",
        ),
        ("import a.csv --template -o b", "--template must be followed by a value; received '-o'"),
        (
            f"cut {ROOT}/replays/sessions/hammer-6.2.mcap -o b.mcap --from 2 --to 1",
            "--from and --to must be times in ascending order; received 2 and 1",
        ),
        (
            "run hammer --engine rk5",
            f"--engine must be one of {', '.join(ENGINES)}; received 'rk5'",
        ),
        (
            "can load --can-bitrate x",
            '--can-bitrate must be as "500k", "1M", or "1M/5M" for CAN FD; received \'x\'',
        ),
        (
            "twins --can foo",
            "--can must be INTERFACE:CHANNEL such as zenoh:can0, with ?NAME=VALUE&... for more settings; "
            "received 'foo'",
        ),
        ("run", "SCENE must be given: name of a scene, or path of a scene file; received nothing"),
        ("stop now", "argument must be one that `rig stop` takes (see -h); received 'now'"),
        ("run x --set", "--set must be followed by a value; received nothing"),
        ("view --live=3", "--live must be given without a value; received one"),
        ("bench --runs 0", "--runs must be greater than or equal to 1; received 0"),
        ("bench --runs x", "--runs must be a valid integer; received 'x'"),
        ("run x --pace y", "--pace must be one of real-time, lockstep, free; received 'y'"),
        ("view x.mcap --at-s nan", "--at-s must be a number; received nan"),
        ("speed nan", "HZ must be a number; received nan"),
        ("record -o x.txt", "--output must be a file name that ends in .mcap; received 'x.txt'"),
        (
            "record -o x.mcap --trigger note --longest-s 1",
            "--longest-s must be at least --pre-s and --post-s, 2.5, at most 1e6; received 1.0",
        ),
        ("daqmx --device a/b", "--device must be letters, digits and _; received 'a/b'"),
        (
            "twins --listen 0.0.0.0:1",
            "--listen must be on 127.0.0.1, since there is no password; from another machine: "
            "ssh -L 1:127.0.0.1:1 USER@HOST (a rig also takes --expose); received '0.0.0.0:1'",
        ),
        ("run hammer --seed -1", "--seed must be greater than or equal to 0; received -1"),
        ("view", "view must be given either a FILE or --live; received neither"),
        ("chart --quick --full", "--quick, --full must be one of the two; received both"),
    ],
)
def test_a_wrong_command_line_is_refused_in_one_line(capsys: pytest.CaptureFixture[str], line: str, says: str) -> None:
    assert run_captured(capsys, *line.split()) == (2, "", f"rig: {says}\n")


def completed(line: str, shell: str = "zsh") -> list[str]:
    return [each.partition("\t")[0] for each in complete(rig(), shell, line)]


def test_completion_of_a_command_line() -> None:
    assert set(completed("rig ")) == set(COMMAND) - {name for name in COMMAND if " " in name}
    assert completed("rig can ") == list(GROUPS["can"])
    assert set(completed("rig run ham")) == {"hammer", "hammer-house", "hammer-shaft"}
    assert completed("rig run hammer ") == completed("rig nothing ") == []
    assert completed("rig run hammer --see") == ["--seed"]
    assert completed("rig run --set contact.fric") == ["contact.friction="]
    assert completed("rig run --set=drive.sp") == ["--set=drive.speed_hz="]
    assert completed("rig run --set=drive.sp", "bash") == ["drive.speed_hz="]
    assert completed("rig run --set engine.name=rk") == ["engine.name=rk8", "engine.name=rk4"]
    assert completed("rig validate --engine ros") == ["rosenbrock"]
    assert completed("rig run x --pace lo") == ["lockstep"]
    assert completed("rig params dtu") == ["dtu-2019"]
    assert completed("rig export a.mcap --channels disk_x,disk") == ["disk_x,disk_y"]
    assert complete(rig(), "fish", "rig info a.mcap 'b") == ["\t.mcap"]
    assert complete(rig(), "fish", "rig run own") == ["\t.toml"]
    assert complete(rig(), "fish", "rig run x --tls ") == ["\t/"]


def test_completed_keys_are_those_of_the_scene() -> None:
    tables = {name: field.annotation for name, field in Scene.model_fields.items()} | {"generator": Generator}
    inner = {name: getattr(table, "model_fields", None) for name, table in tables.items()}
    keys = {f"{name}.{part}" for name, parts in inner.items() for part in parts or ()} | set(inner)
    others = {*("name", "title", "set", "commands", "pick"), *(name for name, parts in inner.items() if parts)}
    keys = keys - {"engine.limits"} | {f"engine.limits.{part}" for part in Limits.model_fields}
    assert set(SCENE_KEYS) == {key for key in keys - others if not key.startswith("pick.")}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
@pytest.mark.parametrize("start", [None, b"", b"alias ll='ls -l'", b"# caf\xe9\n\nexport A=1\n"])
def test_completion_is_removed_exactly(
    shell: str, start: bytes | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def call(*options: str) -> str:
        with pytest.raises(SystemExit) as end:
            main(["completion", shell, *options])
        assert end.value.code == 0
        return capsys.readouterr().out

    def files() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME", "ZDOTDIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    begin, own = tmp_path / f".{shell}rc", tmp_path / "dotfiles"
    if start is not None:
        own.write_bytes(start)
        own.chmod(0o600)
        begin.symlink_to(own)
    before = files()
    assert call("--remove") == f"nothing is installed for {shell}\n"
    call("--install")
    call("--install")
    assert files() != before
    call("--remove")
    assert files() == before
    assert start is None or (begin.is_symlink() and own.stat().st_mode & 0o777 == 0o600)
    call("--install")
    with begin.open("ab") as out:
        out.write(b"export B=1\n")
    call("--remove")
    added = b"\n" if start is not None and shell != "fish" else b""  # separates the lines of the user
    assert begin.read_bytes() == (start or b"") + added + b"export B=1\n"
    assert call("--remove") == f"nothing is installed for {shell}\n"
    assert files().keys() == {str(begin), *before}


def test_completion_leaves_the_script_of_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    own = tmp_path / "fish" / "completions" / "rig.fish"
    own.parent.mkdir(parents=True)
    own.write_text("complete -c rig -a mine")
    for options, status in ((["--remove"], 0), (["--install", "--remove"], 2)):
        with pytest.raises(SystemExit) as end:
            main(["completion", "fish", *options])
        assert end.value.code == status
    assert own.read_text() == "complete -c rig -a mine"


@pytest.mark.wallclock
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_new_shell_completes_after_installation(shell: str, tmp_path: Path) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell} on this machine")
    program = tmp_path / "rig"
    program.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m rig "$@"\n')
    program.chmod(0o755)
    home = {"HOME": str(tmp_path), "PATH": f"{tmp_path}:{os.environ['PATH']}", "SHELL": shell, "TERM": "dumb"}
    settings: Any = {"env": home, "cwd": tmp_path}
    for _ in range(2):  # which changes nothing else
        subprocess.run([program, "completion", "--install"], check=True, **settings)
    for path in (path for path in tmp_path.iterdir() if path.name.endswith("shrc")):
        assert path.read_text().count("completion --install") == 1
    if shell == "fish":
        command_ = [shell, "-c", "complete -C 'rig run stab'"]
        assert subprocess.check_output(command_, **settings).startswith(b"stable-run\tContact-free run")
        return
    terminal = [sys.executable, "-c", f"import pty; pty.spawn(['{shell}', '-i'])"]
    with subprocess.Popen(terminal, stdin=subprocess.PIPE, stdout=subprocess.PIPE, **settings) as child:
        assert isinstance(child.stdout, io.BufferedReader)
        assert child.stdin is not None
        output = child.stdout.read1()  # its prompt
        child.stdin.write(b"rig run stab\t")
        child.stdin.flush()
        while b"rig run stable-run" not in output:
            more = child.stdout.read1()
            assert more, output
            output += more
        child.kill()
