"""Noise-free channels as a function of the numbers of an experiment, and their derivatives.

A value has a dotted key: a parameter (`contact.friction`, in its own unit), a number of the scene (`drive.speed_hz`) or
of a command (`hammer.1.force_n` of the first hammer pulse; likewise `at_s`, `duration_ms` and `direction` [degrees from
x toward y]), or one of the recording (`clock.offset_s` and `clock.rate_ppm` of its clock, `shaft.angle_rad`,
`state.ring_x` and others of its initial state).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import (
    LeadIns,
    Measured,
    Prediction,
    QuietStretch,
    keep_recent,
    last_needed_s,
    predict,
    simplify,
)
from rig.base.errors import InputError, SimulationError
from rig.channels.sampling import ROW_TICKS
from rig.physics.model import build_model
from rig.physics.parameters import load_parameters
from rig.run.commands.table import MECHANICAL, TimedCommand, check_command
from rig.run.motion import MotionStart
from rig.run.scenes import Scene, change_scene, parse_scene
from rig.run.simulation import TICK_RATE_HZ

SCAN = "clock.scan_us"
CLOCK = {"clock.offset_s": ("s", 5e-3), "clock.rate_ppm": ("ppm", 1e3), SCAN: ("us", 10.0)}
"""Delay of the recording's clock at its first sample, its relative rate error, and the time that a scanner needs from
one channel to the next in the order of the mapping: unit, size of a unit change."""
ANGLE = "shaft.angle_rad"
"""Angle of the shaft at the first sample, relative to that of the edges or of the scene [rad], independent of the speed
before. For a log it is that at an edge."""
PHASE = "shaft.unbalance_phase"
STATE = {f"state.{name}": (unit, si, scale) for name, unit, si, scale in (
    ("ring_x", "mm", 1e-3, 0.1), ("ring_y", "mm", 1e-3, 0.1), ("vx", "mm/s", 1e-3, 10.0), ("vy", "mm/s", 1e-3, 10.0),
)}  # fmt: skip
"""Position and velocity of the shaft in the ring at the start of a log from a running rig: unit, that in SI, size of a
unit change."""
_STEP = 1e-5
"""Step of a difference quotient, relative to the value's scale."""
_MIN_STEP = 1e-8
"""Smallest step, to which it is shortened while the contacts on the two sides differ."""
_MAX_CACHED = 9
"""Predictions kept."""
_MARGIN_S = 1e-4
"""Simulated time after the last row, which may lie between two rows of the model."""
_ROWS_HZ = TICK_RATE_HZ // ROW_TICKS
_COMMAND_KEY = re.compile(rf"({'|'.join(MECHANICAL)})\.([1-9][0-9]*)\.(\w+)")
_LATER_KEYS = (*(f"{kind}." for kind in MECHANICAL), "contact.")
"""Starts of keys without effect before the first command and contact."""
_TICK_S = 1.0 / TICK_RATE_HZ
_STEPS = {"at_s": 2.0 * _TICK_S, "duration_ms": 2e3 * _TICK_S}
"""Steps of difference quotients in quantities that a simulation rounds to ticks, by field of a command, in its unit.
They are as small as possible, as later impacts amplify them."""
_SCALES = {"at_s": 1e-3, "direction": 10.0}
"""Size of a unit change if the value itself may be 0 [s], [degrees]."""


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of channels with respect to values of the experiment.

    Attributes:
        base: Channels at the values themselves.
        slopes: d channel / d value in their units, by group, each shape (rows, channels); one per key.
        smooth: True if the contacts were the same on both sides, shape (keys,).
    """

    base: Prediction
    slopes: tuple[dict[str, np.ndarray], ...]
    smooth: np.ndarray


def get_value(experiment: Experiment, key: str) -> float:
    """Return the number of a key in its own unit; for a rule, its result.

    Raises:
        InputError: There is no such number.
    """
    if key in CLOCK:
        return 0.0
    if key == ANGLE:
        return experiment.angle
    if key in STATE:
        return float(getattr(_get_begin(experiment, key), key.split(".")[1])) / STATE[key][1]
    match = _COMMAND_KEY.fullmatch(key)
    if match is not None:
        command = _commands(experiment)[_place(experiment, key)]
        field = match[3]
        if field == "at_s":
            return float(command.at_s)
        value = getattr(command.request, field, None)
        if field == "direction":
            return math.degrees(math.atan2(*reversed(getattr(command.request, "cosines", (1.0, 0.0)))))
        if isinstance(value, int | float):
            return float(value)
        raise InputError(key, f"a number of the command {match[1]}", field)
    if key == PHASE and experiment.angle:
        return math.remainder(get_value(replace(experiment, angle=0.0), PHASE) - experiment.angle, 2.0 * math.pi)
    if key in load_parameters().entries:
        value = experiment.scene.load_parameters().entries[key].value
        return _resolve(experiment.scene)[key] if isinstance(value, str) else float(value)
    value: Any = experiment.scene
    for part in key.split("."):
        value = getattr(value, part, None)
    if isinstance(value, bool) or not isinstance(value, int | float):
        keys = "a parameter, a number of the scene, or of a command such as hammer.1.force_n"
        raise InputError("key", keys, key)
    return float(value)


def with_values(experiment: Experiment, values: Mapping[str, float]) -> Experiment:
    """Return the experiment with other numbers; a number replaces a rule. Clock values are ignored.

    Raises:
        InputError: An unknown key or an invalid value.
    """
    placed: dict[str, Any] = {key.split(".")[1]: value * STATE[key][1] for key, value in values.items() if key in STATE}
    if placed:
        begin = _get_begin(experiment, next(key for key in values if key in STATE))
        experiment = replace(experiment, begin=begin._replace(**placed))
    values = {key: value for key, value in values.items() if key not in CLOCK and key not in STATE}
    if ANGLE in values or (PHASE in values and experiment.angle):
        angle = values.pop(ANGLE, experiment.angle)
        phase = values.get(PHASE, get_value(experiment, PHASE)) + angle
        if experiment.begin is None:
            ahead = values.get("drive.speed_hz", experiment.scene.drive.speed_hz) - experiment.scene.drive.speed_hz
            phase -= 2.0 * math.pi * ahead * experiment.first_s
        values[PHASE] = math.remainder(phase, 2.0 * math.pi)
        experiment = replace(experiment, angle=angle)
    changes = {key: value for key, value in values.items() if _COMMAND_KEY.fullmatch(key) is None}
    scene = change_scene(experiment.scene, changes) if changes else experiment.scene
    changed = replace(experiment, scene=scene)
    own = {_place(experiment, key): {} for key in values if key not in changes}
    for key, value in values.items():
        if key not in changes:
            own[_place(experiment, key)][key.split(".")[2]] = value
    if not own:
        return changed
    # A changed command becomes one of the scene, which may come at any row and not only between two blocks.
    timed, sent = list(scene.commands), list(experiment.commands)
    commands = _commands(experiment)
    kept = [command for place, command in enumerate(timed) if place not in own]
    for place, fields in own.items():
        command = commands[place]
        request = command.request.model_dump(exclude={"command"}) | {k: v for k, v in fields.items() if k != "at_s"}
        if "duration_ms" in fields:
            # Whole ticks with the same impulse, so that the motion does not jump as the number of ticks changes by one.
            ticks = max(1, round(fields["duration_ms"] * 1e-3 * TICK_RATE_HZ))
            request["force_n"] *= fields["duration_ms"] * 1e-3 * TICK_RATE_HZ / ticks
            request["duration_ms"] = ticks * _TICK_S * 1e3
        at_s = fields.get("at_s", command.at_s)
        kept.append(TimedCommand(at_s=at_s, request=check_command(command.request.command, request)))
    rest = tuple(entry for place, entry in enumerate(sent, start=len(timed)) if place not in own)
    data = scene.model_dump() | {"commands": [entry.model_dump() for entry in kept]}
    return replace(changed, scene=parse_scene(data), commands=rest)


def _get_begin(experiment: Experiment, key: str) -> MotionStart:
    if experiment.begin is None:
        raise InputError(key, "used with a log of a rig that was already running", key)
    return experiment.begin


def get_scale(experiment: Experiment, key: str) -> float:
    """Return the size of a unit change of a value, in its unit: the value itself, or a related length or time."""
    if key in ("ring.offset_x", "ring.offset_y"):
        return get_value(experiment, "ring.clearance")
    if key in (PHASE, ANGLE):
        return 1.0
    if key in CLOCK:
        return CLOCK[key][1]
    if key in STATE:
        return STATE[key][2]
    value = abs(get_value(experiment, key))
    return _SCALES.get(key.split(".")[-1], value if value > 0.0 else 1.0)


class Predictor:
    """Channels of a recording as a function of values of its experiment.

    Attributes:
        keys: Keys of the values.
        start: Values of the experiment, shape (keys,).
        scales: Sizes of a unit change, shape (keys,).
        parts: Channels and rows to predict, by group.
        runs: Number of simulations.
    """

    def __init__(
        self,
        experiment: Experiment,
        keys: Sequence[str],
        parts: Mapping[str, Measured],
        *,
        about_s: float | None = None,
        quiet_until_s: float = -math.inf,
    ) -> None:
        """Set up the predictions.

        Args:
            experiment: Experiment of the recording.
            keys: Keys of the values.
            parts: Channels and rows to predict, by group.
            about_s: Time at which the clocks differ by the offset alone [s]; None: the first sample.
            quiet_until_s: Time before the first command up to which rows may be further apart [s].
        """
        self.keys = tuple(keys)
        self.parts = dict(parts)
        self.start = np.array([get_value(experiment, key) for key in self.keys])
        self.scales = np.array([get_scale(experiment, key) for key in self.keys])
        self.runs = 0
        first_s = min(float(part.times_s[0]) for part in self.parts.values())
        self._about_s = first_s if about_s is None else about_s
        self._last_s = last_needed_s(self.parts)
        self._experiment = simplify(experiment)
        self._cache: dict[tuple[float, ...], Prediction] = {}
        self._lead_ins = LeadIns()
        self._quiet = QuietStretch(self.parts, quiet_until_s) if math.isfinite(quiet_until_s) else None

    def predict(self, values: Sequence[float] | np.ndarray) -> Prediction:
        """Return the channels at some values, shape (keys,).

        Simulated commands come at whole ticks; between two ticks the channels are interpolated.

        Raises:
            InputError: The model rejects a value.
            SimulationError: The state became non-finite.
        """
        values = tuple(float(value) for value in values)
        for place, (key, value) in enumerate(zip(self.keys, values, strict=True)):
            if key.endswith(".at_s") and not self._is_later(key):
                below = math.floor(value / _TICK_S + 1e-3)
                if value - below * _TICK_S > 1e-3 * _TICK_S:
                    return self._interpolate_command(values, place, below)
        return keep_recent(
            self._cache, values, _MAX_CACHED, lambda: self._run(dict(zip(self.keys, values, strict=True)))
        )

    def derivatives(self, values: Sequence[float] | np.ndarray) -> Derivatives:
        """Return the derivatives by central differences, one-sided at the limits of the model.

        A step over which the number of contacts changes is shortened.

        Args:
            values: Point of the derivative, shape (keys,).
        """
        values = np.asarray(values, dtype=float)
        base = self.predict(values)
        slopes: list[dict[str, np.ndarray]] = []
        smooth = np.zeros(len(self.keys), dtype=bool)
        directions = [self._direction(values, place) for place in range(len(self.keys))]
        for place, (key, direction) in enumerate(zip(self.keys, directions, strict=True)):
            grid, scale = _get_step(key), self.scales[place]
            slope: dict[str, np.ndarray] = {}
            for step in _shorten(grid or _STEP * scale, grid or _MIN_STEP * scale):
                slope, smooth[place] = self._quotient(values, place, step * direction, base)
                if smooth[place]:
                    break
            slopes.append(slope)
        for place, (slope, direction) in enumerate(zip(slopes, directions, strict=True)):
            for other in np.flatnonzero(direction):  # subtract the slopes of the values that were changed along
                if other != place:
                    slope |= {name: one - direction[other] * slopes[other][name] for name, one in slope.items()}
        return Derivatives(base, tuple(slopes), smooth)

    def _direction(self, values: np.ndarray, place: int) -> np.ndarray:
        """Return the change of all values in the difference quotient of one, shape (keys,).

        The force changes with the length of a pulse, so that the impulse stays constant. The length changes by whole
        ticks, and after impacts such a change of impulse is not small: it would not cancel against that of the force,
        and the rest would be mistaken for the shape of the pulse, which has little effect.
        """
        direction = np.zeros(len(self.keys))
        direction[place] = 1.0
        force = self.keys[place].replace(".duration_ms", ".force_n")
        if force != self.keys[place] and force in self.keys:
            other = self.keys.index(force)
            direction[other] = -values[other] / values[place]
        return direction

    def _is_later(self, key: str) -> bool:
        """Return whether a command comes after all that the last row shows, without effect on the samples."""
        kind, number, _ = key.split(".")
        return get_value(self._experiment, f"{kind}.{number}.at_s") > self._last_s + _MARGIN_S

    def _interpolate_command(self, values: tuple[float, ...], place: int, below: int) -> Prediction:
        """Return the channels for a command between two ticks."""
        # Rounded, so that the cache is hit.
        ends = [round((below + node) * _TICK_S, 9) for node in (0, 1)]
        first, second = (self.predict((*values[:place], end, *values[place + 1 :])) for end in ends)
        part = values[place] / _TICK_S - below
        both = {name: (1.0 - part) * array + part * second.values[name] for name, array in first.values.items()}
        return replace(first, values=both)

    def _quotient(
        self, values: np.ndarray, place: int, step: np.ndarray, base: Prediction
    ) -> tuple[dict[str, np.ndarray], bool]:
        """Return a difference quotient, and whether the contacts were the same on both sides."""
        sides: list[tuple[float, Prediction]] = []
        for sign in (1.0, -1.0):
            moved = values + sign * step
            try:
                sides.append((moved[place], self.predict(moved)))
            except (InputError, SimulationError):
                sides.append((values[place], base))
        (above, up), (below, down) = sides
        if above == below:
            raise InputError(self.keys[place], "a value with room for a change on one side", float(values[place]))
        same = up.contacts == down.contacts == base.contacts
        return {name: (up.values[name] - down.values[name]) / (above - below) for name in up.values}, same

    def _run(self, values: dict[str, float]) -> Prediction:
        self.runs += 1
        parts = to_model_clock(self.parts, values, about_s=self._about_s)
        if SCAN in values:
            parts = self._scan(parts, 1e-6 * values[SCAN])
        # Contacts after the window do not count.
        end_s = math.ceil(round((last_needed_s(parts) + _MARGIN_S) * _ROWS_HZ, 6)) / _ROWS_HZ
        changed = with_values(self._experiment, {**values, "duration_s": end_s})
        if late := self._find_lateness(values):
            parts = {name: replace(part, times_s=part.times_s - late(part.times_s)) for name, part in parts.items()}
        if self._quiet is not None and SCAN not in values:
            earlier = tuple(item for item in values.items() if not item[0].startswith(_LATER_KEYS))
            if (found := self._quiet.predict(changed, parts, earlier)) is not None:
                return found
        found = predict(changed, parts, lead_ins=self._lead_ins)
        if SCAN not in values:
            return found
        alone = {name: [found.values[f"{name} {one}"] for one in part.names] for name, part in self.parts.items()}
        return replace(found, values={name: np.hstack(columns) for name, columns in alone.items()})

    def _scan(self, parts: Mapping[str, Measured], step_s: float) -> dict[str, Measured]:
        """Return each channel alone, at the times at which a scanner samples it."""
        place = {name: n for n, name in enumerate(self._experiment.mapped)}
        return {
            f"{name} {one}": replace(
                part.select_channels([one]), group=f"{name} {one}", times_s=part.times_s + step_s * place.get(one, 0)
            )
            for name, part in parts.items() for one in part.names
        }  # fmt: skip

    def _find_lateness(self, values: Mapping[str, float]) -> Callable[[np.ndarray], np.ndarray] | None:
        """Return how much later signals come after a pulse of a fraction of a tick than after one of whole ticks [s].

        With the same impulse, a longer pulse acts later by half of the difference. Impacts show a fraction of a tick.
        """
        for key in values:
            if key.endswith(".duration_ms"):
                at_key = key.replace(".duration_ms", ".at_s")
                at_s = values[at_key] if at_key in values else get_value(self._experiment, at_key)
                length_s = 1e-3 * values[key]
                late_s = 0.5 * (length_s - max(1, round(length_s / _TICK_S)) * _TICK_S)
                return lambda times_s: np.where(times_s > at_s, late_s, 0.0)
        return None


def to_model_clock(
    parts: Mapping[str, Measured], values: Mapping[str, float], *, about_s: float
) -> dict[str, Measured]:
    """Return channels of a recording whose clock is off by `clock.offset_s` and `clock.rate_ppm`.

    Args:
        parts: The channels.
        values: Values, of which only these two are used.
        about_s: Time at which the clocks differ by the offset alone [s].
    """
    shift, rate = values.get("clock.offset_s", 0.0), values.get("clock.rate_ppm", 0.0) * 1e-6
    if shift == rate == 0.0:
        return dict(parts)
    return {name: part.correct_clock(shift, rate, about_s=about_s) for name, part in parts.items()}


def _get_step(key: str) -> float | None:
    return _STEPS.get(key.split(".")[-1]) if _COMMAND_KEY.fullmatch(key) else None


def _shorten(step: float, least: float) -> Iterator[float]:
    yield step
    while step / 4.0 >= least:
        step /= 4.0
        yield step


def _commands(experiment: Experiment) -> list[TimedCommand]:
    """Return every command: the scene's own, then those that were sent."""
    sent = [
        TimedCommand(at_s=command.tick / TICK_RATE_HZ, request=check_command(command.name, command.request))
        for command in experiment.commands
    ]
    return [*experiment.scene.commands, *sent]


def _place(experiment: Experiment, key: str) -> int:
    """Return the index in `_commands` for a key; commands are numbered by time, each kind from 1."""
    kind, number, field = key.split(".")
    commands = _commands(experiment)
    places = [place for place, command in enumerate(commands) if command.request.command == kind]
    places.sort(key=lambda place: commands[place].at_s)
    if int(number) > len(places):
        raise InputError(key, f"a command of the experiment, which has {len(places)} of {kind}", int(number))
    fields = ["at_s", *(name for name in type(commands[places[int(number) - 1]].request).model_fields)]
    if field not in fields or field == "command":
        raise InputError(key, f"a field of {kind}: {', '.join(name for name in fields if name != 'command')}", field)
    return places[int(number) - 1]


@cache
def _resolve_text(scene: str) -> dict[str, float]:
    whole = Scene.model_validate_json(scene)
    return build_model(whole.load_parameters(), whole.model).resolved


def _resolve(scene: Scene) -> dict[str, float]:
    return _resolve_text(scene.model_dump_json())
