"""Low-passes of a log's channels other than told: the motion is fitted and the channels are predicted with each."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from replays.recordings.identification.agreement import approach, rms
from replays.recordings.identification.nuisance import Tuned
from replays.recordings.resimulation.sensitivity import Predictor
from replays.recordings.validation.explanations.attribution import Explained
from replays.recordings.validation.explanations.channel_fit import least_at
from replays.recordings.validation.explanations.explanation import Explanation, excess
from replays.recordings.validation.explanations.timing import KINDS

_LENGTH_S = 3e-3
"""Length of the samples from the first contact on, which shows what a filter passes [s]."""
_CORNER_FACTORS = (0.35, 0.5, 0.7, 1.4, 2.0)
"""Corners tried first, relative to the told one."""
_REFINED, _REFINEMENTS = (0.75, 1.3), 5
"""Range of the corners tried about the best one, and their number."""
_MAX_RESIDUAL, _MIN_CORNER_CHANGE = 1.2, 0.1
"""Median residual over noise with a low-pass that is the cause, and its smallest relative change of the corner."""
_MIN_CHANNELS = 3
"""Fewest channels that are a group."""
_SEPARATE_CHANNELS = ("hammer", "keyphasor")
"""Channels that most recorders take from other conditioners."""


def explain_by_group_low_pass(tuned: Tuned, failed: Sequence[str], touched_s: float) -> Explained | None:
    """Return the explanation by another low-pass of all channels that were told the same one; None if it is not.

    Args:
        tuned: Fit of the log with the told low-passes.
        failed: Channels that fail; empty if the fit ended before they could.
        touched_s: First contact in the signals [s].
    """
    channels = {one.name: (group, one) for group, part in tuned.whole.items() for one in part.channels}
    told = Counter(one.low_pass for name, (_, one) in channels.items() if name not in _SEPARATE_CHANNELS).most_common(
        1
    )[0][0]
    alike = {
        name: group
        for name, (group, one) in channels.items()
        if name not in _SEPARATE_CHANNELS and one.low_pass == told
    }
    if len(alike) < _MIN_CHANNELS or (failed and 2 * len(alike.keys() & set(failed)) < len(alike)):
        return None
    told_kind, told_hz = str(told[0]), float(told[1] or 0.0)
    whole = {name: part.select_until(touched_s + _LENGTH_S) for name, part in tuned.whole.items()}
    priors = {one.key: one.prior for one in tuned.fitted}
    found: dict[tuple[str, float], tuple[float, np.ndarray]] = {}

    def cost(kind: str, corner_hz: float) -> float:
        """Return the cost of the channels with a low-pass, after a fit of the motion."""
        other = KINDS.get(kind, {}) | {"bandwidth_hz": corner_hz}
        parts = {name: part.with_low_pass([*alike], other) for name, part in whole.items()}
        predictor = Predictor(tuned.baseline, tuple(priors), parts)
        loose = zip(predictor.start, predictor.scales, strict=True)
        known = np.array([prior or held for prior, held in zip(priors.values(), loose, strict=True)]).T
        enabled = [name in alike for part in parts.values() for name in part.names]
        values, here = approach(predictor, predictor.start, known, by_residuals=True, enabled=enabled)
        left = [z for z, has in zip(here.apart, enabled, strict=True) if has]
        found[kind, corner_hz] = here.cost((values - known[0]) / known[1], enabled), np.array([rms(z) for z in left])
        return found[kind, corner_hz][0]

    tried = [("told", factor * told_hz) for factor in (1.0, *_CORNER_FACTORS)]
    own = {"filter": told[0], "filter_order": told[2], "group_delay_us": told[4]}
    for one in [*tried, *((kind, told_hz) for kind, other in KINDS.items() if other != own)]:
        cost(*one)
        if found[one][1].max() < _MAX_RESIDUAL:
            break
    if all(left.max() > _MAX_RESIDUAL for _, left in found.values()):
        best, near_hz = min(found, key=lambda one: found[one][0])
        ends = (math.log(factor * near_hz) for factor in _REFINED)
        least_at(lambda log_hz: cost(best, math.exp(log_hz)), *ends, most=_REFINEMENTS)
    kind, corner_hz = min(found, key=lambda one: found[one][0])
    left = found[kind, corner_hz][1]
    same = kind == "told" and abs(corner_hz / told_hz - 1.0) < _MIN_CORNER_CHANGE
    if same or float(np.median(left)) > _MAX_RESIDUAL:
        return None
    before = excess(found["told", told_hz][1])
    kind = told_kind if kind == "told" else kind
    change = f"low-pass of kind {kind} near {float(f'{corner_hz:.3g}'):g} Hz, told {told_kind} of {told_hz:g} Hz"
    explanation = Explanation.of(
        left, kind="sensor", name=f"{', '.join(alike)} bandwidth", change=change, value=corner_hz, unit="Hz",
        explained=1.0 - excess(left) / before if before > 0.0 else 0.0, to_s=touched_s + _LENGTH_S,
    )  # fmt: skip
    whose = ", ".join(dict.fromkeys(alike.values()))
    text = f"sensor: all {len(alike)} channels of {whose} behind a {change} ({explanation.left:.2f} of the noise left)"
    return Explained(touched_s, explanation.to_s, (explanation,), text, (explanation.name,))
