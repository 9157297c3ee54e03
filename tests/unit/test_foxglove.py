"""The server for the Foxglove app: streams, services, parameters, play bar and layout, read by another client."""

from __future__ import annotations

import contextlib
import json
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from drivers.console import Accepted, Console
from recorder.foxglove.layout import make_layout
from recorder.foxglove.server import SERVICES, FoxgloveServer
from recorder.session import RecordingSession
from replays.player.messages import Track
from replays.player.player import Player
from rig.base import wire
from rig.base.errors import RefusedError
from rig.channels.table import default_table
from rig.cli.main import main
from rig.serve.pacing import RealTime
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.foxglove_client import FoxgloveClient
from tests.unit.player_recording import DURATION_NS, write_recording
from tests.unit.viewer_recording import Synthetic, generate_messages, make_replies

pytest.importorskip("foxglove")
PLAY, PAUSE = 0, 1
PLAYING, PAUSED, ENDED = 0, 1, 3
SCENE = {"name": "hammer", "seed": 7, "scene": {"drive": {"speed_hz": 6.2}, "commands": [{"at_s": 1.0}], "law": None}}


@dataclass
class Rig:
    """A rig in this process that accepts every command."""

    server: MemoryServer
    recording: Synthetic
    sent: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    refusal: str = ""

    def send(self, name: str, **fields: Any) -> Accepted:
        if self.refusal:
            raise RefusedError(self.refusal)
        self.sent.append((name, fields))
        return Accepted(name, len(self.sent), 2500, 0.0025)

    def publish_all(self) -> None:
        for block in generate_messages(self.recording):
            for key, payload in block:
                self.server.publish(key, payload)


@pytest.fixture
def rig() -> Iterator[Rig]:
    recording = Synthetic(duration_s=0.3)
    with MemoryServer() as server:
        status = wire.encode_document({"scene": "hammer", "block_ms": 10.0})
        scene = wire.encode_document(SCENE)
        for key, reply in (make_replies(recording) | {wire.STATUS: status, wire.SCENE: scene}).items():
            server.answer(key, lambda _, reply=reply: reply)
        server.announce()
        yield Rig(server, recording)


@contextlib.contextmanager
def serving(
    server: MemoryServer, send: Any, *, commands: bool = True, secret: str | None = None
) -> Iterator[FoxgloveClient]:
    """Serve a rig, and yield a client of the WebSocket server."""
    done = threading.Event()
    access = {"allow_commands": commands, "allow_playback": True, "secret": secret}
    with FoxgloveServer(MemoryClient(server), ("127.0.0.1", 0), view_rate_hz=500.0, send=send, **access) as served:
        cycle = threading.Thread(target=served.run, args=(done.is_set,))
        cycle.start()
        try:
            with FoxgloveClient(served.port) as client:
                client.until(lambda: client.services and client.channels)
                yield client
        finally:
            done.set()
            cycle.join()


def read_views(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Return time and bytes of the plot messages of a recording, by topic."""
    from mcap.reader import make_reader

    found: dict[str, list[tuple[int, bytes]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic.startswith("view/"):
                found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


def test_the_streams_are_those_of_the_recording(rig: Rig, tmp_path: Path) -> None:
    with serving(rig.server, rig.send) as client:
        topics = list(client.channels)
        client.subscribe(*topics)
        client.tell(op="getParameters", parameterNames=[], id="later")
        client.until(lambda: client.find("parameterValues"))  # the subscriptions came before it
        rig.publish_all()
        path = tmp_path / "same.mcap"
        RecordingSession(MemoryClient(rig.server), path, history=True).run()
        recorded = read_views(path)
        assert sorted(recorded) == sorted(topics)
        client.until(lambda: all(len(client.messages.get(topic, ())) >= len(recorded[topic]) for topic in topics))
        client.until(lambda: client.time_ns == 299_950_000)  # simulated time of the last row
    assert len(recorded["view/drive"]) == 150
    assert {topic: sorted(rows) for topic, rows in client.messages.items()} == {
        topic: sorted(rows) for topic, rows in recorded.items()
    }
    drive = client.channels["view/drive"]
    assert (drive["schemaName"], drive["encoding"]) == ("sensor_msgs/msg/JointState", "cdr")


def test_services_command_the_rig(rig: Rig) -> None:
    with serving(rig.server, rig.send) as client:
        assert set(client.services) == {"hammer", "speed", "release", "fault", "clear", "stop"}
        reply = client.call("hammer", {"force_n": 120.0})
        assert (reply["op"], reply["command"], reply["tick"]) == ("reply", "hammer", 2500)
        assert client.call("fault", {"channel": "disk_x", "kind": "gain", "factor": 1.05})["op"] == "reply"
        assert client.call("stop", b"")["op"] == "reply"
        for request, must in ((b"[1", "JSON object"), (b"[" * 5000, "hammer must be"), ({"from": "me"}, "left out")):
            failure = client.call("hammer", request)
            assert failure["op"] == "serviceCallFailure"
            assert must in failure["message"]
        rig.refusal = "hammer must be idle"
        assert "hammer must be idle" in client.call("hammer", {})["message"]
    fault = {"channel": "disk_x", "kind": "gain", "factor": 1.05}
    assert rig.sent == [("hammer", {"force_n": 120.0}), ("fault", fault), ("stop", {})]


def test_services_are_refused_without_permission(rig: Rig) -> None:
    with serving(rig.server, rig.send, commands=False) as client:
        for name in SERVICES:
            assert "--allow-commands" in client.call(name, {})["message"]
    assert rig.sent == []


def test_services_need_the_secret(rig: Rig) -> None:
    with serving(rig.server, rig.send, secret="a1") as client:
        for name in SERVICES:
            for wrong in ({}, {"secret": "a2"}, {"secret": ["a1"]}, {"secret": "\u20ac"}):
                assert "secret must be" in client.call(name, wrong)["message"]
        assert rig.sent == []
        assert client.call("speed", {"speed_hz": 5.0, "secret": "a1"})["command"] == "speed"
        assert "secret" in client.services["speed"]["request"]["schema"]
    assert rig.sent == [("speed", {"speed_hz": 5.0})]


def test_parameters_are_the_scene_and_cannot_be_set(rig: Rig) -> None:
    expected = {"scene.drive.speed_hz": 6.2, "scene.commands": '[{"at_s": 1.0}]'}
    with serving(rig.server, rig.send) as client:
        for number, names in enumerate(([], ["scene.drive.speed_hz", "absent"])):
            client.tell(op="getParameters", parameterNames=names, id=f"get {number}")
        changed = {"name": "scene.drive.speed_hz", "value": 9.0, "type": "float64"}
        client.tell(op="setParameters", parameters=[changed], id="set")
        client.until(lambda: len(client.find("parameterValues")) == 3)
        given = {
            each["id"]: {row["name"]: row["value"] for row in each["parameters"]}
            for each in client.find("parameterValues")
        }
        client.until(lambda: any("cannot be set" in each["message"] for each in client.find("status")))
    one = {"scene.drive.speed_hz": 6.2}
    assert given == {"get 0": expected, "get 1": one, "set": one}


def test_the_play_bar_moves_a_replay(tmp_path: Path) -> None:
    track = Track([write_recording(tmp_path / "run.mcap")])
    with MemoryServer() as server:
        player = Player(track, server, RealTime(), paused=True, hold=True, linger_s=0.0)
        player.prepare()
        playing = threading.Thread(target=player.run)
        playing.start()
        try:
            with serving(server, Console(MemoryClient(server)).send, commands=False) as client:
                info = client.find("serverInfo")[0]
                assert "playbackControl" in info["capabilities"]
                client.subscribe("view/drive")
                paused = client.play(command=PAUSE, rate=2.0, seek_ns=300_000_000, request="seek")
                assert (paused["status"], paused["rate"], paused["sought"]) == (PAUSED, 2.0, 1)
                assert 0.3e9 <= paused["ns"] < 0.35e9
                client.until(lambda: client.messages.get("view/drive"))  # the plots show the new position
                assert client.messages["view/drive"][0][0] == 300_000_000
                wrong = client.play(command=PAUSE, rate=float("nan"), seek_ns=None, request="wrong")
                assert (wrong["status"], wrong["rate"], wrong["ns"]) == (PAUSED, 2.0, paused["ns"])
                late = client.play(command=PAUSE, rate=2.0, seek_ns=2**64 - 1, request="late")
                assert (late["ns"], late["status"]) == (DURATION_NS, ENDED)  # the last two blocks are shown
                assert client.play(command=PLAY, rate=0.01, seek_ns=None, request="play")["status"] == PLAYING
                client.play(command=PLAY, rate=10.0, seek_ns=None, request="fast")
                client.until(lambda: client.states[-1]["status"] == ENDED)
                client.until(lambda: max(row[0] for row in client.messages["view/drive"]) == DURATION_NS - 2_000_000)
                client.messages.clear()
                client.play(command=PLAY, rate=10.0, seek_ns=None, request="again")
                client.until(lambda: any(row[0] == 0 for row in client.messages.get("view/drive", ())))
                client.until(lambda: client.states[-1]["status"] == ENDED)
        finally:
            player.stop()
            playing.join()


def test_the_layout_has_each_channel_once(tmp_path: Path) -> None:
    layout = json.loads(make_layout(default_table()))
    panels = layout["configById"]
    # Fields that Lichtblick 1.28.1 requires when it imports a layout.
    assert (layout["globalVariables"], layout["userNodes"], layout["playbackConfig"]) == ({}, {}, {"speed": 1})
    placed = re.findall(r'"(\w+!.*?)"[,}]', json.dumps(layout["layout"]))
    assert sorted(placed) == sorted(panels)
    paths = [path for panel in panels.values() for path in panel.get("paths", ())]
    recorded = read_views(write_recording(tmp_path / "run.mcap"))
    for path in paths:
        topic, array, place = re.fullmatch(r'"(.+)"\.(\w+)\[(\d+)\]', path["value"]).groups()  # type: ignore[union-attr]
        message = decode(recorded[topic][0][1])
        assert message.name[int(place)].startswith(f"{path['label']} [")
        value = getattr(message, array)[int(place)]
        assert value == value, path  # the array that has the channel's values, not nan
    assert sorted(path["label"] for path in paths) == sorted(default_table().channels)
    for name in SERVICES:
        panel = panels[f"CallService!{name}"]
        assert panel["serviceName"] == name
        assert None not in json.loads(panel["requestPayload"]).values()
        assert panel["foxglovePanelTitle"] == panel["lichtblickPanelTitle"] == name


def decode(data: bytes) -> Any:
    """Return a JointState message."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    from recorder.files.schemas import JOINT_STATE

    schema = Schema(data=JOINT_STATE.text, encoding="ros2msg", id=1, name=JOINT_STATE.name)
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    return decoder(data)


def test_the_command_writes_a_layout_and_refuses_other_addresses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as end:
            main(["foxglove", *arguments])
        return int(end.value.code or 0), capsys.readouterr().err

    path = tmp_path / "rig-layout.json"
    assert run("--layout", str(path))[0] == 0
    assert json.loads(path.read_bytes()) == json.loads(make_layout(default_table()))
    status, error = run("--layout", str(path))
    assert (status, "--force" in error, error.count("\n")) == (2, True, 1)
    for options, must in {
        ("--listen", "0.0.0.0:8765"): "--listen must be on 127.0.0.1",
        ("--view-rate-hz", "0"): "above 0",
        ("--layout", str(tmp_path / "a.txt")): "--layout must be",
        ("--replay", str(tmp_path / "none.mcap"), "--listen", "127.0.0.1:0"): "none.mcap",
        ("--replay", "a.mcap", "--connect", "127.0.0.1:7461", "--listen", "127.0.0.1:0"): "--connect must be left out",
    }.items():
        status, error = run(*options)
        assert (status, error.count("\n")) == (2, 1), error
        assert must in error
