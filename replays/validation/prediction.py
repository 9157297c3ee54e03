"""What the model foretells for the very rows of a recording: every channel without noise, and the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from recorder.reader import Recording
from replays.experiment import Experiment
from rig.channels import Channel, Group
from rig.errors import InputError
from rig.kernels.signals import COLUMN
from rig.scenes import SensorChoice
from rig.sensors.conditioning import Conditioner
from rig.simulation import TICK_RATE_HZ, Frame

_FINE_BITS = 32
"""Bits of a foretold channel's converter: its steps are none of the recording's."""
_QUIET = 2.0
"""Below so many steps of noise a channel's rounding is not random: its floor is a bound, not a deviation."""


@dataclass(frozen=True)
class Measured:
    """The channels of one group of a recording that the model knows.

    Attributes:
        group: Its name.
        channels: With the recording's own calibration.
        times_s: Simulated time of each row [s], shape (n,).
        index: Number of each row, shape (n,); a step other than 1 is a gap.
        values: Engineering values, shape (n, channels).
        floor: Standard deviation of noise and rounding of each channel [its unit], shape (channels,).
        random: Whether that is noise (True) or a bound of the rounding, shape (channels,).
        ideal: Whether the scene left filters and noise out.
    """

    group: str
    channels: tuple[Channel, ...]
    times_s: np.ndarray
    index: np.ndarray
    values: np.ndarray
    floor: np.ndarray
    random: np.ndarray
    ideal: bool

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names, in column order."""
        return tuple(channel.name for channel in self.channels)

    def rows_until(self, end_s: float) -> int:
        """Number of rows before a time."""
        return int(np.searchsorted(self.times_s, end_s))

    def until(self, end_s: float) -> Measured:
        """The rows before a time."""
        n = self.rows_until(end_s)
        return replace(self, times_s=self.times_s[:n], index=self.index[:n], values=self.values[:n])

    @cached_property
    def fine(self) -> tuple[Channel, ...]:
        """The channels with a converter that hardly rounds."""
        return tuple(channel.model_copy(update={"adc_bits": _FINE_BITS}) for channel in self.channels)


def measured(recording: Recording, sensors: SensorChoice, *, longest_s: float) -> dict[str, Measured]:
    """The groups of a recording that the model knows, by name.

    Args:
        recording: The recording.
        sensors: The scene's choice: whether there were filters and noise.
        longest_s: How much of it, from the first sample on [s].

    Raises:
        InputError: It holds no channel that the model knows.
    """
    found = {}
    ideal = sensors.chain == "ideal"
    noise = sensors.noise and not ideal
    for name, group in recording.table.groups.items():
        columns = [c for c, channel in enumerate(group.channels) if channel.signal in COLUMN]
        samples = recording.samples(name)
        if not columns or not len(samples.times_s):
            continue
        order = np.argsort(samples.index, kind="stable")
        order = order[samples.times_s[order] < samples.times_s[order[0]] + longest_s]
        channels = tuple(group.channels[c] for c in columns)
        loud = np.array([channel.noise_v if noise else 0.0 for channel in channels])
        step = np.array([channel.lsb_v for channel in channels])
        random = loud > _QUIET * step
        floor = np.where(random, np.hypot(loud, step / np.sqrt(12.0)), np.maximum(loud, step))
        found[name] = Measured(
            group=name,
            channels=channels,
            times_s=samples.times_s[order],
            index=samples.index[order],
            values=samples.values[order][:, columns],
            floor=floor / np.abs([channel.sensitivity_v for channel in channels]),
            random=random,
            ideal=ideal,
        )
    if not found:
        raise InputError("file", "a recording with a channel that the model knows", str(recording.path))
    return found


@dataclass(frozen=True)
class Prediction:
    """What is foretold.

    Attributes:
        values: Of each group, on the recording's rows, in its channels' units, shape (rows, channels).
        truth: Of each truth table [SI], from time zero on, shape (n, columns).
        truth_rate_hz: Rows of it a second.
    """

    values: dict[str, np.ndarray]
    truth: dict[str, np.ndarray]
    truth_rate_hz: int


class _Channels:
    """Turns rows of the model into what the channels of one group show without noise, on the recorded rows."""

    def __init__(self, part: Measured, *, row_rate_hz: int) -> None:
        self._times_s = part.times_s
        rate = part.channels[0].rate_hz
        exact = row_rate_hz % rate == 0
        position = part.times_s * rate
        exact = exact and bool(np.abs(position - np.rint(position)).max() < 1e-6)
        self._rate_hz = rate if exact else row_rate_hz
        self._rows = np.rint(position).astype(int) if exact else None
        self._group = Group(name=part.group, title=part.group, rate_hz=self._rate_hz, channels=part.fine)
        self._conditioner = Conditioner((self._group,), row_rate_hz=row_rate_hz, seed=0, noise=False, ideal=part.ideal)
        self._counts: list[np.ndarray] = []

    def take(self, rows: np.ndarray) -> None:
        self._counts.append(self._conditioner.counts(rows)[self._group.name])

    def values(self) -> np.ndarray:
        values = self._group.engineering(np.concatenate(self._counts))
        if self._rows is not None:
            return values[self._rows]
        # The recorder's clock is none that divides ours: straight lines between the model's rows, 25 us apart.
        times = np.arange(len(values)) / self._rate_hz
        return np.column_stack([np.interp(self._times_s, times, column) for column in values.T])


def predict(
    experiment: Experiment,
    parts: dict[str, Measured],
    *,
    end_s: float | None = None,
    follow: Callable[[Frame], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Prediction:
    """Simulate, and read off what the recorded channels would have shown without noise.

    Args:
        experiment: What to simulate; `bare` makes it cheaper.
        parts: The channels, and the rows wanted.
        end_s: Only rows before this time [s].
        follow: Given every frame, to the end of the experiment; without it nothing behind the last row is simulated.
        progress: Called with the part done, 0 to 1.
    """
    if end_s is not None:
        parts = {name: part.until(end_s) for name, part in parts.items()}
    parts = {name: part for name, part in parts.items() if len(part.times_s)}
    last_s = max((float(part.times_s[-1]) for part in parts.values()), default=0.0)
    simulation = experiment.simulation()
    row_rate_hz = TICK_RATE_HZ // simulation.row_ticks
    taking = {name: _Channels(part, row_rate_hz=row_rate_hz) for name, part in parts.items()}
    truth: dict[str, list[np.ndarray]] = {}
    # The row of the last sample must be in it.
    for frame in experiment.frames(simulation, chunk_s=min(0.1, last_s + 2e-3)):
        if frame.tick <= last_s * TICK_RATE_HZ:
            for channels in taking.values():
                channels.take(frame.rows)
            for name, block in frame.truth.items():
                truth.setdefault(name, []).append(block.values)
        if follow is not None:
            follow(frame)
        if progress is not None:
            progress(simulation.tick / simulation.end_tick)
        if follow is None and simulation.tick > (last_s + 1e-3) * TICK_RATE_HZ:
            break
    return Prediction(
        values={name: channels.values() for name, channels in taking.items()},
        truth={name: np.concatenate(blocks) for name, blocks in truth.items()},
        truth_rate_hz=experiment.scene.sensors.truth_rate_hz,
    )


def bare(experiment: Experiment) -> Experiment:
    """The same motion with one cheap sensor: rows stay as far apart as they were."""
    return experiment.changed(
        {
            "sensors.groups": ["hammer"],
            "sensors.chain": "ideal",
            "sensors.rate_hz": TICK_RATE_HZ // experiment.simulation().row_ticks,
        }
    )
