"""Notes: sent through the rig into its events, and thus into every recording."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from drivers.console import Console
from recorder.files.schemas import event_text
from recorder.reader import Recording
from recorder.session import RecordingSession
from rig.base import wire
from rig.base.errors import RefusedError
from rig.serve.pacing import Lockstep
from rig.serve.service import Service
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.unit.recorder_stream import make_documents
from tests.unit.service_fake import FakeSimulation
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.wallclock


class NotesSimulation(FakeSimulation):
    """The fake simulation with a catalogue that a recorder can use."""

    def catalogue(self) -> dict:
        return make_documents()[wire.CATALOGUE]


def test_a_note_is_recorded_with_its_time_and_is_no_command(tmp_path: Path) -> None:
    server = MemoryServer()
    service = Service(NotesSimulation(duration_s=1.0), server, Lockstep(timeout_s=20.0), block_ticks=10_000)
    service.prepare()
    run = threading.Thread(target=service.run)
    session = RecordingSession(MemoryClient(server), tmp_path / "run.mcap", history=True)
    recording = threading.Thread(target=session.run)
    run.start()
    recording.start()
    console = Console(MemoryClient(server), name="a test")
    console.step(300_000)
    accepted = console.note("bearing is warm", tags=["bearing", "look"])
    for text, tags, must in (
        ("", [], "text must be a line"),
        ("two\nlines", [], "text must be a line"),
        ("x" * 1001, [], "text must be a line"),
        ("x", ["two words"], r"tags\.0 must be a word"),
        ("x", ["t"] * 11, "tags must be a value of at most 10 items"),
    ):
        with pytest.raises(RefusedError, match=must):
            console.note(text, tags=tags)
    console.stop()
    run.join(PATIENCE_S)
    recording.join(PATIENCE_S)
    events = [event for event in Recording.open(tmp_path / "run.mcap").events if event["event"] == "note"]
    assert len(events) == 1
    (note,) = events
    assert accepted.tick == note["tick"] == 300_000
    assert (note["text"], note["tags"], note["from"]) == ("bearing is warm", ["bearing", "look"], "a test")
    assert note["wall_s"] > 1e9
    assert event_text(note)[1] == "note: bearing is warm #bearing #look (from a test)"
    # It has no effect on the rig: it is not among the commands that must be repeated.
    scene = wire.decode_document(MemoryClient(server).request(wire.SCENE))
    assert all(entry["command"] != "note" for entry in scene["taken"])
