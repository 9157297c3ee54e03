"""Calls of hostile programs to the NI-DAQmx device: in any order, with other values, counts, names and bytes."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterable, Iterator
from typing import Any
from unittest.mock import patch

import grpc
from google.protobuf.message import DecodeError
from nidaqmx._stubs import nidaqmx_pb2  # noqa: PLC2701

from drivers.daqmx.hardware.errors import Code
from drivers.daqmx.rpc import samples
from drivers.daqmx.rpc.samples import DaqmxServicer
from drivers.daqmx.rpc.sessions import SECRET_KEY
from drivers.daqmx.server import DaqmxServer
from drivers.daqmx.tasks import task
from tests.hostile.files import Rng, spoil_bytes
from tests.hostile.interfaces import NUMBERS, TEXTS, pick
from tests.waiting import until

METHODS = nidaqmx_pb2.DESCRIPTOR.services_by_name["NiDAQmx"].methods_by_name
_HANDLERS = [getattr(DaqmxServicer, name) for name in dir(DaqmxServicer) if not name.startswith("__")]
_PATTERNS = [method.pattern for method in _HANDLERS if hasattr(method, "pattern")]
CALLS = [name for name in METHODS if any(pattern.fullmatch(name) for pattern in _PATTERNS)]
"""Calls that the device supports."""
STREAMS = ("RegisterEveryNSamplesEvent", "RegisterDoneEvent")
_SCRIPTS = (
    "CreateAIVoltageChan CfgSampClkTiming CfgDigEdgeRefTrig StartTask BLOCK ReadAnalogF64 ClearTask",
    "CreateAIAccelChan SetTimingAttributeDouble StartTask BLOCK ReadBinaryI32 ReadRaw StopTask",
    "CreateAIForceIEPEChan CfgSampClkTiming CfgAnlgEdgeStartTrig ReadAnalogWaveforms BLOCK ReadRaw",
    "CreateCIFreqChan CfgImplicitTiming StartTask BLOCK ReadCounterF64 ReadCounterScalarF64",
    "CreateCICountEdgesChan StartTask BLOCK ReadCounterScalarU32 ReadCounterU32 ClearTask",
    "CreateCIPulseChanTime CfgImplicitTiming StartTask BLOCK ReadCtrTime ReadCtrTimeScalar",
    "CreateDOChan WriteDigitalLines WriteDigitalU32 ReadDigitalU32 ReadDigitalScalarU32 ClearTask",
    "CreateDOChan CfgSampClkTiming WriteDigitalLines StartTask BLOCK WaitUntilTaskDone ClearTask",
    "CreateDOChan CfgSampClkTiming WriteDigitalWaveforms StartTask BLOCK WriteDigitalScalarU32",
    "CreateDIChan CfgSampClkTiming StartTask BLOCK ReadDigitalLines ReadDigitalU32 StopTask",
    "CreateAOVoltageChan WriteAnalogF64 WriteAnalogScalarF64 StartTask ClearTask",
    "CreateAIVoltageChan CfgSampClkTiming RegisterDoneEvent RegisterEveryNSamplesEvent StartTask BLOCK",
)
_VALID_VALUES: dict[str, tuple[Any, ...]] = {
    "physical_channel": ("rig/ai0:3", "rig/ai14", "rig/ao0"), "counter": ("rig/ctr0",), "device_name": ("rig",),
    "lines": ("rig/port0/line0:1", "rig/port0", "rig/port2/line0", "rig/port1/line0"), "rate": (20_000.0, 2000.0),
    "trigger_source": ("/rig/PFI0", "rig/ai0"), "min_val": (-10.0,), "max_val": (10.0,), "samps_per_chan": (200, 2),
    "num_samps_per_chan": (1, 2, 100, -1), "array_size_in_samps": (4000,), "array_size_in_bytes": (1 << 20,),
    "timeout": (0.0, 10.0), "time_to_wait": (0.0, 1.0), "sensitivity": (100.0,), "source": ("", "OnboardClock"),
    "name_to_assign_to_channel": ("", "x"), "name_to_assign_to_lines": ("",), "channel": ("", "rig/ai0"),
    "pretrigger_samples": (10,), "n_samples": (50,), "voltage_excit_val": (2.5,),
    "auto_start": (True, False), "sample_mode_raw": (10178, 10123), "edge_raw": (10280,),
    "starting_edge_raw": (10280,), "trigger_edge_raw": (10280,),
    "fill_mode_raw": (0, 1), "data_layout_raw": (0, 1), "terminal_config_raw": (-1,), "initialization_behavior": (0,),
}  # fmt: skip
_UNITS = {
    "Voltage": 10348, "Accel": 10186, "Velocity": 15959, "Force": 15875, "Pos": 10219, "Bridge": 15896,
    "Freq": 10373, "Period": 10364, "Time": 10364,
}  # fmt: skip
"""Units by a part of the name of the call."""
_SENSITIVITIES = {"Accel": 12509, "Velocity": 15963, "Force": 15891, "Pos": 14838}
_TEXTS = (
    *TEXTS, "x" * 10_000, "1" * 10_000 + "x", "1" * 10_000, "rig/ai0:" + "9" * 5000, "rig/ai0:14999", "rig/ai14:0",
    ",".join(["rig/ai0:14998"] * 500), "rig/ai0,rig/ai0", "rig/port0," * 800, "," * 10_000, ":",
    "rig/ai0:x1", "Dev1/ai0",
)  # fmt: skip
_RANGES = {13: (0, 1 << 32), 5: (-(1 << 31), 1 << 31), 4: (0, 1 << 64), 3: (-(1 << 63), 1 << 63)}
"""Range of each type of integer, by its number in the protocol."""


class AbortError(Exception):
    """A call was ended with an error of the vendor."""


class Context:
    """Context of a call by a program that waits for two polls."""

    def __init__(self, metadata: tuple[tuple[str, str], ...] = ()) -> None:
        self.polls, self.metadata, self.code = 2, metadata, 0

    def is_active(self) -> bool:
        self.polls -= 1
        return self.polls >= 0

    def invocation_metadata(self) -> tuple[tuple[str, str], ...]:
        return self.metadata

    def send_initial_metadata(self, metadata: object) -> None:
        assert metadata == ()

    def set_trailing_metadata(self, metadata: Any) -> None:
        self.code = int(dict(metadata)["ni-error"])

    def abort(self, status: grpc.StatusCode, text: str) -> None:
        assert self.code in list(Code)
        assert status in (grpc.StatusCode.UNKNOWN, grpc.StatusCode.PERMISSION_DENIED)
        assert len(text) < 4000, "longer metadata are an error of the package's channel"
        assert text.replace("\n", "").isprintable()
        raise AbortError(text)


def pass_calls(calls: Iterable[tuple[str, bytes]], *, with_secret: bool) -> int:
    """Pass calls to a device whose rig accepts every command; return the number of those that succeeded."""
    from tests.unit.test_daqmx import PlayedRig

    rig, blocks, accepted = PlayedRig(), 0, 0
    metadata = ((SECRET_KEY, "s"),) if with_secret else ()
    with (
        patch.object(task, "POLL_S", 1e-3),
        patch.object(samples, "POLL_S", 1e-3),
        DaqmxServer(rig, allow_commands=True, secret="s") as server,  # type: ignore[arg-type]
    ):
        servicer = server._servicer  # noqa: SLF001 - without sockets
        for name, payload in calls:
            if name == "BLOCK":
                rig.send(blocks)
                blocks += 1
                continue
            with contextlib.suppress(AbortError, DecodeError):
                request = getattr(nidaqmx_pb2, METHODS[name].input_type.name).FromString(payload)
                response = getattr(servicer, name)(request, Context(metadata))
                assert all(each.IsInitialized() for each in (response if name in STREAMS else [response]))
                accepted += 1
    until(lambda: not any("_generate" in thread.name for thread in threading.enumerate()))
    assert with_secret or not rig.commands
    return accepted


def generate_calls(rng: Rng, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield names and messages of calls; the name BLOCK stands for a block of the rig."""
    script: list[str] = []
    for _ in range(count):
        if rng.random() < 0.7:
            if not script:
                script, task = (
                    ["ClearTask", "CreateTask", *pick(rng, _SCRIPTS).split()],
                    str(pick(rng, ("a", "b", "c"))),
                )
            name, change = script.pop(0), 0.01
        else:
            name, task, change = str(pick(rng, CALLS)), str(pick(rng, ("a", "b", "c"))), 0.2
        if name == "BLOCK":
            yield name, b""
            continue
        payload = _fill(name, task, rng, change).SerializeToString()
        yield name, spoil_bytes(payload, rng) if payload and rng.random() < 0.5 * change else payload


def _fill(name: str, task: str, rng: Rng, change: float) -> Any:
    """Return a message with usual values, or with some probability others."""
    kind = METHODS[name].input_type
    message = getattr(nidaqmx_pb2, kind.name)()
    for field in kind.fields:
        if rng.random() < 0.1 * change or f"{field.name}_raw" in kind.fields_by_name:
            continue
        if field.name in ("task", "session_name"):
            text = task if rng.random() > 0.1 * change else _text(rng)
            setattr(*((message.task, "name") if field.name == "task" else (message, "session_name")), text)
        elif field.name == "waveforms":
            for _ in range(1 if rng.random() > change else int(pick(rng, (0, 2, 20)))):
                lines = int(pick(rng, (1, 2, 4))) if rng.random() > change else int(pick(rng, (0, -1, 3, 1 << 31 - 1)))
                message.waveforms.add(y_data=rng.bytes(4 * abs(lines) % 1000), signal_count=lines)
        elif field.message_type is not None:
            continue
        elif field.is_repeated:
            count = int(pick(rng, (1, 2, 4)) if rng.random() > change else pick(rng, (0, 200, 10_000)))
            getattr(message, field.name).extend(_value(name, field, rng, change) for _ in range(count))
        else:
            setattr(message, field.name, _value(name, field, rng, change))
    return message


def _value(name: str, field: Any, rng: Rng, change: float) -> Any:
    units = {"units_raw": _UNITS, "sensitivity_units_raw": _SENSITIVITIES}.get(field.name, {})
    if (known := [number for part, number in units.items() if part in name]) and rng.random() > change:
        return known[0]
    if field.name in _VALID_VALUES and rng.random() > change:
        values = [each for each in _VALID_VALUES[field.name] if not isinstance(each, str) or _fits(name, each)]
        return pick(rng, values or _VALID_VALUES[field.name])
    sibling = field.containing_type.fields_by_name.get(field.name.removesuffix("_raw"), field)
    if sibling.enum_type is not None and rng.random() > 0.5 * change:
        return int(pick(rng, list(sibling.enum_type.values_by_number)))
    match field.type:
        case 1 | 2:
            return float(pick(rng, NUMBERS)) if rng.random() < 0.5 else float(rng.normal())
        case 8:
            return bool(rng.integers(2))
        case 9:
            return _text(rng)
        case 12:
            return rng.bytes(int(pick(rng, (1, 2, 4)) if rng.random() > change else pick(rng, (0, 3, 100_000))))
        case 14:
            return int(rng.integers(-(1 << 31), 1 << 31))
        case _:
            low, high = _RANGES[field.type]
            number = pick(rng, NUMBERS) if rng.random() < change + 0.2 else rng.integers(0, 20)
            return max(low, min(int(number) if abs(number) < 1e30 else 0, high - 1))


def _fits(name: str, channel: str) -> bool:
    """Return whether a channel is of the kind that a call creates."""
    kind = "ao" if name.startswith("CreateAO") else "ai" if name.startswith("CreateAI") else ""
    return kind in channel and not (name.startswith("CreateDO") and "port1" in channel)


def _text(rng: Rng) -> str:
    return str(pick(rng, _TEXTS)).encode("utf-8", "ignore").decode()
