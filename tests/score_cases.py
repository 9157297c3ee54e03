"""Foreign records and perfect DAQs of a population; the number of a case determines all of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tests.score_files import COUNT_FORMATS, FORMATS, WRITERS, write_samples, write_values
from tests.score_sessions import RATE_HZ, Sent, Sessions

Generator = np.random.Generator
CYCLE = (
    "test-prbs",
    "test-sine",
    "test-two-tone",
    "test-multisine",
    "test-chirp",
    "test-whirl",
    "hammer",
    "stable-run",
)


@dataclass
class Case:
    """One record of a DAQ.

    Attributes:
        label: Name of the case.
        file: The DAQ's file.
        sent: The session to compare it with.
        path: The requested path; None: detected from the file.
        right: Quantities; at least one must fail, unless this is empty.
        allowed: Further quantities that the defect changes.
        judged: Further arguments of `replays.score.judgement.judge`.
    """

    label: str
    file: Path
    sent: Sent
    path: Any = None
    right: frozenset[str] = frozenset()
    allowed: frozenset[str] = frozenset()
    judged: dict[str, Any] = field(default_factory=dict)


# Columns of a DAQ's file.


def convert_counts(sent: Sent, counts: np.ndarray, unit: str) -> dict[str, tuple[str, np.ndarray]]:
    """Return columns of counts, as engineering values, volts or counts, by name."""
    found = {}
    for n, channel in enumerate(sent.channels):
        column = counts[:, n]
        if unit == "counts":
            found[channel.name] = "", column.astype(np.int64)
        elif unit == "V":
            found[channel.name] = "V", column * channel.lsb_v
        else:
            found[channel.name] = channel.unit, column * channel.scale + channel.offset
    return found


@dataclass
class Converter:
    """A DAQ that samples by its own clock; values by channel are one number, or one per channel.

    Attributes:
        begin_s: Time of the run at its first sample [s].
        rows: Samples.
        rate_hz: Nominal rate [Hz].
        ppm, drift_ppm_s: Error of its clock and the drift of that error [ppm, ppm/s].
        gain, offset_v, skew_s, noise: Of the channels; noise as a multiple of the calibrated one.
        jitter_s: rms of all sampling instants [s].
        idle_s: Until this time of the run the input is the bias only [s].
    """

    begin_s: float
    rows: int
    rate_hz: float = float(RATE_HZ)
    ppm: float = 0.0
    drift_ppm_s: float = 0.0
    gain: Any = 1.0
    offset_v: Any = 0.0
    skew_s: Any = 0.0
    noise: Any = 1.0
    jitter_s: float = 0.0
    idle_s: float = -1e9

    def volts(self, sent: Sent, generator: Generator, signal: Callable[..., np.ndarray] | None = None) -> np.ndarray:
        """Return the recorded volts, shape (rows, channels); `signal` replaces the session's."""
        own_s = np.arange(self.rows) / self.rate_hz
        middle = own_s - 0.5 * own_s[-1]
        true_s = self.begin_s + own_s / (1.0 + 1e-6 * self.ppm) - 0.5e-6 * self.drift_ppm_s * middle**2
        shake = self.jitter_s * generator.standard_normal(self.rows) if self.jitter_s else 0.0
        count = len(sent.channels)
        gain, offset, skew, noise = (
            np.broadcast_to(each, count) for each in (self.gain, self.offset_v, self.skew_s, self.noise)
        )
        found = np.empty((self.rows, count))
        for n, channel in enumerate(sent.channels):
            at_s = true_s + skew[n] + shake
            values = (signal or sent.volts)(channel.name, at_s) - channel.bias_v
            values = np.where(true_s < self.idle_s, 0.0, values) * gain[n] + channel.bias_v + offset[n]
            values = values + noise[n] * channel.noise_v * generator.standard_normal(self.rows)
            found[:, n] = np.rint(values / channel.lsb_v) * channel.lsb_v
        return found


def make_columns(sent: Sent, volts: np.ndarray, unit: str) -> dict[str, tuple[str, np.ndarray]]:
    """Return columns of volts, unchanged or in the channels' units."""
    return {
        c.name: ("V", volts[:, n]) if unit == "V" else (c.unit, (volts[:, n] - c.bias_v) / c.sensitivity_v)
        for n, c in enumerate(sent.channels)
    }


# Perfect DAQs.


def make_perfect_case(number: int, seed: int, sessions: Sessions, stem: Path) -> Case:
    """Return a DAQ without a defect."""
    g = np.random.default_rng([seed, 2, number])
    form = FORMATS[number % len(FORMATS)]
    kind = CYCLE[(number // len(FORMATS) + number) % len(CYCLE)]
    bits = int(g.choice([12, 14, 16, 18, 20, 24, 24, 24, 32]))
    bits = min(bits, 24) if form in ("candump", "asc", "blf") else bits  # the limit of its frames
    digital = form in COUNT_FORMATS or bool(number % 2)
    groups = str(g.choice(["two", "eight", "all"], p=[0.7, 0.2, 0.1]))
    groups = "all" if form == "asc" else groups  # a classic frame has channels of several groups
    physics = kind in ("hammer", "stable-run")
    sent = sessions.get(
        kind, seed=seed, groups=groups, bits=bits, noisy=digital or bool(g.random() < 0.7),
        first_s=2.0 if physics else 61.0, seconds=2.0,
    )  # fmt: skip
    length_s = float(np.exp(g.uniform(np.log(0.5), np.log(1.8))))
    way = str(g.choice(["inside", "going-on", "idle", "past-the-end"], p=[0.4, 0.25, 0.2, 0.15]))
    most_s = 1.9 if physics and way == "going-on" else 60.0
    most_s = most_s if form in ("parquet", "mdf", "tdms", "uff", "wav", "mcap") else min(3.0, most_s)
    early_s = float(np.exp(g.uniform(np.log(0.02), np.log(most_s)))) if way in ("going-on", "idle") else 0.0
    first = sent.first + int(g.integers(0, sent.rows - round(length_s * RATE_HZ)))
    rows = round(length_s * RATE_HZ)
    if way in ("going-on", "idle"):
        first, rows = sent.first - round(early_s * RATE_HZ), rows + round(early_s * RATE_HZ)
    if way == "past-the-end":
        first = sent.first + sent.rows - rows
        rows += int(g.integers(10, 2 * RATE_HZ))
    label = (
        f"{kind} {form} {'digital' if digital else 'analogue'} {bits} bit {way} {early_s:.2f}+{length_s:.2f} s {groups}"
    )
    stamps = bool(g.random() < 0.7)
    if digital:
        counts = sent.sent(first, rows)
        if way == "idle":
            still = sent.first - first
            bias = np.array([c.bias_v for c in sent.channels])
            quiet = bias + g.standard_normal((still, len(bias))) * [c.noise_v for c in sent.channels]
            counts[:still] = sent.quantised(quiet)
        if form in COUNT_FORMATS:
            return Case(label, write_samples(form, stem, sent, counts, first), sent)
        unit = str(g.choice(["unit", "V", "counts"]))
        times = np.arange(rows) / RATE_HZ if stamps else None
        return Case(
            f"{label} {unit}", write_values(form, stem, convert_counts(sent, counts, unit), times, RATE_HZ), sent
        )
    rate = float(g.choice([20e3, 20e3, 25.6e3, 48e3])) if rows < 10 * RATE_HZ else 20e3
    box = Converter(
        (first + g.random()) / RATE_HZ, round(rows * rate / RATE_HZ), rate, ppm=float(g.uniform(-150.0, 150.0)),
        idle_s=sent.first / RATE_HZ if way == "idle" else -1e9,
    )  # fmt: skip
    unit = str(g.choice(["unit", "V"]))
    columns, times = make_columns(sent, box.volts(sent, g), unit), np.arange(box.rows) / rate
    label += f" {unit} {rate:g} Hz {'noisy' if sent.noisy else 'clean'} session"
    return Case(label, write_values(form, stem, columns, times, rate), sent)


# Foreign records.


def _noise(g: Generator, rows: int, count: int) -> np.ndarray:
    colour = g.integers(3)
    white = g.standard_normal((rows, count))
    return white if colour == 0 else np.cumsum(white, axis=0) if colour == 1 else np.diff(white, axis=0, prepend=0.0)


def _machine(g: Generator, rows: int, count: int) -> np.ndarray:
    """Return signals of another machine, different on every channel."""
    t, kind = np.arange(rows) / RATE_HZ, g.integers(4)
    found = []
    for _ in range(count):
        hz, phase = g.uniform(0.8, 1500.0), g.uniform(0.0, 6.28)
        wave = np.sin(2 * np.pi * hz * t + phase)
        if kind == 1:
            wave = np.sign(wave)
        elif kind == 2:  # as an ECG: one sharp wave per beat, and two slow ones
            beat = (t * g.uniform(0.8, 3.0) + phase) % 1.0
            wave = sum(
                a * np.exp(-(((beat - at) / w) ** 2))
                for a, at, w in ((1, 0.5, 0.01), (0.2, 0.3, 0.04), (0.3, 0.8, 0.06))
            )
        elif kind == 3:
            wave = np.sin(2 * np.pi * (hz + 300.0 * t) * t) * np.exp(-((t % 0.3) / 0.05))
        found.append(wave + 0.01 * g.standard_normal(rows))
    return np.column_stack(found)


FOREIGN = (
    "noise", "twelve numbers", "another seed", "another scene", "another machine", "shifted channels", "permuted rows",
    "half missing", "noise of the session", "reversed", "constant", "single column", "squared",
)  # fmt: skip


def make_foreign_case(number: int, seed: int, sessions: Sessions, stem: Path) -> Case:
    """Return a record that differs from the session with which it is compared."""
    g = np.random.default_rng([seed, 1, number])
    kind, label = CYCLE[number // len(FOREIGN) % len(CYCLE)], FOREIGN[number % len(FOREIGN)]
    if label == "reversed" and kind in ("test-sine", "test-two-tone"):
        label = "permuted rows"  # tones in reverse are the same tones
    sent = sessions.get(kind, seed=seed)
    count, rows = len(sent.channels), int(np.exp(g.uniform(np.log(500), np.log(30_000))))
    first = sent.first + int(g.integers(0, sent.rows - rows))
    times: np.ndarray | None = np.arange(rows) / RATE_HZ
    own = sent.clean(first, rows) if g.random() < 0.5 else sent.sent(first, rows) * [c.lsb_v for c in sent.channels]
    bias = np.array([c.bias_v for c in sent.channels])
    if label == "noise":
        volts = bias + _noise(g, rows, count)
    elif label == "twelve numbers":
        volts = g.standard_normal((12, count))
        times = np.arange(12.0)
    elif label == "another seed":
        other = {"test-prbs": "slow-prbs", "hammer": "hammer"}.get(kind, "slow-prbs")
        sent = sessions.get({"hammer": "hammer"}.get(kind, "test-prbs"), seed=seed)
        strange = sessions.get(other, seed=seed + 1)
        volts = strange.sent(sent.first, rows) * [c.lsb_v for c in sent.channels]
    elif label == "another scene":
        strange = sessions.get(CYCLE[(CYCLE.index(kind) + 1 + int(g.integers(len(CYCLE) - 1))) % len(CYCLE)], seed=seed)
        volts = strange.sent(strange.first + 11, rows) * [c.lsb_v for c in sent.channels]
    elif label == "another machine":
        volts = bias + _machine(g, rows, count)
    elif label == "shifted channels":
        apart = np.cumsum(g.integers(7, 400, count)) - 7
        volts = np.column_stack([sent.sent(first + int(s), rows)[:, n] for n, s in enumerate(apart)])
        volts = volts * [c.lsb_v for c in sent.channels]
    elif label == "permuted rows":
        volts = own[g.permutation(rows)]
    elif label == "half missing":
        cut = slice(rows // 4, rows // 4 + rows // 2)
        volts = np.delete(own, cut, axis=0)
        times = np.delete(times, cut) if g.random() < 0.5 else times[: len(volts)]
    elif label == "noise of the session":
        volts = bias + g.standard_normal((rows, count)) * [c.noise_v for c in sent.channels]
    elif label == "reversed":
        volts = own[::-1]
    elif label == "constant":
        volts = np.tile(own[:1], (rows, 1))
    elif label == "single column":
        volts = _noise(g, rows, 1)
    else:
        volts = bias + (own - bias) ** 2
    if times is not None and g.random() < 0.3 and label not in ("twelve numbers", "half missing"):
        times = None
    named = g.random() < 0.7
    units = str(g.choice(["V", "unit", ""]))
    columns = {}
    for n in range(volts.shape[1]):
        channel = sent.channels[n]
        values = volts[:, n] if units != "unit" else (volts[:, n] - channel.bias_v) / channel.sensitivity_v
        columns[channel.name if named and label != "single column" else f"ai{n}"] = (
            {"unit": channel.unit}.get(units, units),
            values,
        )
    form = str(g.choice(list(WRITERS)))
    form = "parquet" if form in ("tdms", "uff") and times is None else form
    text = f"{label}, {kind}, {rows} rows, {form}, {'own names' if named else 'other names'}, unit {units or 'none'}"
    return Case(text, write_values(form, stem, columns, times, RATE_HZ), sent)
