"""Faults of a log: each changes the signals before a recorder's filter or the samples after it.

Times refer to `second_rig.run` with the tests' settings: the hammer pulse is at 0.8 s.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from replays.recordings.validation import Validation
from tests.second_rig import NOISE, Motion

Values = dict[str, np.ndarray]
PROBES, FORCES = ("disk_x", "disk_y", "ring_x", "ring_y"), ("P_N", "P_S", "P_E", "P_W")
HOUSINGS = ("inner_x", "inner_y", "outer_x", "outer_y")


@dataclass(frozen=True)
class Case:
    """One fault.

    Attributes:
        name: Name of the fault.
        pattern: Pattern that a finding must match.
        ppm: Clock error of the recorder [ppm]; positive: fast.
        analog: Changes signals before the recorder's filter; also receives their rate [Hz].
        digital: Changes times and samples after it.
    """

    name: str
    pattern: str
    ppm: float = 80.0
    analog: Callable[[Values, float], Values] | None = None
    digital: Callable[[np.ndarray, Values], tuple[np.ndarray, Values]] | None = None

    def signals(self, values: Values, motion: Motion) -> Values:
        """Return the input of the recorder's filters."""
        return values if self.analog is None else self.analog(dict(values), motion.rate_hz)

    def samples(self, own_s: np.ndarray, values: Values) -> tuple[np.ndarray, Values]:
        """Return the recorded samples."""
        return (own_s, values) if self.digital is None else self.digital(own_s, dict(values))

    def named_by(self, found: Validation) -> bool:
        """Return whether a validation names the fault."""
        messages = (
            [one.line for one in found.faults]
            + found.beyond
            + ([found.explained.conclusion] if found.explained else [])
        )
        return not found.good and any(re.search(self.pattern, one) for one in messages)


def _gain(names: tuple[str, ...], factor: float, offset: float = 0.0) -> Callable[[Values, float], Values]:
    def change(values: Values, _: float) -> Values:
        return values | {name: factor * values[name] + offset for name in names}

    return change


def _late(names: tuple[str, ...], late_s: float) -> Callable[[Values, float], Values]:
    def change(values: Values, rate_hz: float) -> Values:
        rows = round(late_s * rate_hz)
        return values | {n: np.concatenate([np.full(rows, values[n][0]), values[n][:-rows]]) for n in names}

    return change


def _added(name: str, what: Callable[[np.ndarray], np.ndarray]) -> Callable[[Values, float], Values]:
    """Add a function of time [s] to a channel."""
    return lambda values, hz: values | {name: values[name] + what(np.arange(len(values[name])) / hz)}


def _bent(name: str, end: float) -> Callable[[Values, float], Values]:
    return lambda values, _: values | {name: end * np.tanh(values[name] / end)}


def _beside(name: str, other: str, part: float) -> Callable[[Values, float], Values]:
    return lambda values, _: values | {name: values[name] + part * (values[other] - values[other].mean())}


def _swapped(a: str, b: str) -> Callable[[Values, float], Values]:
    return lambda values, _: values | {a: values[b], b: values[a]}


def _turned(a: str, b: str, degrees: float) -> Callable[[Values, float], Values]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return lambda v, _: v | {a: c * v[a] - s * v[b], b: s * v[a] + c * v[b]}


def _slow(name: str, hz: float) -> Callable[[Values, float], Values]:
    def change(values: Values, rate_hz: float) -> Values:
        from scipy.signal import butter, sosfilt, sosfilt_zi

        sos = butter(2, hz, fs=rate_hz, output="sos")
        return values | {name: sosfilt(sos, values[name], zi=sosfilt_zi(sos) * values[name][0])[0]}

    return change


SampleChange = Callable[[np.ndarray, Values], tuple[np.ndarray, Values]]


def _held(name: str, from_s: float, for_s: float, level: float | None = None) -> SampleChange:
    def change(own_s: np.ndarray, values: Values) -> tuple[np.ndarray, Values]:
        rows, shown = (own_s >= from_s) & (own_s < from_s + for_s), values[name].copy()
        shown[rows] = shown[np.argmax(rows)] if level is None else level
        return own_s, values | {name: shown}

    return change


def _in_steps(name: str, step: float) -> SampleChange:
    return lambda own_s, values: (own_s, values | {name: np.round(values[name] / step) * step})


def _spikes(name: str, size: float) -> SampleChange:
    def change(own_s: np.ndarray, values: Values) -> tuple[np.ndarray, Values]:
        rng = np.random.default_rng(3)
        return own_s, values | {name: values[name] + size * (rng.random(len(own_s)) < 60.0 * (own_s[1] - own_s[0]))}

    return change


def _clipped(name: str, low: float, high: float) -> SampleChange:
    return lambda own_s, values: (own_s, values | {name: np.clip(values[name], low, high)})


def _noisy(name: str, times: float) -> SampleChange:
    def change(own_s: np.ndarray, values: Values) -> tuple[np.ndarray, Values]:
        more = times * NOISE[name] * np.random.default_rng(5).standard_normal(len(own_s))
        return own_s, values | {name: values[name] + more}

    return change


def _dead(name: str, level: float) -> SampleChange:
    def change(own_s: np.ndarray, values: Values) -> tuple[np.ndarray, Values]:
        return own_s, values | {name: level + NOISE[name] * np.random.default_rng(1).standard_normal(len(own_s))}

    return change


def _pulses(*, without: int = 0, doubled: bool = False) -> SampleChange:
    """Remove every n-th pulse, or add a pulse half way to the next."""

    def change(own_s: np.ndarray, values: Values) -> tuple[np.ndarray, Values]:
        shown = values["keyphasor"].copy()
        high = shown > 0.5
        edges = np.flatnonzero(high[1:] & ~high[:-1]) + 1
        turn, width = int(np.median(np.diff(edges))), int(high.sum() / len(edges)) + 8
        for number, edge in enumerate(edges):
            if doubled:
                shown[edge + turn // 2 : edge + turn // 2 + width] = 1.0
            elif number % without == 2:
                shown[edge - 4 : edge + width] = 0.0
        return own_s, values | {"keyphasor": shown}

    return change


def _lost(at_s: float, rows: int) -> SampleChange:
    """Remove rows without a gap in the time stamps."""

    def change(own_s: np.ndarray, values: Values) -> tuple[np.ndarray, Values]:
        first = int(np.searchsorted(own_s, at_s))
        kept = np.r_[0:first, first + rows : len(own_s)]
        return own_s[: len(kept)], {name: shown[kept] for name, shown in values.items()}

    return change


CASES = tuple(
    [
        Case(f"{name} gain {factor:g}", rf"sensor: {name} gain", analog=_gain((name,), factor))
        for name, factors in {
            "P_N": (1.01, 1.05, 1.5), "ring_x": (1.005, 1.03, 1.2), "disk_y": (0.995, 0.9, 0.5),
            "inner_x": (1.02, 1.1, 2.0), "speed": (1.005, 1.02, 1.1), "hammer": (1.02, 1.1, 2.0),
        }.items() for factor in factors
    ]
    + [Case(f"ring_x offset {mm} mm", "sensor: ring_x offset", analog=_gain(("ring_x",), 1.0, mm))
       for mm in (0.005, 0.05, 0.3)]
    + [Case(f"P_W offset {n} N", "sensor: P_W offset", analog=_gain(("P_W",), 1.0, n)) for n in (5.0, 50.0, 500.0)]
    + [Case(f"{name} polarity", f"sensor: {name} polarity", analog=_gain((name,), -1.0, offset))
       for name, offset in (("P_E", 6000.0), ("ring_y", 0.0), ("inner_x", 0.0))]
    + [Case(f"P_S {us} us late", "sensor: P_S delay", analog=_late(("P_S",), us * 1e-6)) for us in (20, 100, 1000)]
    + [Case(f"probes {ms:g} ms late", r"sensor: disk_x, disk_y, ring_x, ring_y delay", analog=_late(PROBES, ms * 1e-3))
       for ms in (0.052, 0.2, 1.0)]
    # Two transducers preloaded against each other look the same if they are swapped and both inverted.
    + [Case(f"{a} and {b} swapped", f"{a} and {b} swapped|{a}.* polarity.*{b}.* polarity", analog=_swapped(a, b))
       for a, b in (("P_N", "P_S"), ("ring_x", "ring_y"), ("P_N", "P_E"))]
    + [Case(f"{a} and {b} swapped", f"({a}.*{b}|{b}.*{a})", analog=_swapped(a, b))
       for a, b in (("disk_x", "ring_x"), ("disk_y", "ring_y"), ("inner_x", "outer_x"))]
    + [Case(f"ring at {degrees} degrees", "ring_x and ring_y angle", analog=_turned("ring_x", "ring_y", degrees))
       for degrees in (2, 10, 45)]
    + [Case("disk as inch for mm", r"gain .*as inch for mm", analog=_gain(PROBES[:2], 1.0 / 25.4)),
       Case("forces as lbf for N", r"gain .*as lbf for N", analog=_gain(FORCES, 1.0 / 4.4482)),
       Case("housings as g for m/s^2", r"gain .*as g for m/s\^2", analog=_gain(HOUSINGS, 1.0 / 9.80665))]
    + [Case(f"clock {ppm:+g} ppm", r"clock: [-+]", ppm=ppm) for ppm in (600.0, 2000.0, -5000.0)]
    + [Case("P_N stuck for 10 ms", "P_N freeze", digital=_held("P_N", 0.9, 0.01)),
       Case("P_N stuck for 50 ms", "P_N freeze", digital=_held("P_N", 0.9, 0.05)),
       Case("ring_y stuck from 0.3 s", "ring_y freeze", digital=_held("ring_y", 0.3, 9.0))]
    + [Case("disk_x drops out for 5 ms", "disk_x freeze", digital=_held("disk_x", 0.9, 0.005, 0.0)),
       Case("disk_x drops out for 20 ms", "disk_x freeze", digital=_held("disk_x", 0.9, 0.02, 0.0)),
       Case("P_W drops out for 100 ms", "P_W freeze", digital=_held("P_W", 0.82, 0.1, 0.0))]
    + [Case("P_E clipped", "P_E clip:", digital=_clipped("P_E", -1e9, 3800.0)),
       Case("inner_y clipped", "inner_y clip:", digital=_clipped("inner_y", -100.0, 100.0)),
       Case("ring_x clipped", "ring_x clip:", digital=_clipped("ring_x", -0.8, 0.8))]
    + [Case(f"{name} noise x {times:g}", f"{name} noise", digital=_noisy(name, times))
       for name, times in (("P_S", 5.0), ("P_S", 15.0), ("disk_y", 10.0))]
    + [Case("pulses missing, a fifth", "keyphasor miss-pulses", digital=_pulses(without=5)),
       Case("pulses missing, a third", "keyphasor miss-pulses", digital=_pulses(without=3)),
       Case("pulses twice a turn", "keyphasor extra-pulses", digital=_pulses(doubled=True))]
    + [Case(f"{name} dead", f"{name} signal missing", digital=_dead(name, level))
       for name, level in (("ring_x", 0.0), ("P_E", 3000.0), ("inner_y", 0.0))]
    + [Case(f"hammer {ms:g} ms late", "hammer delay|time: shifted", analog=_late(("hammer",), ms * 1e-3))
       for ms in (0.3, 1.0, 3.0)]
    + [Case(f"{name} after a low-pass of {hz} Hz", f"{name} {pattern}", analog=_slow(name, hz))
       for name, hz, pattern in (("P_E", 3000, "(bandwidth|delay)"), ("P_E", 1000, "band"), ("P_N", 300, "band"))]
    + [Case(f"{name} nonlinear to {end:g}", f"{name} nonlinear", analog=_bent(name, end))
       for name, end in (("P_E", 20000.0), ("P_E", 6000.0), ("P_N", 3000.0), ("disk_x", 4.0), ("ring_y", 0.4))]
    + [Case(f"{name} hum {size:g}", f"{name} hum", analog=_added(name, lambda t, k=size: k * np.sin(314.0 * t)))
       for name, size in (("P_W", 30.0), ("P_W", 300.0), ("disk_y", 0.02))]
    + [Case(f"{name} drift {rate:g} a second", f"{name} drift", analog=_added(name, lambda t, k=rate: k * t))
       for name, rate in (("P_S", 20.0), ("P_S", 200.0), ("ring_x", 0.05))]
    + [Case(f"{name} spikes {size:g}", f"{name} spikes", digital=_spikes(name, size))
       for name, size in (("P_N", 300.0), ("disk_x", 0.3), ("inner_y", 50.0))]
    + [Case(f"{name} in steps of {step:g}", f"{name} bits", digital=_in_steps(name, step))
       for name, step in (("P_N", 200.0), ("disk_x", 0.05), ("ring_y", 0.02))]
    + [Case(f"{name} with {part:g} of {other}", f"{name} crosstalk|{other} angle", analog=_beside(name, other, part))
       for name, other, part in (("P_N", "P_E", 0.1), ("disk_x", "disk_y", 0.1), ("ring_x", "ring_y", 0.03))]
    + [Case(f"P_N {us} us late with gain {gain}", "P_N gain and delay",
            analog=lambda v, hz, us=us, gain=gain: _late(("P_N",), us * 1e-6)(v | {"P_N": gain * v["P_N"]}, hz))
       for us, gain in ((200, 1.1), (100, 0.5), (1000, 2.0))]
    + [Case(f"{rows} rows lost at {at_s:g} s", "time lost samples|clock: [-+]", digital=_lost(at_s, rows))
       for at_s, rows in ((0.5, 20), (0.5, 200), (0.81, 100))]
    + [Case(f"{a} and {b} swapped, inverted", f"{a} and {b} swapped and both inverted",
            analog=lambda v, _, a=a, b=b: v | {a: -v[b], b: -v[a]}) for a, b in (("ring_x", "ring_y"), PROBES[:2])]
    + [Case("hammer as lbf for N", "hammer gain .*as lbf for N", analog=_gain(("hammer",), 1.0 / 4.4482))]
)  # fmt: skip


@dataclass(frozen=True)
class Drawn:
    """A drawn fault, or several.

    Attributes:
        case: The fault; its pattern matches the right name.
        channels: Faulty channels; empty if the time of all is wrong.
        size: Size as text.
        over_noise: Size over what is detectable; above 1 a name is due, above 10 / 3 "cannot tell" is rare.
        kin: Pattern of a name of the right class, on the right channels.
    """

    case: Case
    channels: tuple[str, ...]
    size: str
    over_noise: float
    kin: str


def _coupled(name: str, hz: float) -> Callable[[Values, float], Values]:
    def change(values: Values, rate_hz: float) -> Values:
        from scipy.signal import butter, sosfilt, sosfilt_zi

        sos = butter(1, hz, "highpass", fs=rate_hz, output="sos")
        return values | {name: sosfilt(sos, values[name], zi=sosfilt_zi(sos) * values[name][0])[0]}

    return change


def _wrapped(name: str, half: float) -> SampleChange:
    return lambda own_s, values: (own_s, values | {name: (values[name] + half) % (2.0 * half) - half})


def lose_rows(names: tuple[str, ...], at_s: float, rows: int) -> SampleChange:
    """Remove rows of some channels; their last rows repeat."""

    def change(own_s: np.ndarray, values: Values) -> tuple[np.ndarray, Values]:
        first = int(np.searchsorted(own_s, at_s))
        lost = {n: np.r_[values[n][:first], values[n][first + rows :], values[n][-rows:]] for n in names}
        return own_s, values | lost

    return change


def scan(step_s: float) -> Callable[[Values, float], Values]:
    """Sample each channel a step later than the one before it."""

    def change(values: Values, rate_hz: float) -> Values:
        rows = np.arange(len(values["speed"]))
        return {
            name: one if name == "keyphasor" else np.interp(rows + n * step_s * rate_hz, rows, one)
            for n, (name, one) in enumerate(values.items())
        }

    return change


def _warming(name: str, size: float, time_s: float) -> Callable[[Values, float], Values]:
    return _added(name, lambda t: size * (1.0 - np.exp(-t / time_s)))


KINDS = (
    "offset", "gain", "polarity", "swap", "delay", "freeze", "clip", "hum", "AC coupling", "bandwidth", "wrap",
    "crosstalk", "drift", "lost samples", "scanner", "clock", "two",
)  # fmt: skip
"""Kinds of drawn faults."""


def draw_fault(kind: str, rng: np.random.Generator, motion: Motion, rows: int, hit_s: float) -> Drawn:
    """Draw a fault of a kind with its channels and size.

    An offset or a gain is detectable from three standard deviations of the mean of the noise on, a gain also has to be
    twice the calibration's uncertainty; the other faults from a deviation of one noise (RMS) on.

    Args:
        kind: One of `KINDS`.
        rng: Generator.
        motion: Ideal signals.
        rows: Rows that a validation compares.
        hit_s: Time of the hammer pulse [s].
    """
    if kind == "two":
        a, b = (draw_fault(each, rng, motion, rows, hit_s) for each in rng.choice(["gain", "offset", "hum"], 2, False))
        both = Case(
            "two", f"(?=.*{a.case.pattern})(?=.*{b.case.pattern})",
            analog=lambda values, hz: b.case.signals(a.case.signals(values, motion), motion),
        )  # fmt: skip
        return Drawn(
            both, a.channels + b.channels, f"{a.size}; {b.size}", min(a.over_noise, b.over_noise), f"({a.kin}|{b.kin})"
        )
    names = (*PROBES, *FORCES, *HOUSINGS)
    name = str(rng.choice(FORCES if kind in ("AC coupling", "clip") else HOUSINGS if kind == "wrap" else names))
    first = round(hit_s * motion.rate_hz)
    signal, noise = motion.values[name][first:], NOISE[name]
    swing, mean_noise = float(signal.std()), noise / np.sqrt(rows)
    sign, channels = float(rng.choice([-1.0, 1.0])), (name,)

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    def drawn(size: float, over: float, text: str = "", kin: str = "", **changes: Any) -> Drawn:
        pattern = rf"{name} .*{text or kind}"
        return Drawn(Case(kind, pattern, **changes), channels, f"{name} {size:.4g}", over, kin or rf"{name} ")

    if kind == "offset":
        size = sign * log(0.1, 300.0) * noise
        return drawn(size, abs(size) / mean_noise / 3.0, analog=_gain((name,), 1.0, size))
    if kind == "gain":
        size = sign * log(0.002, 0.3)
        over = min(abs(size) * swing / mean_noise / 3.0, abs(size) / 0.004)
        return drawn(size, over, analog=_gain((name,), 1.0 + size))
    if kind == "polarity":
        return drawn(-1.0, 2.0 * swing / noise, "(polarity|swapped)", analog=_gain((name,), -1.0))
    if kind == "swap":
        kinds = [PROBES, FORCES, HOUSINGS][int(rng.integers(3))]
        a, b = (str(one) for one in rng.choice(kinds, 2, False))
        over = float((motion.values[a] - motion.values[b])[first:].std()) / NOISE[a]
        pattern = f"(?=.*{a})(?=.*{b}).*(swapped|polarity|angle)"
        return Drawn(Case(kind, pattern, analog=_swapped(a, b)), (a, b), f"{a} {b}", over, f"({a}|{b})")
    if kind == "delay":
        size = log(10e-6, 1e-3)
        slope = float(np.gradient(signal).std()) * motion.rate_hz
        return drawn(1e6 * size, size * slope / noise, "(delay|bandwidth)", analog=_late((name,), size))
    if kind == "freeze":
        size = log(5e-3, 50e-3)
        return drawn(size, swing / noise, digital=_held(name, hit_s + 0.02, size))
    if kind == "clip":
        top = float(signal.mean() + (signal.max() - signal.mean()) * rng.uniform(0.3, 0.8))
        return drawn(top, swing / noise, "(clip|freeze)", digital=_clipped(name, -1e9, top))
    if kind == "hum":
        size, hz = log(0.5, 300.0) * noise, float(rng.choice([50.0, 60.0, 100.0]))
        added = _added(name, lambda t: size * np.sin(2.0 * np.pi * hz * t))
        return drawn(size, size / np.sqrt(2.0) / noise, analog=added)
    if kind == "AC coupling":
        hz = log(0.5, 20.0)
        return drawn(hz, 100.0, analog=_coupled(name, hz))
    if kind == "bandwidth":
        hz = log(100.0, 2500.0)
        slow = _slow(name, hz)
        over = float((slow(motion.values, motion.rate_hz)[name] - motion.values[name])[first:].std()) / noise
        return drawn(hz, over, "(bandwidth|delay)", analog=slow)
    if kind == "wrap":
        half = float(np.abs(signal).max() * rng.uniform(0.4, 0.8))
        return drawn(half, swing / noise, digital=_wrapped(name, half))
    if kind == "crosstalk":
        other = str(rng.choice([one for one in names if one != name]))
        part = log(0.01, 0.3) * swing / float(motion.values[other][first:].std())
        over = part * float(motion.values[other][first:].std()) / noise
        return drawn(part, over, "(crosstalk|angle)", analog=_beside(name, other, part))
    if kind == "drift":
        size = log(3.0, 300.0) * noise
        return drawn(size, size / noise / 10.0, analog=_warming(name, size, log(0.1, 2.0)))
    if kind == "lost samples":
        count, at_s = int(rng.integers(2, 30)), hit_s + rng.uniform(0.0, 0.03)
        slope = float(np.gradient(signal).std()) * motion.rate_hz / 20e3
        return drawn(count, count * slope / noise, "lost samples", digital=lose_rows((name,), at_s, count))
    if kind == "scanner":
        step = log(2e-6, 10e-6)
        fault = Case(kind, r"scan", analog=scan(step))
        return Drawn(fault, (), f"{1e6 * step:.3g} us", step / 1e-6, "delay")
    ppm = sign * log(500.0, 5000.0)
    return Drawn(Case(kind, "clock", ppm=ppm), (), f"{ppm:.0f} ppm", abs(ppm) / 300.0, "time|speed")


def judge_names(drawn: Drawn, found: Validation) -> tuple[str, list[str], list[str]]:
    """Return the judgement of a validation, the names that it gives, and the sound channels among them."""
    names = [f"{one.channel} {one.what}" for one in found.faults]
    names += [one.partition(":")[0] for one in found.beyond]
    names += found.explained.best if found.explained is not None else ()
    blamed = {word for one in names for word in re.findall(r"\w+", one) if word in NOISE}
    sound = sorted(blamed - {*drawn.channels}) if drawn.channels else sorted(blamed)
    if found.good:
        return "passed", names, sound
    text = "; ".join(names)
    if not names:
        return "cannot tell", names, sound
    if re.search(drawn.case.pattern, text):
        return "right", names, sound
    return ("class" if re.search(drawn.kin, text) and not sound else "wrong"), names, sound
