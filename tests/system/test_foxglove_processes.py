"""`rig foxglove` of a recording, as its users start it; see test_doors.py for that of a rig."""

from __future__ import annotations

import re
import signal
import subprocess
from pathlib import Path

import pytest

from tests.foxglove_client import FoxgloveClient
from tests.processes import start_rig
from tests.waiting import PATIENCE_S

pytest.importorskip("foxglove")
pytestmark = pytest.mark.wallclock


def read_port(child: subprocess.Popen[str]) -> int:
    assert child.stdout is not None
    found = re.match(r"ws://127\.0\.0\.1:(\d+) serves \S+cut\.mcap;", child.stdout.readline())
    assert found is not None
    return int(found[1])


def test_a_recording_is_played_by_the_play_bar(tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(Path("tests/recordings/hammer-table-1.mcap").read_bytes()[:-50])
    with start_rig("foxglove", "--replay", str(cut), "--listen", "127.0.0.1:0") as child:
        with FoxgloveClient(read_port(child)) as client:
            client.until(lambda: client.channels)
            topic = next(topic for topic in client.channels if topic != "view/events")
            client.subscribe(topic)
            assert client.play(command=0, rate=1.0, seek_ns=None, request="play")["status"] == 0
            client.until(lambda: client.messages.get(topic))
        child.send_signal(signal.SIGTERM)
        _, error = child.communicate(timeout=PATIENCE_S)
        assert (child.returncode, "Traceback" in error) == (0, False), error
        assert "rig: the recording was cut off" in error
