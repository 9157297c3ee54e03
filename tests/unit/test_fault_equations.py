"""Each kind of fault compared with the equation of its docstring, by its methods alone; no run of the rig."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rig.channels.faults import KINDS
from rig.channels.faults.kind import At, Draws, Kind
from rig.channels.table import default_table
from tests.fault_cases import EXAMPLES

CHANNEL = default_table().channels["disk_x"]
RATE_HZ, ROWS = 20_000, 6000
T, N = np.arange(ROWS) / RATE_HZ, np.arange(ROWS)
X = 0.8 * np.sin(2.0 * np.pi * 37.0 * T + 0.4) + 0.1
V = -10.0 + 3.94 * X
SOURCE_V = np.cos(2.0 * np.pi * 91.0 * T)
COUNTS = np.rint(V / CHANNEL.lsb_v)
U = Draws(3, 1, 0).uniform(N)
TURNS_HZ = 25.0
TICKS = 1e6 * np.arange(1, 400) / TURNS_HZ
TURN_U = Draws(3, 1, 0).uniform(np.arange(1, 400))[:, 0]


def kind(name: str, **numbers: Any) -> Kind:
    return KINDS[name].model_validate({"kind": name, **numbers})


def make_state(rows: slice = slice(None), kept: dict[str, float] | None = None) -> At:
    """Return rows of the channel, with the state of one fault."""
    none = np.empty(0)
    return At(
        T[rows], N[rows], CHANNEL, Draws(3, 1, 0), {} if kept is None else kept, lambda _: SOURCE_V[rows], none, none,
        lambda x: x,
    )  # fmt: skip


def make_edge_state() -> At:
    """Return the edges of a shaft that turns evenly, one per turn."""
    angle, rate = 2.0 * np.pi * np.arange(1, 400), np.full(399, 2.0 * np.pi * TURNS_HZ)
    return At(1e-6 * TICKS, np.arange(399), CHANNEL, Draws(3, 1, 0), {}, lambda _: SOURCE_V, angle, rate, lambda x: x)


@pytest.mark.parametrize(("name", "numbers", "expected"), [
    ("gain", {"factor": 0.7}, 0.7 * X),
    ("gain", {"factor": 1.2, "ramp_s": 0.1}, X * (1.0 + 0.2 * np.minimum(10.0 * T, 1.0))),
    ("offset", {"value": -0.3}, X - 0.3), ("offset", {"value": 0.3, "ramp_s": 0.2}, X + 0.3 * np.minimum(5.0 * T, 1.0)),
    ("drift", {"rate": 2.0}, X + 2.0 * T),
    ("drift", {"rate": 2.0, "tau_s": 0.05}, X + 0.1 * (1.0 - np.exp(-20.0 * T))), ("polarity", {}, -X),
    ("stuck", {}, np.full(ROWS, X[0])), ("nonlinear", {"end": 0.5}, 0.5 * np.tanh(2.0 * X)),
])  # fmt: skip
def test_transducers(name: str, numbers: dict[str, float], expected: np.ndarray) -> None:
    np.testing.assert_allclose(kind(name, **numbers).signal(X, make_state()), expected, rtol=1e-9, atol=1e-12)


def test_a_resonance_settles_to_the_response_of_an_oscillator() -> None:
    """Driven at 37 Hz from rest, of 80 Hz and quality 3; in blocks of any length."""
    fault, drive = kind("resonance", frequency_hz=80.0, quality=3.0), 37.0 / 80.0
    response = 1.0 / (1.0 - drive**2 + 1j * drive / 3.0)
    settled = 0.1 + 0.8 * np.imag(response * np.exp(1j * (2.0 * np.pi * 37.0 * T + 0.4)))
    whole = fault.signal(X, make_state())
    np.testing.assert_allclose(whole[3000:], settled[3000:], atol=2e-4)
    kept: dict[str, float] = {}
    parts = [fault.signal(X[rows], make_state(rows, kept)) for rows in (slice(0, 7), slice(7, 8), slice(8, ROWS))]
    np.testing.assert_allclose(np.concatenate(parts), whole, atol=1e-9)


@pytest.mark.parametrize(("name", "numbers", "expected"), [
    ("open", {"level_v": 1.5}, np.full(ROWS, 1.5)), ("short", {}, np.zeros(ROWS)),
    ("intermittent", {"part": 0.15, "slot_s": 0.001, "level_v": 2.0},
     np.where(np.repeat(U[:300, 0] < 0.15, 20), 2.0, V)),
    ("hum", {"amplitude_v": 0.2, "frequency_hz": 60.0, "third": 0.4, "offset_v": -0.1},
     V + 0.2 * (np.sin(120.0 * np.pi * T) + 0.4 * np.sin(360.0 * np.pi * T)) - 0.1),
    ("crosstalk", {"source": "disk_y", "db": -20.0}, V + 0.1 * SOURCE_V),
    ("crosstalk", {"source": "disk_y", "db": -6.0}, V + 0.501187233627272 * SOURCE_V),
    ("saturation", {"part": 0.2}, np.clip(V, -11.6, -8.4)),
])  # fmt: skip
def test_cables_and_conditioners(name: str, numbers: dict[str, Any], expected: np.ndarray) -> None:
    np.testing.assert_allclose(kind(name, **numbers).volts(V, make_state()), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("name", "numbers", "expected_us"), [
    ("late", {"late_us": 12.5}, np.full(ROWS, 12.5)),
    ("wander", {"amplitude_us": 80.0, "period_s": 0.05}, 80.0 * (1.0 - np.cos(40.0 * np.pi * T))),
    ("jitter", {"rms_us": 3.0}, 3.0 * (4.0 + np.clip(Draws(3, 1, 0).normal(N), -4.0, 4.0))),
])  # fmt: skip
def test_clocks(name: str, numbers: dict[str, float], expected_us: np.ndarray) -> None:
    np.testing.assert_allclose(1e6 * kind(name, **numbers).late_s(make_state()), expected_us, atol=1e-9)
    assert kind("gain", factor=2.0).late_s(make_state()).tolist() == [0.0] * ROWS


@pytest.mark.parametrize(("name", "numbers", "expected"), [
    ("noise", {"factor": 1.25}, COUNTS + np.rint(0.75 * 1e-3 / CHANNEL.lsb_v * Draws(3, 1, 0).normal(N))),
    ("spikes", {"rate_hz": 1600.0, "size_v": 0.5},
     COUNTS + np.where(U[:, 0] < 0.08, np.where(U[:, 1] < 0.5, -1.0, 1.0) * np.rint(0.5 / CHANNEL.lsb_v), 0.0)),
    ("bits", {"lost": 3}, 8.0 * np.floor(COUNTS / 8.0)),
    ("stuck-bit", {"bit": 5}, COUNTS + 32.0 * (np.floor(COUNTS / 32.0) % 2.0 == 0.0)),
    ("stuck-bit", {"bit": 5, "value": 0}, COUNTS - 32.0 * (np.floor(COUNTS / 32.0) % 2.0 == 1.0)),
    ("clip", {"part": 0.5}, np.clip(COUNTS, -(2.0**22), 2.0**22 - 1.0)), ("freeze", {}, np.full(ROWS, COUNTS[0])),
])  # fmt: skip
def test_converters(name: str, numbers: dict[str, float], expected: np.ndarray) -> None:
    found = kind(name, **numbers).counts(COUNTS, make_state())
    np.testing.assert_array_equal(found, expected)
    assert name == "freeze" or 0 < np.sum(found != COUNTS) < ROWS


@pytest.mark.parametrize(("name", "numbers", "expected"), [
    ("miss-pulses", {"part": 0.1}, TICKS[TURN_U >= 0.1]),
    ("extra-pulses", {"part": 0.1}, np.sort(np.concatenate([TICKS, TICKS[TURN_U < 0.1] + 0.5e6 / TURNS_HZ]))),
    ("edge-jitter", {"rms_us": 20.0},
     TICKS + 20.0 * (4.0 + np.clip(Draws(3, 1, 0).normal(np.arange(1, 400)), -4.0, 4.0))),
    ("stuck", {}, TICKS[:0]), ("open", {}, TICKS[:0]), ("freeze", {}, TICKS[:0]),
])  # fmt: skip
def test_pulses(name: str, numbers: dict[str, float], expected: np.ndarray) -> None:
    np.testing.assert_allclose(kind(name, **numbers).edges(TICKS, make_edge_state()), expected, rtol=1e-12)
    assert len(kind(name, **numbers).edges(TICKS[:0], make_edge_state())) == 0


@pytest.mark.parametrize("name", sorted(name for name, each in KINDS.items() if not each.of_blocks))
def test_a_fault_changes_only_its_stage(name: str) -> None:
    """A fault of one stage leaves the values of all others."""
    fault = kind(name, **EXAMPLES[name])
    methods: dict[str, tuple[Callable[[np.ndarray, At], np.ndarray], np.ndarray]] = {
        "transducer": (fault.signal, X), "cable": (fault.volts, V), "converter": (fault.counts, COUNTS),
    }  # fmt: skip
    for stage, (method, values) in methods.items():
        if fault.stage not in (stage, "keyphasor"):
            assert method(values, make_state()) is values
    assert fault.stage == "clock" or not fault.late_s(make_state()).any()
    assert fault.stage == "filter" or fault.chain(CHANNEL) is CHANNEL
