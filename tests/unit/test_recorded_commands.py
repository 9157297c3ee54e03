"""Command events in a file are checked by the models of live commands: an invalid one is a doubt, no traceback."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from recorder.reader import Recording
from recorder.writer import RecordingWriter
from rig.base.wire import CATALOGUE, EVENTS, PARAMETERS, SCENE
from tests.commands import run

from .recorder_stream import generate_stream, make_documents

FAULT = {"channel": "disk_x", "kind": "gain", "factor": 2.0}
COMMAND = {"event": "command", "tick": 20_000, "time_s": 0.02, "id": 1, "command": "fault", "request": FAULT}
DOUBTS = {
    "a huge duration": ({**COMMAND, "request": {**FAULT, "for_s": 1e308}}, "for_s must be"),
    "a negative duration": ({**COMMAND, "request": {**FAULT, "for_s": -1.0}}, "for_s must be"),
    "an effect of a huge duration": ({**COMMAND, **FAULT, "event": "fault", "for_s": 1e308}, "without a scene entry"),
    "an unknown command": ({**COMMAND, "command": "sped", "request": {}}, "command must be one of"),
    "a number as text": ({**COMMAND, "command": "speed", "request": {"speed_hz": "5"}}, "speed_hz must be"),
    "a force below 0": ({**COMMAND, "command": "hammer", "request": {"force_n": -5.0}}, "force_n must be"),
    "a negative tick": ({**COMMAND, "tick": -5}, "malformed messages of rig/events: 1"),
    "an id as text": ({**COMMAND, "id": "all"}, "malformed messages of rig/events: 1"),
}


@pytest.mark.parametrize("name", DOUBTS)
def test_an_invalid_recorded_command_is_a_doubt(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    event, text = DOUBTS[name]
    found = {}
    for file, events in (("sound", []), ("odd", [event])):
        found[file] = set(Recording.open(_write(tmp_path / f"{file}.mcap", events)).doubts)
    assert any(text in doubt for doubt in found["odd"] - found["sound"])
    assert run("info", tmp_path / "odd.mcap") == 1
    capsys.readouterr()


def _write(path: Path, events: list[dict[str, Any]]) -> Path:
    about = make_documents()
    with RecordingWriter(path, catalogue=about[CATALOGUE], parameters=about[PARAMETERS], scene=about[SCENE]) as file:
        rows = list(generate_stream(3))
        for key, payload in [*rows[:-1], *((EVENTS, json.dumps(each).encode()) for each in events), rows[-1]]:
            file.write(key, payload, 1_700_000_000_000_000_000)
        file.finish("completed")
    return path
