"""Comparison of two recordings by phase and channel; no model is simulated."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from typing import Any

import numpy as np

from recorder.reader import Recording
from replays.estimate.intervals import student_quantile
from replays.recordings.changes.estimates import (
    MIN_STEADY_ROWS,
    Estimate,
    decay_rate,
    rotation,
    steady,
    transient,
    widen,
)
from replays.recordings.formats.guessing.noise import corner_hz, estimate_noise
from replays.recordings.resimulation.prediction import Measured
from replays.recordings.validation.phases import (
    CONTACT,
    FORCES,
    PHASES,
    RING,
    WINDOW_S,
    Phase,
    View,
    find_phases,
    select_view,
)
from replays.recordings.whirl import parameter_si
from replays.report import OUTCOME_MARKS, Report, Row
from rig.base.errors import InputError
from rig.base.outcome import Outcome
from rig.base.text import build_html_table, replace_nonfinite
from rig.channels.orbit import phase as unwrapped_angle

CONFIDENCE = 0.95
"""Probability that no row changes between two recordings of the same signals."""
HEADINGS = ("phase", "channel", "quantity", "A", "B", "difference", "changed")
_STEADY_PHASES = ("free run", "whirl", "rest")
_WHOLE_RUN = "recording"
_KEYPHASOR = "keyphasor"
_TOUCH_FLOORS = 6.0
"""Noise by which the shaft must exceed the clearance for contact, as in a validation."""
_MIN_EDGES = 4
_EDGE_ROUNDING_S = 1e-6
"""Smallest uncertainty of a keyphasor edge [s]."""


@dataclass(frozen=True)
class Change:
    """Difference of a quantity between two recordings.

    Attributes:
        phase: Phase of the run.
        channel: Channel, or a combination such as `reaction`.
        quantity: Name of the quantity.
        unit: Its unit.
        a: Estimate of the first recording.
        b: Estimate of the second one.
        tests: Number of all rows, for the simultaneous interval.
    """

    phase: str
    channel: str
    quantity: str
    unit: str
    a: Estimate
    b: Estimate
    tests: int

    @property
    def difference(self) -> float:
        """Second value minus first; of a phase within ±180°."""
        off = self.b.value - self.a.value
        return math.remainder(off, 360.0) if self.unit == "°" else off

    @property
    def half(self) -> float:
        """Half width of the simultaneous interval of the difference (Bonferroni, Welch's degrees of freedom)."""
        squares = self.a.deviation**2, self.b.deviation**2
        if not sum(squares) > 0.0:
            return 0.0
        dof = sum(squares) ** 2 / (squares[0] ** 2 / self.a.dof + squares[1] ** 2 / self.b.dof)
        quantile = student_quantile(1.0 - 0.5 * (1.0 - CONFIDENCE) / self.tests, dof)
        return float(quantile) * math.sqrt(sum(squares))

    @property
    def changed(self) -> bool:
        """True if the interval of the difference excludes zero."""
        return abs(self.difference) > self.half

    @property
    def size(self) -> float:
        """Difference over the half width of its interval."""
        if self.difference == 0.0:
            return 0.0
        return abs(self.difference) / self.half if self.half > 0.0 else math.inf

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a table with `HEADINGS`."""
        name = self.quantity + (f" [{self.unit}]" if self.unit not in ("", "1") else "")
        values = (f"{one.value:.6g} ± {one.half:.2g}" for one in (self.a, self.b))
        off = f"{self.difference:+.3g} ± {self.half:.2g}"
        return self.phase, self.channel, name, *values, off, "changed" if self.changed else ""


@dataclass(frozen=True)
class Comparison:
    """Comparison of two recordings.

    Attributes:
        files: Names of the recordings.
        changes: Rows, the largest change first.
        missing: Phases, channels or quantities that only one recording has, as text.
    """

    files: tuple[str, str]
    changes: tuple[Change, ...]
    missing: tuple[str, ...]

    @property
    def changed(self) -> tuple[Change, ...]:
        """Rows that changed."""
        return tuple(one for one in self.changes if one.changed)

    @property
    def outcome(self) -> Outcome:
        """Fail if a row changed, inconclusive if something exists in one recording only, otherwise pass."""
        return Outcome.judge(failed=bool(self.changed), has_evidence=bool(self.changes) and not self.missing)

    @property
    def line(self) -> str:
        """Result in one line."""
        text = f"{len(self.changed)} of {len(self.changes)} rows changed"
        if self.changed:
            places = Counter((one.phase, one.channel) for one in self.changed)
            named = [f"{channel} in {phase} ({count})" for (phase, channel), count in places.items()]
            more = f", and {len(named) - 3} more" if named[3:] else ""
            return f"{text}, largest first: {', '.join(named[:3])}{more}"
        return f"inconclusive: {text}, but not everything could be compared" if self.missing else text

    def document(self) -> dict[str, Any]:
        """Return the comparison as a JSON document."""
        rows = [
            {
                "phase": one.phase, "channel": one.channel, "quantity": one.quantity, "unit": one.unit,
                "a": one.a.value, "a_half": one.a.half, "b": one.b.value, "b_half": one.b.half,
                "difference": one.difference, "half": one.half, "changed": one.changed,
            }
            for one in self.changes
        ]  # fmt: skip
        document = {
            "files": list(self.files), "outcome": self.outcome.value, "line": self.line, "confidence": CONFIDENCE,
            "changed": len(self.changed), "rows": rows, "missing": list(self.missing),
        }  # fmt: skip
        return replace_nonfinite(document)

    def report(self, origin: Mapping[str, str] | None = None) -> Report:
        """Return the comparison as a report."""
        marks = {True: OUTCOME_MARKS[Outcome.FAIL], False: OUTCOME_MARKS[Outcome.PASS]}
        a, b = self.files
        report = Report(f"{b} against {a}", f"{self.line}.", origin=origin, mark=OUTCOME_MARKS[self.outcome])
        report.text(NOTE)
        for line in self.missing:
            report.text(line)
        report.table(HEADINGS, [Row(one.cells, marks[one.changed]) for one in self.changes], caption=f"A: {a}, B: {b}")
        return report

    def _repr_html_(self) -> str:
        return build_html_table(self.line, HEADINGS, (one.cells for one in self.changes))


NOTE = (
    "A and B: value and 95 % interval. Difference: B - A and its interval, for 95 % of all rows together. Before the "
    "contact, in whirl and at rest the interval follows from blocks of the phase, with their correlation. Impacts and "
    "decays occur once: their interval contains the noise of the channel, and repeated runs may differ by more."
)


class _Log:
    """Signals of a recording, its phases and the angle of its shaft."""

    def __init__(self, recording: Recording) -> None:
        self.recording, self.parts, self.edges = recording, _read(recording), recording.edges()
        channels = [(one, part, c) for part in self.parts.values() for c, one in enumerate(part.channels)]
        self.noise = {one.name: float(part.floor[c]) for one, part, c in channels}
        self.colour = {one.name: _colour(part.values[:, c], one.rate_hz) for one, part, c in channels}
        self.units = {one.name: one.unit for one, _, _ in channels}
        self.rates = {one.name: float(one.rate_hz) for one, _, _ in channels}
        self.step = {one.name: abs(one.lsb_v / one.sensitivity_v) for one, _, _ in channels}
        self.values = {name: part.values for name, part in self.parts.items()}
        self.begin_s = min(float(part.times_s[0]) for part in self.parts.values())
        self.end_s = max(float(part.times_s[-1]) for part in self.parts.values()) + 1e-9
        commands = [float(one["time_s"]) for one in recording.events if one.get("event") == "hammer"]
        commands += [float(one["at_s"]) for one in recording.scene.get("commands", ()) if "force_n" in one["request"]]
        self.hammer_s = min((time for time in commands if self.begin_s < time < self.end_s), default=None)
        self.touches, self.phases = math.nan, dict[str, Phase]()

    def clearance(self) -> float:
        """Return the distance from the ring's centre that shows contact [mm]; nan if unknown."""
        try:
            return parameter_si(self.recording, "ring.clearance") * 1e3 + _TOUCH_FLOORS * self.noise["ring_x"]
        except (KeyError, TypeError, ValueError):
            return math.nan

    def find_phases(self, touches: float, common: Set[str]) -> None:
        """Find the phases by common channels and distance of contact; they begin at the hammer pulse, if any."""
        self.touches = touches
        view = self.view(Phase("", self.begin_s, self.end_s), {})
        base = {name: float(np.median(view.values[name][:MIN_STEADY_ROWS])) for name in FORCES if name in view.values}
        self.base = base
        floor = math.hypot(*(self.noise.get(name, 0.0) for name in FORCES))
        view = self.view(Phase("", self.begin_s, self.end_s), base)
        for name in {*RING, *FORCES} - common:
            view.values.pop(name, None)
        found = find_phases(view, floor_n=floor)
        hit, count = self.hammer_s, Counter[str]()
        for one in found:
            pieces = [one]
            if one.name == PHASES[0] and hit is not None and one.from_s < hit:
                after = [] if len(found) > 1 or one.to_s <= hit else [Phase(PHASES[-1], hit, one.to_s)]
                pieces = [Phase(one.name, one.from_s, min(hit, one.to_s)), *after]
            for piece in pieces:
                count[piece.name] += 1
                self.phases[f"{piece.name} {count[piece.name]}" if count[piece.name] > 1 else piece.name] = piece

    def view(self, phase: Phase, base: dict[str, float]) -> View:
        """Return the signals of a phase."""
        return select_view(self.parts, self.values, phase, base=base, touches=self.touches)

    def turns(self, times_s: np.ndarray) -> np.ndarray | None:
        """Return the angle of the shaft from the keyphasor's edges [revolutions]; None without enough edges."""
        edges = self.edges
        if len(edges) < _MIN_EDGES:
            return None
        count = np.arange(len(edges), dtype=float)
        turns = np.interp(times_s, edges, count)
        for end, period, beyond in (
            (0, edges[1] - edges[0], times_s < edges[0]), (-1, edges[-1] - edges[-2], times_s > edges[-1]),
        ):  # fmt: skip
            turns[beyond] = count[end] + (times_s[beyond] - edges[end]) / period
        return turns

    def estimates(self, name: str, length_s: float) -> dict[tuple[str, str, str], Estimate]:
        """Return the estimates of a phase, by channel, quantity and unit.

        Args:
            name: Name of the phase.
            length_s: Length of a transient that both recordings have [s].
        """
        phase = self.phases[name]
        is_steady = phase.name in _STEADY_PHASES
        if not is_steady:
            phase = Phase(phase.name, phase.from_s, min(phase.to_s, phase.from_s + length_s))
        view = self.view(phase, self.base)
        found: dict[tuple[str, str, str], Estimate] = {}
        whole = None if is_steady else self.view(Phase("", self.begin_s, self.end_s), self.base)
        for channel, variants in self._signals(view, phase):
            like, values = _SOURCE.get(channel, channel), variants[0]
            unit, rate, times = self.units[like], self.rates[like], view.times_s[like]
            noise = self.noise[like] * (2.0 if channel == "reaction" else 1.0)
            if channel == "contact":
                unit, noise = "1", 0.0
            if is_steady and len(values) >= MIN_STEADY_ROWS:
                some = steady(values, self.turns(times), rate, unit)
            elif whole is not None and len(values) > 2:
                begin = int(np.searchsorted(whole.times_s[like], times[0]))
                wider = [one for _, all_ in self._signals(whole, phase, channel) for one in all_]
                rows = [widen(one, begin, begin + len(values)) for one in wider]
                some = transient(rows, noise, self.colour[like], unit)
                rate_s = decay_rate(values, noise, rate) if phase.name == PHASES[-1] else None
                some |= {("decay rate", "1/s"): rate_s} if rate_s is not None else {}
            else:
                continue
            # Rounding that no noise spreads, and single rows of contact.
            step = self.step[like]
            least = 1.0 / len(values) if channel == "contact" else 0.3 * step * (noise < step)
            for (quantity, of), one in some.items():
                if channel != "contact" or quantity == "mean":
                    spread = max(one.deviation, least if of == unit else 0.0)
                    found[channel, quantity, of] = Estimate(one.value, spread, max(one.dof, 1.0))
        if phase.name == "whirl" and view.has(*RING) and len(view.values["ring_x"]) >= MIN_STEADY_ROWS:
            angle = unwrapped_angle(view.values["ring_x"], view.values["ring_y"])
            found["shaft", "whirl frequency", "Hz"] = rotation(angle, self.rates["ring_x"])
        edges = self.edges[(self.edges >= phase.from_s) & (self.edges < phase.to_s)]
        if is_steady and len(edges) >= _MIN_EDGES:
            speeds = 1.0 / np.diff(edges)
            rounding = _EDGE_ROUNDING_S * float(speeds.mean()) / (edges[-1] - edges[0])
            error = math.hypot(float(speeds.std(ddof=1)) / math.sqrt(len(speeds)), rounding)
            found["keyphasor", "run speed", "Hz"] = Estimate(float(speeds.mean()), error, len(speeds) - 1.0)
        return found

    def _signals(self, view: View, phase: Phase, only: str = "") -> Iterator[tuple[str, list[np.ndarray]]]:
        """Yield the channels of a phase, and combinations of them: each with equally valid versions."""
        for channel, values in view.values.items():
            if channel != _KEYPHASOR and only in ("", channel):
                yield channel, [values]
        if phase.name not in CONTACT:
            return
        if view.has(*FORCES) and only in ("", "reaction"):
            yield "reaction", [np.abs(view.force())]
        if view.has(*RING):
            radius, off = view.radius(), self.noise["ring_x"]
            if only in ("", "radius"):
                yield "radius", [radius]
            if math.isfinite(view.touches) and only in ("", "contact"):
                yield "contact", [(radius > view.touches + d).astype(float) for d in (0.0, -off, off)]

    def events(self) -> dict[tuple[str, str, str], Estimate]:
        """Return the times of contact and whirl, relative to the hammer pulse or the contact."""
        begins = {one.name: one.from_s for one in reversed(self.phases.values())}
        contact = min((begins[name] for name in CONTACT if name in begins), default=None)
        row_s = 1.0 / min(self.rates.values())
        found = {}
        if contact is not None and self.hammer_s is not None and self.hammer_s < contact:
            found["event", "hammer to contact", "s"] = Estimate(contact - self.hammer_s, 2.0 * row_s, 60.0)
        if contact is not None and begins.get("whirl", contact) > contact:
            found["event", "contact to whirl", "s"] = Estimate(begins["whirl"] - contact, 0.5 * WINDOW_S, 60.0)
        if contact is not None and PHASES[-1] in begins:
            found["event", "length of contact", "s"] = Estimate(begins[PHASES[-1]] - contact, 0.5 * WINDOW_S, 60.0)
        return found


_SOURCE = {"reaction": FORCES[0], "radius": RING[0], "contact": RING[0]}
"""Channel whose unit, rate and noise a combination has."""


def _read(recording: Recording) -> dict[str, Measured]:
    """Return all sampled channels of a recording, with the noise that they show.

    Raises:
        InputError: It has no samples.
    """
    parts = {}
    for name, group in recording.table.groups.items():
        if f"rig/sensors/{name}" not in recording.messages or len((samples := recording.samples(name)).times_s) < 2:
            continue
        order = np.argsort(samples.index, kind="stable")
        values = samples.values[order]
        floor = np.array([estimate_noise(column) for column in values.T])
        parts[name] = Measured(
            group=name, channels=group.channels, times_s=samples.times_s[order], index=samples.index[order],
            values=values, floor=floor, random=floor > 0.0, ideal=False,
        )  # fmt: skip
    if not parts:
        raise InputError("recording", "one with samples", str(recording.path))
    return parts


def _colour(values: np.ndarray, rate_hz: float) -> float:
    corner = corner_hz(values, rate_hz)
    return 1.0 if corner is None else max(1.0, 0.5 * rate_hz / corner)


def compare(first: Recording, second: Recording) -> Comparison:
    """Compare two recordings by phase and channel.

    Args:
        first: First recording, A.
        second: Second one, B.

    Raises:
        InputError: A recording has no samples, or they have no channel in common.
    """
    logs = _Log(first), _Log(second)
    files = first.path.name, second.path.name
    if not any(logs[1].units.get(name) == unit for name, unit in logs[0].units.items()):
        raise InputError("recordings", "two with a channel of the same name and unit", f"{files[0]} and {files[1]}")
    touches = float(np.fmax(logs[0].clearance(), logs[1].clearance()))
    common = logs[0].units.keys() & logs[1].units.keys()
    shows_contact = common.issuperset(RING) or common.issuperset(FORCES)
    for log in logs:
        if not shows_contact and None in (logs[0].hammer_s, logs[1].hammer_s):
            log.hammer_s = None
        log.find_phases(touches, common)
    both = [name for name in logs[0].phases if name in logs[1].phases]
    missing = _only("phase", *(dict.fromkeys(log.phases) for log in logs))
    missing += _only("channel", *({f"{name} [{unit}]": 0 for name, unit in log.units.items()} for log in logs))
    for label, log in zip("AB", logs, strict=True):
        if any((np.diff(part.index) != 1).any() for part in log.parts.values()):
            missing += [f"{label} has gaps: only the longest stretch without one is compared"]
    pairs = {}
    for name in both:
        spans = [log.phases[name] for log in logs]
        length_s = min(one.to_s - one.from_s for one in spans)
        estimates = [log.estimates(name, length_s) for log in logs]
        common = {(name, *key): (one, estimates[1][key]) for key, one in estimates[0].items() if key in estimates[1]}
        missing += [] if common else [f"not compared, as it is too short: phase {name}"]
        pairs |= common
    events = [log.events() for log in logs]
    pairs |= {(_WHOLE_RUN, *key): (one, events[1][key]) for key, one in events[0].items() if key in events[1]}
    changes = [Change(*key, *pair, tests=len(pairs)) for key, pair in pairs.items()]
    return Comparison(files, tuple(sorted(changes, key=lambda one: -one.size)), tuple(missing))


def _only(kind: str, *named: Mapping[str, Any]) -> list[str]:
    a, b = named
    lines = []
    for label, here, there in (("A", a, b), ("B", b, a)):
        if names := [name for name in here if name not in there]:
            lines.append(f"only in {label}: {kind} {', '.join(names)}")
    return lines
