"""Coverage of the analogue scorecard's intervals: `python -m tests.score_coverage [-n FITS] [--first SEED]
[--noise NAME ...]`.

Fits synthetic DAQs of known gain, offset, clock and so on, whose noise is white, coloured or drifts, and counts the
95 % intervals that contain the true value. Each fit is a line of a journal, from which an interrupted run continues. It
prints one row for each quantity and noise. Status 1 if fewer than 275 or more than 294 of 300 intervals contain it, or
the median half width is above 1.5 times 1.96 standard deviations of the error; cells of `KNOWN` are marked and do not
count.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from replays.estimate.sine import fit_sine, quality
from replays.score.analogue import score_analogue
from replays.score.card.scorecard import Scorecard
from replays.score.records.recorded import Recorded, RecordedTable
from replays.score.records.sent import Session
from replays.score.records.stimulus import Exact
from replays.score.records.wiring import Wire
from replays.score.waveform import find_order, fit_waveform, fit_with_filter, response
from rig.channels.table import default_table
from tests.score_daqs import RATE_HZ, Tones

ROWS = 6000
SIGNALS = 12
"""Known signals of each kind; their splines are kept."""
LEVEL = 3e-3
"""Noise of each record [mm rms]."""
FITS, MIN_HELD, MAX_HELD, MAX_WIDTH = 300, 275, 294, 1.5
KNOWN = {
    **dict.fromkeys(
        [("offset", "walk"), ("SINAD", "walk"), ("ENOB", "walk")],
        "too wide: a walk beyond 12 half periods a record is taken for noise",
    ),
    **dict.fromkeys(
        [("jitter", "rising"), ("effective bits", "rising")],
        "too wide: the level's rise within the record is taken for chance",
    ),
}
"""Cells outside the goal, with the reason."""
CHANNELS = default_table().groups["probes"].channels[:2]
FULL_MM = CHANNELS[0].adc_v / abs(CHANNELS[0].sensitivity_v)
Noise = tuple[np.ndarray, float, float]
"""Samples [mm], shape (n,), the offset added by a wander [mm], and the true rms about the mean of a record [mm]."""
Estimate = tuple[float, float, float, float]
"""Value, low end, high end, true value."""


def _white(generator: np.random.Generator, rows: int) -> Noise:
    return LEVEL * generator.standard_normal(rows), 0.0, LEVEL


def _rising(generator: np.random.Generator, rows: int) -> Noise:
    """Return white noise whose level rises threefold over the record."""
    level = LEVEL * np.linspace(0.5, 1.5, rows)
    return level * generator.standard_normal(rows), 0.0, float(np.sqrt(np.mean(level**2)))


def _coloured(time_rows: float) -> Callable[[np.random.Generator, int], Noise]:
    """Return a generator of first-order noise with a correlation time in samples."""

    def noise(generator: np.random.Generator, rows: int) -> Noise:
        from scipy.signal import lfilter

        follow = math.exp(-1.0 / time_rows)
        shocks = math.sqrt(1.0 - follow**2) * generator.standard_normal(rows)
        shocks[0] /= math.sqrt(1.0 - follow**2)
        lags = np.arange(1, rows)
        of_mean = (1.0 + 2.0 * float(np.sum((1.0 - lags / rows) * follow**lags))) / rows
        return LEVEL * np.asarray(lfilter([1.0], [1.0, -follow], shocks)), 0.0, LEVEL * math.sqrt(1.0 - of_mean)

    return noise


def _pink(generator: np.random.Generator, rows: int) -> Noise:
    """Return 1/f noise, flat below ten periods per record."""
    longer = 4 * rows
    lines = np.fft.rfftfreq(longer, 1.0 / rows)
    size = np.maximum(lines, 10.0) ** -0.5
    size *= LEVEL / math.sqrt(float(np.sum(size[1:] ** 2)))
    parts = size * (generator.standard_normal(len(size)) + 1j * generator.standard_normal(len(size)))
    parts[0] = math.sqrt(2.0) * parts[0].real
    of_mean = 0.5 * size[0] ** 2 * 8.0 / LEVEL**2
    return np.fft.irfft(parts, longer)[:rows] * 0.5 * longer, 0.0, LEVEL * math.sqrt(1.0 - of_mean)


def _wandering(wander: Callable[[np.random.Generator, np.ndarray], np.ndarray]) -> Callable[..., Noise]:
    """Return a generator of white noise plus a wander of the same level, with the true values of each record."""

    def noise(generator: np.random.Generator, rows: int) -> Noise:
        slow = LEVEL * wander(generator, (np.arange(rows) + 0.5) / rows)
        white = LEVEL * generator.standard_normal(rows)
        return slow + white, float(slow.mean()), math.hypot(LEVEL, float(np.std(slow)))

    return noise


NOISES: dict[str, Callable[[np.random.Generator, int], Noise]] = {
    "white": _white, "ar1": _coloured(1.0), "ar10": _coloured(10.0), "ar100": _coloured(100.0), "pink": _pink,
    "rising": _rising,
    "sine": _wandering(lambda g, u: math.sqrt(2.0) * np.sin(2.0 * np.pi * (u + g.uniform()))),
    "settling": _wandering(lambda g, u: g.choice([-1.0, 1.0]) * 4.5 * np.exp(-5.0 * u)),
    "walk": _wandering(lambda g, u: np.cumsum(g.standard_normal(len(u))) * math.sqrt(6.0 / len(u))),
}  # fmt: skip


@lru_cache
def _curve(seed: int, **settings: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Return a spline through tones at 5 times the rate: 30 times as fast, and used as the known signal itself."""
    from scipy.interpolate import make_interp_spline

    signal = Tones(seed, 1.0, **settings)
    grid_s = np.arange(round((0.15 + ROWS / RATE_HZ) * 5 * RATE_HZ)) / (5 * RATE_HZ)
    return make_interp_spline(grid_s, signal(grid_s), k=5)


def _slope(signal: Callable[[np.ndarray], np.ndarray], times_s: np.ndarray) -> float:
    return float(np.sqrt(np.mean((signal(times_s + 1e-7) - signal(times_s - 1e-7)) ** 2))) / 2e-7


def _judged(
    values: Sequence[np.ndarray], formulas: Sequence[Callable[[np.ndarray], np.ndarray]], sent_hz: float, late_s: float
) -> dict[tuple[str, str], Any]:
    """Return a scorecard's rows by quantity and channel, of a record whose signals are known by formulas."""
    t, names = np.arange(len(values[0])) / RATE_HZ, [each.name for each in CHANNELS[: len(values)]]
    columns = np.column_stack([t, *values])
    table = RecordedTable(len(t), len(values), lambda wanted: [columns[:, [0, *(1 + n for n in wanted)]]])
    recorded = {name: Recorded(name, CHANNELS[0].unit, table, n, None) for n, name in enumerate(names)}
    wires = {name: Wire(name, 1, 1.0, (), False, late_s, (0.0, t[-1]), (), late_s) for name in names}
    sent = np.zeros(round((t[-1] + 0.1) * sent_hz))
    session = SimpleNamespace(
        channels=dict(zip(names, CHANNELS, strict=False)), noisy=True, whole=lambda _: (sent, 0.0, sent_hz)
    )
    card = Scorecard("coverage", "analogue", "", lambda *_, **__: None)
    score_analogue(card, recorded, wires, cast(Session, session), dict(zip(names, formulas, strict=True)))
    return {(row.quantity, row.channel): row for row in card.rows}


def _waveforms(generator: np.random.Generator, noise: Callable[..., Noise], seed: int) -> dict[str, Estimate]:
    """Return estimates of two channels of tones: gain, times, noise and derived quantities."""
    t, signals = np.arange(ROWS) / RATE_HZ, [_curve(2 * (seed % SIGNALS) + k, high_hz=3000.0, tones=12) for k in (0, 1)]
    gain, offset, late_s = generator.uniform(0.9, 1.1), generator.normal(0.0, 0.1), generator.uniform(0.02, 0.03)
    drift, bend, skew_s = generator.normal(0.0, 50e-6), generator.normal(0.0, 1e-4), generator.normal(0.0, 1e-6)
    jitter_s, middle_s = generator.uniform(0.2e-6, 0.6e-6), 0.5 * t[-1]
    curve_s = late_s + drift * (t - middle_s) + bend * (0.5 * (t - middle_s) ** 2 - t[-1] ** 2 / 24.0)
    values, means, levels = [], [], []
    for k, signal in enumerate(signals):
        series, mean, level = noise(generator, ROWS)
        shake_s = jitter_s * generator.standard_normal(ROWS)
        values.append(gain * signal(t + curve_s + k * skew_s + shake_s) + offset + series)
        means.append(mean)
        levels.append(level)
    rows = _judged(values, signals, float(RATE_HZ), late_s + 1e-6 * generator.standard_normal())
    first, second = (each.name for each in CHANNELS)
    full_over_noise = FULL_MM / levels[0]
    residual = math.hypot(levels[0], jitter_s * gain * _slope(signals[0], t + curve_s))
    true = {
        ("gain", first): 1e6 * (gain - 1.0), ("offset", first): offset + means[0], ("start", first): curve_s[0],
        ("skew", second): 1e9 * skew_s, ("clock", ""): -1e6 * drift / (1.0 + drift), ("clock drift", ""): -1e6 * bend,
        ("noise", first): levels[0], ("jitter", first): 1e9 * jitter_s,
        ("effective bits", first): math.log2(FULL_MM / residual / math.sqrt(3.0)),
        ("dynamic range", first): 20.0 * math.log10(full_over_noise / math.sqrt(2.0)),
    }  # fmt: skip
    return {key[0]: (rows[key].value, rows[key].low, rows[key].high, value) for key, value in true.items()}


def _corner(generator: np.random.Generator, noise: Callable[..., Noise], seed: int) -> dict[str, Estimate]:
    t, seed = np.arange(ROWS) / RATE_HZ, seed % SIGNALS
    corner_hz, late_s = generator.uniform(900.0, 2000.0), generator.uniform(0.02, 0.03)
    values = Tones(seed, 1.0, high_hz=3000.0, tones=40).behind(corner_hz, 4)(t + late_s) + noise(generator, ROWS)[0]
    known = Exact(_curve(seed, high_hz=3000.0, tones=40), (0.0, t[-1] + 0.1), RATE_HZ)
    low = fit_waveform(values, t, known, (late_s - 0.3 / corner_hz, 0.0, 0.0))
    shown = None if low is None else response(low)
    if low is None or shown is None or shown.corner_hz is None or find_order(shown) != 4:
        return {}
    behind = fit_with_filter(low, known, shown)
    return {} if behind is None else {"corner": (*behind[1], corner_hz)}


def _sine(generator: np.random.Generator, noise: Callable[..., Noise], seed: int) -> dict[str, Estimate]:
    n, (series, _mean, level) = np.arange(ROWS), noise(generator, ROWS)
    turn = 2.0 * np.pi * generator.uniform(0.01, 0.045)
    second, third = LEVEL * generator.uniform([1.5, 0.2], [3.0, 0.4])
    values = np.sin(turn * n) + second * np.sin(2.0 * turn * n + 1.0) + third * np.sin(3.0 * turn * n) + series
    quality_figures, bad = quality(fit_sine(values)), level**2 + 0.5 * (second**2 + third**2)
    sinad_db = 10.0 * math.log10(0.5 / bad)
    return {
        "SINAD": (*quality_figures.sinad_db, sinad_db), "ENOB": (*quality_figures.enob, (sinad_db - 1.76) / 6.02),
        "THD": (*quality_figures.thd_db, 20.0 * math.log10(math.hypot(second, third))),
        "SFDR": (*quality_figures.sfdr_db, -20.0 * math.log10(second)),
    }  # fmt: skip


def _alias(generator: np.random.Generator, noise: Callable[..., Noise], seed: int) -> dict[str, Estimate]:
    below = _curve(2 * (seed % SIGNALS), high_hz=6000.0, tones=12)
    above = _curve(2 * (seed % SIGNALS) + 1, low_hz=12e3, high_hz=18e3, tones=4)
    at_s, passed = np.arange(ROWS) / RATE_HZ + 0.03, generator.uniform(0.02, 0.05)
    values = below(at_s) + passed * above(at_s) + noise(generator, ROWS)[0]
    row = _judged([values], [lambda t: below(t) + above(t)], 2.5 * RATE_HZ, 0.03)[("alias rejection", CHANNELS[0].name)]
    return {"alias rejection": (row.value, row.low, row.high, -20.0 * math.log10(passed))}


KINDS = {"waveforms": _waveforms, "corner": _corner, "sine": _sine, "alias": _alias}


def compute_estimates(seed: int, noise: str, kinds: Sequence[str] = tuple(KINDS)) -> dict[str, Estimate]:
    """Return each quantity of one fit: value, low and high end of its interval, and its true value."""
    found: dict[str, Estimate] = {}
    for kind in kinds:
        generator = np.random.default_rng([seed, list(NOISES).index(noise), list(KINDS).index(kind)])
        found |= KINDS[kind](generator, NOISES[noise], seed)
    return found


def summarise_cell(found: Sequence[Estimate]) -> tuple[int, float]:
    """Return the number of intervals that contain the truth, and their median half width over 1.96 standard deviations
    of
    the error.
    """
    value, low, high, true = np.array(found).T
    spread = float(np.std(value - true))
    return int(np.sum((low <= true) & (true <= high))), float(np.median(high - low)) / (2.0 * 1.96 * spread)


def main(words: list[str] | None = None) -> int:
    """Print the table of coverage; return 1 if the goal is missed."""
    parser = argparse.ArgumentParser(prog="python -m tests.score_coverage", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-n", type=int, default=FITS, help="fits for each noise")
    parser.add_argument("--first", type=int, default=0, help="seed of the first fit")
    parser.add_argument("--noise", nargs="*", choices=list(NOISES), default=list(NOISES))
    parser.add_argument("--kind", nargs="*", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--journal", type=Path, default=Path(tempfile.gettempdir()) / "rig-score-coverage.jsonl")
    options = parser.parse_args(words)
    seeds = range(options.first, options.first + options.n)
    lines = options.journal.read_text(encoding="utf-8").splitlines() if options.journal.exists() else []
    done = {(line["noise"], line["seed"], line["kind"]): line["found"] for line in map(json.loads, lines)}
    with options.journal.open("a", encoding="utf-8") as file:
        for noise in options.noise:
            for key in [(noise, seed, kind) for seed in seeds for kind in options.kind]:
                if key not in done:
                    done[key] = compute_estimates(key[1], noise, [key[2]])
                    line = {"noise": noise, "seed": key[1], "kind": key[2], "found": done[key]}
                    file.write(json.dumps(line) + "\n")
                    file.flush()
    good, by_quantity = True, dict[str, dict[str, list[Estimate]]]()
    for (noise, seed, kind), found in done.items():
        if noise in options.noise and kind in options.kind and seed in seeds:
            for quantity, estimate in found.items():
                by_quantity.setdefault(quantity, {}).setdefault(noise, []).append(cast(Estimate, tuple(estimate)))
    print(f"{'':16}" + "".join(f"{noise:>14}" for noise in options.noise))
    for quantity, by_noise in by_quantity.items():
        cells = []
        for noise in options.noise:
            held, width = summarise_cell(found := by_noise[noise])
            right = MIN_HELD / FITS <= held / len(found) <= MAX_HELD / FITS and width <= MAX_WIDTH
            mark = " " if right else "k" if (quantity, noise) in KNOWN else "*"
            good &= mark != "*"
            cells.append(f"{held:4}/{len(found)}{width:5.2f}{mark}")
        print(f"{quantity:16}" + "".join(f"{each:>14}" for each in cells))
    print("\n".join(f"k {quantity}, {noise}: {why}" for (quantity, noise), why in KNOWN.items()))
    print("the goal is met" if good else "THE GOAL IS MISSED")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
