"""What is asked of a recording: which numbers of its experiment, from where, within what, by which channels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from recorder.reader import Recording
from replays.experiment import Experiment
from replays.sensitivity import channel_noise, scale_of, value_of, with_values
from rig.channels import default_table
from rig.errors import InputError
from rig.parameters import load_parameters
from rig.scenes import HammerCommand
from rig.simulation import TICK_RATE_HZ
from rig.wire import sensor_key

NOT_FITTED = ("keyphasor",)
"""Pulses say where an edge is, which a difference of samples does not."""
MOST_ROWS = 20_000
"""A longer window is thinned out."""
_QUIET_S = 0.5
"""The window begins this long before the first command: enough to see where the shaft runs."""
_COMMAND_BOUNDS = {"force_n": (1.0, 1000.0), "duration_ms": (0.5, 50.0), "direction": (-360.0, 360.0)}
_COMMAND_UNITS = {"force_n": "N", "duration_ms": "ms", "direction": "degrees", "at_s": "s", "speed_hz": "Hz"}


@dataclass(frozen=True)
class Unknown:
    """A number that is asked for.

    Attributes:
        key: Its dotted key.
        unit: Its unit.
        start: Where the search begins.
        scale: What counts as a change of size 1.
        low: Least value.
        high: Largest value.
        bounded: Whether these bounds were asked for, and are not only what the model takes.
        prior: Mean and standard deviation known from elsewhere, or None.
        rule: The rule that gave the start, if one did.
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

    @property
    def reach(self) -> float:
        """Half of the interval that is believed before the recording is looked at: beyond it a value says nothing.

        Of the prior (95 %), or of the bounds that were asked for, or else as much as the scale.
        """
        if self.prior is not None:
            return 1.96 * self.prior[1]
        return (self.high - self.low) / 2.0 if self.bounded and math.isfinite(self.high - self.low) else self.scale


@dataclass(frozen=True)
class Observation:
    """The samples that are explained.

    Attributes:
        names: Channels.
        units: Their units.
        times_s: Simulated time of the rows [s], shape (n,).
        values: In each channel's unit, nan where a sample was lost, shape (n, channels).
        noise: Standard deviation of each channel's noise, in its unit, shape (channels,).
        noise_from: Where it is from, by channel: "table", or "measured" where the table tells none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    times_s: np.ndarray
    values: np.ndarray
    noise: np.ndarray
    noise_from: tuple[Literal["table", "measured"], ...]

    def until(self, end_s: float) -> int:
        """Number of rows before a time."""
        return int(np.searchsorted(self.times_s, end_s - 1e-9))


@dataclass(frozen=True)
class Question:
    """A recording, and what is asked of it.

    Attributes:
        experiment: What was done, on the values from which the search begins.
        unknowns: What is asked for.
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
    channels: Sequence[str] | None = None,
    window: tuple[float, float] | None = None,
) -> Question:
    """Put a question to a recording.

    Args:
        recording: Whose samples are explained; its truth is not looked at.
        experiment: What was done.
        keys: What is asked for.
        start: Where the search begins, by key; else the experiment's own values.
        bounds: Least and largest value by key.
        priors: Mean and standard deviation by key.
        channels: By which channels; None for all that it has, but for the keyphasor's pulses.
        window: Simulated times between which samples are used [s]; None: from shortly before the first command to the
            end.

    Raises:
        InputError: An unknown or doubled key, channel or value, or no samples.
    """
    if not keys or len(set(keys)) < len(keys):
        raise InputError("fit", "different keys, at least one", ", ".join(keys))
    for option, given in (("start", start), ("bounds", bounds), ("prior", priors)):
        for key in given or {}:
            if key not in keys:
                raise InputError(option, f"of a key that is fitted ({', '.join(keys)})", key)
    rules = {key: experiment.scene.load_parameters().rule(key) for key in keys if key in load_parameters().entries}
    centres = {key: mean for key, (mean, _) in (priors or {}).items()} | dict(start or {})
    values = {key: centres.get(key, value_of(experiment, key)) for key in keys}
    begun = with_values(experiment, values)
    unknowns = []
    for key in keys:
        low, high = (bounds or {}).get(key) or _accepted(key)
        if not low < high or not low <= values[key] <= high:
            raise InputError(f"bounds of {key}", f"ascending and around the start {values[key]:g}", [low, high])
        prior = (priors or {}).get(key)
        if prior is not None and not prior[1] > 0.0:
            raise InputError(f"prior of {key}", "with a standard deviation above 0", prior[1])
        unknowns.append(
            Unknown(
                key=key,
                unit=_unit(key),
                start=values[key],
                scale=scale_of(begun, key),
                low=low,
                high=high,
                bounded=key in (bounds or {}),
                prior=prior,
                rule=rules.get(key),
            )
        )
    return Question(begun, tuple(unknowns), observe(recording, begun, channels=channels, window=window))


def observe(
    recording: Recording,
    experiment: Experiment,
    *,
    channels: Sequence[str] | None = None,
    window: tuple[float, float] | None = None,
) -> Observation:
    """Samples of a recording.

    Raises:
        InputError: It has none of these channels, or no samples in the window.
    """
    known = default_table().channels
    groups = {
        name: group.name
        for group in recording.table.groups.values()
        for name in group.names
        if name in known and recording.messages.get(sensor_key(group.name))
    }
    usable = [name for name in groups if name not in NOT_FITTED]
    wanted = list(channels) if channels else usable
    missing = [name for name in wanted if name not in usable]
    if missing or not wanted:
        raise InputError("channels", f"some that the recording has: {', '.join(usable)}", ", ".join(missing))
    samples = {group: recording.samples(group) for group in dict.fromkeys(groups[name] for name in wanted)}
    first_s = max(float(held.times_s[0]) for held in samples.values())
    last_s = min(float(held.times_s[-1]) for held in samples.values())
    start_s, end_s = window or (max(first_s, _first_command_s(experiment) - _QUIET_S), math.inf)
    longest = max(samples.values(), key=lambda held: held.rate_hz)
    period_s = 1.0 / longest.rate_hz
    whole = longest.times_s
    times_s = whole[(whole >= max(start_s, first_s) - 1e-9) & (whole < min(end_s, last_s + period_s) - 1e-9)]
    if len(times_s) < 10:
        must = f"a window with samples in it; the recording goes from {first_s:.3f} to {last_s:.3f} s"
        raise InputError("window", must, [start_s, end_s])
    values = np.full((len(times_s), len(wanted)), np.nan)
    noise, sources = np.empty(len(wanted)), []
    for column, name in enumerate(wanted):
        held = samples[groups[name]]
        place = np.searchsorted(held.times_s, times_s - 0.01 * period_s)
        place = np.minimum(place, len(held.times_s) - 1)
        there = np.abs(held.times_s[place] - times_s) < 0.01 * period_s
        values[there, column] = held.column(name)[place[there]]
        channel = recording.table.channels[name]
        told = channel.noise_v > 0.0
        noise[column] = channel_noise(channel) if told else measured_noise(values[:, column])
        sources.append("table" if told else "measured")
    thin = -(-len(times_s) // MOST_ROWS)
    return Observation(
        names=tuple(wanted),
        units=tuple(known[name].unit for name in wanted),
        times_s=times_s[::thin],
        values=values[::thin],
        noise=noise,
        noise_from=tuple(sources),
    )


def measured_noise(values: np.ndarray) -> float:
    """Noise of a smooth signal from its third differences, of which impacts spoil only a few."""
    differences = np.diff(values[np.isfinite(values)], 3)
    spread = float(np.median(np.abs(differences))) / (0.6745 * math.sqrt(20.0)) if len(differences) else 0.0
    return spread or max(1e-9, 1e-6 * float(np.nanmax(np.abs(values), initial=0.0)))


def _first_command_s(experiment: Experiment) -> float:
    times = [timed.at_s for timed in experiment.scene.commands if isinstance(timed.request, HammerCommand)]
    times += [command.tick / TICK_RATE_HZ for command in experiment.commands if command.name == "hammer"]
    return min(times, default=0.0)


def _accepted(key: str) -> tuple[float, float]:
    entries = load_parameters().entries
    if key in entries:
        return entries[key].range
    return _COMMAND_BOUNDS.get(key.split(".")[-1], (-math.inf, math.inf))


def _unit(key: str) -> str:
    entries = load_parameters().entries
    return entries[key].unit if key in entries else _COMMAND_UNITS.get(key.split(".")[-1], "")
