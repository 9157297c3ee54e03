"""Synthetic DAQs under test: sessions of known signals, and the records of each kind of DAQ."""

from __future__ import annotations

from copy import copy
from pathlib import Path

import numpy as np

from recorder.writer import RecordingWriter
from rig.base.wire import CATALOGUE, PARAMETERS, SCENE, Block, encode_block, sensor_key
from rig.channels.table import default_table
from tests.unit.recorder_stream import TICK_RATE_HZ, make_documents

RATE_HZ = 20_000


def write_session(path: Path, groups: dict[str, np.ndarray], *, index: int = 0) -> Path:
    """Write a session of counts by group, each of shape (n, channels), in blocks of 10 ms."""
    document = make_documents()
    writer = RecordingWriter(
        path, catalogue=document[CATALOGUE], parameters=document[PARAMETERS], scene=document[SCENE]
    )
    rows = RATE_HZ // 100
    for start in range(0, max(map(len, groups.values())), rows):
        tick = (index + start) * TICK_RATE_HZ // RATE_HZ
        for group, counts in groups.items():
            if len(part := counts[start : start + rows]):
                block = Block(tick, index + start, float(RATE_HZ), float(TICK_RATE_HZ), part.astype(np.int32))
                writer.write(sensor_key(group), encode_block(block), 1_700_000_000_000_000_000 + tick * 1000)
    writer.finish("completed")
    return path


def make_counts(group: str, values: np.ndarray, generator: np.random.Generator | None) -> np.ndarray:
    """Return counts of engineering values, shape (n, channels), with the channels' noise if there is a generator."""
    channels = default_table().groups[group].channels
    volts = np.column_stack([c.bias_v + c.sensitivity_v * v for c, v in zip(channels, values.T, strict=True)])
    if generator is not None:
        volts += generator.standard_normal(volts.shape) * [c.noise_v for c in channels]
    return np.rint(volts / [c.lsb_v for c in channels]).astype(np.int64)


class Tones:
    """A sum of sines of random frequencies and phases."""

    def __init__(self, seed: int, rms: float, *, low_hz: float = 20.0, high_hz: float = 4e3, tones: int = 25) -> None:
        generator = np.random.default_rng(seed)
        self.hz = generator.uniform(low_hz, high_hz, tones)
        self.parts = rms * np.sqrt(2.0 / tones) * np.exp(2j * np.pi * generator.uniform(0.0, 1.0, tones))

    def __call__(self, t: np.ndarray) -> np.ndarray:
        found = np.zeros(len(t))
        for hz, part in zip(self.hz, self.parts, strict=True):
            phase = 2.0 * np.pi * hz * t
            found += part.real * np.cos(phase) - part.imag * np.sin(phase)
        return found

    def behind(self, corner_hz: float, order: int) -> Tones:
        """Return the tones after an analogue Butterworth low-pass, by the closed form of its poles."""
        poles = np.exp(1j * np.pi * (2.0 * np.arange(1, order + 1) + order - 1.0) / (2.0 * order))
        passed = copy(self)
        passed.parts = self.parts / np.prod(1.0 - 1j * self.hz[:, None] / corner_hz / poles, axis=1)
        return passed


def make_chips(seed: int, seconds: float, *, rate_hz: float = RATE_HZ) -> np.ndarray:
    """Return a pseudo-random binary sequence of 1 and -1 with chips of four rows, shape (n,)."""
    rows = round(seconds * rate_hz)
    return np.repeat(np.random.default_rng(seed).integers(0, 2, rows // 4 + 1) * 2.0 - 1.0, 4)[:rows]


def write_parquet(path: Path, columns: dict[str, np.ndarray]) -> Path:
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table(columns), path)
    return path
