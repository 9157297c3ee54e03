"""Time over CAN late in a real run: `python -m tests.system.can_time [--minutes 40] [--scene test-quiet]`.

Runs a scene at full speed as a node of a virtual CAN bus. Once it has reached the simulated time, a new CAN client
connects and sends commands. Its time, and that of each reply, must be between two replies of the rig over zenoh, before
and after it; a heartbeat carries the time, so that the client's may be older by one. A time on the bus has 32 bits of
microseconds, which wrap after 71.6 simulated minutes; half of that is 35.8. Status 1 if a time is wrong.
"""

from __future__ import annotations

import argparse
import math
import sys
import time

from drivers.sources.can_client import CanClient
from rig.base import wire
from rig.serve.transport.zenoh import ZenohClient
from tests.processes import COMPILE_S, free_endpoint, running_rig
from tests.waiting import PATIENCE_S

HEARTBEAT_S = 1.5
"""Longest wall time from one heartbeat to the next [s]."""
CHANNELS = ("P_E", "P_N", "disk_x", "disk_y")


def main() -> int:
    """Run, compare and print; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=40.0, help="simulated time at which the client joins [min]")
    parser.add_argument("--scene", default="test-quiet", help="scene to run")
    options = parser.parse_args()
    bus = f"zenoh:can0?endpoint={free_endpoint()}"
    # Few samples and long blocks: each frame costs processor time, and here only its time matters.
    settings = ("--pace", "free", "--block-ms", "1000", "--can", bus, "--can-rate", "10")
    began_s = time.monotonic()
    with running_rig(options.scene, *settings) as (child, endpoint), ZenohClient(endpoint, wait_s=COMPILE_S) as client:

        def rig_s() -> float:
            return wire.decode_document(client.request(wire.STATUS, timeout_s=PATIENCE_S))["time_s"]

        while (reached_s := rig_s()) < 60.0 * options.minutes:
            assert child.poll() is None, "the rig has ended"
            time.sleep(0.5)
        speed = reached_s / (time.monotonic() - began_s)
        print(f"{reached_s / 60:.1f} min simulated at {speed:.1f} times real time; a CAN client joins")
        right = 0
        with CanClient(bus, wait_s=PATIENCE_S) as late:
            for channel in CHANNELS:
                command = wire.encode_document({"channel": channel, "kind": "polarity"})  # valid in every scene
                before_s = rig_s()
                joined_s = wire.decode_document(late.request(wire.STATUS))["time_s"]
                reply = wire.decode_document(late.request(wire.command_key("fault"), command, timeout_s=PATIENCE_S))
                after_s = rig_s()
                reply_s = reply.get("time_s", math.nan)  # a refusal has none, and counts as wrong
                right += before_s - HEARTBEAT_S * speed <= joined_s <= reply_s <= after_s and before_s <= reply_s
                print(f"rig {before_s:.3f} s, client {joined_s:.3f} s, reply {reply}, rig {after_s:.3f} s")
    print(f"{right} of {len(CHANNELS)} right")
    return 0 if right == len(CHANNELS) else 1


if __name__ == "__main__":
    sys.exit(main())
