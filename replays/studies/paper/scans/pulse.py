"""A hammer pulse on a changed rig, and the numbers that come of it: what every scan of the report is made of."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.studies.common.run import end_with_parent
from replays.studies.ladder.quantity import QUANTITIES, Trace, rolls_from
from rig.base.errors import InputError
from rig.physics.parameters import DEFAULT_SET, load_parameters
from rig.run.offline import Run, simulate
from rig.run.scenes import Scene, load_scene

if TYPE_CHECKING:
    from rig.physics.model import Model

FORCE_N = 100.0
"""Peak of the pulse: the paper, section 6.2."""
SPEED_HZ = 6.2
CENTRED_BY = "ring.off_centre_y"
"""A name of this report alone [mm]: the ring's height over where it is centred on the shaft at rest."""
BANDWIDTH = "transducer.bandwidth"
"""A name of this report alone [Hz]: corner of a low-pass of order 2 on the reactions; left out, there is none."""
HAMMER_MS = "hammer.duration"
"""A name of this report alone [ms]: length of the pulse."""
PULSE_AT = "hammer.at"
"""A name of this report alone [s]: when it comes; the shaft's turn at the pulse decides which bounces follow."""
RATE_HZ = 10_000
MEASURED_N = 500.0
"""Last label of the axis of the measured forces, Fig. 15(c, d): the only number that the text has of them."""


@dataclass(frozen=True)
class Pulse:
    """What is run.

    Attributes:
        label: Names the run in a table.
        parameters: The parameter set.
        changes: Of scene or parameters by dotted key in their own units, or of the names above.
        speed_hz: Speed of the drive [Hz].
        force_n: Peak of the half-sine [N].
        duration_s: Of the run [s].
    """

    label: str = ""
    parameters: str = DEFAULT_SET
    changes: dict[str, Any] = field(default_factory=dict)
    speed_hz: float = SPEED_HZ
    force_n: float = FORCE_N
    duration_s: float = 1.2


@dataclass(frozen=True)
class Outcome:
    """The numbers of a pulse; those of the whirl are nan where it does not whirl.

    Attributes:
        outcome: The motion at the end, in a word.
        whirl_hz: Phase slope of the shaft in the ring [Hz], backward negative.
        spin_hz: Of the shaft while it whirls [Hz].
        normal_n: Mean normal force while it whirls [N].
        ripple_n: RMS of the normal force about that [N].
        reaction_x_n: Amplitude of P_E - P_W while it whirls [N], through the low-pass if there is one.
        reaction_y_n: Amplitude of P_N - P_S while it whirls [N], likewise.
        depth_m: Mean penetration while it whirls [m].
        ring_m: Mean radius of the orbit in the ring while it whirls [m].
        disk_m: Largest |x| at the disk while it whirls [m].
        peak_normal_n: Largest normal force of the whole run, by the engine's own steps [N].
        peak_x_n: Largest |P_E - P_W| of the whole run [N], through the low-pass if there is one.
        peak_y_n: Largest |P_N - P_S| of the whole run [N], likewise.
        true_peak_x_n: Largest |P_E - P_W| without it [N].
        true_peak_y_n: Largest |P_N - P_S| without it [N].
        contacts: Contacts begun.
        rebound_m_s: Fastest that the shaft flies off the ring, seen from the ring [m/s].
        slowest_hz: Lowest spin of the whole run [Hz].
        roll_s: From the pulse until it rolls for good [s].
        slope_n_s: Largest rate of P_E - P_W while it whirls [N/s].
        imbalance: Line of the reactions at the spin over that at the whirl frequency [1].
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
        """Whether it ends in full annular backward whirl."""
        return self.outcome == "backward whirl"


def pulse_scene(pulse: Pulse) -> Scene:
    """The scene of a pulse: ideal sensors, few rows."""
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
    """The model of a pulse with these changes, those that are not of its parameters left out."""
    from rig.physics.model import build_model

    own = load_parameters(pulse.parameters)
    return build_model(own.override({key: v for key, v in changes.items() if key in own.entries}))


def outcome(pulse: Pulse) -> Outcome:
    """Run a pulse and read its numbers; a rig that cannot be built is an outcome of its own."""
    try:
        scene = pulse_scene(pulse)
        run = simulate(scene)
    except InputError:
        return Outcome("cannot be built")
    return read(run, at_s=scene.commands[0].at_s, bandwidth_hz=pulse.changes.get(BANDWIDTH))


def trace_of(run: Run) -> Trace:
    """A run as the ladder's quantities read it."""
    contact, radius = run.simulation.model.constants.contact, run.simulation.model.constants.shaft.radius
    return Trace(
        times_s=run.times_s,
        rows=run.signals,
        peak_force=float(run.simulation.health()["peak_normal_force_n"]),
        clearance=contact.clearance,
        surface_radius=radius,
        first_impact_s=math.nan,
        rolls_s=rolls_from(run.times_s, run.signals, radius),
    )


def read(run: Run, *, at_s: float, bandwidth_hz: float | None = None) -> Outcome:
    """The numbers of a finished run.

    Args:
        run: The run.
        at_s: When the pulse came [s].
        bandwidth_hz: Corner of the low-pass on the reactions [Hz]; None: they are read as they are.
    """
    trace = trace_of(run)

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
        return Outcome(kind, **whole)
    settled = slice(-trace.settled_rows, None)
    return Outcome(
        kind,
        whirl_hz=number("whirl_frequency"),
        spin_hz=number("spin"),
        normal_n=number("mean_normal_force"),
        ripple_n=number("force_ripple"),
        reaction_x_n=float(np.ptp(pair_x[settled]) / 2),
        reaction_y_n=float(np.ptp(pair_y[settled]) / 2),
        depth_m=float(trace.settled("penetration").mean()),
        ring_m=float(np.hypot(run["ring_x"], run["ring_y"])[settled].mean()),
        disk_m=float(np.abs(run["disk_x"][settled]).max()),
        roll_s=number("time_to_roll") - at_s,
        slope_n_s=float(np.abs(np.diff(pair_x[settled])).max() * RATE_HZ),
        imbalance=_line(run, number("spin"), settled) / _line(run, number("whirl_frequency"), settled),
        **whole,
    )


def _line(run: Run, hz: float, rows: slice) -> float:
    """Height of the line of the reactions, as they turn, at a frequency, backward negative."""
    forces = (run["P_E"] - run["P_W"] + 1j * (run["P_N"] - run["P_S"]))[rows]
    weights = np.hanning(len(forces)) * np.exp(-2j * math.pi * hz * run.times_s[rows])
    return float(abs(np.sum((forces - forces.mean()) * weights)))


def rebound(run: Run) -> float:
    """Fastest that the shaft flies off the ring, seen from the ring [m/s]; nan where it never touched."""
    touched = np.logical_or.accumulate(run["penetration"] > 0.0)
    flies = touched & (run["penetration"] <= 0.0)
    inward = -np.diff(np.hypot(run["ring_x"], run["ring_y"])) / np.diff(run.times_s)
    return float(inward[flies[1:] & flies[:-1]].max(initial=0.0)) if touched.any() else math.nan


def reaction(run: Run, plus: str, minus: str, *, bandwidth_hz: float | None = None) -> np.ndarray:
    """Reaction of a direction: the difference of its opposed transducers [N], shape (n,).

    Args:
        run: The run.
        plus: One transducer.
        minus: The opposed one.
        bandwidth_hz: Corner of a Butterworth low-pass of order 2 [Hz], or None.
    """
    pair = run[plus] - run[minus]
    return pair if bandwidth_hz is None else low_passed(run, pair, bandwidth_hz)


def low_passed(run: Run, signal: np.ndarray, bandwidth_hz: float) -> np.ndarray:
    """A signal of a run through a Butterworth low-pass of order 2, shape (n,)."""
    from scipy.signal import butter, sosfilt

    rate_hz = 1.0 / (run.times_s[1] - run.times_s[0])
    sections: Any = butter(2, bandwidth_hz, fs=rate_hz, output="sos")
    return np.asarray(sosfilt(sections, signal))


def outcomes(
    pulses: Iterable[Pulse], *, processes: int, progress: Callable[[str], None] | None = None
) -> Iterator[Outcome]:
    """Run many pulses, in order.

    Args:
        pulses: What to run.
        processes: How many at a time; 1 for this process alone.
        progress: Told each label when it is done.
    """
    pulses = list(pulses)
    tell = progress or (lambda _: None)
    if processes == 1:
        for pulse in pulses:
            result = outcome(pulse)
            tell(pulse.label)
            yield result
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=end_with_parent)
    try:
        for pulse, result in zip(pulses, pool.map(outcome, pulses, chunksize=4), strict=True):
            tell(pulse.label)
            yield result
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
