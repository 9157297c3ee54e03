"""Faults of a log: each changes the signals before a recorder's filter or the samples after it.

Times refer to `second_rig.run` with the tests' settings: the hammer pulse is at 0.8 s.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

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
