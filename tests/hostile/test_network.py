"""Generated messages over real sockets on the loopback, 300 for each interface; RIG_FUZZ_INPUTS sets another number.

Socketcand and SLCAN are in `test_can.py` (1500 commands each, over TCP and a pseudo-terminal), forged blocks and events
over zenoh in `test_blocks.py`.
"""

from __future__ import annotations

import contextlib
import threading
from collections import Counter
from typing import Any

import can  # noqa: TID253 - the subject
import grpc
import nidaqmx
import numpy as np
import pytest

from drivers.can.bus import codec
from drivers.can.bus.hub import Hub
from drivers.can.bus.model import BusModel
from drivers.can.gateway import Gateway
from drivers.can.schedule import Schedule
from drivers.can.signals import default_messages
from drivers.daqmx.server import DaqmxServer
from drivers.instruments.twins import TWINS, Twins
from drivers.link.zenoh import request_key
from drivers.sources.can_client import CanClient
from rig.base import wire
from rig.serve.transport import NoReplyError
from rig.serve.transport.memory import MemoryClient, MemoryServer
from rig.serve.transport.zenoh import ZenohClient, ZenohServer
from tests.hostile import input_count
from tests.hostile.daqmx import STREAMS, generate_calls
from tests.hostile.documents import generate_documents
from tests.hostile.interfaces import ask, make_frame_line, make_request, serve_lockstep
from tests.hostile.test_can import make_offer
from tests.hostile.test_can import make_request as make_instrument_request
from tests.processes import free_endpoint
from tests.unit.instruments_fake import FakeRig
from tests.unit.test_daqmx import PlayedRig
from tests.waiting import PATIENCE_S, until

pytestmark = [pytest.mark.wallclock, pytest.mark.timeout(3600)]
WAITING = ("step", "note", "hammer")
"""Requests whose reply may wait for a device."""


def test_requests_to_a_run_in_lockstep_over_zenoh() -> None:
    rng, endpoint = np.random.default_rng(21), free_endpoint()
    accepted = refused = 0
    with ZenohServer(endpoint) as server, serve_lockstep(server) as (_, service), ZenohClient(endpoint) as client:
        for _ in range(input_count(300)):
            name, payload = make_request(rng)
            with contextlib.suppress(*((NoReplyError,) if name in WAITING else ())):
                timeout_s = 0.02 if name in WAITING else 5.0
                reply = wire.decode_document(client.request(wire.command_key(name), payload, timeout_s=timeout_s))
                assert str(reply).isprintable()
                accepted, refused = accepted + reply["accepted"], refused + (not reply["accepted"])
        assert wire.decode_document(client.request(wire.STATUS))["state"] == "running"
        assert not service.status()["warnings"]
    assert accepted > 10
    assert refused > 100


def test_frames_in_lockstep_and_messages_to_a_hub_over_zenoh() -> None:
    rng, endpoint, messages = np.random.default_rng(22), free_endpoint(), default_messages()
    examples: list[dict[str, Any]] = [{"endpoint": "a", "listen_only": True, "secret": "0" * 32}, {}]
    settings = {"interface": "zenoh", "ignore_config": True, "endpoint": endpoint}
    with (
        serve_lockstep() as (server, service),
        ZenohServer(endpoint) as transport,
        Hub(BusModel("1M/8M"), "can0", transport) as hub,
        can.Bus("can0", **settings) as own,
        can.Bus("can0", **settings) as villain,
        Gateway(MemoryClient(server), own, Schedule(), paced=False) as gateway,
    ):
        ask(server, "step", b'{"blocks": 3}')
        with CanClient(f"zenoh:can0?endpoint={endpoint}", wait_s=PATIENCE_S) as client, ZenohClient(endpoint) as other:
            requests = generate_documents(rng, input_count(300), examples)
            for number, request in enumerate(requests):
                identifier, _, data = make_frame_line(rng, messages).partition(" ")
                if int(identifier, 16) == messages.by_name["Heartbeat"].identifier:
                    continue  # a second rig on the bus, which ends a client
                frame = can.Message(arbitration_id=int(identifier, 16), data=bytes.fromhex(data), is_extended_id=False)
                villain.send(frame, timeout=PATIENCE_S)
                offer, _ = make_offer(rng, bytes(16))
                other.report(codec.offer_key("can0", f"ghost{number % 7}"), offer)
                with contextlib.suppress(NoReplyError):
                    name = ("join", "set", "flush", "status")[rng.integers(4)]
                    other.request(codec.request_key("can0", name), request, timeout_s=1.0)
            beats = client._beats  # noqa: SLF001 - the frames are read on
            until(lambda: client._beats > beats + 1)  # noqa: SLF001
            assert wire.decode_document(client.request(wire.STATUS))["pace"] == "lockstep"
            assert not gateway.guard.warnings()
            assert not any("failed" in text for text in hub.warnings())
            assert service.status()["state"] == "running"
            assert any(thread.name == "can hub can0" for thread in threading.enumerate())


def test_calls_to_a_daqmx_device_over_grpc(caplog: pytest.LogCaptureFixture) -> None:
    rng, rig = np.random.default_rng(24), PlayedRig()
    codes, others = Counter[grpc.StatusCode](), list[tuple[str, grpc.StatusCode]]()
    with (
        DaqmxServer(rig, allow_commands=True, secret="s") as server,  # type: ignore[arg-type]
        grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel,
    ):
        for name, payload in generate_calls(rng, input_count(300)):
            if name == "BLOCK":
                continue
            call = channel.unary_stream if name in STREAMS else channel.unary_unary
            try:
                reply = call(f"/nidaqmx_grpc.NiDAQmx/{name}")(payload, timeout=0.5)
                codes[grpc.StatusCode.OK] += 1
                if name in STREAMS:
                    reply.cancel()
            except grpc.RpcError as error:
                codes[error.code()] += 1
                if "ni-error" not in dict(error.trailing_metadata()):
                    others.append((name, error.code()))
        with nidaqmx.Task(grpc_options=nidaqmx.GrpcSessionOptions(channel, "")) as task:
            task.ai_channels.add_ai_voltage_chan("rig/ai0:14")
            task.timing.cfg_samp_clk_timing(20_000.0, samps_per_chan=200)
            task.start()
            rig.send(0)
            np.testing.assert_array_equal(np.shape(task.read(200)), (15, 200))
    assert not rig.commands
    for name, code in others:  # a read that waits, or bytes that are no message
        assert code is grpc.StatusCode.INTERNAL or (code is grpc.StatusCode.DEADLINE_EXCEEDED and "Read" in name), name
    assert min(codes[code] for code in (grpc.StatusCode.OK, grpc.StatusCode.UNKNOWN)) > 30
    assert codes[grpc.StatusCode.PERMISSION_DENIED] > 10
    assert not [record for record in caplog.records if "deserializing" not in record.getMessage()]


def test_requests_to_instruments_over_zenoh() -> None:
    rng, endpoint, rig = np.random.default_rng(23), free_endpoint(), FakeRig(MemoryServer())
    replies = 0
    with Twins(MemoryClient(rig.server)) as twins:
        twins.serve_zenoh(endpoint)
        with ZenohClient(endpoint) as client:
            for _ in range(input_count(300)):
                codec_ = TWINS[rng.integers(len(TWINS))].CODEC
                key = request_key(codec_.address.name)
                reply = client.request(key, make_instrument_request(rng, codec_), timeout_s=PATIENCE_S)
                codec_.decode(reply)
                replies += 1
    assert replies == input_count(300)
