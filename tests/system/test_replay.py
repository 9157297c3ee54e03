"""A recording played to real clients: a recorder and a DAQ over zenoh, python-can over CAN; and the command."""

from __future__ import annotations

import itertools
import json
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can  # noqa: TID253 - the subject
import numpy as np
import pytest

from drivers.console import Console
from drivers.daq import Daq
from recorder.reader import Recording
from recorder.session import RecordingSession
from replays.player.messages import Track
from replays.player.play_range import Part
from replays.player.player import Player
from rig.base import wire
from rig.base.errors import RefusedError
from rig.cli.connections.can_output import CanMessages, CanOptions, CanOutput
from rig.serve.pacing import FreeRun, RealTime
from rig.serve.transport.zenoh import ZenohClient, ZenohServer
from tests.processes import free_endpoint, read_line
from tests.processes import start_rig as command
from tests.system.test_can_run import check_against_recording
from tests.unit.player_recording import BLOCKS, group_by_key, write_recording
from tests.unit.recorder_stream import generate_stream
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock
_channels = itertools.count()


def generate_payloads() -> Iterator[tuple[str, bytes]]:
    """Yield a short run whose end event has the number of rows."""
    rows: dict[str, int] = {}
    for key, payload in generate_stream(BLOCKS):
        schema = wire.get_schema(key)
        if schema is not None:
            block = wire.decode_block(payload, schema)
            rows[key] = block.index + len(block.values)
        elif (document := wire.decode_document(payload)).get("event") == "end":
            payload = wire.encode_document({**document, "rows": rows})
        yield key, payload


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("replay") / "first.mcap", generate_payloads())


@contextmanager
def start_player(path: Path, clock: RealTime | FreeRun, **options: Any) -> Iterator[tuple[Player, str]]:
    """Start a player that waits for one client, at a new endpoint."""
    endpoint = free_endpoint()
    with ZenohServer(endpoint, wait=not isinstance(clock, RealTime)) as server:
        player = Player(Track([path]), server, clock, wait_for=1, **options)
        player.prepare()
        thread = threading.Thread(target=player.run)
        thread.start()
        try:
            yield player, endpoint
        finally:
            player.stop()
            thread.join(PATIENCE_S)


@pytest.mark.parametrize("clock", [RealTime, FreeRun])
def test_a_recording_of_a_replay_is_identical_byte_for_byte(path: Path, tmp_path: Path, clock: type[FreeRun]) -> None:
    again = tmp_path / "again.mcap"
    with start_player(path, clock()) as (_, endpoint), ZenohClient(endpoint, wait_s=PATIENCE_S) as client:
        RecordingSession(client, again, name="recorder").run()
    assert group_by_key(_payloads(again)) == group_by_key(generate_payloads())
    first, second = Recording.open(path), Recording.open(again)
    assert (second.catalogue, second.parameters, second.scene) == (first.catalogue, first.parameters, first.scene)
    assert second.gaps == []
    assert second.end_reason == "completed"


def _payloads(path: Path) -> Iterator[tuple[str, bytes]]:
    recording = Recording.open(path)
    for key in recording.messages:
        if key.startswith(f"{wire.ROOT}/"):
            for _, payload in recording.payloads(key):
                yield key, payload


def test_a_daq_gets_every_row_of_a_burst(path: Path) -> None:
    # Capacity far below the recording: the reader must wait for it.
    with (
        start_player(path, FreeRun()) as (_, endpoint),
        Daq.open(f"zenoh:{endpoint}", buffer_s=0.1, wait_s=PATIENCE_S) as daq,
    ):
        got = list(daq.blocks(1000))
        assert (got[0].index, sum(map(len, got))) == (0, 200 * BLOCKS)
        assert (daq.dropped, daq.unmatched, sum(daq.lost.values())) == (0, 0, 0)
        force = np.concatenate([samples["P_N"] for samples in got])
    assert np.allclose(force, Recording.open(path).samples("forces")["P_N"], rtol=1e-12)


def test_passes_without_end_have_consecutive_rows_for_a_daq(path: Path) -> None:
    passes = 5
    options = {"part": Part(loops=None), "renumber": True}
    with (
        start_player(path, FreeRun(), **options) as (_, endpoint),
        Daq.open(f"zenoh:{endpoint}", wait_s=PATIENCE_S) as daq,
    ):
        rows = 200 * BLOCKS * passes
        got = [daq.read(1000) for _ in range(rows // 1000)]
        assert [samples.index for samples in got] == list(range(0, rows, 1000))
        assert all(samples.gap == 0 for samples in got)
        assert (daq.dropped, daq.unmatched, sum(daq.lost.values())) == (0, 0, 0)


def test_two_replays_at_one_endpoint_are_refused(path: Path) -> None:
    with start_player(path, RealTime()) as (_, endpoint), command("replay", str(path), "--listen", endpoint) as child:
        _, errors = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 2
    assert errors.count("\n") == 1
    assert errors.startswith("rig: ")


def test_frames_on_a_bus_are_those_of_the_recording(path: Path) -> None:
    channel = f"replay-{next(_channels)}"
    frames: dict[int, list[bytes]] = {}
    both = CanOptions(messages=CanMessages(can_classic=True, can_fd=True), can_overload=True)
    with can.Bus(channel, interface="virtual", ignore_config=True) as bus:
        with (
            ZenohServer(free_endpoint()) as server,
            # The capacity of a real bus of this speed does not limit the virtual one.
            CanOutput(f"virtual:{channel}", both) as output,
        ):
            player = Player(Track([path]), output.join_server(server), FreeRun())
            player.prepare()
            output.start(paced=False)
            player.run()
        while (message := bus.recv(0.2)) is not None:
            frames.setdefault(message.arbitration_id, []).append(bytes(message.data))
    compared = check_against_recording(frames, path, rates={True: 10_000, False: 1000})
    # Full frames only: the last instants of a message with many rows per frame may never be sent.
    assert 0.95 < compared / (15 * 11 * 10 * BLOCKS) <= 1.0


@contextmanager
def start_replay(path: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start `rig replay`, and wait until it listens."""
    endpoint = free_endpoint()
    with command("replay", str(path), "--listen", endpoint, *arguments) as child:
        read_line(child, "listening on")
        yield child, endpoint


def test_the_command_is_led_from_elsewhere_and_stopped(path: Path) -> None:
    with (
        start_replay(path, "--pause") as (child, endpoint),
        ZenohClient(endpoint, wait_s=PATIENCE_S) as client,
    ):
        console = Console(client)
        until(lambda: console.status()["replay"]["paused"], of=child)
        assert console.step(20_000).time_s == pytest.approx(0.02)
        assert console.seek(0.5).time_s == pytest.approx(0.5)
        with pytest.raises(RefusedError, match="does not accept hammer"):
            console.hammer()
        console.rate(0.01)
        console.resume()
        console.stop()
        output, _ = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0
    assert output.startswith("replay: stopped at 0.5")


def test_ctrl_c_ends_the_stream_with_a_message(path: Path) -> None:
    events: list[dict] = []
    with (
        start_replay(path, "--rate", "0.01") as (child, endpoint),
        ZenohClient(endpoint, wait_s=PATIENCE_S) as client,
    ):
        client.subscribe(wire.EVENTS, lambda _, payload: events.append(json.loads(payload)))
        client.settle()  # the status uses another link
        until(lambda: Console(client).status()["state"] == "running", of=child)
        child.send_signal(signal.SIGINT)
        output, errors = child.communicate(timeout=PATIENCE_S)
        until(lambda: bool(events))
    assert child.returncode == 0
    assert "replay: stopped" in output
    assert "Traceback" not in errors
    assert (events[-1]["event"], events[-1]["reason"]) == ("end", "stopped")


def test_the_command_ends_if_clients_do_not_connect(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from rig.cli.main import main

    with pytest.raises(SystemExit) as end:
        main(["replay", str(path), "--wait-for", "2", "--wait-s", "0.1", "--listen", free_endpoint()])
    assert end.value.code == 2
    assert capsys.readouterr().err.endswith("rig: 0 of 2 clients were present after 0.1 s\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nothing.mcap",), "file must be a file that can be read"),
        (("FILE", "--rate", "0"), "--rate must be a number of 0.01 to 1000"),
        (("FILE", "--rate", "2", "--burst"), "--rate must be left out with --burst"),
        (("FILE", "--from", "9"), "--from must be within the recording, 0 to 0.6 s"),
        (("FILE", "--remap", "a"), "--remap must be KEY=KEY"),
        (("FILE", "--wait-for", "2", "--pause"), "--wait-for must be left out with --pause"),
        (("FILE", "--can-rate", "1000"), "--can must be given with the other --can options"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    path: Path, arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from rig.cli.main import main

    files = [str(path) if text == "FILE" else text for text in arguments]
    with pytest.raises(SystemExit) as end:
        main(["replay", *files, "--listen", free_endpoint()])
    assert end.value.code == 2
    assert message in (line := capsys.readouterr().err)
    assert line.count("\n") == 1
