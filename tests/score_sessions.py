"""Sessions of a population of DAQs: short recordings of all kinds of scenes, and the adjacent samples of the run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

import rig
from recorder.writer import RecordingWriter
from rig.base.wire import CATALOGUE, PARAMETERS, SCENE, Block, encode_block, sensor_key
from rig.channels.generators import VoltageSource
from rig.channels.table import Channel, ChannelTable, default_table
from rig.run.scenes import Scene, load_scene, scene_document
from tests.unit.recorder_stream import TICK_RATE_HZ, make_documents

RATE_HZ = 20_000
PHYSICS_S = 8.0
"""Duration of a run of the model, of which a session is a part [s]."""
GROUPS = {
    "two": ("probes",),
    "eight": ("probes", "forces"),
    "all": ("probes", "forces", "accelerations", "drive", "hammer"),
}
SCENES = {
    "test-prbs": {}, "test-sine": {}, "test-two-tone": {}, "test-multisine": {},
    "test-chirp": {"generator.period_s": 0.7}, "test-whirl": {}, "hammer": {}, "stable-run": {},
    "alias": {"generator.frequencies": [79.0, 7001.0]},
    "slow-prbs": {"generator.frequency_hz": 1250.0, "generator.seed": 77},
}  # fmt: skip
"""Differences from a scene of the rig, by kind of session."""
_SCENE_OF = {"alias": "test-two-tone", "slow-prbs": "test-prbs"}
FORMULAS = ("test-sine", "test-two-tone", "test-multisine", "test-chirp", "test-whirl", "alias")
"""Kinds of session whose signal is known between samples."""
_HALF_TAPS = 64


@cache
def make_scene(kind: str) -> Scene:
    """Return the scene of a kind of session."""
    return load_scene(_SCENE_OF.get(kind, kind), {"duration_s": PHYSICS_S, **SCENES[kind]})


@cache
def _physics_volts(kind: str, seed: int) -> dict[str, np.ndarray]:
    """Return the noise-free inputs of the converters in a run of the model [V], by channel."""
    force = 80.0 + 15.0 * (seed % 5)
    changes = {"drive.speed_hz": 5.0 + 0.3 * (seed % 7)} if kind == "stable-run" else {}
    scene = load_scene(kind, {"duration_s": PHYSICS_S, "sensors.noise": False, **changes})
    if kind == "hammer":
        hits = [c.model_copy(update={"at_s": 2.0 + c.at_s}) for c in scene.commands]
        hits = [c.model_copy(update={"request": c.request.model_copy(update={"force_n": force})}) for c in hits]
        scene = scene.model_copy(update={"commands": tuple(hits)})
    run = rig.simulate(scene)
    channels = run.table.channels
    return {name: run.counts[name].astype(float) * channels[name].lsb_v for name in channels}


def make_table(bits: int, groups: Sequence[str]) -> ChannelTable:
    """Return the rig's channel table with some of its groups and converters of another width."""
    document = default_table().model_dump(mode="json")
    document["groups"] = {name: document["groups"][name] for name in groups}
    for group in document["groups"].values():
        for channel in group["channels"]:
            channel["adc_bits"] = bits
    return ChannelTable.model_validate(document)


@dataclass
class Sent:
    """One session.

    Attributes:
        kind: A key of `SCENES`.
        seed: Of the run and of its noise.
        table: Its channels.
        noisy: Whether its samples have the channels' noise.
        path: The recording.
        first, rows: Number of its first row, and of its rows.
        counts: Its samples, int64, shape (rows, channels).
    """

    kind: str
    seed: int
    table: ChannelTable
    noisy: bool
    path: Path
    first: int
    rows: int
    counts: np.ndarray = field(init=False)
    _sources: dict[str, VoltageSource] = field(init=False)

    def __post_init__(self) -> None:
        self._sources = make_scene(self.kind).sources() if self.generated else {}
        self.counts = self.sent(self.first, self.rows)

    @property
    def generated(self) -> bool:
        """True if a test signal replaces the model."""
        return make_scene(self.kind).generator is not None

    @property
    def channels(self) -> list[Channel]:
        """Its channels, in the order of the columns."""
        return list(self.table.channels.values())

    def clean(self, first: int, rows: int) -> np.ndarray:
        """Return noise-free volts of rows of the run, extended at its ends, shape (rows, channels)."""
        numbers = np.arange(first, first + rows)
        if self.generated:
            return np.column_stack([self._sources[c.name].volts(numbers / RATE_HZ) for c in self.channels])
        whole = _physics_volts(self.kind, self.seed)
        at = np.clip(numbers, 0, len(next(iter(whole.values()))) - 1)
        return np.column_stack([whole[c.name][at] for c in self.channels])

    def sent(self, first: int, rows: int) -> np.ndarray:
        """Return counts of rows of the run, the same on every call, int64, shape (rows, channels)."""
        volts = self.clean(first, rows)
        if self.noisy:
            part, parts = 1 << 14, []
            for block in range(first // part, (first + rows - 1) // part + 1):  # each row always has the same noise
                parts.append(np.random.default_rng([self.seed, block + 1000]).standard_normal((part, volts.shape[1])))
            begin = first - first // part * part
            volts += np.concatenate(parts)[begin : begin + rows] * [c.noise_v for c in self.channels]
        return self.quantised(volts)

    def quantised(self, volts: np.ndarray) -> np.ndarray:
        """Return the counts of volts, limited to the converters, int64, shape (rows, channels)."""
        ends = np.array([1 << (c.adc_bits - 1) for c in self.channels])
        return np.clip(np.rint(volts / [c.lsb_v for c in self.channels]), -ends, ends - 1).astype(np.int64)

    def volts(self, name: str, times_s: np.ndarray) -> np.ndarray:
        """Return one channel's noise-free volts at any times of the run [s], shape (n,).

        Uses the formula of a test signal without jumps, otherwise a windowed sinc between the samples.
        """
        channel = self.table.channels[name]
        if self.kind in FORMULAS:
            return np.clip(self._sources[name].volts(times_s), -channel.adc_v, channel.adc_v)
        place = times_s * RATE_HZ
        low = int(place.min()) - _HALF_TAPS - 1
        column = [c.name for c in self.channels].index(name)
        rows = self.clean(low, int(place.max()) + _HALF_TAPS + 2 - low)[:, column]
        if self.kind.endswith("prbs"):  # its jumps have much above 97 % of half of the rate, which interpolation loses
            from replays.score.records.stimulus import EDGE, Sampled

            wide = self.clean(low - EDGE, len(rows) + 2 * EDGE)[:, column]
            return Sampled(wide, (low - EDGE) / RATE_HZ, RATE_HZ)(times_s)[0]
        return _between(rows, place - low)


def _between(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return a band-limited signal between its samples, by a sinc with a Blackman-Harris window."""
    found = np.empty(len(places))
    taps = np.arange(1 - _HALF_TAPS, _HALF_TAPS + 1)
    for begin in range(0, len(places), 1 << 14):
        part = places[begin : begin + (1 << 14)]
        whole = np.floor(part).astype(np.int64)
        apart = (part - whole)[:, None] - taps
        angle = np.pi * (1.0 + apart / _HALF_TAPS)
        window = 0.35875 - 0.48829 * np.cos(angle) + 0.14128 * np.cos(2.0 * angle) - 0.01168 * np.cos(3.0 * angle)
        found[begin : begin + len(part)] = np.sum(values[whole[:, None] + taps] * np.sinc(apart) * window, axis=1)
    return found


def write_counts(path: Path, sent: Sent, counts: np.ndarray, first: int) -> Path:
    """Write counts as a recording of the session's scene, starting at a row of the run."""
    document = make_documents()
    document[CATALOGUE]["table"] = sent.table.model_dump(mode="json")
    scene = make_scene(sent.kind)
    scene = scene.model_copy(update={"sensors": scene.sensors.model_copy(update={"noise": sent.noisy})})
    document[SCENE] = {"name": scene.name, "seed": sent.seed, "scene": scene_document(scene)}
    writer = RecordingWriter(
        path, catalogue=document[CATALOGUE], parameters=document[PARAMETERS], scene=document[SCENE]
    )
    size, column = RATE_HZ // 100, 0
    spans = {}
    for name, group in sent.table.groups.items():
        spans[name] = slice(column, column := column + len(group.channels))
    for start in range(0, len(counts), size):
        tick = (first + start) * TICK_RATE_HZ // RATE_HZ
        for name, span in spans.items():
            part = counts[start : start + size, span].astype(np.int32)
            block = Block(tick, first + start, float(RATE_HZ), float(TICK_RATE_HZ), part)
            writer.write(sensor_key(name), encode_block(block), 1_700_000_000_000_000_000 + tick * 1000)
    writer.finish("completed")
    return path


class Sessions:
    """Sessions of a population, each created on first use, in a folder that is reused."""

    def __init__(self, folder: Path) -> None:
        """Set the folder."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._made = folder, dict[tuple, Sent]()

    def get(
        self, kind: str, *, seed: int = 1, groups: str = "two", bits: int = 24, noisy: bool = True,
        first_s: float = 2.0, seconds: float = 2.0,
    ) -> Sent:  # fmt: skip
        """Return a session of a kind of scene, with groups of channels and a part of its run."""
        key = kind, seed, groups, bits, noisy, first_s, seconds
        if key not in self._made:
            path = self._folder / f"{'-'.join(map(str, key))}.mcap"
            table = make_table(bits, GROUPS[groups])
            first, rows = round(first_s * RATE_HZ), round(seconds * RATE_HZ)
            sent = Sent(kind, seed, table, noisy, path, first, rows)
            if not path.exists():
                write_counts(path, sent, sent.counts, first)
            self._made[key] = sent
        return self._made[key]
