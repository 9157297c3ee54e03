"""Kinds of faults in tests: an example of each, and its effect on monitor, scorecard and blind validation.

A new kind needs its entry in each of these tables; tests/unit/test_entries.py names the ones that lack it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from rig.channels.faults import KINDS
from rig.channels.faults.defects import DEFECTS
from rig.channels.table import default_table

NUMBERED = (
    "gain", "offset", "drift", "polarity", "stuck", "nonlinear", "open", "short", "intermittent", "hum", "crosstalk",
    "saturation", "swap", "resonance", "no-filter", "bandwidth", "late", "clock", "jitter", "wander", "noise",
    "spikes", "bits", "stuck-bit", "clip", "freeze", "miss-pulses", "extra-pulses", "edge-jitter", "dropout",
    "lose-blocks", "duplicate-blocks", "reorder-blocks", "late-blocks", "stale-stamps", "restart",
)  # fmt: skip
"""Kinds numbered from 1 on CAN; the numbers never change, because users' DBC files contain them. New kinds follow."""
EXAMPLES: dict[str, dict[str, Any]] = {
    "gain": {"factor": 1.1}, "offset": {"value": 0.05}, "drift": {"rate": 5.0}, "polarity": {}, "stuck": {},
    "nonlinear": {"end": 0.01}, "open": {"level_v": 1.0}, "short": {}, "intermittent": {"part": 0.5, "slot_s": 0.002},
    "hum": {"amplitude_v": 0.1}, "crosstalk": {"source": "P_N", "db": -20.0}, "saturation": {"part": 0.001},
    "swap": {"other": "speed"}, "no-filter": {}, "bandwidth": {"corner_hz": 50.0}, "late": {"late_us": 2000.0},
    "clock": {"ppm": 5e4}, "jitter": {"rms_us": 100.0}, "wander": {"amplitude_us": 2000.0, "period_s": 0.05},
    "noise": {"factor": 3.0}, "spikes": {"rate_hz": 500.0, "size_v": 0.5}, "bits": {"lost": 6},
    "stuck-bit": {"bit": 8}, "clip": {"part": 1e-4}, "freeze": {}, "miss-pulses": {"part": 1.0},
    "extra-pulses": {"part": 1.0}, "edge-jitter": {"rms_us": 300.0}, "resonance": {"frequency_hz": 80.0},
}  # fmt: skip
"""Parameters of each kind that changes channels; each changes counts of `disk_x` or of the keyphasor."""
BLOCKS: dict[str, dict[str, Any]] = {
    "dropout": {}, "lose-blocks": {"part": 0.5}, "duplicate-blocks": {"part": 0.5}, "reorder-blocks": {"part": 0.5},
    "late-blocks": {"delay_s": 0.033}, "stale-stamps": {}, "restart": {},
}  # fmt: skip
"""Parameters of each kind that changes blocks."""

BENIGN, ONE, BROKEN, BLIND = ("-",) * 4, ("T", "a", "a", "T"), ("N", "N", "N", "TN"), ("N", "N", "TN", "TN")
MONITORED: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    # kind: its parameters, result by vote (VOTES of protection_acceptance); the signal is 200 um peak-to-peak at 10 Hz.
    # A false level above 1000 um within the OK limits: danger on one probe.
    "gain": ({"factor": 8.0}, ONE),
    "offset": ({"value": 1.2}, ONE),
    "hum": ({"amplitude_v": 2.5}, ONE),
    "stuck-bit": ({"bit": 21}, ONE),  # 2^21 of 2^24 counts over 40 V: 5 V, 1.27 mm
    # Output at 0 V, or outside the converter's range: NOT OK in time, no alarm of this probe.
    "open": ({}, BROKEN),
    "short": ({}, BROKEN),
    "intermittent": ({"part": 0.2}, BROKEN),
    "clip": ({"part": 0.05}, BROKEN),  # at -1 V
    # The ramp to the OK limit, 1.9 mm at 20 mm/s, exceeds 500 um for longer than the delay; 1000 um not.
    "drift": ({"rate": 20.0}, ("aN", "aN", "aN", "TN")),
    # Faults that keep the level or reduce it.
    **{kind: ({}, BENIGN) for kind in ("polarity", "stuck", "freeze")},
    "nonlinear": ({"end": 0.02}, BENIGN),
    "resonance": ({"frequency_hz": 200.0}, BENIGN),
    "crosstalk": ({"source": "disk_y", "db": -6.0}, BENIGN),
    "saturation": ({"part": 0.01}, BENIGN),
    "swap": ({"other": "disk_y"}, BENIGN),
    "late": ({"late_us": 1000.0}, BENIGN),
    "clock": ({"ppm": 100.0}, BENIGN),
    "jitter": ({"rms_us": 5.0}, BENIGN),
    "wander": ({"amplitude_us": 100.0}, BENIGN),
    "noise": ({"factor": 100.0}, BENIGN),  # 25 um rms
    "spikes": ({"rate_hz": 10.0, "size_v": 1.0}, BENIGN),  # 250 um
    "bits": ({"lost": 8}, BENIGN),
    # Block faults: 0.5 s without a block exceeds the window, and so do renumbered rows.
    "dropout": ({"channel": "probes"}, BLIND),
    "restart": ({"channel": "probes"}, BLIND),
    **{kind: ({"channel": "probes"}, BENIGN) for kind in ("lose-blocks", "duplicate-blocks", "reorder-blocks")},
    "late-blocks": ({"channel": "probes", "delay_s": 0.1}, BENIGN),
    "stale-stamps": ({"channel": "probes"}, BENIGN),
}
MONITORED_PULSES: dict[str, tuple[dict[str, Any], set[str]]] = {
    # kind: its parameters, result at 6.2 Hz. Overspeed: 7 Hz for three turns; missing pulse: 0.3 s.
    "miss-pulses": ({"part": 1.0}, {"speed-lost"}),
    "extra-pulses": ({"part": 1.0}, {"overspeed", "trip"}),
    "edge-jitter": ({"rms_us": 100.0}, set()),
}

DEFECT_OF = {kind: name for name, each in DEFECTS.items() for kind in each.faults}
"""Name in the table of defects of each kind of fault."""


def size_of(kind: str, numbers: dict[str, Any], channel: str) -> float | None:
    """Return the size of a fault in the unit of its defect on a channel; None if it has no size."""
    defect, about = DEFECTS[DEFECT_OF[kind]], default_table().channels[channel]
    name = defect.faults[kind]
    if not name:
        return None
    scale = 1e-6 if name.endswith("_us") else 1.0
    if name.endswith("_v") and defect.unit != "V":
        scale = 1.0 / abs(about.sensitivity_v)
    return scale * (numbers.get(name, KINDS[kind].model_fields[name].default) - defect.neutral)


class FaultCase(NamedTuple):
    """A fault on a channel; the table of defects lists the scorecard quantities that it makes fail."""

    channel: str
    numbers: dict[str, Any]


SCORED = {
    "gain": FaultCase("disk_x", {"factor": 1.001}),
    "offset": FaultCase("disk_y", {"value": 0.01}),
    "drift": FaultCase("ring_x", {"rate": 0.1}),
    "polarity": FaultCase("P_N", {}),
    "resonance": FaultCase("P_W", {"frequency_hz": 800.0, "quality": 5.0}),
    "stuck": FaultCase("P_S", {}),
    "nonlinear": FaultCase("P_E", {"end": 4000.0}),
    "open": FaultCase("outer_y", {}),
    "short": FaultCase("inner_x", {}),
    "intermittent": FaultCase("inner_y", {"slot_s": 0.002}),
    "hum": FaultCase("outer_x", {"amplitude_v": 0.02}),
    "crosstalk": FaultCase("P_W", {"source": "disk_x", "db": -30.0}),
    "saturation": FaultCase("disk_x", {"part": 0.2}),
    "swap": FaultCase("disk_y", {"other": "ring_x"}),
    "no-filter": FaultCase("P_N", {}),
    "bandwidth": FaultCase("P_S", {"corner_hz": 500.0}),
    "late": FaultCase("P_E", {"late_us": 3.0}),
    "clock": FaultCase("P_W", {"ppm": 500.0}),
    "jitter": FaultCase("ring_y", {"rms_us": 0.5}),
    "wander": FaultCase("inner_y", {"amplitude_us": 1.0, "period_s": 0.1}),
    "noise": FaultCase("outer_x", {"factor": 3.0}),
    "spikes": FaultCase("outer_y", {"rate_hz": 50.0, "size_v": 0.5}),
    "bits": FaultCase("disk_x", {"lost": 13}),
    "stuck-bit": FaultCase("disk_y", {"bit": 14}),
    "clip": FaultCase("ring_x", {"part": 0.55}),
    "freeze": FaultCase("P_N", {}),
    "miss-pulses": FaultCase("keyphasor", {"part": 1.0}),
    "extra-pulses": FaultCase("keyphasor", {"part": 1.0}),
    "edge-jitter": FaultCase("keyphasor", {"rms_us": 300.0}),
}

BLIND_SIZES: dict[str, tuple[str, list[dict[str, Any]]]] = {
    "gain": ("P_E", [{"factor": 1.005}, {"factor": 1.5}]), "offset": ("ring_x", [{"value": 0.002}, {"value": 0.2}]),
    "drift": ("P_N", [{"rate": 2.0}, {"rate": 200.0, "tau_s": 0.05}]), "polarity": ("inner_y", [{}]),
    "resonance": ("P_E", [{"frequency_hz": 300.0, "quality": 20.0}]), "stuck": ("P_S", [{}]),
    "nonlinear": ("disk_x", [{"end": 5.0}, {"end": 1.0}]), "open": ("disk_y", [{}]),
    "short": ("P_S", [{}]), "intermittent": ("disk_x", [{"part": 0.2, "slot_s": 0.002}]),
    "hum": ("ring_x", [{"amplitude_v": 0.005}, {"amplitude_v": 0.3, "frequency_hz": 60.0, "third": 0.5}]),
    "crosstalk": ("disk_x", [{"source": "disk_y", "db": -60.0}]), "saturation": ("P_E", [{"part": 0.32}]),
    "swap": ("P_N", [{"other": "P_S"}, {"other": "inner_y"}]), "no-filter": ("inner_x", [{}]),
    "bandwidth": ("P_E", [{"corner_hz": 3000.0}, {"corner_hz": 200.0}]),
    "late": ("P_E", [{"late_us": 5.0}, {"late_us": 500.0}]), "clock": ("disk_x", [{"ppm": 1000.0}, {"ppm": -3000.0}]),
    "jitter": ("disk_x", [{"rms_us": 5.0}]), "wander": ("disk_x", [{"amplitude_us": 50.0, "period_s": 0.1}]),
    "noise": ("P_E", [{"factor": 1.2}]), "spikes": ("P_E", [{"rate_hz": 40.0, "size_v": 0.02}]),
    "bits": ("disk_x", [{"lost": 2}]), "stuck-bit": ("disk_x", [{"bit": 12}]), "clip": ("P_E", [{"part": 0.32}]),
    "freeze": ("ring_y", [{}]), "miss-pulses": ("keyphasor", [{"part": 0.5}]),
    "extra-pulses": ("keyphasor", [{"part": 0.5}]), "edge-jitter": ("keyphasor", [{"rms_us": 300.0}]),
}  # fmt: skip
