"""`rig view` as its users start it: a process, separate from the rig's."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from recorder.viewer import window
from recorder.viewer.window import Window, WindowError, environment, free_port
from tests.processes import ROOT, free_endpoint, read_line, start_python
from tests.unit.viewer_recording import Saved, Synthetic, generate_messages, make_replies
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.wallclock

VIEW = ["-c", "from rig.cli.main import main; main()", "view"]


def make_environment() -> dict[str, str]:
    """Return the environment of a machine without a screen."""
    kept = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY", "CI")}
    return {**kept, "PYTHONPATH": str(ROOT)}


@contextlib.contextmanager
def start_process(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    """Start a process, and end it afterwards."""
    with start_python(*command, env=make_environment(), stderr=subprocess.STDOUT, bufsize=1) as process:
        yield process


@contextlib.contextmanager
def rig(*, duration_s: float) -> Iterator[tuple[subprocess.Popen[str], int]]:
    port = int(free_endpoint().rpartition(":")[2])
    with start_process(["-m", "tests.system.viewer_rig", str(port), str(duration_s)]) as process:
        read_line(process, "ready")
        yield process, port


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording on disk."""
    from recorder.session import RecordingSession
    from rig.serve.transport.memory import MemoryClient, MemoryServer

    recording = Synthetic(duration_s=1.2)
    path = tmp_path_factory.mktemp("recorded") / "whirl.mcap"
    with MemoryServer() as server:
        for key, reply in make_replies(recording).items():
            server.answer(key, lambda _, reply=reply: reply)
        server.announce()
        for block in generate_messages(recording):
            for key, payload in block:
                server.publish(key, payload)
        summary = RecordingSession(MemoryClient(server), path, history=True).run()
    assert summary.path == path
    return path


def test_a_recording_becomes_an_rrd(recorded: Path, tmp_path: Path) -> None:
    target = tmp_path / "whirl.rrd"
    done = subprocess.run(
        [sys.executable, *VIEW, str(recorded), "--save", str(target)],
        cwd=ROOT,
        env=make_environment(),
        text=True,
        capture_output=True,
        timeout=120,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "MB" in done.stdout
    first, _ = Saved(target)["/orbit/ring/reading", "Points2D:labels"].values[-1]
    assert first == "BACKWARD whirl -83.0 Hz"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "either a FILE or --live"),
        (["missing.mcap"], "file must be"),
        ([__file__], "which is not an MCAP file"),
        ([str(ROOT)], "file must be"),
        (["a.mcap", "--live"], "either a FILE or --live"),
        (["a.mcap", "--save", "a.mcap"], "ends in .rrd"),
        (["a.mcap", "--save", "/no/such/folder/a.rrd"], "in a folder that exists"),
        (["a.mcap", "--screenshot", "/proc/a.png"], "can be written"),
        (["a.mcap", "--web", "--save", "a.rrd"], "at most one of"),
        (["--live", "--screenshot", "a.png"], "--screenshot must be used with a FILE"),
        (["a.mcap", "--at-s", "1"], "--at-s must be used with --screenshot"),
        (["--live", "--connect", "nowhere"], "HOST:PORT"),
        (["--live", "--connect", "127.0.0.1:1", "--wait-s", "0.1"], "no rig answers"),
    ],
)
def test_invalid_files_are_refused_in_one_line(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from rig.cli.main import main

    with pytest.raises(SystemExit) as ended:
        main(["view", *arguments])
    captured = capsys.readouterr()
    assert ended.value.code == 2
    assert captured.err.count("\n") == 1
    assert expected in captured.err


def test_live_view_until_the_rig_ends(tmp_path: Path) -> None:
    target = tmp_path / "live.rrd"
    with (
        rig(duration_s=2.0) as (server, port),
        start_process([*VIEW, "--live", "--connect", f"127.0.0.1:{port}", "--save", str(target)]) as viewer,
    ):
        out, _ = viewer.communicate(timeout=PATIENCE_S)
        assert (viewer.returncode, out) == (0, "the rig ended: completed\n")
        output = server.communicate(timeout=PATIENCE_S)[0]
    beats = re.findall(r'rig/clients/viewer .*"received_index":(\d+)', output)
    assert beats
    # The table of contents of a file grows in memory until its end, so a live view writes none.
    assert b"RRF2FOOT" not in target.read_bytes()
    saved = Saved(target)
    first, _ = saved["/orbit/disk/reading", "Points2D:labels"].values[-1]
    assert first == "BACKWARD whirl -83.0 Hz"
    # All that it observed in the two seconds was at 25 Hz or less.
    frames = saved["/orbit/ring/trace", "LineStrips2D:strips"].times_s
    assert 2 <= len(frames) <= 30.0 * (frames[-1] - frames[0]) + 5


def test_live_view_notices_that_the_rig_was_killed(tmp_path: Path) -> None:
    target = tmp_path / "killed.rrd"
    with (
        rig(duration_s=30.0) as (server, port),
        start_process([*VIEW, "--live", "--connect", f"127.0.0.1:{port}", "--save", str(target)]) as viewer,
    ):
        read_line(server, "rig/clients/viewer")
        server.send_signal(signal.SIGKILL)
        out, _ = viewer.communicate(timeout=PATIENCE_S)
    assert viewer.returncode == 1
    assert out.startswith("the rig disappeared without ending its stream")
    assert Saved(target)["/events", "TextLog:level"].values[-1] == ["WARN"]


def test_the_web_viewer_uses_loopback_only_and_ends_with_the_command(recorded: Path) -> None:
    import psutil

    with start_process([*VIEW, str(recorded)]) as viewer:
        address = re.search(r"http://127\.0\.0\.1:\d+/\S*", read_line(viewer, "http://"))
        assert address is not None
        assert len(address[0]) <= 30
        with urllib.request.urlopen(address[0], timeout=PATIENCE_S) as page:
            assert page.status == 200
            assert "notebook=1" in page.url
            assert b"viewer_state()" in page.read()
        with urllib.request.urlopen(f"{address[0]}re_viewer.js", timeout=PATIENCE_S) as code:
            assert (
                b"viewer_state()" in code.read()
            )  # the function that the page's script calls, in the installed version
        children = psutil.Process(viewer.pid).children(recursive=True)
        listening = [
            connection.laddr
            for child in children
            for connection in child.net_connections()
            if connection.status == psutil.CONN_LISTEN
        ]
        assert len(listening) == 2
        assert {place.ip for place in listening} == {"127.0.0.1"}
        for child in children:
            assert child.environ().get("CI") == "true"
            assert os.getpgid(child.pid) != os.getpgid(viewer.pid)
        viewer.send_signal(signal.SIGTERM)
        out, _ = viewer.communicate(timeout=PATIENCE_S)
        assert viewer.returncode == 0
        assert "Traceback" not in out
        _, alive = psutil.wait_procs(children, timeout=PATIENCE_S)
        assert [child for child in alive if child.status() != psutil.STATUS_ZOMBIE] == []


def test_rerun_keeps_no_usage_reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert "FORCE_RERUN_ANALYTICS" not in environment()
    with Window("web") as window:
        assert window.open
        time.sleep(1.0)
    # Without the switch it writes a configuration and its first reports there within this time.
    assert list(tmp_path.rglob("*rerun*")) == []


def test_a_viewer_that_cannot_start_reports_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":987")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(WindowError, match="could not start"):
        Window("native")


class BusyViewer:
    """Replies to every second request; the others get no reply within rerun's own time limit."""

    asked = 0
    picture = b"a picture"

    @classmethod
    def connect(cls, url: str) -> BusyViewer:
        return cls()

    def _answer(self) -> None:
        BusyViewer.asked += 1
        if BusyViewer.asked % 2:
            raise TimeoutError("Deadline expired before operation could complete")

    def get_state(self) -> SimpleNamespace:
        self._answer()
        line = SimpleNamespace(name="simulated_time", end=2_000_000_000)
        return SimpleNamespace(recordings=[SimpleNamespace(timelines=[line])])

    def set_time(self, *_: object, **__: object) -> None:
        self._answer()

    def take_screenshot(self) -> bytes:
        self._answer()
        return self.picture


def test_a_busy_viewer_is_retried_and_then_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "ViewerClient", BusyViewer)
    messages: list[str] = []
    monkeypatch.setattr(window, "_MESSAGE_INTERVAL_S", 0.0)
    with Window("web", on_message=messages.append) as shown:
        shown.picture(tmp_path / "busy.png", at_s=1.0, end_s=2.0)
        assert (tmp_path / "busy.png").read_bytes() == BusyViewer.picture
        assert messages[-1].startswith("waiting for the viewer for ")
        monkeypatch.setattr(window, "_REPLY_TIMEOUT_S", 0.3)
        with pytest.raises(WindowError, match="did not load the recording within"):
            shown.picture(tmp_path / "never.png", at_s=1.0, end_s=3.0)
    assert not (tmp_path / "never.png").exists()


def test_a_taken_port_is_avoided() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        assert free_port(port) != port


def test_a_picture_where_this_machine_can_draw(recorded: Path, tmp_path: Path) -> None:
    try:
        Window("headless").close()
    except WindowError as error:
        pytest.skip(f"no Vulkan driver here: {error}")
    picture = tmp_path / "whirl.png"
    done = subprocess.run(
        [sys.executable, *VIEW, str(recorded), "--screenshot", str(picture)],
        cwd=ROOT,
        env=make_environment(),
        text=True,
        capture_output=True,
        timeout=180,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 100_000
