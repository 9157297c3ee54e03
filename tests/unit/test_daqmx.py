"""The NI-DAQmx device of a rig: programs with the package `nidaqmx` read and command a rig that a test plays."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from typing import Any

import grpc
import nidaqmx
import numpy as np
import pytest
from nidaqmx import GrpcSessionOptions
from nidaqmx._stubs import nidaqmx_pb2  # noqa: PLC2701
from nidaqmx._stubs.nidaqmx_pb2_grpc import NiDAQmxStub  # noqa: PLC2701
from nidaqmx.constants import AccelUnits, AcquisitionType, Edge, LineGrouping, OverwriteMode, Slope
from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.stream_readers import (
    AnalogMultiChannelReader,
    AnalogUnscaledReader,
    CounterReader,
    DigitalSingleChannelReader,
)
from nidaqmx.system import System
from nitypes.waveform import DigitalWaveform

from drivers.daqmx.rpc.calls import CHECKED_VERSION
from drivers.daqmx.server import DaqmxServer
from drivers.daqmx.tasks.settings import DEFAULTS
from drivers.daqmx.tasks.task import Task
from rig.base import wire
from rig.channels.table import default_table
from rig.serve.waiting import wait_until
from tests.waiting import PATIENCE_S

from .recorder_stream import ScriptedClient, make_block

TABLE = default_table()
ROWS = 200
CHANNELS = list(TABLE.channels)


class PlayedRig(ScriptedClient):
    """A rig whose blocks a test sends, and that accepts every command."""

    def __init__(self) -> None:
        super().__init__()
        self.commands: list[tuple[str, dict[str, Any]]] = []

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        if key in self.replies:
            return super().request(key, payload, timeout_s=timeout_s)
        self.commands.append((key.rsplit("/", 1)[1], wire.decode_document(payload)))
        return wire.encode_document({"accepted": True, "id": 1, "tick": 0, "time_s": 0.0})

    def send(self, *numbers: int, **signals: np.ndarray) -> None:
        """Send blocks of all groups; the counts of a named channel are those given, of all blocks."""
        for place, number in enumerate(numbers):
            for name, group in TABLE.groups.items():
                block = make_block(wire.sensor_key(name), number)
                for channel in set(group.names) & set(signals):
                    column = group.names.index(channel)
                    block.values[:, column] = signals[channel][ROWS * place : ROWS * (place + 1)]
                self.publish(wire.sensor_key(name), wire.encode_block(block))


def counts(*numbers: int) -> np.ndarray:
    """Return the counts of all channels in blocks, shape (rows, 15)."""
    blocks = [[make_block(wire.sensor_key(name), number).values for name in TABLE.groups] for number in numbers]
    return np.concatenate([np.concatenate(groups, axis=1) for groups in blocks])


def pulses(channel: str, rows: int, *places: int, width: int = 5) -> np.ndarray:
    """Return the counts of a channel that is at 0, with pulses of 100 units of it."""
    row, values = TABLE.channels[channel], np.zeros(rows)
    for place in places:
        values[place : place + width] = 100.0 if channel == "hammer" else 1.0
    return np.round((values - row.offset) / row.scale).astype(np.int32)


@pytest.fixture
def rig() -> PlayedRig:
    return PlayedRig()


@pytest.fixture
def options(rig: PlayedRig) -> Iterator[GrpcSessionOptions]:
    with DaqmxServer(rig) as server, grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        yield GrpcSessionOptions(channel, "")


@pytest.fixture
def task(options: GrpcSessionOptions) -> Iterator[nidaqmx.Task]:
    with nidaqmx.Task(grpc_options=options) as task:
        yield task


@pytest.fixture
def analog(task: nidaqmx.Task) -> Callable[..., nidaqmx.Task]:
    """Return a function that starts a task with analogue inputs."""

    def start(channels: str = "rig/ai0:14", rate_hz: float = 20_000.0, samples: int | None = None) -> nidaqmx.Task:
        task.ai_channels.add_ai_voltage_chan(channels)
        mode = AcquisitionType.CONTINUOUS if samples is None else AcquisitionType.FINITE
        task.timing.cfg_samp_clk_timing(rate_hz, sample_mode=mode, samps_per_chan=samples or 1000)
        task.start()
        return task

    return start


def refused(code: DAQmxErrors) -> Any:
    return pytest.raises(nidaqmx.DaqError, match=rf"(?s){re.escape(code.name.replace('_', ' ').capitalize())}.*{code}")


def test_the_private_messages_are_those_that_were_checked() -> None:
    assert version("nidaqmx") == CHECKED_VERSION
    known = {
        value.name.partition("_ATTRIBUTE_")[2]
        for enum in nidaqmx_pb2.DESCRIPTOR.enum_types_by_name.values()
        for value in enum.values
    }
    assert set(DEFAULTS) <= known


def test_counts_are_those_of_the_rig(rig: PlayedRig, analog: Callable[..., nidaqmx.Task]) -> None:
    reader, got = AnalogUnscaledReader(analog().in_stream), np.zeros((15, 300), dtype=np.int32)
    rig.send(3, 4, 5)
    reader.read_int32(got, 300)
    np.testing.assert_array_equal(got.T, counts(3, 4)[:300])
    reader.read_int32(got, 300)
    np.testing.assert_array_equal(got.T, counts(4, 5)[100:])


def test_raw_samples_are_those_of_the_rig(rig: PlayedRig, analog: Callable[..., nidaqmx.Task]) -> None:
    task = analog("rig/ai14, rig/ai2:0")
    rig.send(0)
    raw = task.in_stream.read(ROWS)
    np.testing.assert_array_equal(raw.reshape(ROWS, 4), counts(0)[:, [14, 2, 1, 0]])
    coefficients = task.ai_channels[0].ai_dev_scaling_coeff
    assert coefficients[:2] == [0.0, TABLE.channels["hammer"].lsb_v]


def test_slower_samples_are_every_nth_of_the_rig(rig: PlayedRig, analog: Callable[..., nidaqmx.Task]) -> None:
    task = analog("rig/ai0", 1500.0 / 1.125, 40)
    rig.send(0, 1, 2)
    lsb_v = TABLE.channels["disk_x"].lsb_v
    np.testing.assert_allclose(task.read(40), counts(0, 1, 2)[:, 0][::15] * lsb_v, rtol=1e-12)


def test_values_are_scaled_as_the_program_defines(rig: PlayedRig, task: nidaqmx.Task) -> None:
    task.ai_channels.add_ai_voltage_chan("rig/ai8", "volts")
    task.ai_channels.add_ai_accel_chan("rig/ai9", "accel", sensitivity=10.0)
    task.ai_channels.add_ai_accel_chan("rig/ai10", "si", units=AccelUnits.METERS_PER_SECOND_SQUARED, sensitivity=10.0)
    task.ai_channels.add_ai_force_iepe_chan("rig/ai14", "force", sensitivity=2.25)
    task.ai_channels.add_ai_pos_eddy_curr_prox_probe_chan("rig/ai0", "probe", sensitivity=3940.0 * 0.0254)
    task.ai_channels.add_ai_bridge_chan("rig/ai4", "bridge", voltage_excit_val=10.0)
    task.ai_channels.add_ai_force_bridge_two_point_lin_chan(
        "rig/ai5", "cell", voltage_excit_val=10.0, first_electrical_val=0.0, second_electrical_val=0.1 * 1e3,
        first_physical_val=0.0, second_physical_val=1000.0,
    )  # fmt: skip
    task.timing.cfg_samp_clk_timing(20_000.0, samps_per_chan=ROWS)
    reader, got = AnalogMultiChannelReader(task.in_stream), np.zeros((7, ROWS))
    task.start()
    rig.send(0)
    reader.read_many_sample(got, ROWS)
    columns = [8, 9, 10, 14, 0, 4, 5]
    volts = counts(0)[:, columns].T * [[TABLE.channels[CHANNELS[n]].lsb_v] for n in columns]
    factors = np.array([[1.0], [100.0], [980.665], [1 / 2.25e-3], [1e-3 / 3.94], [0.1], [1000.0]])
    np.testing.assert_allclose(got, volts * factors, rtol=1e-9)
    assert task.channel_names == ["volts", "accel", "si", "force", "probe", "bridge", "cell"]


def test_finite_acquisition_ends(rig: PlayedRig, analog: Callable[..., nidaqmx.Task]) -> None:
    task = analog("rig/ai0", samples=300)
    assert not task.is_task_done()
    with refused(DAQmxErrors.WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE):
        task.wait_until_done(timeout=0.0)
    rig.send(0, 1, 2, 3)
    task.wait_until_done(timeout=PATIENCE_S)
    assert len(task.read(nidaqmx.constants.READ_ALL_AVAILABLE)) == 300
    with refused(DAQmxErrors.SAMPLES_WILL_NEVER_BE_AVAILABLE):
        task.read(1)


def test_partial_read_times_out_with_its_samples(rig: PlayedRig, analog: Callable[..., nidaqmx.Task]) -> None:
    task = analog("rig/ai0:1")
    reader, got = AnalogMultiChannelReader(task.in_stream), np.zeros((2, 500))
    rig.send(0)
    with pytest.raises(nidaqmx.errors.DaqReadError, match="have not yet been acquired") as error:
        reader.read_many_sample(got, 500, timeout=0.01)
    assert (error.value.error_code, error.value.samps_per_chan_read) == (-200284, ROWS)
    np.testing.assert_allclose(got[:, :ROWS].T, counts(0)[:, :2] * TABLE.channels["disk_x"].lsb_v)


def test_unread_samples_overflow_with_the_vendor_error(rig: PlayedRig, analog: Callable[..., nidaqmx.Task]) -> None:
    task = analog("rig/ai0", 10_000.0)  # a buffer of 10000 samples
    rig.send(*range(100))
    assert len(task.read(10)) == 10
    rig.send(*range(100, 102))
    for _ in range(2):
        with refused(DAQmxErrors.SAMPLES_NO_LONGER_AVAILABLE):
            task.read(10)
    task.stop()
    task.start()
    rig.send(102)
    assert len(task.read(100)) == 100


def test_lost_samples_are_not_silent(rig: PlayedRig, analog: Callable[..., nidaqmx.Task]) -> None:
    task = analog("rig/ai0")
    rig.send(0, 2, 3)
    with refused(DAQmxErrors.SAMPLES_NO_LONGER_AVAILABLE):
        task.read(300)


def test_lost_rig_and_end_of_the_run(rig: PlayedRig, analog: Callable[..., nidaqmx.Task]) -> None:
    task = analog("rig/ai0")
    rig.send(0)
    rows = {wire.sensor_key(name): ROWS for name in TABLE.groups}
    end = {"event": "end", "tick": 10_000, "time_s": 0.01, "reason": "completed", "rows": rows}
    rig.publish(wire.EVENTS, wire.encode_document(end))
    assert len(task.read(ROWS)) == ROWS
    with refused(DAQmxErrors.DEV_CANNOT_BE_ACCESSED):
        task.read(1)


def test_start_trigger_waits_for_the_hammer(rig: PlayedRig, task: nidaqmx.Task) -> None:
    task.ai_channels.add_ai_voltage_chan("rig/ai0")
    task.timing.cfg_samp_clk_timing(2_000.0, samps_per_chan=20)
    task.triggers.start_trigger.cfg_dig_edge_start_trig("/rig/PFI0")
    task.start()
    rig.send(0, 1, hammer=pulses("hammer", 400))
    assert task.in_stream.avail_samp_per_chan == 0
    rig.send(2, 3, hammer=pulses("hammer", 400, 77))
    got = np.array(task.read(20)) / TABLE.channels["disk_x"].lsb_v
    np.testing.assert_allclose(got, counts(2, 3)[77 : 77 + 200 : 10, 0], atol=1e-6)


def test_retriggered_task_acquires_after_each_impact(rig: PlayedRig, task: nidaqmx.Task) -> None:
    task.ai_channels.add_ai_voltage_chan("rig/ai0")
    task.timing.cfg_samp_clk_timing(10_000.0, samps_per_chan=50)
    task.triggers.start_trigger.cfg_anlg_edge_start_trig("rig/ai14", trigger_level=0.1)  # 44 N
    task.triggers.start_trigger.retriggerable = True
    task.start()
    rig.send(0, 1, 2, hammer=pulses("hammer", 600, 30, 90, 180, 410))
    got = np.array(task.read(150)) / TABLE.channels["disk_x"].lsb_v
    rows = np.concatenate([np.arange(begin, begin + 100, 2) for begin in (30, 180, 410)])
    np.testing.assert_allclose(got, counts(0, 1, 2)[rows, 0], atol=1e-6)


@pytest.mark.parametrize("digital", [True, False])
def test_reference_trigger_keeps_the_samples_before_it(rig: PlayedRig, task: nidaqmx.Task, digital: bool) -> None:
    task.ai_channels.add_ai_voltage_chan("rig/ai0:1")
    task.ai_channels.add_ai_force_iepe_chan("rig/ai14", sensitivity=2.25)
    task.timing.cfg_samp_clk_timing(20_000.0, samps_per_chan=300)
    trigger = task.triggers.reference_trigger
    if digital:
        trigger.cfg_dig_edge_ref_trig("/rig/PFI0", pretrigger_samples=250, trigger_edge=Edge.FALLING)
    else:
        trigger.cfg_anlg_edge_ref_trig("rig/ai14", 250, trigger_level=50.0, trigger_slope=Slope.FALLING)
    task.start()
    rig.send(0, 1, 2, hammer=pulses("hammer", 600, 30, 255))  # the first is before 250 samples
    got = np.array(task.read(300))[:2].T / TABLE.channels["disk_x"].lsb_v
    np.testing.assert_allclose(got, counts(0, 1, 2)[10:310, :2], atol=1e-6)


def test_counter_counts_and_times_the_keyphasor(rig: PlayedRig, options: GrpcSessionOptions) -> None:
    signal = pulses("keyphasor", 1000, 100, 300, 600, 800, width=20)
    with nidaqmx.Task(grpc_options=options) as edges, nidaqmx.Task(grpc_options=options) as periods:
        channel = edges.ci_channels.add_ci_count_edges_chan("rig/ctr0", initial_count=7)
        channel.ci_count_edges_term = "/rig/PFI8"
        periods.ci_channels.add_ci_freq_chan("rig/ctr0", min_val=2.0, max_val=1000.0)
        periods.timing.cfg_implicit_timing(samps_per_chan=3)
        edges.start()
        periods.start()
        rig.send(*range(5), keyphasor=signal)
        assert (edges.read(), channel.ci_count, CounterReader(edges.in_stream).read_one_sample_uint32()) == (11, 11, 11)
        np.testing.assert_allclose(periods.read(3), [100.0, 20_000 / 300, 100.0])
    with nidaqmx.Task(grpc_options=options) as widths:
        widths.ci_channels.add_ci_pulse_chan_freq("rig/ctr0", min_val=2.0, max_val=1000.0)
        widths.timing.cfg_implicit_timing(samps_per_chan=1)
        widths.start()
        rig.send(*range(5, 10), keyphasor=signal)
        pulse = widths.read(1)[0]
        assert (pulse.freq, pulse.duty_cycle) == pytest.approx((100.0, 0.1))


def test_buffered_edge_counts_follow_the_sample_clock(rig: PlayedRig, task: nidaqmx.Task) -> None:
    task.ci_channels.add_ci_count_edges_chan("rig/ctr0")
    task.timing.cfg_samp_clk_timing(1_000.0, source="/rig/PFI9", sample_mode=AcquisitionType.CONTINUOUS)
    task.start()
    rig.send(0, 1, keyphasor=pulses("keyphasor", 400, 110, 250))
    assert task.read(20) == [0.0] * 6 + [1.0] * 7 + [2.0] * 7


def test_digital_inputs_are_the_signals_of_the_rig(rig: PlayedRig, task: nidaqmx.Task) -> None:
    task.di_channels.add_di_chan("rig/port1/line0:1", line_grouping=LineGrouping.CHAN_PER_LINE)
    task.timing.cfg_samp_clk_timing(20_000.0, samps_per_chan=ROWS)
    task.start()
    rig.send(0, hammer=pulses("hammer", ROWS, 50), keyphasor=pulses("keyphasor", ROWS, 150))
    hammer, keyphasor = np.array(task.read(ROWS))
    assert (np.flatnonzero(hammer)[[0, -1]].tolist(), np.flatnonzero(keyphasor)[0]) == ([50, 54], 150)


def test_a_clocked_line_without_samples_is_a_timeout(task: nidaqmx.Task) -> None:
    task.di_channels.add_di_chan("rig/port1/line0")
    task.timing.cfg_samp_clk_timing(20_000.0)
    with pytest.raises(nidaqmx.DaqError, match="-200284"):
        DigitalSingleChannelReader(task.in_stream).read_one_sample_port_uint32(timeout=0.0)


def test_large_messages_are_refused_before_they_need_memory(rig: PlayedRig) -> None:
    with (
        DaqmxServer(rig, allow_commands=True) as server,
        grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel,
        nidaqmx.Task(grpc_options=GrpcSessionOptions(channel, "")) as task,
        nidaqmx.Task(grpc_options=GrpcSessionOptions(channel, "")) as lines,
        nidaqmx.Task(grpc_options=GrpcSessionOptions(channel, "")) as drive,
    ):
        for name in ("1" * 2000, ",".join(["rig/ai0:14998"] * 20)):
            with pytest.raises(nidaqmx.DaqError, match="at most 1024 characters with 16 colons"):
                task.ai_channels.add_ai_voltage_chan(name)
        with pytest.raises(nidaqmx.DaqError, match=r"rig/ai0\\x1b\[2J; this device"):
            task.ai_channels.add_ai_voltage_chan("rig/ai0\x1b[2J")
        with refused(DAQmxErrors.INVALID_ATTRIBUTE_VALUE):
            task.ai_channels.add_ai_accel_chan("rig/ai10", sensitivity=5e-324)
        task.ai_channels.add_ai_voltage_chan("rig/ai0:14")
        with refused(DAQmxErrors.PAL_MEMORY_FULL):
            task.read(1_000_000, timeout=0.0)
        lines.do_channels.add_do_chan("rig/port0/line0:1", line_grouping=LineGrouping.CHAN_FOR_ALL_LINES)
        drive.ao_channels.add_ao_voltage_chan("rig/ao0")
        for output, samples in ((lines, [1] * 10_001), (drive, [1.0] * 10_001)):
            with pytest.raises(nidaqmx.DaqError, match="at most 10000 without a sample clock"):
                output.write(samples, auto_start=True)
    assert not rig.commands


def test_a_clocked_output_that_is_stopped_early_leaves_no_thread(rig: PlayedRig) -> None:
    with (
        DaqmxServer(rig, allow_commands=True) as server,
        grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel,
        nidaqmx.Task(grpc_options=GrpcSessionOptions(channel, "")) as port,
    ):
        port.do_channels.add_do_chan("rig/port0", line_grouping=LineGrouping.CHAN_FOR_ALL_LINES)
        port.timing.cfg_samp_clk_timing(2000.0, samps_per_chan=1000)
        port.write([1, 0])
        port.start()
        generator = next(thread for thread in threading.enumerate() if "_generate" in thread.name)
        port.stop()
        generator.join(PATIENCE_S)
        assert not generator.is_alive()


def test_calls_beyond_the_limit_are_refused_and_do_not_wait(task: nidaqmx.Task, options: GrpcSessionOptions) -> None:
    stub, session = NiDAQmxStub(options.grpc_channel), type(nidaqmx_pb2.StartTaskRequest().task)(name=task.name)
    events = [stub.RegisterDoneEvent(nidaqmx_pb2.RegisterDoneEventRequest(task=session)) for _ in range(64)]
    for event in events:
        event.initial_metadata()
    with pytest.raises(nidaqmx.errors.RpcError, match="Concurrent RPC limit exceeded"):
        task.name  # noqa: B018
    for event in events:
        event.cancel()

    def is_served() -> bool:
        with contextlib.suppress(nidaqmx.errors.RpcError):
            return bool(task.name)
        return False

    assert wait_until(is_served, PATIENCE_S)


@pytest.mark.parametrize(
    ("clear", "text"), [(False, "Operation aborted: the task was stopped"), (True, "Invalid task: 't' was cleared")]
)
def test_calls_of_another_program_during_a_read_end_it(
    options: GrpcSessionOptions, monkeypatch: pytest.MonkeyPatch, clear: bool, text: str
) -> None:
    start = Task.start

    def race(task: Task) -> None:
        if not clear:
            start(task)
        task.stop(clear=clear)
        if clear:
            start(task)

    monkeypatch.setattr(Task, "start", race)
    with nidaqmx.Task("t", grpc_options=options) as task:
        task.ai_channels.add_ai_voltage_chan("rig/ai0")
        with pytest.raises(nidaqmx.DaqError, match=text):
            task.read()
    assert not [thread for thread in threading.enumerate() if thread.name == "daq reports"]


def test_a_reset_by_another_program_ends_reads_and_loses_no_samples_silently(
    rig: PlayedRig, analog: Callable[..., nidaqmx.Task], options: GrpcSessionOptions
) -> None:
    task = analog("rig/ai0")
    rig.send(0)
    assert len(task.read(10)) == 10
    System.remote(options).devices["rig"].reset_device()
    for _ in range(2):
        with pytest.raises(nidaqmx.DaqError, match="the device was reset; start the task again"):
            task.read(10)
    task.start()
    rig.send(1)
    assert len(task.read(10)) == 10


def test_a_stop_in_another_thread_ends_a_read(task: nidaqmx.Task) -> None:
    task.ai_channels.add_ai_voltage_chan("rig/ai0")
    task.timing.cfg_samp_clk_timing(20_000.0, sample_mode=AcquisitionType.CONTINUOUS)
    task.start()
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit(task.read, 10)
        while not read.done():
            task.stop()
    assert "Operation aborted: the task was stopped" in str(read.exception())


def test_clocked_lines_of_outputs_wait_for_the_clock(rig: PlayedRig, task: nidaqmx.Task) -> None:
    task.di_channels.add_di_chan("rig/port0", line_grouping=LineGrouping.CHAN_FOR_ALL_LINES)
    task.timing.cfg_samp_clk_timing(20_000.0, samps_per_chan=ROWS)
    task.start()
    with pytest.raises(nidaqmx.errors.DaqReadError, match="-200284"):
        task.read(ROWS, timeout=0.0)
    rig.send(0)
    assert task.read(ROWS) == [0] * ROWS


def test_outputs_are_refused_unless_commands_are_allowed(rig: PlayedRig, task: nidaqmx.Task) -> None:
    for create in (task.do_channels.add_do_chan, task.ao_channels.add_ao_voltage_chan):
        with refused(DAQmxErrors.RESOURCE_ALREADY_RESERVED):
            create("rig/port0/line0")
    assert not rig.commands


class Secret(grpc.UnaryUnaryClientInterceptor, grpc.UnaryStreamClientInterceptor):
    """Sends a secret with each call."""

    def __init__(self, secret: str) -> None:
        self._secret = secret

    def intercept_unary_unary(self, call: Any, details: Any, request: Any) -> Any:
        return call(details._replace(metadata=[("rig-secret", self._secret)]), request)

    intercept_unary_stream = intercept_unary_unary


def test_outputs_need_the_secret_and_inputs_do_not(rig: PlayedRig) -> None:
    with (
        DaqmxServer(rig, allow_commands=True, secret="a1") as server,
        grpc.insecure_channel(f"127.0.0.1:{server.port}") as plain,
    ):
        own, other, none = (
            GrpcSessionOptions(grpc.intercept_channel(plain, *interceptors), "")
            for interceptors in ([Secret("a1")], [Secret("a2")], [])
        )
        with nidaqmx.Task("t", grpc_options=none) as task, refused(DAQmxErrors.PASSWORD_REQUIRED):
            task.do_channels.add_do_chan("rig/port0/line0")
        with nidaqmx.Task("t", grpc_options=other) as task, refused(DAQmxErrors.INCORRECT_PASSWORD):
            task.ao_channels.add_ao_voltage_chan("rig/ao0")
        with nidaqmx.Task("t", grpc_options=none) as task:
            task.ai_channels.add_ai_voltage_chan("rig/ai0")
            task.start()
        with refused(DAQmxErrors.PASSWORD_REQUIRED):
            System.remote(none).devices["rig"].reset_device()
        with nidaqmx.Task("t", grpc_options=own) as task:
            task.do_channels.add_do_chan("rig/port0/line0")
            stub, session = NiDAQmxStub(plain), type(nidaqmx_pb2.StartTaskRequest().task)(name="t")
            for name in ("StartTask", "ClearTask", "WriteDigitalScalarU32"):  # tasks belong to no program
                with pytest.raises(grpc.RpcError) as error:
                    getattr(stub, name)(getattr(nidaqmx_pb2, f"{name}Request")(task=session))
                assert error.value.code() is grpc.StatusCode.PERMISSION_DENIED
            assert not rig.commands
            task.write(True)
    assert [name for name, _ in rig.commands] == ["hammer"]


def test_outputs_send_commands_at_rising_edges(rig: PlayedRig) -> None:
    with DaqmxServer(rig, allow_commands=True) as server, grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        options = GrpcSessionOptions(channel, "")
        with nidaqmx.Task(grpc_options=options) as lines:
            lines.do_channels.add_do_chan("rig/port0/line0:1", line_grouping=LineGrouping.CHAN_PER_LINE)
            lines.do_channels.add_do_chan("rig/port2/line1")
            lines.write([True, False, False])
            lines.write([True, True, False])
            lines.write([False, True, True])
        with nidaqmx.Task(grpc_options=options) as port:
            port.do_channels.add_do_chan("rig/port0", line_grouping=LineGrouping.CHAN_FOR_ALL_LINES)
            assert port.read() == 2
            port.write(0b1101)
            assert port.read() == 0b1101, "lines without an action"
        with nidaqmx.Task(grpc_options=options) as trip:
            trip.do_channels.add_do_chan("rig/port2/line0")
            trip.write(True)
        with nidaqmx.Task(grpc_options=options) as drive:
            drive.ao_channels.add_ao_voltage_chan("rig/ao0", min_val=0.0, max_val=10.0)
            drive.write(2.5)
            with refused(DAQmxErrors.INVALID_AO_DATA_WRITE):
                drive.write(11.0)
    assert [name for name, _ in rig.commands] == ["hammer", "speed", "release", "hammer", "stop", "speed"]
    assert [fields["speed_hz"] for name, fields in rig.commands if name == "speed"] == [0.0, 10.0]


@pytest.mark.parametrize("waveform", [False, True])
def test_clocked_outputs_write_their_samples_at_the_clock(rig: PlayedRig, waveform: bool) -> None:
    with (
        DaqmxServer(rig, allow_commands=True) as server,
        grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel,
        nidaqmx.Task(grpc_options=GrpcSessionOptions(channel, "")) as port,
    ):
        port.do_channels.add_do_chan("rig/port0", line_grouping=LineGrouping.CHAN_FOR_ALL_LINES)
        port.timing.cfg_samp_clk_timing(2000.0, samps_per_chan=ROWS // 10 + 5)
        with refused(DAQmxErrors.OUTPUT_BUF_SIZE_TOO_SMALL_TO_START_GEN):
            port.start()
        data = [*[0] * 6, 1, 0, 0, *[1] * 9, 2]  # two hits in one block, then stop; the pattern is repeated
        assert port.write(DigitalWaveform.from_port(data, mask=15) if waveform else data) == 19
        assert not rig.commands
        port.start()
        rig.send(0)
        wait_until(lambda: len(rig.commands) == 2, PATIENCE_S)
        with refused(DAQmxErrors.WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE):
            port.wait_until_done(0.0)
        rig.send(1)
        port.wait_until_done(10.0)
        assert port.read() == 0, "sample 25 is the last one"
    assert [name for name, _ in rig.commands] == ["hammer", "speed"]


def test_wrong_settings_are_refused_with_the_codes_of_the_vendor(
    task: nidaqmx.Task, options: GrpcSessionOptions
) -> None:
    with refused(DAQmxErrors.INVALID_DEVICE_ID):
        task.ai_channels.add_ai_voltage_chan("Dev1/ai0")
    with refused(DAQmxErrors.PHYSICAL_CHAN_DOES_NOT_EXIST):
        task.ai_channels.add_ai_voltage_chan("rig/ai15")
    with refused(DAQmxErrors.FUNCTION_NOT_SUPPORTED_FOR_DEVICE):
        task.ai_channels.add_ai_thrmcpl_chan("rig/ai0")
    with refused(DAQmxErrors.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK):
        task.start()
    with refused(DAQmxErrors.MIN_NOT_LESS_THAN_MAX):
        task.ai_channels.add_ai_voltage_chan("rig/ai0", min_val=1.0, max_val=1.0)
    with refused(DAQmxErrors.INVALID_ATTRIBUTE_VALUE):
        task.ai_channels.add_ai_accel_chan("rig/ai0", sensitivity=0.0)
    task.ai_channels.add_ai_voltage_chan("rig/ai0")
    with refused(DAQmxErrors.DUPLICATE_PHYSICAL_CHANS_NOT_SUPPORTED):
        task.ai_channels.add_ai_voltage_chan("rig/ai0", "again")
    with refused(DAQmxErrors.MULTI_CHAN_TYPES_IN_TASK):
        task.ci_channels.add_ci_freq_chan("rig/ctr0")
    for rate_hz in (19_999.0, 40_000.0, 0.0, float("nan")):
        with refused(DAQmxErrors.INVALID_ATTRIBUTE_VALUE):
            task.timing.cfg_samp_clk_timing(rate_hz)
    with refused(DAQmxErrors.INVALID_ROUTING_SOURCE_TERMINAL_NAME_ROUTING):
        task.triggers.start_trigger.cfg_dig_edge_start_trig("/rig/PFI3")
    with pytest.raises(nidaqmx.DaqError, match="must be DO_NOT_OVERWRITE_UNREAD_SAMPLES; received OVERWRITE_UNREAD"):
        task.in_stream.overwrite = OverwriteMode.OVERWRITE_UNREAD_SAMPLES
    with refused(DAQmxErrors.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT):
        task.in_stream.overcurrent_chans_exist  # noqa: B018
    with refused(DAQmxErrors.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING):
        task.ai_channels.add_ai_voltage_chan("rig/ai:x")
    task.timing.cfg_samp_clk_timing(20_000.0, samps_per_chan=1 << 40)
    with refused(DAQmxErrors.PAL_MEMORY_FULL):
        task.start()
    one = nidaqmx.Task("same", grpc_options=options)
    with nidaqmx.Task("same", grpc_options=options) as other:
        assert one.name == other.name == "same"
        one.close()
        with refused(DAQmxErrors.INVALID_TASK):
            other.start()


def test_the_system_lists_the_device(options: GrpcSessionOptions) -> None:
    (device,) = System.remote(options).devices
    assert (device.name, device.is_simulated, device.ai_max_multi_chan_rate) == ("rig", True, 20_000.0)
    assert device.ai_physical_chans.channel_names == [f"rig/ai{n}" for n in range(15)]
    assert device.terminals == ["/rig/PFI0", "/rig/PFI8"]
    assert [each.channel_names for each in (device.ci_physical_chans, device.do_ports)] == [
        ["rig/ctr0"],
        ["rig/port0", "rig/port2"],
    ]


def test_tasks_of_lost_programs_are_bounded(options: GrpcSessionOptions) -> None:
    tasks = [nidaqmx.Task(grpc_options=options) for _ in range(64)]
    with refused(DAQmxErrors.PAL_MEMORY_FULL):
        nidaqmx.Task(grpc_options=options)
    for task in tasks:
        task.close()


def test_events_report_samples_and_the_end(rig: PlayedRig, task: nidaqmx.Task) -> None:
    task.ai_channels.add_ai_voltage_chan("rig/ai0")
    task.timing.cfg_samp_clk_timing(20_000.0, samps_per_chan=400)
    seen, done = [], threading.Event()
    task.register_every_n_samples_acquired_into_buffer_event(100, lambda *_: seen.append(len(task.read(100))) or 0)
    task.register_done_event(lambda _, status, __: done.set() or 0)
    task.start()
    rig.send(0, 1)
    assert done.wait(PATIENCE_S)
    assert wait_until(lambda: len(seen) == 4, PATIENCE_S)
    assert seen == [100] * 4
