"""A rig without physics, paced in real time: `python -m tests.system.viewer_rig PORT DURATION_S`."""

from __future__ import annotations

import sys
import threading
import time

from rig.base import wire
from rig.serve.transport.zenoh import ZenohServer
from tests.unit.viewer_recording import Synthetic, generate_messages, make_replies
from tests.waiting import PATIENCE_S


def main(port: int, duration_s: float) -> None:
    """Serve a synthetic recording from the first report of a client on, then stay for a second."""
    recording = Synthetic(duration_s=duration_s)
    blocks = list(generate_messages(recording))
    with ZenohServer(f"127.0.0.1:{port}") as server:
        for key, reply in make_replies(recording).items():
            server.answer(key, lambda _, reply=reply: reply)
        met = threading.Event()

        def subscribe_reports(key: str, payload: bytes) -> None:
            print(key, payload.decode(), flush=True)
            met.set()

        server.subscribe_reports(f"{wire.CLIENTS}/*", subscribe_reports)
        server.announce()
        print("ready", flush=True)
        met.wait(PATIENCE_S)
        start = time.monotonic()
        for number, block in enumerate(blocks):
            time.sleep(max(0.0, start + 0.01 * number - time.monotonic()))
            for key, payload in block:
                server.publish(key, payload)
        time.sleep(1.0)


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))
