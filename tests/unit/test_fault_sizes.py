"""Faults that could change no count are refused, and the message contains the smallest effective size."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from rig.base.errors import InputError
from rig.channels.faults import KINDS
from rig.channels.faults.converter import Clock
from rig.channels.faults.kind import At, Kind
from rig.channels.table import Channel
from rig.run.scenes import load_scene, parse_scene
from rig.run.simulation import Simulation
from tests.fault_cases import EXAMPLES
from tests.unit.test_channel_faults import find_differences, run

SCENE = load_scene("stable-run", {"duration_s": 0.2, "sensors.groups": ["probes", "forces", "drive"]})
TOO_SMALL_FAULTS: dict[str, tuple[str, dict[str, Any], str]] = {
    "gain": ("disk_x", {"factor": 1.0 + 1e-12}, "factor"), "offset": ("disk_x", {"value": -1e-12}, "value"),
    "drift": ("P_E", {"rate": 1e-9, "for_s": 0.05}, "rate"), "nonlinear": ("disk_x", {"end": 1e9}, "end"),
    "hum": ("P_E", {"amplitude_v": 1e-9}, "amplitude_v"), "saturation": ("P_E", {"part": 1.0 - 1e-12}, "part"),
    "bandwidth": ("disk_x", {"corner_hz": 5000.0 - 1e-9}, "corner_hz"),
    "late": ("disk_x", {"late_us": 1e-9}, "late_us"),
    "clock": ("disk_x", {"ppm": 1e-9, "for_s": 0.05}, "ppm"), "jitter": ("disk_x", {"rms_us": 1e-9}, "rms_us"),
    "wander": ("disk_x", {"amplitude_us": 1e-9}, "amplitude_us"), "noise": ("P_E", {"factor": 1.0 + 1e-9}, "factor"),
    "spikes": ("P_E", {"size_v": 1e-9}, "size_v"), "clip": ("disk_x", {"part": 0.999}, "part"),
    "edge-jitter": ("keyphasor", {"rms_us": 1e-9}, "rms_us"),
}  # fmt: skip
TOO_RARE_FAULTS: dict[str, tuple[str, str]] = {
    "intermittent": ("P_E", "part"), "spikes": ("P_E", "rate_hz"), "lose-blocks": ("forces", "part"),
    "duplicate-blocks": ("forces", "part"), "reorder-blocks": ("forces", "part"), "miss-pulses": ("keyphasor", "part"),
    "extra-pulses": ("keyphasor", "part"),
}  # fmt: skip


def submit_refused(request: dict[str, Any], scene: Any = SCENE) -> str:
    """Return the message with which a live command is refused; a fault of the scene must be refused with the same."""
    with pytest.raises(InputError) as caught:
        Simulation(scene).submit("fault", request)
    timed = {"at_s": 0.0, "command": "fault", **request}
    with pytest.raises(InputError) as in_scene:
        Simulation(scene.model_copy(update={"commands": parse_scene({"commands": [timed]}).commands}))
    assert str(caught.value) == str(in_scene.value).removeprefix("commands.0.")
    return str(caught.value)


def test_every_kind_with_a_size_has_a_case() -> None:
    """A kind whose effect can be too small, or too rare, has its own `reach_v` or `chance`."""
    sized = {name for name, kind in KINDS.items() if (kind.reach_v, kind.chance) != (Kind.reach_v, Kind.chance)}
    assert not sized - {*TOO_SMALL_FAULTS, *TOO_RARE_FAULTS, "crosstalk", "late-blocks"}, (
        "each of these kinds must have a case"
    )


@pytest.mark.parametrize("kind", TOO_SMALL_FAULTS)
def test_a_fault_below_a_step_is_refused_with_the_smallest_size(kind: str) -> None:
    channel, numbers, field = TOO_SMALL_FAULTS[kind]
    text = submit_refused({"channel": channel, "kind": kind, **numbers})
    found = re.match(rf"{field} must be at (least|most) (\S+) to change a count of {channel}, whose", text)
    assert found is not None, text
    enough = {"channel": channel, "kind": kind, **numbers, field: float(found[2])}
    Simulation(SCENE).submit("fault", enough)
    # A fifth less is refused again: the message contains the smallest size, not a safe one.
    neutral = {"gain": 1.0, "noise": 1.0, "saturation": 1.0, "bandwidth": 5000.0}.get(kind, 0.0)
    less = neutral + 0.8 * (float(found[2]) - neutral)
    if kind == "nonlinear":
        less = 1.25 * float(found[2])
    elif kind == "clip":
        less = float(found[2]) + 1e-4
    submit_refused({**enough, field: less})


@pytest.mark.parametrize(("kind", "numbers"), [
    ("offset", {}), ("hum", {"frequency_hz": 150.0}), ("spikes", {"rate_hz": 5000.0}), ("late", {}), ("jitter", {}),
])  # fmt: skip
def test_the_smallest_size_changes_counts(kind: str, numbers: dict[str, Any]) -> None:
    channel, tiny, field = TOO_SMALL_FAULTS[kind]
    given = {"channel": channel, "kind": kind, **tiny, **numbers}
    size = float(submit_refused(given).split()[5])
    sound, _ = run(scene=SCENE)
    there, _ = run({**given, field: size, "at_s": 0.05}, scene=SCENE)
    assert set(find_differences(there, sound)) == {channel}


@pytest.mark.parametrize("kind", TOO_RARE_FAULTS)
def test_a_random_fault_that_never_happens_is_refused(kind: str) -> None:
    channel, field = TOO_RARE_FAULTS[kind]
    tiny = {"channel": channel, "kind": kind, "for_s": 0.1, field: 1e-9}
    found = re.match(rf"{field} must be above (\S+) to happen once", submit_refused(tiny))
    assert found is not None
    often = 1.01 * float(found[1])
    Simulation(SCENE).submit("fault", {**tiny, field: often})
    if kind in ("intermittent", "spikes"):
        sound, _ = run(scene=SCENE)
        there, _ = run({**tiny, field: often, "at_s": 0.0}, scene=SCENE)
        assert set(find_differences(there, sound)) == {channel}


def make_coarse_scene(bits: int, noise_v: float) -> Any:
    """Return the scene with a converter of few bits at P_E."""
    table = SCENE.table
    change = {"adc_bits": bits, "noise_v": noise_v}
    groups = {
        name: group.model_copy(
            update={
                "channels": tuple(one.model_copy(update=change if one.name == "P_E" else {}) for one in group.channels)
            }
        )
        for name, group in table.groups.items()
    }
    document = table.model_copy(update={"groups": groups}).model_dump(mode="json")
    return load_scene("stable-run", {"duration_s": 0.2, "channels": document, "sensors.groups": ["forces", "probes"]})


def measure_noise(scene: Any, *faults: dict[str, Any]) -> float:
    """Return the standard deviation of P_E's counts after 0.05 s."""
    found, _ = run(*faults, scene=scene)
    return float(np.std(found["P_E"][1000:]))


def test_noise_of_a_coarse_converter_is_refused_until_it_shows() -> None:
    scene = make_coarse_scene(12, 0.002)
    channel: Channel = scene.table.channels["P_E"]
    assert channel.noise_v / channel.lsb_v == pytest.approx(0.41, abs=0.01)
    noise = {"channel": "P_E", "kind": "noise"}
    text = submit_refused({**noise, "factor": 1.1}, scene)
    least = float(text.split()[5])
    assert 1.5 < least < 1.7
    sound = measure_noise(scene)
    more = measure_noise(scene, {**noise, "factor": least, "at_s": 0.0})
    # Rounding to counts adds a twelfth of a step squared to both.
    added = (least**2 - 1.0) * (channel.noise_v / channel.lsb_v) ** 2
    assert more == pytest.approx(math.sqrt(sound**2 + added), rel=0.15)


def test_crosstalk_below_a_step_of_a_coarse_converter_is_refused() -> None:
    scene, given = make_coarse_scene(12, 0.002), {"channel": "P_E", "kind": "crosstalk", "source": "P_N"}
    least = float(submit_refused({**given, "db": -100.0}, scene).split()[5])
    Simulation(scene).submit("fault", {**given, "db": least})
    submit_refused({**given, "db": least - 1.0}, scene)
    Simulation(SCENE).submit("fault", {**given, "db": -100.0})


@pytest.mark.parametrize(("channel", "kind", "at_s", "least_s"), [
    ("disk_x", "open", 0.0, 1e-6), ("disk_x", "open", 10e-6, 41e-6), ("P_E", "gain", 51e-6, 50e-6),
    ("forces", "dropout", 26e-6, 25e-6), ("forces", "stale-stamps", 0.0, 10_001e-6),
])  # fmt: skip
def test_a_fault_that_ends_before_the_next_sample_is_refused(
    channel: str, kind: str, at_s: float, least_s: float
) -> None:
    def scene(for_s: float) -> Simulation:
        fault = {"at_s": at_s, "channel": channel, "kind": kind, "for_s": for_s, **EXAMPLES.get(kind, {})}
        return Simulation(
            parse_scene({"duration_s": 0.05, "sensors": {"groups": ["probes", "forces"]}, "faults": [fault]})
        )

    scene(least_s)
    if least_s > 1e-6:
        with pytest.raises(InputError, match=f"for_s must be at least {least_s:g}, to reach a sample at 20000 Hz"):
            scene(least_s - 1e-6)


def test_a_block_delay_of_zero_is_refused() -> None:
    assert "delay_s must be" in submit_refused({"channel": "probes", "kind": "late-blocks", "delay_s": 1e-9})


@pytest.mark.parametrize("kind", sorted({*TOO_SMALL_FAULTS} - {"edge-jitter"}))
def test_the_reach_of_a_fault_has_no_sign(kind: str) -> None:
    """An inverting sensor and a negative size are not smaller than others."""
    table = SCENE.table.channels
    name, _, field = TOO_SMALL_FAULTS[kind]
    inverting = {n: one.model_copy(update={"sensitivity_v": -one.sensitivity_v}) for n, one in table.items()}
    fault = KINDS[kind].model_validate({"kind": kind, **EXAMPLES[kind]})
    reach_v = fault.reach_v(table[name], 0.1, table[name])
    assert reach_v > 0.0
    assert fault.reach_v(inverting[name], 0.1, inverting[name]) == reach_v
    if kind in ("offset", "drift"):
        opposite = fault.model_copy(update={field: -getattr(fault, field)})
        assert opposite.reach_v(table[name], 0.1, table[name]) == reach_v


@pytest.mark.parametrize(("kind", "numbers", "expected_v"), [
    ("gain", {"factor": 0.9}, 0.8), ("gain", {"factor": 1.1, "ramp_s": 0.4}, 0.2),
    ("gain", {"factor": -2.0, "ramp_s": 0.05}, 24.0), ("offset", {"value": -0.05}, 0.197),
    ("offset", {"value": 0.05, "ramp_s": 0.2}, 0.0985), ("drift", {"rate": -5.0}, 1.97),
    ("drift", {"rate": 5.0, "tau_s": 0.1}, 1.97 * (1.0 - math.exp(-1.0))),
    ("nonlinear", {"end": 1.0}, 8.0 - 3.94 * math.tanh(8.0 / 3.94)), ("late", {"late_us": 1.0}, 0.08 * math.pi),
    ("late", {"late_us": 1000.0}, 8.0), ("clock", {"ppm": 10.0}, 0.08 * math.pi),
    ("hum", {"amplitude_v": 0.2, "third": 0.5, "offset_v": -0.1}, 0.4), ("saturation", {"part": 0.75}, 2.0),
    ("hum", {"amplitude_v": 0.2, "frequency_hz": 1.0}, 0.2 * math.sin(0.2 * math.pi)),
    ("crosstalk", {"source": "disk_y", "db": -40.0}, 0.08), ("bandwidth", {"corner_hz": 4000.0}, 6.4),
    ("jitter", {"rms_us": 0.1}, 0.064 * math.pi), ("noise", {"factor": 1.5}, 2e-3), ("clip", {"part": 0.5}, 8.008),
    ("wander", {"amplitude_us": 1.0}, 0.08 * math.pi * (1.0 - math.cos(0.2 * math.pi))),
    ("wander", {"amplitude_us": 1.0, "period_s": 0.05}, 0.16 * math.pi), ("spikes", {"size_v": 0.3}, 0.3),
])  # fmt: skip
def test_the_reach_of_a_fault_follows_from_its_equation(
    kind: str, numbers: dict[str, float], expected_v: float
) -> None:
    """After 0.1 s, of a probe of 3.94 V/mm and 5 kHz with a range of 8 V to each side."""
    channel = SCENE.table.channels["disk_x"]
    fault = KINDS[kind].model_validate({"kind": kind, **numbers})
    assert fault.reach_v(channel, 0.1, channel) == pytest.approx(expected_v, rel=1e-12)


@pytest.mark.parametrize("ppm", [20.0, -20.0, 5e4, -5e4])
def test_a_clock_takes_samples_at_its_own_rate_until_it_is_ten_milliseconds_off(ppm: float) -> None:
    t = np.linspace(0.0, 2.0, 401)
    at = cast(At, SimpleNamespace(t=t))
    late_s = cast(Clock, KINDS["clock"].model_validate({"kind": "clock", "ppm": ppm})).late_s(at)
    taken_s = (0.0 if ppm > 0.0 else -0.01) + t / (1.0 + 1e-6 * ppm)  # a slow one begins late
    assert t - late_s == pytest.approx(np.clip(taken_s, t - 0.01, t), abs=1e-12)
