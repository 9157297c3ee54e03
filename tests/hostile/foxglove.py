"""Messages of hostile clients to the server for the Foxglove app, on one connection."""

from __future__ import annotations

import contextlib
import json
import struct
import threading
from collections.abc import Iterable, Iterator
from typing import Any

from recorder.foxglove.server import SERVICES, FoxgloveServer
from rig.base import wire
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.foxglove_client import BINARY, TEXT, FoxgloveClient
from tests.hostile.documents import generate_documents
from tests.hostile.files import Rng, spoil_bytes
from tests.hostile.interfaces import pick
from tests.unit.viewer_recording import Synthetic, make_replies

_REQUESTS: list[dict[str, Any]] = [{"force_n": 120.0, "secret": "t"}, {"speed_hz": 5.0}, {"id": "all", "secret": None}]
_MESSAGES: list[dict[str, Any]] = [
    {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]},
    {"op": "unsubscribe", "subscriptionIds": [1]},
    {"op": "advertise", "channels": [{"id": 1, "topic": "x", "encoding": "json", "schemaName": "x"}]},
    {"op": "getParameters", "parameterNames": ["scene.drive.speed_hz"], "id": "a"},
    {"op": "setParameters", "parameters": [{"name": "scene.drive.speed_hz", "value": 9.0, "type": "float64"}]},
    {"op": "subscribeParameterUpdates", "parameterNames": ["scene.drive.speed_hz"]},
    {"op": "fetchAsset", "uri": "file:///etc/passwd", "requestId": 1},
    {"op": "subscribeConnectionGraph"},
]


def generate_messages(rng: Rng, count: int) -> Iterator[tuple[int, bytes]]:
    """Yield kinds and payloads of frames: calls of services, the play bar, JSON messages, and bytes."""
    for _ in range(count):
        request = next(generate_documents(rng, 1, _REQUESTS))
        encoding = pick(rng, (b"json", b"json", b"", b"ros1", b"\xff"))
        head = struct.pack(
            "<BIII", 2, int(pick(rng, (*range(1, 8), 0, 1 << 31))), int(rng.integers(100)), len(encoding)
        )
        match rng.integers(0, 6):
            case 0 | 1:
                yield BINARY, head + encoding + request
            case 2:
                yield BINARY, spoil_bytes(head + encoding + request, rng)
            case 3:
                rate, seek_ns = pick(rng, (1.0, float("nan"), float("inf"), -1.0, 1e30)), int(rng.integers(1 << 62))
                bar = struct.pack("<BBfBQI", 3, int(rng.integers(4)), rate, int(rng.integers(3)), seek_ns, 1) + b"x"
                yield BINARY, bar if rng.integers(2) else spoil_bytes(bar, rng)
            case 4:
                yield BINARY, rng.bytes(int(rng.integers(1, 60)))
            case _:
                document = next(generate_documents(rng, 1, _MESSAGES))
                yield TEXT, document.decode(errors="replace").encode() if rng.random() < 0.97 else document


def pass_messages(messages: Iterable[tuple[int, bytes]]) -> None:
    """Pass messages to a server that needs a secret, and check that it then serves a good client."""
    done, sent = threading.Event(), list[Any]()
    with MemoryServer() as server:
        documents = {wire.STATUS: {"scene": "hammer", "block_ms": 10.0}, wire.SCENE: {"scene": {"speed_hz": 6.2}}}
        replies = make_replies(Synthetic(duration_s=0.1)) | {
            key: wire.encode_document(document) for key, document in documents.items()
        }
        for key, reply in replies.items():
            server.answer(key, lambda _, reply=reply: reply)
        server.announce()
        access = {"allow_commands": True, "allow_playback": True, "secret": "s"}
        with FoxgloveServer(
            MemoryClient(server), ("127.0.0.1", 0), view_rate_hz=500.0, send=lambda *each: sent.append(each), **access
        ) as served:
            cycle = threading.Thread(target=served.run, args=(done.is_set,))
            cycle.start()
            try:
                remaining = list(messages)
                while remaining:
                    with contextlib.suppress(AssertionError, OSError), FoxgloveClient(served.port) as hostile:
                        while remaining:
                            kind, payload = remaining.pop(0)
                            hostile.send(payload, kind)
                            if kind == TEXT and payload.decode(errors="replace").encode() != payload:
                                hostile.until(lambda: False)  # it closes the connection
                        hostile.tell(op="getParameters", parameterNames=[], id="last")
                        hostile.until(lambda: any(each.get("id") == "last" for each in hostile.find("parameterValues")))
                with FoxgloveClient(served.port) as good:
                    for name in SERVICES:
                        assert "secret must be" in good.call(name, {"secret": "t"})["message"]
                    good.tell(op="getParameters", parameterNames=[], id="good")
                    good.until(lambda: good.find("parameterValues"))
                    assert good.find("parameterValues")[0]["parameters"][0]["value"] == 6.2
            finally:
                done.set()
                cycle.join()
    assert sent == []


def encode_messages(messages: Iterable[tuple[int, bytes]]) -> bytes:
    return json.dumps([(kind, payload.hex()) for kind, payload in messages]).encode()


def decode_messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    return ((kind, bytes.fromhex(payload)) for kind, payload in json.loads(data))
