"""`rig validate FOLDER`: one table, continued after an interruption; a damaged file is a row."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from replays.recordings import validation
from replays.studies.common.journal import Journal
from tests.commands import run_captured
from tests.unit.test_validation import record_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("folder")
    good = record_scene(folder / "good.mcap", duration_s=0.03)
    shutil.copy(good.path, folder / "again.mcap")
    record_scene(folder / "short.mcap", duration_s=0.03, leave_out=(1,))
    (folder / "damaged.mcap").write_bytes(good.path.read_bytes()[:20_000])
    return folder


def test_table_is_the_same_after_two_interruptions(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, whole, _ = run_captured(capsys, "validate", str(folder), "-o", str(tmp_path / "whole"), "--json")
    assert code == 3, "the damaged file could not be judged"
    rows = json.loads(whole)["rows"]
    assert [(row["file"], row["outcome"]) for row in rows] == [
        ("damaged.mcap", "not readable"), ("short.mcap", "inconclusive"), ("again.mcap", "pass"), ("good.mcap", "pass"),
    ]  # fmt: skip
    assert "cut off" in rows[0]["line"]
    done: list[str] = []
    original, add = validation.validate, Journal.add

    def counted(recording: Any, **options: Any) -> Any:
        done.append(recording.path.name)
        return original(recording, **options)

    def interrupted(journal: Journal, row: dict[str, Any]) -> None:
        add(journal, row)
        raise KeyboardInterrupt

    monkeypatch.setattr(validation, "validate", counted)
    monkeypatch.setattr(Journal, "add", interrupted)
    arguments = ("validate", str(folder), "-o", str(tmp_path / "parts"), "-j", "1", "--json")
    for _ in range(2):
        assert run_captured(capsys, *arguments)[0] == 130
    monkeypatch.setattr(Journal, "add", add)
    kept = {json.loads(line)["file"] for line in (tmp_path / "parts" / "validations.jsonl").read_text().splitlines()}
    assert len(kept) == 2
    done.clear()
    code, parts, _ = run_captured(capsys, *arguments)
    assert (code, parts) == (3, whole)
    assert set(done) == {"again.mcap", "good.mcap", "short.mcap"} - kept, "no kept file is validated again"
    results = json.loads((tmp_path / "parts" / "validations.json").read_text(encoding="utf-8"))
    assert results["rows"] == rows
    done.clear()
    _, table, _ = run_captured(capsys, "validate", str(folder), "-o", str(tmp_path / "parts"))
    assert not done
    assert f"results  {tmp_path / 'parts' / 'validations.json'}" in table
    run_captured(capsys, "validate", str(folder), "-o", str(tmp_path / "parts"), "--declared")
    assert len(done) == 3, "with other options each file is validated again"


def test_any_name_and_file_in_a_folder_is_a_row(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The table can be continued; an unreadable file is tried again, although its size and time are the same."""
    data, late = (folder / "good.mcap").read_bytes(), tmp_path / "late.mcap"
    (tmp_path / "sub.mcap").mkdir()
    (tmp_path / "nowhere.mcap").symlink_to("missing.mcap")
    (tmp_path / os.fsdecode(b"b\xff.mcap")).write_bytes(b"")
    for content, outcome in ((bytes(len(data)), "not readable"), (data, "pass")):
        late.write_bytes(content)
        os.utime(late, ns=(0, 0))
        code, out, _ = run_captured(capsys, "validate", str(tmp_path), "-o", str(tmp_path / "results"), "--json")
        rows = {row["file"]: row["outcome"] for row in json.loads(out)["rows"]}
        assert code == 3
        assert rows == {"b\\xff.mcap": "not readable", "nowhere.mcap": "not readable", "late.mcap": outcome}


def test_wrong_use_is_one_line(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = str(folder / "good.mcap")
    for arguments in ([str(tmp_path)], [str(folder), one], [one, "-o", str(tmp_path)], [str(folder), "-o", one]):
        code, _, error = run_captured(capsys, "validate", *arguments)
        assert (code, error.count("\n")) == (2, 1)
