"""Hammer pulse on a modified rig, and its results: the basis of all scans in the report."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.studies.common.run import end_with_parent
from replays.studies.ladder.quantity import QUANTITIES, Trace, find_rolling_start
from rig.base.errors import InputError
from rig.physics.parameters import DEFAULT_SET, load_parameters
from rig.run.offline import Run, simulate
from rig.run.scenes import Scene, load_scene

if TYPE_CHECKING:
    from rig.physics.model import Model

FORCE_N = 100.0
"""Peak of the pulse [N], section 6.2 of the paper."""
SPEED_HZ = 6.2
CENTRED_BY = "ring.off_centre_y"
"""Pseudo-parameter of this report [mm]: height of the ring above its position centred on the shaft at rest."""
BANDWIDTH = "transducer.bandwidth"
"""Pseudo-parameter of this report [Hz]: corner of a second-order low-pass on the reactions; without it, none."""
HAMMER_MS = "hammer.duration"
"""Pseudo-parameter of this report [ms]: length of the pulse."""
PULSE_AT = "hammer.at"
"""Pseudo-parameter of this report [s]: time of the pulse; the shaft angle at the pulse determines the bounces."""
RATE_HZ = 10_000
MEASURED_N = 500.0
"""Last label of the axis of the measured forces, Fig. 15(c, d), the only number on them in the paper."""


@dataclass(frozen=True)
class Pulse:
    """A run with a hammer pulse.

    Attributes:
        label: Name of the run in a table.
        parameters: Parameter set.
        changes: Changes to scene or parameters by dotted key in their own units, or by the pseudo-parameters above.
        speed_hz: Speed of the drive [Hz].
        force_n: Peak of the half-sine [N].
        duration_s: Length of the run [s].
    """

    label: str = ""
    parameters: str = DEFAULT_SET
    changes: dict[str, Any] = field(default_factory=dict)
    speed_hz: float = SPEED_HZ
    force_n: float = FORCE_N
    duration_s: float = 1.2


@dataclass(frozen=True)
class PulseRun:
    """Results of a pulse; those of the whirl are NaN without whirl.

    Attributes:
        outcome: Final motion in a word.
        whirl_hz: Phase slope of the shaft in the ring [Hz], backward negative.
        spin_hz: Spin in whirl [Hz].
        normal_n: Mean normal force in whirl [N].
        ripple_n: RMS of the normal force about its mean [N].
        reaction_x_n: Amplitude of P_E - P_W in whirl [N], after the low-pass if there is one.
        reaction_y_n: Amplitude of P_N - P_S in whirl [N], likewise.
        depth_m: Mean penetration in whirl [m].
        ring_m: Mean radius of the orbit in the ring in whirl [m].
        disk_m: Largest |x| at the disk in whirl [m].
        peak_normal_n: Largest normal force of the whole run, at the engine's own steps [N].
        peak_x_n: Largest |P_E - P_W| of the whole run [N], after the low-pass if there is one.
        peak_y_n: Largest |P_N - P_S| of the whole run [N], likewise.
        true_peak_x_n: Largest |P_E - P_W| without the low-pass [N].
        true_peak_y_n: Largest |P_N - P_S| without the low-pass [N].
        contacts: Number of contacts.
        rebound_m_s: Largest rebound speed relative to the ring [m/s].
        slowest_hz: Lowest spin of the whole run [Hz].
        roll_s: Time from the pulse to lasting rolling [s].
        slope_n_s: Largest rate of P_E - P_W in whirl [N/s].
        imbalance: Spectral line of the reactions at the spin over that at the whirl frequency [1].
    """

    outcome: str
    whirl_hz: float = math.nan
    spin_hz: float = math.nan
    normal_n: float = math.nan
    ripple_n: float = math.nan
    reaction_x_n: float = math.nan
    reaction_y_n: float = math.nan
    depth_m: float = math.nan
    ring_m: float = math.nan
    disk_m: float = math.nan
    peak_normal_n: float = math.nan
    peak_x_n: float = math.nan
    peak_y_n: float = math.nan
    true_peak_x_n: float = math.nan
    true_peak_y_n: float = math.nan
    contacts: int = 0
    rebound_m_s: float = math.nan
    slowest_hz: float = math.nan
    roll_s: float = math.nan
    slope_n_s: float = math.nan
    imbalance: float = math.nan

    @property
    def whirls(self) -> bool:
        """True if it ends in full annular backward whirl."""
        return self.outcome == "backward whirl"


def pulse_scene(pulse: Pulse) -> Scene:
    """Return the scene of a pulse, with ideal sensors at a low rate."""
    changes = dict(pulse.changes)
    hammer_ms, at_s = float(changes.pop(HAMMER_MS, 5.0)), float(changes.pop(PULSE_AT, 0.02))
    changes.pop(BANDWIDTH, None)
    above_mm = changes.pop(CENTRED_BY, None)
    if above_mm is not None:
        changes["ring.offset_y"] = pulse_model(pulse, changes).sag * 1e3 + above_mm
    hammer = {"at_s": at_s, "command": "hammer", "force_n": pulse.force_n, "duration_ms": hammer_ms, "direction": "x"}
    return load_scene(
        "hammer",
        {
            "parameters": pulse.parameters,
            "duration_s": pulse.duration_s,
            "drive.speed_hz": pulse.speed_hz,
            "sensors.chain": "ideal",
            "sensors.groups": ["hammer"],
            "sensors.rate_hz": RATE_HZ,
            "commands": [hammer],
            **changes,
        },
    )


def pulse_model(pulse: Pulse, changes: dict[str, Any]) -> Model:
    """Return the model of a pulse with those changes that concern its parameters."""
    from rig.physics.model import build_model

    own = load_parameters(pulse.parameters)
    return build_model(own.override({key: v for key, v in changes.items() if key in own.entries}))


def outcome(pulse: Pulse) -> PulseRun:
    """Run a pulse and return its results; a rig that cannot be built is a result, too."""
    try:
        scene = pulse_scene(pulse)
        run = simulate(scene)
    except InputError:
        return PulseRun("cannot be built")
    return read_outcome(run, at_s=scene.commands[0].at_s, bandwidth_hz=pulse.changes.get(BANDWIDTH))


def make_trace(run: Run) -> Trace:
    """Return a run in the form used by the ladder's quantities."""
    contact, radius = run.simulation.model.constants.contact, run.simulation.model.constants.shaft.radius
    return Trace(
        times_s=run.times_s,
        rows=run.signals,
        peak_force=float(run.simulation.health()["peak_normal_force_n"]),
        clearance=contact.clearance,
        surface_radius=radius,
        first_impact_s=math.nan,
        rolls_s=find_rolling_start(run.times_s, run.signals, radius),
    )


def read_outcome(run: Run, *, at_s: float, bandwidth_hz: float | None = None) -> PulseRun:
    """Return the results of a finished run.

    Args:
        run: The run.
        at_s: Time of the pulse [s].
        bandwidth_hz: Corner of the low-pass on the reactions [Hz]; None: no low-pass.
    """
    trace = make_trace(run)

    def number(name: str) -> float:
        return float(QUANTITIES[name].read(trace))

    kind = str(QUANTITIES["outcome"].read(trace))
    pair_x, pair_y = (reaction(run, a, b, bandwidth_hz=bandwidth_hz) for a, b in (("P_E", "P_W"), ("P_N", "P_S")))
    whole = {
        "peak_normal_n": trace.peak_force,
        "peak_x_n": float(np.abs(pair_x).max()),
        "peak_y_n": float(np.abs(pair_y).max()),
        "true_peak_x_n": float(np.abs(run["P_E"] - run["P_W"]).max()),
        "true_peak_y_n": float(np.abs(run["P_N"] - run["P_S"]).max()),
        "rebound_m_s": rebound(run),
        "slowest_hz": float(run["spin_rate"].min() / (2.0 * math.pi)),
        "contacts": int(run.simulation.health()["contacts"]),
    }
    if kind != "backward whirl":
        return PulseRun(kind, **whole)
    settled = slice(-trace.settled_rows, None)
    return PulseRun(
        kind,
        whirl_hz=number("whirl_frequency"),
        spin_hz=number("spin"),
        normal_n=number("mean_normal_force"),
        ripple_n=number("force_ripple"),
        reaction_x_n=float(np.ptp(pair_x[settled]) / 2),
        reaction_y_n=float(np.ptp(pair_y[settled]) / 2),
        depth_m=float(trace.settled_signal("penetration").mean()),
        ring_m=float(np.hypot(run["ring_x"], run["ring_y"])[settled].mean()),
        disk_m=float(np.abs(run["disk_x"][settled]).max()),
        roll_s=number("time_to_roll") - at_s,
        slope_n_s=float(np.abs(np.diff(pair_x[settled])).max() * RATE_HZ),
        imbalance=_line(run, number("spin"), settled) / _line(run, number("whirl_frequency"), settled),
        **whole,
    )


def _line(run: Run, hz: float, rows: slice) -> float:
    """Return the amplitude of the rotating reactions at a frequency, backward negative."""
    forces = (run["P_E"] - run["P_W"] + 1j * (run["P_N"] - run["P_S"]))[rows]
    weights = np.hanning(len(forces)) * np.exp(-2j * math.pi * hz * run.times_s[rows])
    return float(abs(np.sum((forces - forces.mean()) * weights)))


def rebound(run: Run) -> float:
    """Return the largest rebound speed relative to the ring [m/s]; NaN without contact."""
    touched = np.logical_or.accumulate(run["penetration"] > 0.0)
    flies = touched & (run["penetration"] <= 0.0)
    inward = -np.diff(np.hypot(run["ring_x"], run["ring_y"])) / np.diff(run.times_s)
    return float(inward[flies[1:] & flies[:-1]].max(initial=0.0)) if touched.any() else math.nan


def reaction(run: Run, plus: str, minus: str, *, bandwidth_hz: float | None = None) -> np.ndarray:
    """Return the reaction in a direction: the difference of opposed transducers [N], shape (n,).

    Args:
        run: The run.
        plus: Positive transducer.
        minus: Opposed transducer.
        bandwidth_hz: Corner of a second-order Butterworth low-pass [Hz], or None.
    """
    pair = run[plus] - run[minus]
    return pair if bandwidth_hz is None else apply_low_pass(run, pair, bandwidth_hz)


def apply_low_pass(run: Run, signal: np.ndarray, bandwidth_hz: float) -> np.ndarray:
    """Return a signal of a run after a second-order Butterworth low-pass, shape (n,)."""
    from scipy.signal import butter, sosfilt

    rate_hz = 1.0 / (run.times_s[1] - run.times_s[0])
    sections: Any = butter(2, bandwidth_hz, fs=rate_hz, output="sos")
    return np.asarray(sosfilt(sections, signal))


def outcomes(
    pulses: Iterable[Pulse], *, processes: int, progress: Callable[[str], None] | None = None
) -> Iterator[PulseRun]:
    """Run many pulses and yield their outcomes in order.

    Args:
        pulses: The pulses.
        processes: Number of parallel processes; 1 uses this process.
        progress: Function that receives the label of each completed pulse.
    """
    pulses = list(pulses)
    report = progress or (lambda _: None)
    if processes == 1:
        for pulse in pulses:
            result = outcome(pulse)
            report(pulse.label)
            yield result
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=end_with_parent)
    try:
        for pulse, result in zip(pulses, pool.map(outcome, pulses, chunksize=4), strict=True):
            report(pulse.label)
            yield result
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
