"""A simulation without physics: as many streams and bytes as the real one, values that encode their row number.

Run as a program it is a complete rig on one port: `python -m tests.unit.service_fake PORT PACE [DURATION_S]`. With a
duration it starts when it has read a line, so that the parent process can be connected before it ends.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np

from rig.base.errors import InputError
from rig.base.wire import Block
from rig.run.simulation import Frame

GROUPS = {"probes": 4, "forces": 4, "accelerations": 4, "drive": 2, "hammer": 1}
TRUTH = {"state": 28, "contact": 6, "energy": 8}
SAMPLE_TICKS = 50
TRUTH_TICKS = 500
EDGE_TICKS = 160_000


def _rows(tick: int, ticks: int, every: int, columns: int, dtype: type) -> Block:
    first, last = -(-tick // every), -(-(tick + ticks) // every)
    values = np.repeat(np.arange(first, last, dtype=dtype)[:, None], columns, axis=1)
    return Block(tick=first * every, index=first, rate_hz=1e6 / every, tick_rate_hz=1e6, values=values)


class FakeSimulation:
    """Counts rows instead of simulating.

    Args:
        duration_s: Length of the scene [s], or None.
        fail_at_tick: `advance` raises from this tick on.
        warn_at_tick: `health` has a warning from this tick on.
    """

    tick_rate_hz = 1_000_000
    block_ticks = 1_000

    def __init__(
        self,
        *,
        duration_s: float | None = 1.0,
        fail_at_tick: int | None = None,
        warn_at_tick: int | None = None,
    ) -> None:
        self.tick = 0
        self.command_result = {}
        self.end_tick = None if duration_s is None else round(duration_s * self.tick_rate_hz)
        self.fail_at_tick = fail_at_tick
        self.warn_at_tick = warn_at_tick
        self.warmed_up = False
        self._scheduled: list[dict[str, Any]] = []

    def set_transports(self, transports: tuple[str, ...]) -> None:
        assert transports

    def warm_up(self) -> None:
        self.warmed_up = True

    def advance(self, ticks: int) -> Frame:
        assert self.warmed_up
        assert ticks > 0
        assert ticks % self.block_ticks == 0
        if self.fail_at_tick is not None and self.tick >= self.fail_at_tick:
            raise FloatingPointError("the shaft\nleft the rig")
        tick = self.tick
        edges = _rows(tick, ticks, EDGE_TICKS, 1, np.float64)
        frame = Frame(
            tick=tick,
            ticks=ticks,
            samples={name: _rows(tick, ticks, SAMPLE_TICKS, columns, np.int32) for name, columns in GROUPS.items()},
            edges=edges if len(edges.values) else None,
            truth={name: _rows(tick, ticks, TRUTH_TICKS, columns, np.float64) for name, columns in TRUTH.items()},
            events=self._scheduled,
            rows=np.empty((0, 0)),
        )
        self._scheduled = []
        self.tick += ticks
        return frame

    def submit(self, command: str, request: dict[str, Any]) -> int:
        if command == "hammer":
            force = request["force_n"]
            if not 0 < force <= 1000:
                raise InputError("force_n", "above 0 and at most 1000", force)
        self._scheduled.append({"event": command, "tick": self.tick, "time_s": self.tick / self.tick_rate_hz})
        return self.tick

    def catalogue(self) -> dict[str, Any]:
        return {"root": "rig", "tick_rate_hz": self.tick_rate_hz}

    def parameters_document(self) -> dict[str, Any]:
        return {"set": "fake", "values": {}}

    def scene_document(self) -> dict[str, Any]:
        return {"name": "fake", "scene": {}, "seed": 1}

    def health(self) -> dict[str, Any]:
        warn = self.warn_at_tick is not None and self.tick >= self.warn_at_tick
        energy = {"residual_j": float("nan"), "dissipated_j": 0.0}
        return {"spin_hz": 6.2, "energy": energy, "warnings": ["energy does not close"] if warn else []}


def main(port: int, pace: str, duration_s: float | None) -> None:
    """Serve until the end and print the summary."""
    import signal

    from rig.serve.pacing import FreeRun, Lockstep, RealTime
    from rig.serve.service import Service
    from rig.serve.transport.zenoh import ZenohServer

    clock = {"real-time": RealTime, "free": FreeRun, "lockstep": Lockstep}[pace]()
    with ZenohServer(f"127.0.0.1:{port}", wait=pace != "real-time") as server:
        service = Service(FakeSimulation(duration_s=duration_s), server, clock, block_ticks=10_000)
        signal.signal(signal.SIGTERM, lambda *_: service.stop())
        print("ready", flush=True)
        if duration_s is not None:
            sys.stdin.readline()
        summary = service.run()
    print(json.dumps(summary), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], float(sys.argv[3]) if len(sys.argv) > 3 else None)
