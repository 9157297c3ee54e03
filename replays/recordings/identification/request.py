"""Request to identify parameters: keys, start values, bounds, priors, channels and window."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from recorder.reader import Recording
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import Measured, read_measured
from replays.recordings.resimulation.sensitivity import ANGLE, CLOCK, STATE, get_scale, get_value, with_values
from rig.base.errors import InputError
from rig.base.text import find_similar
from rig.base.wire import sensor_key
from rig.channels.table import Channel
from rig.physics.parameters import load_parameters
from rig.run.commands.command import UNBOUNDED
from rig.run.commands.table import COMMANDS, QUANTITIES, HammerCommand
from rig.run.scenes import Scene
from rig.run.simulation import TICK_RATE_HZ

NOT_FITTED = ("keyphasor",)
"""Pulses give the time of an edge, which a difference of samples does not."""
MAX_ROWS = 20_000
"""Rows to which a longer window is decimated."""
_SCENE_KEYS = ("drive.speed_hz", "initial.x_mm", "initial.y_mm")
"""Keys of a scene that describe the rig; the others describe its simulation."""
_LEAD_S = 0.5
"""Start of the window before the first command, which shows the steady motion [s]."""
_COMMAND_UNITS = {"at_s": "s"} | {name: each.quantity.unit for name, each in QUANTITIES.items()}


@dataclass(frozen=True)
class Unknown:
    """Requested value.

    Attributes:
        key: Dotted key.
        unit: Unit.
        start: Start of the search.
        scale: Size of a unit change.
        low: Lowest value.
        high: Highest value.
        bounded: True if the bounds were requested, False if they are the limits of the model.
        prior: Mean and standard deviation of the prior, or None.
        rule: Rule that gave the start, or None.
        nuisance: True for a nuisance parameter, whose precision does not matter.
    """

    key: str
    unit: str
    start: float
    scale: float
    low: float
    high: float
    bounded: bool
    prior: tuple[float, float] | None
    rule: str | None
    nuisance: bool = False

    @property
    def reach(self) -> float:
        """Half of the interval assumed before the fit; a wider interval has no information.

        It is that of the prior (95 %), of the requested bounds, or else the scale.
        """
        if self.prior is not None:
            return 1.96 * self.prior[1]
        return (self.high - self.low) / 2.0 if self.bounded and math.isfinite(self.high - self.low) else self.scale


@dataclass(frozen=True)
class Observation:
    """Samples to be explained.

    Attributes:
        names: Channels.
        units: Their units.
        times_s: Times of the rows of all groups together [s], shape (n,).
        values: Values in the units of the channels, nan without a sample, shape (n, channels).
        noise: Standard deviation of the noise in the units of the channels, shape (channels,).
        noise_from: Source of the noise by channel: "table", or "measured" if the table has none.
        parts: Samples by group, with the recording's own calibration and filters.
        rows: Indices in `times_s` of the rows of each group.
        every: Decimation factor of a long window.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    times_s: np.ndarray
    values: np.ndarray
    noise: np.ndarray
    noise_from: tuple[Literal["table", "measured"], ...]
    parts: dict[str, Measured]
    rows: dict[str, np.ndarray]
    every: int = 1

    def count_rows(self, end_s: float) -> int:
        """Return the number of rows before a time."""
        return int(np.searchsorted(self.times_s, end_s - 1e-9))

    def select_parts(self, rows: int) -> dict[str, Measured]:
        """Return the groups, restricted to the first rows."""
        ends = {name: int(np.searchsorted(self.rows[name], rows)) for name in self.parts}
        return {name: self.parts[name].select_first(end) for name, end in ends.items() if end}

    def tabulate(self, values: Mapping[str, np.ndarray], rows: int) -> np.ndarray:
        """Return values by group as one table, nan without a sample, shape (rows, channels)."""
        table = np.full((rows, len(self.names)), np.nan)
        for name, held in values.items():
            columns = np.array([self.names.index(channel) for channel in self.parts[name].names])
            table[self.rows[name][: len(held), None], columns] = held
        return table


@dataclass(frozen=True)
class Question:
    """Request to a recording.

    Attributes:
        experiment: Experiment at the start values.
        unknowns: Requested values.
        observation: The samples.
    """

    experiment: Experiment
    unknowns: tuple[Unknown, ...]
    observation: Observation

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the unknowns."""
        return tuple(unknown.key for unknown in self.unknowns)


def ask(
    recording: Recording,
    experiment: Experiment,
    keys: Sequence[str],
    *,
    start: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    nuisances: Collection[str] = (),
    channels: Sequence[str] | None = None,
    window: tuple[float | None, float | None] = (None, None),
) -> Question:
    """Build a request to a recording.

    Args:
        recording: Recording with the samples; its truth is not used.
        experiment: The experiment.
        keys: Requested keys.
        start: Start values by key; default: those of the experiment.
        bounds: Lowest and highest value by key.
        priors: Mean and standard deviation by key.
        nuisances: Keys that are nuisance parameters.
        channels: Channels to use; None for all except the keyphasor's pulses.
        window: Start and end of the used samples, simulated [s]; None: from shortly before the first command, to the
            end.

    Raises:
        InputError: An unknown or doubled key, channel or value, or no samples.
    """
    if not keys or len(set(keys)) < len(keys):
        raise InputError("fit", "different keys, at least one", ", ".join(keys))
    for option, entries in (("start", start), ("bounds", bounds), ("prior", priors)):
        for key in entries or {}:
            if key not in keys:
                raise InputError(option, f"of a key that is fitted ({', '.join(keys)})", key)
    for key in keys:
        _check_key(experiment, key)
    rules = {key: experiment.scene.load_parameters().rule(key) for key in keys if key in load_parameters().entries}
    centres = {key: mean for key, (mean, _) in (priors or {}).items()} | dict(start or {})
    values = {key: centres.get(key, get_value(experiment, key)) for key in keys}
    # An angle is relative to that of the experiment.
    baseline = with_values(experiment, {key: value for key, value in values.items() if key != ANGLE})
    unknowns = []
    for key in keys:
        low, high = (bounds or {}).get(key) or _accepted_range(key)
        if not low < high or not low <= values[key] <= high:
            raise InputError(f"bounds of {key}", f"ascending and around the start {values[key]:g}", [low, high])
        prior = (priors or {}).get(key)
        if prior is not None and not prior[1] > 0.0:
            raise InputError(f"prior of {key}", "with a standard deviation above 0", prior[1])
        unknowns.append(
            Unknown(
                key=key,
                unit=fit_unit(key),
                start=values[key],
                scale=get_scale(baseline, key),
                low=low,
                high=high,
                bounded=key in (bounds or {}),
                prior=prior,
                rule=rules.get(key),
                nuisance=key in nuisances,
            )
        )
    return Question(baseline, tuple(unknowns), observe(recording, baseline, channels=channels, window=window))


def observe(
    recording: Recording,
    experiment: Experiment,
    *,
    channels: Sequence[str] | None = None,
    window: tuple[float | None, float | None] = (None, None),
) -> Observation:
    """Return samples of a recording.

    Raises:
        InputError: The recording does not have the channels, or has no samples in the window.
    """
    formulas = experiment.scene.formulas()
    groups = {
        channel.name: group.name
        for group in recording.table.groups.values()
        for channel in group.channels
        if formulas.is_valid(channel.name, channel.signal) and recording.messages.get(sensor_key(group.name))
    }
    usable = [name for name in groups if name not in NOT_FITTED]
    wanted = list(channels) if channels else usable
    missing = [name for name in wanted if name not in usable]
    if missing or not wanted:
        raise InputError("channels", f"channels of the recording: {', '.join(usable)}", ", ".join(missing))
    whole = read_measured(recording, experiment.scene)
    whole = {name: whole[name].select_channels(wanted) for name in dict.fromkeys(groups[name] for name in wanted)}
    first_s = max(float(part.times_s[0]) for part in whole.values())
    last_s = min(float(part.times_s[-1]) for part in whole.values())
    start_s, end_s = window
    start_s = max(first_s, first_command_s(experiment) - _LEAD_S) if start_s is None else start_s
    end_s = math.inf if end_s is None else end_s
    period_s = max(1.0 / part.channels[0].rate_hz for part in whole.values())
    parts, every = {}, 1
    for name, part in whole.items():
        kept = (part.times_s >= max(start_s, first_s) - 1e-9) & (part.times_s < min(end_s, last_s + period_s) - 1e-9)
        step = -(-int(kept.sum()) // MAX_ROWS) or 1
        parts[name] = part.select_rows(np.flatnonzero(kept)[::step])
        every = max(every, step)
    if min(len(part.times_s) for part in parts.values()) < 10:
        must = f"a window with samples; the recording is from {first_s:.3f} to {last_s:.3f} s"
        raise InputError("window", must, [start_s, end_s])
    parts = {name: _with_noise(part) for name, part in parts.items()}
    # Times of two groups are equal if they agree to a nanosecond.
    stamps = {name: np.rint(part.times_s * 1e9).astype(np.int64) for name, part in parts.items()}
    union, first = np.unique(np.concatenate(list(stamps.values())), return_index=True)
    own = {channel.name: (part, c) for part in parts.values() for c, channel in enumerate(part.channels)}
    observation = Observation(
        names=tuple(wanted),
        units=tuple(own[name][0].channels[own[name][1]].unit for name in wanted),
        times_s=np.concatenate([part.times_s for part in parts.values()])[first],
        values=np.empty(0),
        noise=np.array([own[name][0].floor[own[name][1]] for name in wanted]),
        noise_from=tuple("table" if _has_noise(*own[name]) else "measured" for name in wanted),
        parts=parts,
        rows={name: np.searchsorted(union, held) for name, held in stamps.items()},
        every=every,
    )
    values = observation.tabulate({name: part.values for name, part in parts.items()}, len(union))
    return replace(observation, values=values)


def _has_noise(part: Measured, column: int) -> bool:
    return part.channels[column].noise_v > 0.0


def _with_noise(part: Measured) -> Measured:
    """Return the part with the noise of the table and of rounding; measured where the table has none."""
    floor = np.array(
        [
            channel_noise(channel) if _has_noise(part, c) else measure_noise(part.values[:, c])
            for c, channel in enumerate(part.channels)
        ]
    )
    return replace(part, floor=floor)


def measure_noise(values: np.ndarray) -> float:
    """Return the noise of a smooth signal from its third differences, few of which are affected by impacts."""
    differences = np.diff(values[np.isfinite(values)], 3)
    spread = float(np.median(np.abs(differences))) / (0.6745 * math.sqrt(20.0)) if len(differences) else 0.0
    return spread or max(1e-9, 1e-6 * float(np.nanmax(np.abs(values), initial=0.0)))


def channel_noise(channel: Channel) -> float:
    """Return the noise of a channel of the table, including rounding in the converter, in its unit."""
    return math.hypot(channel.noise_v, channel.lsb_v / math.sqrt(12.0)) / abs(channel.sensitivity_v)


def first_command_s(experiment: Experiment) -> float:
    """Return the time of the first hammer pulse [s]; 0 without one."""
    times = [timed.at_s for timed in experiment.scene.commands if isinstance(timed.request, HammerCommand)]
    times += [command.tick / TICK_RATE_HZ for command in experiment.commands if command.name == "hammer"]
    return min(times, default=0.0)


def _check_key(experiment: Experiment, key: str) -> None:
    """Check that a key is a parameter of the rig or of its experiment."""
    parameters = load_parameters().entries
    own = [name for name, entry in parameters.items() if entry.unit != "count"]
    own += [*_SCENE_KEYS, *CLOCK, ANGLE, *STATE]
    if key in own:
        return
    if len(key.split(".")) == 3 and key.split(".")[0] in COMMANDS:
        get_value(experiment, key)
        return
    close = find_similar(key, own)
    must = f"the name of a parameter, of a number of the scene ({', '.join(_SCENE_KEYS)}) or of a command "
    must += "(hammer.1.force_n)"
    if key in parameters or key.split(".")[0] in Scene.model_fields:
        must += ", which describe the rig or the experiment, not the simulation"
    elif close:
        must += f", such as {', '.join(close)}"
    raise InputError("fit", must, key)


def _accepted_range(key: str) -> tuple[float, float]:
    entries = load_parameters().entries
    if key in entries:
        return entries[key].range
    each = QUANTITIES.get(key.split(".")[-1])
    return UNBOUNDED if each is None else (each.low, each.high)


def fit_unit(key: str) -> str:
    """Return the unit of a value that can be fitted; empty if unknown."""
    if key in CLOCK:
        return CLOCK[key][0]
    if key == ANGLE:
        return "rad"
    if key in STATE:
        return STATE[key][0]
    entries = load_parameters().entries
    return entries[key].unit if key in entries else _COMMAND_UNITS.get(key.split(".")[-1], "")
