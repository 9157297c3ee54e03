"""Programs of a campaign: their output is bounded, and all of their processes end, also those that hide."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from recorder.reader import Recording
from replays.campaigns.equipment.cleanup import find_containment
from replays.campaigns.equipment.process import Program
from replays.campaigns.files.case_results import CaseRecording
from rig.base.errors import DiskError, InputError
from tests import waiting
from tests.processes import ROOT
from tests.waiting import PATIENCE_S

pytestmark = [pytest.mark.wallclock]
CHILD = """
import os, signal, subprocess, sys, time
code = "import signal, time; signal.signal(15, signal.SIG_IGN); print(1, flush=True); time.sleep(600)"
child = subprocess.Popen([sys.executable, "-c", code], start_new_session=True, stdout=subprocess.PIPE)
child.stdout.readline()
with open("child.new", "w") as file:
    file.write(str(child.pid))
os.rename("child.new", "child")
"""


def start(folder: Path, code: str, **settings: float) -> Program:
    return Program([sys.executable, "-c", code], folder / "program.log", folder=folder, **settings)


def is_running(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2][:3]
    except FileNotFoundError:
        return False


@pytest.mark.skipif(find_containment() != "subreaper", reason="needs Linux")
@pytest.mark.parametrize(
    ("more", "status"),
    [
        ("", 0),
        ("time.sleep(600)", 137),
        ("os.kill(os.getppid(), 9); time.sleep(600)", 137),
        ("sys.exit(3)", 3),
    ],
    ids=["ends", "killed", "kills its supervisor", "exits"],
)
def test_a_child_in_a_session_of_its_own_ends_with_its_program(tmp_path: Path, more: str, status: int) -> None:
    program = start(tmp_path, CHILD + more)
    waiting.until((tmp_path / "child").exists)
    if status == 137 and "getppid" not in more:
        program.kill()
    assert program.wait(PATIENCE_S) == status
    program.end()
    waiting.until(lambda: not is_running(int((tmp_path / "child").read_text())))


def test_status_and_lines_of_a_program(tmp_path: Path) -> None:
    for code, status, line in (
        ("print('one'); print('two words'); print(' ')", 0, "two words"), ("raise SystemExit(3)", 3, "nothing"),
        ("import os; os.kill(os.getpid(), 15)", 143, "nothing"),
    ):  # fmt: skip
        program, calls = start(tmp_path, code), list[int]()
        program.before_end = lambda calls=calls: calls.append(1)
        assert program.wait(PATIENCE_S) == status
        assert program.last_line == line
        assert program.wait_for("two", 60.0) == ("two words" if line != "nothing" else None)
        assert not program.is_output_cut
        for _ in range(2):
            program.end()
        assert (calls, program.is_ended) == ([1], True)
    missing = Program(["./nothing"], tmp_path / "program.log", folder=tmp_path)
    assert (missing.wait(PATIENCE_S), missing.last_line) == (127, "./nothing: No such file or directory")
    missing.end()
    with pytest.raises(DiskError, match="could not be started"):
        Program(["./nothing"], tmp_path / "none/program.log", folder=tmp_path)


def test_output_is_bounded_and_read_although_the_file_was_replaced(tmp_path: Path) -> None:
    code = "import os, sys; os.unlink('program.log'); sys.stdout.write('x' * 100 + '\\n')"
    program = Program([sys.executable, "-c", code], tmp_path / "program.log", folder=tmp_path, output_bytes=60)
    assert program.wait(PATIENCE_S) == 0
    program.end()
    assert program.is_output_cut
    assert program.read_output() == "x" * 60 + "\n41 more bytes of output were dropped\n"
    assert program.last_line == "41 more bytes of output were dropped"


@pytest.mark.parametrize("file", ["link", "sub/file", "sub/../file", "../file", "/etc/passwd", "."])
def test_files_behind_links_or_outside_the_folder_are_refused(tmp_path: Path, file: str) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path / "file")
    (folder / "sub").symlink_to(tmp_path)
    seen = CaseRecording(Recording.open(ROOT / "replays/sessions/hammer-6.2.mcap"), folder)
    with pytest.raises(InputError, match="without symbolic links"):
        seen.card(file, None, None)
    with pytest.raises(InputError, match="a file that ends in"):
        seen.card("file", None, None)
