"""The recorder in a separate process, over zenoh on loopback, with a publisher in place of the rig."""

from __future__ import annotations

import random
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from recorder.reader import Recording, join
from rig.base.wire import (
    CLIENTS,
    EVENTS,
    Block,
    decode_block,
    decode_document,
    encode_block,
    encode_document,
    get_schema,
    sensor_key,
)
from rig.serve.transport.zenoh import ZenohServer
from tests.processes import free_port, read_line, start_python
from tests.waiting import PATIENCE_S, until

from ..unit.recorder_stream import generate_stream, make_documents

pytestmark = pytest.mark.wallclock
PROBES = sensor_key("probes")
BLOCK_S = 0.01
CYCLE = list(generate_stream(50))[1:-1]
"""Half a second of all streams; later halves differ only in ticks and row numbers."""


def _later(key: str, payload: bytes, cycle: int) -> bytes:
    schema = get_schema(key)
    if schema is None:
        return payload
    block = decode_block(payload, schema)
    rows = 50 if "edges" in key else 50 * len(block.values)
    index = block.index + cycle * rows
    return encode_block(Block(block.tick + cycle * 500_000, index, block.rate_hz, block.tick_rate_hz, block.values))


class Publisher:
    """Publishes in real time, and stores the time of each message."""

    def __init__(self, port: int) -> None:
        self.server = ZenohServer(f"127.0.0.1:{port}")
        for key, document in make_documents().items():
            self.server.answer(key, lambda _, document=document: encode_document(document))
        self.beats: list[dict] = []
        self.reached: set[str] = set()
        """Keys of the clients that have received a row."""
        self.server.subscribe_reports(f"{CLIENTS}/*", self._heard)
        self.server.announce()
        self.sent: dict[str, list[bytes]] = {}
        self.rows: dict[str, int] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _heard(self, key: str, payload: bytes) -> None:
        beat = decode_document(payload)
        self.beats.append(beat)
        if beat["received_index"]:
            self.reached.add(key)

    def _run(self) -> None:
        start_s = time.monotonic()
        per_block = len(CYCLE) / 50
        number = 0
        while not self._stop.is_set():
            due = (time.monotonic() - start_s) / BLOCK_S * per_block
            while number < due and not self._stop.is_set():
                cycle, place = divmod(number, len(CYCLE))
                key, payload = CYCLE[place]
                payload = _later(key, payload, cycle)
                self.sent.setdefault(key, []).append(payload)
                self.server.publish(key, payload)
                number += 1
            self._stop.wait(0.002)

    def blocks(self, key: str = PROBES) -> int:
        return len(self.sent.get(key, []))

    def end(self, reason: str = "completed") -> None:
        """End the stream."""
        self._stop.set()
        self._thread.join()
        rows = {}
        for key, payloads in self.sent.items():
            schema = get_schema(key)
            if schema is not None:
                block = decode_block(payloads[-1], schema)
                rows[key] = block.index + len(block.values)
        tick = self.blocks() * 10_000
        end = {"event": "end", "tick": tick, "time_s": tick / 1e6, "reason": reason, "rows": rows}
        self.server.publish(EVENTS, encode_document(end))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.server.close()


@contextmanager
def publisher(port: int) -> Iterator[Publisher]:
    rig = Publisher(port)
    try:
        yield rig
    finally:
        rig.close()


@contextmanager
def start_recorder(path: Path, port: int, options: str = "", *, before: str = "") -> Iterator[subprocess.Popen[str]]:
    """Start `rig record` in a separate process, which always ends."""
    code = before + (
        "import sys; from pathlib import Path; from rig.cli.groups import expand_groups; "
        "from rig.cli.commands.record import record; "
        f"expand_groups(record)(Path(sys.argv[1]), connect='127.0.0.1:{port}', {options})"
    )
    with start_python("-c", code, str(path)) as process:
        yield process


def received(rig: Publisher) -> int:
    return rig.beats[-1]["received_index"] if rig.beats else 0


@pytest.mark.parametrize("history", [False, True])
def test_a_whole_run_arrives_without_loss(tmp_path, history):
    port = free_port()
    path = tmp_path / "run.mcap"
    with publisher(port) as rig, start_recorder(path, port, f"history={history}") as process:
        until(lambda: received(rig) > 0, of=process)
        joined = {key: len(payloads) for key, payloads in rig.sent.items()}
        until(lambda: rig.blocks() > 150)
        rig.end()
        output, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
        assert "ended: completed" in output
        assert "lost: nothing" in output
        recording = Recording.open(path)
        assert recording.complete
        for key, sent in rig.sent.items():
            payloads = [payload for _, payload in recording.payloads(key)]
            assert len(sent) - joined[key] <= len(payloads), key
            assert payloads == (sent if history else sent[len(sent) - len(payloads) :]), key
        # The last report lets the rig drop its cache.
        until(lambda: received(rig) == 200 * rig.blocks())


def test_a_killed_recorder_loses_half_a_second_at_most_and_the_rest_reads(tmp_path):
    port = free_port()
    rng, losses = random.Random(5), []
    with publisher(port) as rig:
        for trial in range(4):
            path = tmp_path / f"run{trial}.mcap"
            rig.beats.clear()
            with start_recorder(path, port) as process:
                until(lambda: received(rig) > 0, of=process)
                first = rig.blocks()
                time.sleep(0.3 + rng.random())
                killed_at = rig.blocks()
                process.send_signal(signal.SIGKILL)
                process.wait()
            assert not path.exists()
            recording = Recording.open(path.with_name(path.name + ".part"))
            assert not recording.complete
            payloads = [payload for _, payload in recording.payloads(PROBES)]
            start = rig.sent[PROBES].index(payloads[0])
            assert payloads == rig.sent[PROBES][start : start + len(payloads)]
            assert start < first
            losses.append(killed_at - (start + len(payloads)))
            for key, stream_ in recording.streams.items():
                assert stream_.lost == 0, key
    # A recorder that gets no processor time for a while had nothing to write when it was killed: not in every trial.
    half_a_second = 0.5 / BLOCK_S + 1
    assert sorted(losses)[1] <= half_a_second, f"blocks lost: {losses}"
    assert max(losses) <= 3.0 * half_a_second, f"blocks lost: {losses}"


RIG = """
import sys, threading
from tests.system.test_recorder_processes import Publisher
rig = Publisher(int(sys.argv[1]))
print("ready", flush=True)
threading.Event().wait()
"""


def test_a_killed_rig_leaves_a_finished_file(tmp_path):
    port = free_port()
    path = tmp_path / "run.mcap"
    with start_python("-c", RIG, str(port), stderr=subprocess.STDOUT) as rig:
        read_line(rig, "ready")
        with start_recorder(path, port) as process:
            part = path.with_name(path.name + ".part")
            until(lambda: part.exists() and part.stat().st_size > 300_000, of=process)
            rig.kill()
            output, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 1, errors
        assert "ended: rig lost" in output
    recording = Recording.open(path)
    assert recording.complete
    assert recording.end_reason == "rig lost"
    assert all(stream_.lost == 0 for stream_ in recording.streams.values())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_recording_well(tmp_path, number):
    port = free_port()
    path = tmp_path / "run.mcap"
    with publisher(port) as rig, start_recorder(path, port) as process:
        until(lambda: received(rig) > 0, of=process)
        process.send_signal(number)
        output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert f"ended: interrupted by {number.name}" in output
    assert Recording.open(path).complete


def test_a_duration_ends_the_recording(tmp_path):
    port = free_port()
    path = tmp_path / "run.mcap"
    with publisher(port), start_recorder(path, port, "duration_s=0.5") as process:
        output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert "ended: duration reached" in output
    recording = Recording.open(path)
    assert recording.streams[PROBES].rows == 10_000


def test_without_a_rig_the_recorder_prints_one_line_and_writes_no_file(tmp_path):
    with start_recorder(tmp_path / "run.mcap", free_port()) as process:
        output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "no rig answers" in errors.splitlines()[-1]
    assert output == ""
    assert list(tmp_path.iterdir()) == []


def test_a_rotating_recorder_loses_nothing_between_files(tmp_path):
    port = free_port()
    path = tmp_path / "run.mcap"
    with publisher(port) as rig, start_recorder(path, port, "rotate_s=0.4") as process:
        until(lambda: received(rig) > 0, of=process)
        begun = rig.blocks()
        until(lambda: rig.blocks() > begun + 200)
        rig.end()
        output, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
        assert "lost: nothing" in output
        files = sorted(tmp_path.iterdir())
        assert len(files) >= 4
        recording = join(files)
        assert recording.complete
        for key, sent in rig.sent.items():
            payloads = [payload for _, payload in recording.payloads(key)]
            assert payloads == sent[len(sent) - len(payloads) :], key
            assert len(payloads) >= 200 or get_schema(key) is None, key


def test_a_recorder_waits_for_a_rig_that_starts_later(tmp_path):
    port = free_port()
    with start_recorder(tmp_path / "run.mcap", port, "wait_s=30.0, duration_s=0.3, keep_free_mb=0.0") as process:
        time.sleep(3.0)  # longer than a recorder waits without that option
        assert process.poll() is None
        with publisher(port):
            output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert "ended: duration reached" in output


def test_a_trigger_writes_a_separate_file(tmp_path):
    port = free_port()
    options = "trigger=['hammer'], pre_s=0.2, post_s=0.3, trigger_count=1"
    with publisher(port) as rig, start_recorder(tmp_path / "run.mcap", port, options) as process:
        until(lambda: received(rig) > 0, of=process)
        begun = rig.blocks()
        until(lambda: rig.blocks() > begun + 60)  # longer than the history before a trigger
        tick = rig.blocks() * 10_000
        rig.server.publish(EVENTS, encode_document({"event": "hammer", "tick": tick, "time_s": tick / 1e6}))
        output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert "ended: 1 capture made" in output
    (path,) = tmp_path.iterdir()
    stream_ = Recording.open(path).streams[PROBES]
    assert stream_.first_time_s == pytest.approx(tick / 1e6 - 0.2, abs=0.011)
    assert stream_.last_time_s == pytest.approx(tick / 1e6 + 0.3, abs=0.011)
    assert stream_.lost == 0


def test_a_recorder_continues_after_a_stop_longer_than_its_link_lease(tmp_path):
    port = free_port()
    path = tmp_path / "run.mcap"
    code = "import rig.serve.transport.session; rig.serve.transport.session._LEASE_S = 1.0; "
    with publisher(port) as rig, start_recorder(path, port, before=code) as process:
        until(lambda: received(rig) > 0, of=process)
        links = rig.server.congestion()["links"]
        process.send_signal(signal.SIGSTOP)
        until(lambda: rig.server.congestion()["links"] < links)
        process.send_signal(signal.SIGCONT)
        until(lambda: rig.server.congestion()["links"] == links, of=process)
        until(lambda: received(rig) > 200 * rig.blocks() - 4000, of=process)
        rig.end()
        output, errors = process.communicate(timeout=PATIENCE_S)
    # If the link is restored before the recorder has noticed, there is nothing to report unless rows are lost.
    assert "is back" in errors or "lost: nothing" in output, output
    assert "ended: completed" in output
    recording = Recording.open(path)
    lost = sum(stream_.lost for stream_ in recording.streams.values())
    assert process.returncode == (1 if "lost: nothing" not in output else 0)
    assert lost == sum(
        int(line.split()[1]) for line in output.splitlines() if line.startswith("lost: ") and " rows " in line
    )
    stream_ = recording.streams[PROBES]
    assert stream_.last_time_s == pytest.approx(rig.blocks() * 0.01, abs=0.001)


def test_a_failed_run_sets_the_exit_status(tmp_path):
    port = free_port()
    with publisher(port) as rig, start_recorder(tmp_path / "run.mcap", port) as process:
        until(lambda: received(rig) > 0, of=process)
        rig.end("failed: SimulationError: not finite")
        output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "ended: failed: SimulationError: not finite" in output
    assert "lost: nothing" in output


def test_a_second_recorder_to_the_same_file_is_refused(tmp_path):
    port = free_port()
    path = tmp_path / "run.mcap"
    with publisher(port) as rig, start_recorder(path, port) as first:
        until(lambda: received(rig) > 0, of=first)
        with start_recorder(path, port, "force=True") as second, start_recorder(tmp_path / "other.mcap", port) as third:
            _, errors = second.communicate(timeout=PATIENCE_S)
            assert second.returncode == 1
            assert "no other recording is writing to" in errors
            until(lambda: len(rig.reached) == 2, of=third)
            rig.end()
            for process in (first, third):
                output, errors = process.communicate(timeout=PATIENCE_S)
                assert process.returncode == 0, errors
                assert "lost: nothing" in output
    assert Recording.open(path).complete
    assert Recording.open(tmp_path / "other.mcap").complete


def test_after_a_full_disk_recover_completes_the_recording(tmp_path):
    from rig.cli.commands.recover import recover

    port = free_port()
    path = tmp_path / "run.mcap"
    # A limit on the size of a file replaces a full disk.
    code = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, -1)); "
    with publisher(port) as rig, start_recorder(path, port, "keep_free_mb=0.0", before=code) as process:
        output, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 1
        assert "ended: disk error" in output
        assert "lost: all data after " in output
        assert "lost: nothing" not in output
        assert "are kept in" in " ".join(errors.split())
        part = path.with_name("run.mcap.part")
        recover([part])
        recording = Recording.open(tmp_path / "run.recovered.mcap")
        payloads = [payload for _, payload in recording.payloads(PROBES)]
        start = rig.sent[PROBES].index(payloads[0])
        assert payloads == rig.sent[PROBES][start : start + len(payloads)]
        assert all(stream_.lost == 0 for stream_ in recording.streams.values())
