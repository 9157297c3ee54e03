"""Contact of shaft and ring from the truth of the model: force over penetration, restitution, and rolling."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from replays.estimate.least_squares import solve
from replays.estimate.runs import find_true_runs
from replays.plots.plot import Plot, Table, describe_frame, describe_title, kind, make_axes
from replays.plots.signals import TRUTH, Signals, break_lines, compute_revolutions
from replays.report.canvas import BLACK, BLUE, ORANGE, SKY, axis_label
from rig.base.errors import InputError, Words
from rig.base.samples import Samples
from rig.channels.orbit import phase

_LINE_RATE_HZ = 5000.0
"""Rate of the truth from which its points in a contact are connected."""
_MIN_RATE_HZ = 1000.0
"""Rate of the truth from which it decides between contact and flight."""
_MAX_IMPACT_S = 5e-3
"""Longest contact that counts as an impact; Hertz's law with the rig's masses gives 0.3 ms at 0.15 m/s."""
_CONTACT_RATIO = 0.97
"""Ratio of the shaft's distance from the ring's centre to the clearance that counts as contact, without the truth."""
_MIN_ROLLING_TURNS = 1.0
"""Smallest whirl angle in a contact whose slope is given [turns]."""


def _read_truth(signals: Signals, what: str, *names: str) -> Samples:
    """Return quantities of the model's contact.

    Raises:
        InputError: The data do not have them.
    """
    names = tuple(TRUTH + name for name in names)
    if missing := [name for name in names if name not in signals.channels]:
        raise InputError(what, f"drawn of data with {', '.join(missing)}", Words("data without"))
    return signals.read(*names)


@kind()
def contact(signals: Signals, *, axes: Any = None) -> Plot:
    """Draw the normal force over the penetration, with the elastic force of the contact law.

    Args:
        signals: The data, with the truth of the contact.
        axes: Axes to draw on; None for a new figure.

    Returns:
        Axes and table: time, penetration, its rate, force, and force of the law at this penetration and rate.

    Raises:
        InputError: The data are without the truth, or without contact.
    """
    whole = _read_truth(signals, "contact", "penetration", "penetration_rate", "normal_force", "onset_speed")
    touching = whole.values[:, 0] > 0.0
    if not touching.any():
        raise InputError("contact", "in the data", Words("none"))
    (depth, rate, force, onset), index = whole.values[touching].T, whole.index[touching]
    law = signals.require_model("contact").constants.contact
    elastic = law.stiffness * depth**law.exponent
    speed = np.maximum(onset, law.speed_floor)
    expected = np.maximum(0.0, elastic * (1.0 + law.damping_factor * rate / speed) + law.viscous_damping * rate)
    note = "penetration of shaft and ring, truth of the model; above the dashed line: compression, below: release"
    (panel,) = make_axes(axes, 1, 1, height=5.6, title=describe_title(signals, "Contact force"), note=note)
    lined = whole.rate_hz >= _LINE_RATE_HZ
    panel.plot(
        *break_lines(np.diff(index) != 1, 1e6 * depth, force), ".-" if lined else ".", color=SKY, lw=0.8, ms=3.5,
        label=f"{len(find_true_runs(touching))} contacts" if lined else "contacts, rows of the truth",
    )  # fmt: skip
    deep = np.linspace(0.0, depth.max(), 100)
    label = f"law without damping, K δ^{law.exponent:.3g}"
    panel.plot(1e6 * deep, law.stiffness * deep**law.exponent, "--", color=BLACK, lw=1.4, label=label)
    panel.set(xlabel="penetration δ [µm]", ylabel="normal force [N]", xlim=(0.0, None), ylim=(0.0, None))
    panel.legend(loc="upper left")
    columns = {
        "time": ("s", whole.times_s[touching]),
        "penetration": ("m", depth),
        "penetration rate": ("m/s", rate),
        "force": ("N", force),
        "law": ("N", expected),
    }
    return Plot((panel,), Table.from_columns(note, **columns))


@kind()
def restitution(signals: Signals, *, axes: Any = None) -> Plot:
    """Draw the restitution of each impact over its approach speed, and that of the contact law in a free impact.

    Approach and separation speed are extrapolated from the rows before and after the contact.

    Args:
        signals: The data, with the truth of the contact.
        axes: Axes to draw on; None for a new figure.

    Returns:
        Axes and table: time, approach and separation speed, restitution, largest force and duration of each impact.

    Raises:
        InputError: The data are without the truth, or without an impact of at least three rows.
    """
    from rig.physics.contacts import returned_restitution

    whole = _read_truth(signals, "restitution", "penetration", "penetration_rate", "normal_force")
    depth, rate, force = whole.values.T
    times_s, last, rows = whole.times_s, len(whole) - 1, []
    for begin, end in find_true_runs(depth > 0.0):
        if (
            end - begin < 3
            or begin < 2
            or end >= last
            or whole.index[end + 1] - whole.index[begin - 2] != end - begin + 3
        ):
            continue
        ends = []
        for inner, outer in ((begin - 1, begin - 2), (end, end + 1)):
            # The gap is crossed by the speed of the nearest free row, which changes slowly in flight.
            wait_s = -depth[inner] / rate[inner]
            slope = (rate[inner] - rate[outer]) / (times_s[inner] - times_s[outer])
            ends.append((times_s[inner] + wait_s, rate[inner] + slope * wait_s))
        (from_s, approach), (to_s, separation) = ends
        if approach > 0.0 > separation and to_s - from_s < _MAX_IMPACT_S:
            rows.append((from_s, approach, -separation, -separation / approach, force[begin:end].max(), to_s - from_s))
    if not rows:
        rate_hz = f"none, at {whole.rate_hz:g} rows/s of the truth"
        raise InputError("restitution", "drawn of data with impacts of three rows of the truth", Words(rate_hz))
    names = ("time", "approach", "separation", "restitution", "largest force", "duration")
    units = ("s", "m/s", "m/s", "1", "N", "s")
    columns = {name: (unit, each) for name, unit, each in zip(names, units, np.transpose(rows), strict=True)}
    note = (
        "speeds relative to the ring (truth of the model); its vibration may give values above 1; law: two free bodies"
    )
    (panel,) = make_axes(axes, 1, 1, height=5.0, title=describe_title(signals, "Restitution"), note=note)
    approach, ratio = columns["approach"][1], columns["restitution"][1]
    panel.semilogx(approach, ratio, "o", ms=4.5, color=BLUE, label=f"{len(rows)} impacts")
    if signals.model is not None and (law := signals.model().constants.contact).viscous_damping == 0.0:
        speeds = np.geomspace(0.7 * approach.min(), 1.4 * approach.max(), 100)
        line = [returned_restitution(law.damping_factor * v / max(v, law.speed_floor)) for v in speeds]
        panel.semilogx(speeds, line, "--", color=BLACK, lw=1.4, label="contact law")
    panel.set(xlabel="approach speed [m/s]", ylabel="restitution", ylim=(0.0, max(1.05, 1.05 * ratio.max())))
    panel.legend(loc="best")
    return Plot((panel,), Table.from_columns(note, **columns))


@kind()
def rolling(signals: Signals, *, pair: str | None = None, axes: Any = None) -> Plot:
    """Draw the path of the shaft's centre in contact, and its angle over the angle of rotation of the shaft.

    A shaft that rolls in the ring has a backward whirl of R_S/(r0 + δ) times its rotation.

    Args:
        signals: The data.
        pair: Common part of the two probes' names; None for `ring`, or the first pair.
        axes: Axes to draw on, for path and angle; None for a new figure.

    Returns:
        Axes and table: time, x and y, angle of rotation and of the centre, and whether shaft and ring touch (1) or not
        (0).

    Raises:
        InputError: There is no contact, no clearance or no keyphasor.
    """
    if (name := TRUTH + "penetration") in signals.channels:  # decides before long channels are read
        truth = signals.read(name)
        if truth.rate_hz >= _MIN_RATE_HZ and not (truth.values > 0.0).any():
            raise InputError("contact", "in the data", Words("none"))
    probes = signals.read_pair(pair or ("ring" if "ring" in signals.pairs else None))
    samples, x, y = probes.samples, probes.x, probes.y
    times_s, radius = samples.times_s, probes.clearance
    touching, depth, criterion = _find_contact(signals, samples, np.hypot(x, y), radius)
    if not touching.any():
        raise InputError("contact", "in the data", Words("none"))
    theta = TRUTH + "theta"
    if theta in signals.channels:
        model = signals.read(theta)
        turns = np.interp(times_s, model.times_s, model.values[:, 0] / (2.0 * math.pi), right=np.nan)
    else:
        turns = compute_revolutions(times_s, signals.require_edges("rolling"))
    touching &= np.isfinite(turns)
    if not touching.any():
        raise InputError("contact", "in the data", Words("none"))
    whirl = phase(x, y) / (2.0 * math.pi)
    breaks = np.diff(samples.index) != 1
    drawn = np.where(touching, 1.0, np.nan)
    note = f"{describe_frame(signals)}; thick: contact, {criterion}"
    title = describe_title(signals, f"Contact at {probes.name}")
    path, angle = make_axes(axes, 1, 2, height=5.2, title=title, note=note)
    path.plot(*break_lines(breaks, x, y), color="0.6", lw=0.6)
    path.plot(*break_lines(breaks, drawn * x, drawn * y), color=BLUE, lw=1.8)
    if radius:
        circle = radius * np.exp(2j * math.pi * np.linspace(0.0, 1.0, 361))
        path.plot(circle.real, circle.imag, color=BLACK, ls="--", lw=0.9)
    path.set(xlabel=axis_label("x", probes.unit), ylabel=axis_label("y", probes.unit), aspect="equal")
    path.set_title("path of the centre")
    angle.plot(*break_lines(breaks, turns, whirl), color="0.6", lw=0.6)
    angle.plot(*break_lines(breaks, turns, drawn * whirl), color=BLUE, lw=1.8, label="in contact")
    begin, end = max(find_true_runs(touching & ~np.append(breaks, True)), key=lambda run: run[1] - run[0])
    if abs(whirl[end - 1] - whirl[begin]) > _MIN_ROLLING_TURNS:
        slope = float(solve(np.vander(turns[begin:end], 2), whirl[begin:end])[0])
        angle.set_title(f"{slope:.3f} turns per revolution".replace("-", "−"))
        if signals.model is not None:
            constants = signals.model().constants
            law = -constants.shaft.radius / (constants.contact.clearance + depth)
            line = whirl[begin] + law * (turns[begin:end] - turns[begin])
            label = f"rolling: {law:.3f}".replace("-", "−")
            angle.plot(turns[begin:end], line, "--", color=ORANGE, lw=1.4, label=label)
    angle.set(xlabel="rotation of the shaft [turns]", ylabel="angle of the centre [turns]")
    angle.legend(loc="best")
    columns = {
        "time": ("s", times_s),
        "x": (probes.unit, x),
        "y": (probes.unit, y),
        "rotation": ("turns", turns),
        "whirl": ("turns", whirl),
        "contact": ("1", touching),
    }
    return Plot((path, angle), Table.from_columns(note, **columns))


def _find_contact(
    signals: Signals, samples: Samples, distance: np.ndarray, radius: float | None
) -> tuple[np.ndarray, float, str]:
    """Return whether shaft and ring touch at each row, the mean penetration [m], and the criterion.

    Raises:
        InputError: There is neither the truth of the contact nor a clearance.
    """
    depth = 0.0
    if (name := TRUTH + "penetration") in signals.channels:
        truth = signals.read(name)
        deep = truth.values[:, 0]
        depth = float(deep[deep > 0.0].mean()) if (deep > 0.0).any() else 0.0
        if truth.rate_hz >= _MIN_RATE_HZ:
            touching = np.interp(samples.times_s, truth.times_s, deep, left=-1.0, right=-1.0) > 0.0
            return touching, depth, "by the truth of the model"
    if radius is None:
        raise InputError("rolling", "drawn of a pair of probes in a plane with a known clearance", Words("none"))
    return distance > _CONTACT_RATIO * radius, depth, f"from {_CONTACT_RATIO:.0%} of the clearance"
