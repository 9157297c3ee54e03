"""Files written by commands are complete or absent, whatever a library reports about the disk; inputs are never
lost.
"""

from __future__ import annotations

import os
import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.base.checks import read_toml
from rig.base.errors import DiskError, InputError
from rig.base.files import (
    TextLines,
    check_new_file,
    check_output_differs,
    open_file,
    open_output,
    read_file,
    whole_file,
    write_file,
)
from rig.cli.app import start
from rig.run.scenes import load_scene, parse_scene
from rig.serve.transport.exposure.certificates import create_keys, read_holder


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("System error."), ValueError()])
def test_any_library_error_is_one_line_with_the_file(error: Exception, tmp_path: Path) -> None:
    path = tmp_path / "a.wav"
    path.write_text("old")
    with pytest.raises(DiskError, match=r"a\.wav could not be written"), whole_file(path) as draft:  # noqa: PT012
        draft.write_text("half")
        raise error
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("a.wav", "old")]


def test_no_symbolic_link_is_followed(tmp_path: Path) -> None:
    other, path, log = tmp_path / "other", tmp_path / "a.csv", tmp_path / "a.log"
    other.write_text("kept")
    for link in (path, log, path.with_name("a.csv.part"), tmp_path / ".a.csv.part"):
        link.symlink_to(other)
    write_file(path, "new")
    assert (path.read_text(), path.is_symlink(), other.read_text()) == ("new", False, "kept")
    assert path.stat().st_mode == other.stat().st_mode  # not the mode of temporary files
    with pytest.raises(OSError, match="symbolic"):
        open_output(log, "w")


def test_a_draft_has_another_name_each_time(tmp_path: Path) -> None:
    write_file(tmp_path / "a.csv", "")
    with whole_file(tmp_path / "a.csv") as one, whole_file(tmp_path / "a.csv") as two:
        assert one != two
        assert one.stat().st_size == two.stat().st_size == 0
    for name in ("x" * 240, "盤" * 80):  # near the limit of 255 bytes
        with whole_file(tmp_path / f"{name}.csv") as draft:
            assert draft.exists()


def test_a_file_that_appears_meanwhile_is_kept_and_so_is_the_output(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with pytest.raises(DiskError, match="created by another process") as found, whole_file(path) as draft:  # noqa: PT012
        draft.write_text("mine")
        path.write_text("of another")
    kept = Path(str(found.value).rpartition(" ")[2])
    assert {each.name: each.read_text() for each in tmp_path.iterdir()} == {"a.csv": "of another", kept.name: "mine"}
    assert kept.suffix == ".csv"


def test_only_a_regular_file_is_replaced_and_a_link_only_if_asked(tmp_path: Path) -> None:
    (tmp_path / "link.csv").symlink_to("nowhere")
    os.mkfifo(tmp_path / "pipe.csv")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(tmp_path / "socket.csv"))
    for force in (False, True):
        for name in ("pipe.csv", "socket.csv"):
            with pytest.raises(InputError, match="a file, not a pipe, socket or device"):
                check_new_file(tmp_path / name, field="output", suffixes=(".csv",), force=force)
    with pytest.raises(InputError, match="a new file"):
        check_new_file(tmp_path / "link.csv", field="output", suffixes=(".csv",), force=False)
    check_new_file(tmp_path / "link.csv", field="output", suffixes=(".csv",), force=True)


def test_a_file_is_read_up_to_a_size_and_a_line_up_to_a_length(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"abc")
    assert read_file(path, 3) == b"abc"
    with pytest.raises(OSError, match="larger than"):
        read_file(path, 2)
    for size, count in ((100, 1), (10 << 20, 0)):
        with path.open("wb") as file:
            file.truncate(size)
        with TextLines(open_file(path), "utf-8") as lines:
            for _ in range(count):
                assert len(next(lines)) == size
            if not count:
                with pytest.raises(ValueError, match="a line of more than"):
                    list(lines)


def test_a_fault_of_the_program_is_not_blamed_on_the_disk(tmp_path: Path) -> None:
    with pytest.raises(TypeError), whole_file(tmp_path / "a.wav"):
        raise TypeError


def test_an_input_is_not_overwritten_through_another_name(tmp_path: Path) -> None:
    source = tmp_path / "a.mcap"
    source.touch()
    (tmp_path / "other").symlink_to(tmp_path)
    os.link(source, tmp_path / "b.mcap")
    for output in (tmp_path / "other" / "a.mcap", tmp_path / "b.mcap"):
        with pytest.raises(InputError, match="output must be another file"):
            check_output_differs([source], output)
    check_output_differs([source], tmp_path / "c.mcap")


def test_long_file_names_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="output must be a file name"):
        check_new_file(tmp_path / ("x" * 300 + ".csv"), field="output", suffixes=(".csv",), force=True)
    for command in ("run", "recover"):
        with pytest.raises(SystemExit) as ended:
            start([command, "x" * 300 + ".mcap"])
        assert ended.value.code == 2
        assert "must be" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("document", "field"),
    [
        ({"\x1b[2J": 1}, r"\x1b[2J"), ({"request": 1}, "request"), ({"float": 1}, "float"), ({"": 1}, '""'),
        ({"commands": [{"at_s": 1, "command": "hammer", "a[b]": 1}]}, "commands.0.hammer.a[b]"),
        ({"commands": [{"at_s": 1, "command": "hammer", "direction": [1]}]}, "commands.0.hammer.direction"),
    ],
)  # fmt: skip
def test_names_of_the_file_are_named_and_branches_of_a_union_are_not(document: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as wrong:
        parse_scene(document)
    assert str(wrong.value).startswith(f"{field} must be ")


def test_long_numbers_are_placed_and_not_printed(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^seed must be without whole numbers") as wrong:
        load_scene("hammer", {"seed": "9" * 5000})
    assert "999" not in str(wrong.value)
    path = tmp_path / "a.toml"
    path.write_text(f"\ufefftitle = 'x'\nseed = {'9' * 5000}\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"line 2 must be without") as wrong:
        read_toml(path)
    assert "999" not in str(wrong.value)


@pytest.mark.parametrize(("words", "field"), [(["hammer", "--force-n", "abc"], "--force-n"), (["speed", "abc"], "")])
def test_a_value_of_another_type_is_shown(words: list[str], field: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        start(words)
    assert ended.value.code == 2
    errors = capsys.readouterr().err
    assert errors.startswith(f"rig: {field}")
    assert errors.endswith("must be a valid number; received 'abc'\n")


def test_a_key_readable_by_others_is_refused(tmp_path: Path) -> None:
    create_keys(tmp_path / "keys")
    read_holder(tmp_path / "keys", server=True)
    (tmp_path / "keys" / "server" / "key.pem").chmod(0o640)
    with pytest.raises(InputError, match=r"chmod 600 .*key.pem"):
        read_holder(tmp_path / "keys", server=True)


def test_a_quoted_number_is_refused() -> None:
    assert parse_scene({"duration_s": 1}).duration_s == 1.0
    with pytest.raises(InputError, match="duration_s must be a number; received '1'"):
        parse_scene({"duration_s": "1"})


@pytest.mark.parametrize(
    ("error", "what"),
    [
        (MemoryError(), "little memory"), (RuntimeError("can't start new thread"), "few threads"),
        (ImportError("libarrow.so: failed to map segment from shared object"), "little memory"),
        (OSError(24, "Too many open files"), "Too many open files"),
    ],
)  # fmt: skip
def test_a_shortage_of_the_system_is_one_line(
    error: Exception, what: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*_: object, **__: object) -> None:
        try:
            raise error
        except Exception:
            if not isinstance(error, OSError):
                raise AttributeError("no attribute 'inner'")  # noqa: B904 - what a library makes of it
            raise

    monkeypatch.setattr("rig.cli.app.rig", lambda: SimpleNamespace(main=run))
    with pytest.raises(SystemExit) as ended:
        start(["params"])
    printed = capsys.readouterr().err
    assert ended.value.code == 1
    assert what in printed
    assert printed.count("\n") == 1
    monkeypatch.setattr("rig.cli.app.rig", lambda: SimpleNamespace(main=lambda *_, **__: {}["x"]))
    with pytest.raises(KeyError):  # an error of the program keeps its traceback
        start(["params"])
