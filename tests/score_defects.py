"""DAQs with one defect each, derived from the case's number, with the quantities that must fail and that may fail."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.score_cases import CYCLE, Case, Converter, convert_counts, make_columns
from tests.score_files import WRITERS, write_values
from tests.score_sessions import FORMULAS, RATE_HZ, Sent, Sessions

_RESIDUE = frozenset({"noise", "effective bits", "dynamic range", "SINAD", "ENOB", "SFDR"})
"""Quantities of the residual after the known signal: all that is not linear and constant in time affects them."""
_LOSS = frozenset({"lost samples", "doubled samples", "missing samples"})
_ABSENCE_ROWS = frozenset(
    {"mapping", "channel", "channels", "recorded", "missing channel", "missing channels", "presence"}
)
_ROWS, _BEGIN_ROWS = 14_000, 900
"""Samples of a DAQ with its own clock, and rows of the session before its first."""
Signal = Callable[[str, np.ndarray], np.ndarray]

DIGITAL_DEFECTS = (
    "lost rows", "doubled rows", "swapped rows", "altered values", "gain", "offset", "swapped channels", "inverted",
    "stuck bit", "delayed channel", "missing channel", "foreign rows",
)  # fmt: skip
ANALOGUE_DEFECTS = (
    "gain", "offset", "skew", "clock", "clock drift", "noise", "jitter", "lost sample", "doubled sample", "corner",
    "THD", "alias rejection", "polarity", "mapping", "missing channel",
)  # fmt: skip


def make_defect_case(number: int, seed: int, sessions: Sessions, stem: Path, base: Callable[[Case], Any]) -> Case:
    """Return a DAQ with one defect.

    Args:
        number: Of the case; even ones record counts, odd ones sample by their own clock.
        seed: Of the population.
        sessions: The sessions.
        stem: Of the file.
        base: Returns the scorecard of a case without a defect, for half widths.
    """
    if number % 2:
        return _analogue(number // 2, seed, sessions, stem, base)
    return _digital(number // 2, seed, sessions, stem)


def _digital(number: int, seed: int, sessions: Sessions, stem: Path) -> Case:
    g = np.random.default_rng([seed, 3, number])
    what = DIGITAL_DEFECTS[number % len(DIGITAL_DEFECTS)]
    kind = CYCLE[(number // len(DIGITAL_DEFECTS) + number) % len(CYCLE)]
    sent = sessions.get(kind, seed=seed, groups="two" if number % 5 else "eight")
    rows = int(g.integers(12_000, 24_000))
    first = sent.first + int(g.integers(0, sent.rows - rows - 200))
    counts = sent.sent(first, rows)
    channel = int(g.integers(len(sent.channels)))
    other = (channel + 1 + int(g.integers(len(sent.channels) - 1))) % len(sent.channels)
    at, several = int(g.integers(500, rows - 1500)), int(g.choice([1, 1, 2, 200]))
    unit = str(g.choice(["unit", "V", "counts"]))
    allowed: set[str] = set()
    columns: dict[str, Any] | None = None
    if what == "lost rows":
        counts, right = np.delete(counts, np.s_[at : at + several], axis=0), {"missing rows"}
    elif what == "doubled rows":
        counts, right = np.insert(counts, at + several, counts[at : at + several], axis=0), {"doubled rows"}
    elif what == "swapped rows":
        several = min(several, 200)
        order = np.arange(rows)
        order[at : at + 2 * several] = np.roll(order[at : at + 2 * several], several)
        counts, right = counts[order], {"swapped rows"}
    elif what == "altered values":
        spots = at + g.permutation(1000)[: int(g.integers(1, 4))]
        counts[spots, channel] += int(g.choice([-1, 1, 1000]))
        right = {"altered values"}
    elif what in ("gain", "offset"):
        unit = "unit" if unit == "counts" else unit
        columns = convert_counts(sent, counts, unit)
        name = sent.channels[channel].name
        stamps, values = columns[name]
        if what == "gain":
            # A gain about zero volts, or about a value of zero: with a bias it also moves the mean.
            columns[name] = (
                stamps,
                values * (1.0 + float(g.choice([-1, 1])) * 1e-6 * float(np.exp(g.uniform(np.log(0.2), np.log(1000))))),
            )
            right, allowed = {"scale", "altered values"}, {"offset"}
        else:
            size = sent.channels[channel].lsb_v if unit == "V" else sent.channels[channel].scale
            columns[name] = stamps, values + size * int(g.choice([-1, 1])) * round(np.exp(g.uniform(0.0, np.log(1000))))
            right, allowed = {"offset", "altered values"}, set()
    elif what == "swapped channels":
        columns = convert_counts(sent, counts, unit)
        a, b = sent.channels[channel].name, sent.channels[other].name
        columns[a], columns[b] = (columns[a][0], columns[b][1]), (columns[b][0], columns[a][1])
        # Swapped channels of different sensitivity also have each other's scale.
        right, allowed = {"mapping"}, {"scale", "offset"} if unit == "unit" else set()
    elif what == "inverted":
        unit = "unit" if unit == "counts" else unit
        columns = convert_counts(sent, counts, unit)
        name = sent.channels[channel].name
        columns[name] = columns[name][0], -columns[name][1]
        right, allowed = {"polarity"}, {"offset"}
    elif what == "stuck bit":
        bit = int(g.integers(0, 16))
        counts[:, channel] |= 1 << bit
        # A bit that is always set moves the mean, from which a scale is estimated.
        right, allowed = {"altered values"}, {"offset", "scale"}
    elif what == "delayed channel":
        counts[:, channel] = sent.sent(first - int(g.integers(1, 100)), rows)[:, channel]
        right = {"altered values"}
    elif what == "missing channel":
        columns = convert_counts(sent, counts, unit)
        del columns[sent.channels[channel].name]
        right = set(_ABSENCE_ROWS)
    else:
        strange = np.rint(np.std(counts, axis=0) * g.standard_normal((several, len(sent.channels)))).astype(np.int64)
        if g.random() < 0.5:
            counts, right = np.insert(counts, at, strange, axis=0), {"foreign rows", "altered values"}
        else:
            counts[at : at + several] = strange
            right = {"foreign rows", "altered values"}
    columns = convert_counts(sent, counts, unit) if columns is None else columns
    if what in ("lost rows", "doubled rows", "foreign rows"):
        # Stamps that count the DAQ's own rows jump relative to the session's, by 10 ms per second.
        allowed = {"stamp rate"}
    length = len(next(iter(columns.values()))[1])
    # Rows that a DAQ loses are also missing from its own count of time, or not.
    times = np.arange(length) / RATE_HZ if g.random() < 0.7 else None
    form = str(g.choice([each for each in WRITERS if times is not None or each not in ("tdms", "uff", "mdf")]))
    text = f"digital {what}, {kind}, {form}, {unit}, {sent.channels[channel].name}, {several} at {at}"
    return Case(
        text, write_values(form, stem, columns, times, RATE_HZ), sent, None, frozenset(right), frozenset(allowed)
    )


def _tones_through(sent: Sent, corner_hz: float, order: int) -> Callable[[str, np.ndarray], np.ndarray]:
    """Return the signal of `test-multisine`, whose tones are multiples of 257 Hz, after a Butterworth low-pass."""
    base_hz, n = 257.0, 512
    poles = np.exp(1j * np.pi * (2.0 * np.arange(1, order + 1) + order - 1.0) / (2.0 * order))

    def volts(name: str, times_s: np.ndarray) -> np.ndarray:
        lines = np.fft.rfft(sent.volts(name, np.arange(n) / (n * base_hz))) / n
        found = np.full(len(times_s), lines[0].real)
        for k in range(1, 34):
            if abs(lines[k]) > 1e-9:
                part = 2.0 * lines[k] / np.prod(1.0 - 1j * k * base_hz / corner_hz / poles)
                phase = 2.0 * np.pi * k * base_hz * times_s
                found += part.real * np.cos(phase) - part.imag * np.sin(phase)
        return found

    return volts


def _one_channel(sent: Sent, name: str, changed: Signal) -> Signal:
    """Return the session's signal with one channel replaced."""
    return lambda channel, times_s: (changed if channel == name else sent.volts)(channel, times_s)


def _folding(sent: Sent, part: Callable[[str], float]) -> Signal:
    """Return the two tones of the session `alias`; of the upper one, a part remains on each channel."""

    def volts(channel: str, times_s: np.ndarray) -> np.ndarray:
        low = sent.table.channels[channel].bias_v + 2.0 * np.sin(2.0 * np.pi * 79.0 * times_s)
        return low + part(channel) * (sent.volts(channel, times_s) - low)

    return volts


def _with_harmonic(sent: Sent, harmonic: int, amplitude_v: float) -> Signal:
    return lambda channel, times_s: (
        sent.volts(channel, times_s) + amplitude_v * np.sin(2.0 * np.pi * 997.0 * harmonic * times_s + 0.4)
    )


_KINDS = {
    "corner": ("test-multisine",), "THD": ("test-sine",), "alias rejection": ("alias",),
    "jitter": ("test-two-tone", "test-multisine"), "noise": FORMULAS[:4], "mapping": ("test-whirl",),
    "polarity": ("test-whirl", "test-chirp"),
}  # fmt: skip
"""Sessions that show a quantity, if not all of the first five do."""
_CONSEQUENCES: dict[str, frozenset[str]] = {
    # Over the record the clock's error is not constant, and the ends' instants are off the line by microseconds.
    "clock drift": frozenset({"clock", "jitter"}) | _RESIDUE,
    "noise": _RESIDUE,
    # Errors of instants become errors in volts.
    "jitter": _RESIDUE,
    # From there on all is one sample late: a line through the time is tilted, and the residual grows with the slope.
    "lost sample": frozenset({"clock", "clock drift", "jitter"}) | _RESIDUE,
    "doubled sample": frozenset({"clock", "clock drift", "jitter"}) | _RESIDUE,
    # A harmonic was not sent.
    "THD": frozenset({"jitter"}) | _RESIDUE,
    # A folded tone was not sent below half of the rate.
    "alias rejection": _RESIDUE | {"THD"},
    # Probes of another sensitivity have another gain, bias and noise in millimetres.
    "mapping": frozenset({"gain", "offset"}) | _RESIDUE,
}
"""Further quantities that fail by a defect of a DAQ with its own clock, with the reason."""


def _beyond(what: str, sent: Sent, channel: str, rate: float, stem: Path, base: Callable[[Case], Any]) -> np.ndarray:
    """Return the limit of a quantity plus half the interval of a DAQ without a defect, in its unit."""
    generator = np.random.default_rng(5)
    rows = int(_ROWS * rate / RATE_HZ)
    volts = Converter((sent.first + _BEGIN_ROWS + 0.4) / RATE_HZ, rows, rate, ppm=20.0).volts(sent, generator)
    stem = stem.with_name(f"base-{sent.kind}")
    file = write_values("parquet", stem, make_columns(sent, volts, "V"), np.arange(rows) / rate, rate)
    card = base(Case(f"base {sent.kind}", file, sent, "analogue"))
    for row in card.rows:
        if row.quantity == what and (row.channel in (channel, "") or what == "skew") and row.limit is not None:
            half = 0.5 * (row.high - row.low)
            return np.array([row.limit.high, half if np.isfinite(half) else 0.0])
    raise AssertionError(f"{what} of {sent.kind} has no limit")


def _analogue(number: int, seed: int, sessions: Sessions, stem: Path, base: Callable[[Case], Any]) -> Case:
    g = np.random.default_rng([seed, 4, number])
    what, turn = ANALOGUE_DEFECTS[number % len(ANALOGUE_DEFECTS)], number // len(ANALOGUE_DEFECTS)
    kinds = _KINDS.get(what, FORMULAS[:5])
    sent = sessions.get(kinds[turn % len(kinds)], seed=seed)
    rate = RATE_HZ / 2.0 if sent.kind == "alias" else float(RATE_HZ)
    count, one = len(sent.channels), int(g.integers(len(sent.channels)))
    channel, only = sent.channels[one], np.eye(count)[one]
    name, sign, halves = channel.name, float(g.choice([-1.0, 1.0])), float(g.uniform(2.0, 6.0))
    begin_s = (sent.first + _BEGIN_ROWS + float(g.random())) / RATE_HZ
    box = Converter(begin_s, int(_ROWS * rate / RATE_HZ), rate, ppm=float(g.uniform(-100.0, 100.0)))
    signal: Signal = sent.volts
    if sent.kind == "alias":
        part = 10.0 ** (-(60.0 - float(g.uniform(3.0, 25.0))) / 20.0)
        signal = _folding(sent, lambda each: part if each == name else 1e-4)

    def beyond(quantity: str, of: str = name, times: float = 1.0) -> float:
        """Return the limit plus `times` half widths."""
        limit, half = _beyond(quantity, sent, of, rate, stem, base)
        return float(limit + times * halves * half)

    if what == "gain":
        box.gain = 1.0 + only * sign * 1e-6 * beyond("gain")
    elif what == "offset":
        box.offset_v = only * sign * beyond("offset") * channel.sensitivity_v
    elif what == "skew":
        box.skew_s = only * sign * 1e-9 * beyond("skew", sent.channels[2].name, 1.5)
    elif what == "clock":
        box.ppm = sign * beyond("clock", "")
    elif what == "clock drift":
        box.drift_ppm_s = sign * float(g.uniform(20.0, 80.0))
    elif what == "noise":
        box.noise = 1.0 + only * (beyond("noise") * abs(channel.sensitivity_v) / channel.noise_v - 1.0)
    elif what == "jitter":
        box.jitter_s = 1e-12 * RATE_HZ * float(g.uniform(5.0, 12.0))
    elif what == "corner":
        corner_hz, order = float(g.uniform(1500.0, 4500.0)), int(g.choice([2, 4, 6]))
        signal = _one_channel(sent, name, _tones_through(sent, corner_hz, order))
    elif what == "THD":
        size = 4.0 * 10.0 ** ((-80.0 + float(g.uniform(1.5, 8.0))) / 20.0)
        signal = _one_channel(sent, name, _with_harmonic(sent, int(g.integers(2, 6)), size))
    elif what == "polarity":
        box.gain = 1.0 - 2.0 * only
    volts = box.volts(sent, g, signal)
    place = len(volts) // 2 + int(g.integers(-len(volts) // 4, len(volts) // 4))
    if what == "lost sample":
        volts = np.delete(volts, place, axis=0)
    elif what == "doubled sample":
        volts = np.insert(volts, place, volts[place], axis=0)
    columns = make_columns(sent, volts, str(g.choice(["V", "unit"])))
    if what == "mapping":
        other = sent.channels[(one + 1) % count].name
        columns[name], columns[other] = (columns[name][0], columns[other][1]), (columns[other][0], columns[name][1])
    elif what == "missing channel":
        del columns[name]
    form = str(g.choice([each for each in WRITERS if each not in ("semicolon", "tab")]))
    file = write_values(form, stem, columns, np.arange(len(volts)) / rate, rate)
    right = {"missing channel": _ABSENCE_ROWS, "lost sample": _LOSS, "doubled sample": _LOSS}.get(
        what, frozenset({what})
    )
    text = f"analogue {what}, {sent.kind}, {form}, {name}, x{halves:.1f}"
    return Case(text, file, sent, "analogue", right, _CONSEQUENCES.get(what, frozenset()))
