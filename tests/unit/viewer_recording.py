"""A synthetic recording with a known whirl, and the contents of a saved .rrd file, for the viewer's tests."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recorder.contents.samples import Samples
from rig.base import wire
from rig.channels.table import Group, default_table

RATE_HZ = 20_000
CLEARANCE_MM = 0.926
RADIUS_MM = 0.930
DISK_RATIO = 0.314 / 0.197
WALL_S = 1.79e9
SIMULATED = "simulated_time"
WALL = "wall_time"


class Synthetic:
    """Free for the first third, then a hammer impact and a whirl at `whirl_hz`; has the interface of a `Recording`."""

    def __init__(self, *, duration_s: float = 1.8, whirl_hz: float = -83.0, pace: float = 1.0, seed: int = 3) -> None:
        self.table = default_table()
        self.truth_columns = ("normal_force", "penetration")
        columns = [{"name": name, "unit": "N", "label": name} for name in self.truth_columns]
        self.catalogue: dict[str, Any] = {"truth": {"contact": {"columns": columns, "rate_hz": 2000}}}
        lengths = {
            "ring.clearance": (CLEARANCE_MM, "mm"),
            "shaft.radius": (12.5, "mm"),
            "shaft.arm_ring": (0.197, "m"),
            "shaft.arm_disk": (0.314, "m"),
            "shaft.arm_magnet": (0.391, "m"),
        }
        self.parameters: dict[str, Any] = {
            "set": "test",
            "values": {key: {"value": value, "unit": unit} for key, (value, unit) in lengths.items()},
        }
        self.clock = np.array([[0.0, WALL_S], [duration_s, WALL_S + duration_s / pace]])
        self.hit_s = duration_s / 3.0
        self.times_s = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
        self.z = np.where(
            self.times_s < self.hit_s,
            0.1 * np.exp(2j * math.pi * 6.2 * self.times_s),
            RADIUS_MM * np.exp(2j * math.pi * whirl_hz * self.times_s),
        )
        self.events: list[dict[str, Any]] = [
            self._event("start", 0.0, scene="hammer", seed=7, pace="real-time"),
            self._event("hammer", self.hit_s, force_n=100.0, duration_ms=5.0, direction="x"),
            self._event("warning", self.hit_s + 0.1, text="a block was late"),
            self._event("end", duration_s, reason="completed", rows={}),
        ]
        rng = np.random.default_rng(seed)
        self.force_n = np.where(self.times_s < self.hit_s, 0.0, 523.0)
        pull = self.force_n * np.exp(1j * np.angle(self.z))
        impact = (self.times_s >= self.hit_s) & (self.times_s < self.hit_s + 5e-3)
        half_sine = np.where(impact, 100.0 * np.sin(math.pi * (self.times_s - self.hit_s) / 5e-3), 0.0)
        speed = np.full_like(self.times_s, 6.2)
        noise = {"probes": 1.3e-4, "forces": 0.5, "accelerations": 0.05, "drive": 2e-3, "hammer": 0.04}
        clean = {
            "probes": (DISK_RATIO * self.z.real, DISK_RATIO * self.z.imag, self.z.real, self.z.imag),
            "forces": (3000 + pull.imag / 2, 3000 - pull.imag / 2, 3000 + pull.real / 2, 3000 - pull.real / 2),
            "accelerations": (pull.real / -9, pull.imag / -9, pull.real / -15, pull.imag / -15),
            "drive": (speed, 0.0 * speed),
            "hammer": (half_sine,),
        }
        self.values = {
            name: np.stack(columns, axis=1) + noise[name] * rng.standard_normal((len(self.times_s), len(columns)))
            for name, columns in clean.items()
        }

    def _event(self, name: str, time_s: float, **fields: Any) -> dict[str, Any]:
        return {"event": name, "tick": round(time_s * 1e6), "time_s": time_s, "wall_s": WALL_S + time_s, **fields}

    def samples(self, group: str) -> Samples:
        channels = self.table.groups[group].channels
        return Samples(
            name=group,
            times_s=self.times_s,
            index=np.arange(len(self.times_s)),
            values=self.values[group],
            names=tuple(channel.name for channel in channels),
            units=tuple(channel.unit for channel in channels),
            rate_hz=float(RATE_HZ),
        )

    def truth(self, table: str) -> Samples:
        assert table == "contact"
        times_s = self.times_s[::10]
        return Samples(
            name=table,
            times_s=times_s,
            index=np.arange(len(times_s)),
            values=np.stack((self.force_n[::10], 0.0 * times_s), axis=1),
            names=self.truth_columns,
            units=("N", "m"),
            rate_hz=2000.0,
        )


@dataclass(frozen=True)
class Column:
    """One component of one entity: instants [s] (nan: for all times) and values, one per row."""

    times_s: np.ndarray
    walls_s: np.ndarray
    values: list[Any]


class Saved:
    """The contents of an .rrd file, by entity path and component."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader
        from rerun.error_utils import RerunWarning

        self.timelines: set[str] = set()
        self.columns: dict[tuple[str, str], Column] = {}
        found: dict[tuple[str, str], list[tuple[float, float, Any]]] = {}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "RRD file has no footer", RerunWarning)  # as after a live view
            chunks = RrdReader(path).stream().to_chunks()
        for chunk in chunks:
            self.timelines.update(chunk.timeline_names)
            batch = chunk.to_record_batch()
            names = batch.schema.names
            rows = batch.num_rows
            times_s = self._seconds(batch, SIMULATED) if SIMULATED in names else np.full(rows, math.nan)
            walls_s = self._seconds(batch, WALL) if WALL in names else np.full(rows, math.nan)
            for name in names:
                if ":" in name and not name.startswith("rerun.controls"):
                    values = batch.column(name).to_pylist()
                    rows_found = found.setdefault((str(chunk.entity_path), name), [])
                    rows_found += [
                        (time, wall, value)
                        for time, wall, value in zip(times_s, walls_s, values, strict=True)
                        if value is not None
                    ]
        for key, rows_found in found.items():
            rows_found.sort(key=lambda row: (not math.isnan(row[0]), row[0]))
            times, walls, values = zip(*rows_found, strict=True) if rows_found else ((), (), ())
            self.columns[key] = Column(np.array(times), np.array(walls), list(values))

    @staticmethod
    def _seconds(batch: Any, name: str) -> np.ndarray:
        import pyarrow as pa

        return batch.column(name).cast(pa.int64()).to_numpy(zero_copy_only=False) / 1e9

    @property
    def paths(self) -> set[str]:
        """Entities with data."""
        return {path for path, _ in self.columns}

    def __getitem__(self, key: tuple[str, str]) -> Column:
        return self.columns[key]


def generate_messages(recording: Synthetic, *, block_s: float = 0.01) -> Iterator[list[tuple[str, bytes]]]:
    """Yield the messages of a rig for a recording: keys and payloads, a list for each block time."""
    rows = round(block_s * RATE_HZ)
    counts = {name: _counts(group, recording.values[name]) for name, group in recording.table.groups.items()}
    events = sorted(recording.events, key=lambda event: event["time_s"])
    truth = recording.truth("contact").values
    for number in range(len(recording.times_s) // rows):
        start = number * rows
        tick = round(start * 1e6 / RATE_HZ)
        sent = []
        while events and events[0]["time_s"] <= tick / 1e6:
            sent.append((wire.EVENTS, wire.encode_document(events.pop(0))))
        for name in recording.table.groups:
            block = wire.Block(tick, start, float(RATE_HZ), 1e6, counts[name][start : start + rows])
            sent.append((wire.sensor_key(name), wire.encode_block(block)))
        true = wire.Block(tick, start // 10, 2000.0, 1e6, truth[start // 10 : (start + rows) // 10])
        sent.append((wire.truth_key("contact"), wire.encode_block(true)))
        yield sent
    yield [(wire.EVENTS, wire.encode_document(event)) for event in events]


def _counts(group: Group, values: np.ndarray) -> np.ndarray:
    scale = np.array([channel.scale for channel in group.channels])
    offset = np.array([channel.offset for channel in group.channels])
    return np.round((values - offset) / scale).astype(np.int32)


def make_replies(recording: Synthetic) -> dict[str, bytes]:
    """Return the replies to the rig's queries."""
    table = recording.table.model_dump(mode="json")
    catalogue = {"root": "rig", "tick_rate_hz": 1e6, "table": table, **recording.catalogue}
    return {
        wire.CATALOGUE: wire.encode_document(catalogue),
        wire.PARAMETERS: wire.encode_document(recording.parameters),
        wire.SCENE: wire.encode_document({"name": "synthetic"}),
    }
