"""`rig daqmx` as a process: a program reads, steps and commands a rig in lockstep, and outlives it."""

from __future__ import annotations

import re
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import grpc
import nidaqmx
import numpy as np
import pytest
from nidaqmx import GrpcSessionOptions
from nidaqmx.constants import AcquisitionType
from nidaqmx.stream_readers import AnalogUnscaledReader

from drivers.console import Console
from recorder.reader import Recording
from rig.base import wire
from tests import processes
from tests.waiting import PATIENCE_S, until

LOCKSTEP = ("--pace", "lockstep", "--set", "drive.speed_hz=12", "--set", "commands=[]")


@contextmanager
def device(endpoint: str, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], GrpcSessionOptions]]:
    """Serve a rig as a device; yield the process and the options of a program."""
    with processes.start_rig("daqmx", "--connect", endpoint, "--port", "0", *arguments) as server:
        found = re.search(r"127\.0\.0\.1:(\d+)", processes.read_line(server, "NI-DAQmx device"))
        assert found is not None
        with grpc.insecure_channel(f"127.0.0.1:{found[1]}") as channel:
            yield server, GrpcSessionOptions(channel, "")
        server.send_signal(signal.SIGINT)
        assert server.wait(PATIENCE_S) == 0
        assert server.communicate()[1] == "rig: a task started\n"


@contextmanager
def stepped(console: Console, ticks: int) -> Iterator[None]:
    """Step a rig on another thread."""
    thread = threading.Thread(target=console.step, args=(ticks,))
    thread.start()
    yield
    thread.join()


def test_a_stepped_rig_feeds_the_reads_with_the_samples_of_its_recording(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with (
        processes.running_rig("hammer", *LOCKSTEP) as (_, endpoint),
        processes.start_rig("record", "--connect", endpoint, "-o", str(path)) as recorder,
        device(endpoint, "--allow-commands") as (_, options),
        Console.open(f"zenoh:{endpoint}", wait_s=PATIENCE_S) as console,
        nidaqmx.Task(grpc_options=options) as task,
        nidaqmx.Task(grpc_options=options) as hit,
        nidaqmx.Task(grpc_options=options) as impact,
    ):
        until(lambda: any(name.startswith("recorder") for name in console.status()["clients"]), of=recorder)
        task.ai_channels.add_ai_voltage_chan("rig/ai0:14")
        task.timing.cfg_samp_clk_timing(20_000.0, sample_mode=AcquisitionType.CONTINUOUS)
        impact.ai_channels.add_ai_force_iepe_chan("rig/ai14", sensitivity=2.25)
        impact.timing.cfg_samp_clk_timing(20_000.0, samps_per_chan=200)
        impact.triggers.reference_trigger.cfg_dig_edge_ref_trig("/rig/PFI0", pretrigger_samples=50)
        hit.do_channels.add_do_chan("rig/port0/line0")
        task.start()
        impact.start()
        with pytest.raises(nidaqmx.errors.DaqReadError, match="-200284"):
            task.read(1, timeout=0.0)  # a read does not step the rig
        console.fault("disk_y", "gain", factor=1.5)
        reader, parts = AnalogUnscaledReader(task.in_stream), []
        with stepped(console, 300_000):
            for _ in range(3):
                parts.append(np.zeros((15, 2000), dtype=np.int32))
                reader.read_int32(parts[-1], 2000)
        assert hit.write(True) == 1
        with stepped(console, 100_000):
            parts.append(np.zeros((15, 2000), dtype=np.int32))
            reader.read_int32(parts[-1], 2000)
        force_n = np.array(impact.read(200))
        console.stop()
        recorder.wait(PATIENCE_S)
    with Recording.open(path) as recording:
        recorded = np.concatenate(
            [
                np.concatenate([block.values for block in recording.blocks(wire.sensor_key(group))])[:8000]
                for group in recording.table.groups
            ],
            axis=1,
        )
        assert [event["event"] for event in recording.events if event["event"] in ("fault", "hammer")] == [
            "fault",
            "hammer",
        ]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1).T, recorded)
    assert force_n[:50].max() < 10.0 <= force_n[50], "the first sample after the trigger"
    assert force_n.max() > 50.0


def test_a_program_of_a_lost_rig_gets_an_error() -> None:
    with (
        processes.running_rig("hammer", *LOCKSTEP) as (rig, endpoint),
        device(endpoint) as (_, options),
        nidaqmx.Task(grpc_options=options) as task,
    ):
        task.ai_channels.add_ai_voltage_chan("rig/ai0")
        task.timing.cfg_samp_clk_timing(20_000.0, sample_mode=AcquisitionType.CONTINUOUS)
        task.start()
        rig.kill()
        with pytest.raises(nidaqmx.DaqError, match="Dev cannot be accessed"):
            task.read(1, timeout=PATIENCE_S)
        task.stop()
