"""`rig validate` and `rig sessions` as commands: exit status, one line for wrong input, reports."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.commands import run, run_captured


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("validate") / "hammer.mcap"
    arguments = ["simulate", "hammer", "-o", str(path), "--duration-s", "0.1", "--set", "sensors.rate_hz=5000"]
    assert run(*arguments) == 0
    return path


def test_a_fresh_recording_is_bit_exact(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run_captured(capsys, "validate", str(recording))
    assert code == 0
    assert "bit-exact" in out
    assert "pass, bit by bit" in out


def test_a_failure_ends_in_1_and_a_report_names_the_cause(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "r.html"
    code, out, _ = run_captured(
        capsys, "validate", str(recording), "--set", "contact.restitution=0.88", "--report", str(report)
    )
    assert code == 1
    assert "contact.restitution +2.27 %" in out
    lines = out.splitlines()
    assert lines[1].startswith("fail, ")  # the verdict, before any table
    assert "contact.restitution +2.27 %" in lines[2]
    page = report.read_text(encoding="utf-8")
    assert "Contact.restitution" in page or "contact.restitution +2.27 %" in page
    assert page.count("data:image/png") == 7  # overview, five groups, orbits and spectra
    assert page.index("Fail, ") < page.index("data:image/png") < page.index("<table>")
    head = page[: page.index("data:image/png")]
    for text in (recording.name, "--set contact.restitution=0.88", "corrected", "<dt>seed</dt>", "<dt>made</dt>"):
        assert text in head
    assert 'src="http' not in page
    assert page.index("Failed criteria") < page.index("Explanations of the difference") < page.index(">Bits<")


def test_json_and_another_engine(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run_captured(capsys, "validate", str(recording), "--engine", "rk8", "--json")
    document = json.loads(out)
    assert document["good"] is (code == 0)
    assert not document["bit_exact"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "contact.frction=1"], "contact.frction must be"),
        (["--criteria", "missing.toml"], "missing.toml must be a readable file"),
        (["--report", "r.txt"], "--report must be a file name that ends in"),
        (["--engine", "euler"], "--engine must be one of"),
    ],
)
def test_wrong_input_ends_in_2(
    recording: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, error = run_captured(capsys, "validate", str(recording), *arguments)
    assert code == 2
    assert error.startswith(f"rig: {message}")
    assert error.count("\n") == 1
    assert out == ""


def test_several_files_are_read_as_one(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    assert run_captured(capsys, "cut", str(recording), "-o", str(first), "--to", "0.04")[0] == 0
    assert run_captured(capsys, "cut", str(recording), "-o", str(second), "--from", "0.04")[0] == 0
    code, out, _ = run_captured(capsys, "validate", str(second), str(first))
    assert code == 0
    assert out.startswith("a.mcap and 1 more")
    assert "pass, bit by bit" in out


def test_a_new_folder_is_made_for_sessions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_captured(capsys, "sessions", "drop", "-o", str(tmp_path / "new"))[0] == 0
    assert (tmp_path / "new" / "drop.mcap").is_file()
    assert run_captured(capsys, "sessions", "drop", "-o", str(tmp_path / "no" / "new"))[0] == 2


def test_sessions_are_written_only_to_allowed_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_captured(capsys, "sessions", "drop", "-o", str(tmp_path))[0] == 0
    assert {path.name for path in tmp_path.iterdir()} == {"drop.mcap", "drop.toml"}
    code, _, error = run_captured(capsys, "sessions", "drop", "-o", str(tmp_path))
    assert code == 2
    assert "--force" in error
    assert run_captured(capsys, "sessions", "hammer", "-o", str(tmp_path))[0] == 2
