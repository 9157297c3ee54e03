"""Faults of channels that carry test signals: by their equations, on their rows, and no effect elsewhere."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from rig.base.errors import InputError
from rig.run.scenes import load_scene, parse_scene, scene_document
from rig.run.simulation import Simulation
from tests.fault_cases import EXAMPLES
from tests.unit.test_channel_faults import find_differences, run

SCENE = load_scene(
    "test-sine", {"duration_s": 0.4, "sensors.groups": ["probes", "forces", "drive"], "generator.frequency_hz": 1000.0}
)
FROM, TO = 0.1, 0.3
RATE_HZ = SCENE.table.channels["disk_x"].rate_hz
REFUSED = {"no-filter", "bandwidth", "miss-pulses", "extra-pulses", "edge-jitter"}


def fault(kind: str, **numbers: Any) -> dict[str, Any]:
    return {"channel": "disk_x", "kind": kind, "for_s": TO - FROM, **(numbers or EXAMPLES[kind])}


@pytest.fixture(scope="module")
def sound() -> dict[str, np.ndarray]:
    return run(scene=SCENE)[0]


@pytest.mark.parametrize("kind", EXAMPLES)
def test_a_fault_is_on_its_channels_and_rows_alone_or_refused(kind: str, sound: dict[str, np.ndarray]) -> None:
    if kind in REFUSED:
        with pytest.raises(InputError, match=r"must be (one that test signals can have, such as clip|keyphasor)"):
            Simulation(SCENE).submit("fault", fault(kind))
        return
    there, events = run(fault(kind), scene=SCENE)
    (begun,) = (event for event in events if event["event"] == "fault")
    found = find_differences(there, sound)
    assert set(found) == set(begun["channels"])
    for first, last in found.values():
        assert FROM * RATE_HZ <= first <= last < TO * RATE_HZ
        assert first <= FROM * RATE_HZ + 4 or kind in ("intermittent", "spikes", "nonlinear", "saturation")
    assert not find_differences(there, run(fault(kind), scene=SCENE, cut=10_000)[0])


def measure_tone(counts: np.ndarray) -> complex:
    """Return the amplitude at the signal's frequency in whole periods of the faulty rows [counts]."""
    part = counts[round(0.2 * RATE_HZ) : round(0.3 * RATE_HZ)]
    hz = SCENE.sources()["disk_x"].signal.frequency_hz
    assert hz is not None
    return complex(2.0 * np.mean(part * np.exp(-2j * math.pi * hz * np.arange(len(part)) / RATE_HZ)))


def test_fault_sizes_are_recovered_from_the_counts(sound: dict[str, np.ndarray]) -> None:
    plain, hz = measure_tone(sound["disk_x"]), SCENE.sources()["disk_x"].signal.frequency_hz or 0.0
    gain = measure_tone(run(fault("gain", factor=0.7), scene=SCENE)[0]["disk_x"]) / plain
    assert gain == pytest.approx(0.7, abs=1e-4)
    late = measure_tone(run(fault("late", late_us=731.0), scene=SCENE)[0]["disk_x"]) / plain
    assert late == pytest.approx(np.exp(-2j * math.pi * hz * 731e-6), abs=1e-4)
    resonance = (
        measure_tone(run(fault("resonance", frequency_hz=3.0 * hz, quality=5.0), scene=SCENE)[0]["disk_x"]) / plain
    )
    x = 1.0 / 3.0
    assert resonance == pytest.approx(1.0 / (1.0 - x**2 + 1j * x / 5.0), rel=0.01)


@pytest.mark.parametrize("ppm", [-2e4, 5e3])
def test_a_clock_error_shifts_the_frequency(ppm: float, sound: dict[str, np.ndarray]) -> None:
    """From the phase: a slow clock begins 10 ms late and catches up, a fast one lags increasingly."""
    there, _ = run(fault("clock", ppm=ppm), scene=SCENE)
    hz, steps = SCENE.sources()["disk_x"].signal.frequency_hz or 0.0, 10
    begin, length = round(0.15 * RATE_HZ), round(0.1 * RATE_HZ)
    carrier = np.exp(-2j * math.pi * hz * np.arange(length) / RATE_HZ)
    turned = [
        np.angle(np.mean((each[begin : begin + length] * carrier).reshape(steps, -1), axis=1))
        for each in (there["disk_x"].astype(float), sound["disk_x"].astype(float))
    ]
    late_s = -np.unwrap(turned[0] - turned[1]) / (2.0 * math.pi * hz)
    slope = np.polyfit(np.arange(steps) * length / steps / RATE_HZ, late_s, 1)[0]
    assert slope == pytest.approx(1.0 - 1.0 / (1.0 + 1e-6 * ppm), rel=0.01)


def test_a_scene_of_test_signals_may_have_faults_and_no_other_commands(sound: dict[str, np.ndarray]) -> None:
    document = scene_document(SCENE)
    faults = [{"at_s": FROM, "channel": "probes", "kind": "dropout"}, {"at_s": FROM, **fault("freeze")}]
    scene = parse_scene({**document, "faults": faults})
    simulation = Simulation(scene)
    frames = [simulation.advance(50_000) for _ in range(4)]
    assert [sum(key.endswith("/probes") for key, _ in frame.blocks()) for frame in frames] == [1, 1, 0, 0]
    assert len(np.unique(frames[3].samples["probes"].values[:, 0])) == 1
    with pytest.raises(InputError, match="commands must be left out with a"):
        parse_scene({**document, "commands": [{"at_s": 0.1, "command": "hammer"}]})
    with pytest.raises(InputError, match="one that test signals can have"):
        Simulation(parse_scene({**document, "faults": [{"at_s": 0.1, "channel": "P_E", "kind": "no-filter"}]}))
