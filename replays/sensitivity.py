"""What the sensors would show without noise, and how that changes with any number of the experiment.

A value goes by its dotted key: a parameter (`contact.friction`, in its own unit), a number of the scene
(`drive.speed_hz`), or one of a command (`hammer.1.force_n`: of the first blow; `at_s`, `duration_ms` and `direction`
[degrees from x toward y] likewise).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from replays.experiment import Experiment
from rig.channels import Channel, default_table
from rig.errors import InputError, SimulationError
from rig.kernels.signals import COLUMN
from rig.model import build_model
from rig.parameters import load_parameters
from rig.scenes import Scene, TimedCommand, change_scene, parse_command, parse_scene
from rig.sensors.conditioning import channel_filter
from rig.simulation import ROW_TICKS, TICK_RATE_HZ

SAME_SLOPE = 0.05
"""Two step sizes may differ by this part before a derivative is called doubtful."""
_STEP = 1e-5
"""Step of a difference quotient, as a part of the value's scale, ..."""
_LEAST_STEP = 1e-8
"""... and this is as far as it is shortened where the contacts are not the same ones on both sides."""
_ONE_GROUP = "hammer"
"""The least group of channels."""
_COMMAND_KEY = re.compile(r"(hammer|speed|release)\.([1-9][0-9]*)\.(\w+)")
_GRIDS = {"at_s": ROW_TICKS / TICK_RATE_HZ, "duration_ms": ROW_TICKS / TICK_RATE_HZ * 1e3}
"""A simulation rounds these to its rows, by field of a command, in the field's unit."""
_SCALES = {"at_s": 1e-3, "direction": 10.0}
"""What counts as a change of size 1 where the value itself may be 0 [s], [degrees]."""


@dataclass(frozen=True)
class Signals:
    """Channels without noise over a window.

    Attributes:
        times_s: Simulated time of the rows [s], shape (n,).
        names: The channels.
        values: In each channel's unit, shape (n, channels).
        contacts: Contacts begun from the start of the experiment to the end of the window.
    """

    times_s: np.ndarray
    names: tuple[str, ...]
    values: np.ndarray
    contacts: int


@dataclass(frozen=True)
class Derivatives:
    """How channels change with values of the experiment.

    Attributes:
        base: The channels at the values themselves.
        keys: The values' keys.
        values: d channel / d value, in their units, shape (keys, n, channels).
        steps: Step of each difference quotient, in the value's unit, shape (keys,).
        differences: By how large a part quotients of this step and of half of it differ (root mean square over the
            window, channels weighted by their noise), shape (keys,).
        smooth: Whether the contacts were the same ones on both sides, shape (keys,).
    """

    base: Signals
    keys: tuple[str, ...]
    values: np.ndarray
    steps: np.ndarray
    differences: np.ndarray
    smooth: np.ndarray

    @property
    def good(self) -> np.ndarray:
        """Which derivatives can be relied on, shape (keys,)."""
        return self.smooth & (self.differences < SAME_SLOPE)


def value_of(experiment: Experiment, key: str) -> float:
    """The number that a key stands for, in its own unit; of a rule, what the rule gives.

    Raises:
        InputError: No such number.
    """
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
    if key in load_parameters().entries:
        value = experiment.scene.load_parameters().entries[key].value
        return _resolved(experiment.scene)[key] if isinstance(value, str) else float(value)
    value: Any = experiment.scene
    for part in key.split("."):
        value = getattr(value, part, None)
    if isinstance(value, bool) or not isinstance(value, int | float):
        keys = "a parameter, a number of the scene, or of a command such as hammer.1.force_n"
        raise InputError("key", keys, key)
    return float(value)


def with_values(experiment: Experiment, values: Mapping[str, float]) -> Experiment:
    """The experiment with other numbers; a rule gives way to the number.

    Raises:
        InputError: An unknown key, or a value that it must not have.
    """
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
        at_s = fields.get("at_s", command.at_s)
        kept.append(TimedCommand(at_s=at_s, request=parse_command(command.request.command, request)))
    left = tuple(entry for place, entry in enumerate(sent, start=len(timed)) if place not in own)
    data = scene.model_dump() | {"commands": [entry.model_dump() for entry in kept]}
    return replace(changed, scene=parse_scene(data), commands=left)


def scale_of(experiment: Experiment, key: str) -> float:
    """What counts as a change of size 1 in a value, in its unit: the value itself, or a length or time like it."""
    if key in ("ring.offset_x", "ring.offset_y"):
        return value_of(experiment, "ring.clearance")
    if key == "shaft.unbalance_phase":
        return 1.0
    value = abs(value_of(experiment, key))
    return _SCALES.get(key.split(".")[-1], value if value > 0.0 else 1.0)


def signals(
    experiment: Experiment,
    *,
    channels: Sequence[str],
    start_s: float = 0.0,
    end_s: float | None = None,
    rate_hz: int | None = None,
) -> Signals:
    """What channels show without noise, by the sensors' own chain.

    Args:
        experiment: What is done.
        channels: Names of channels.
        start_s: Start of the window, simulated [s].
        end_s: End of the window [s]; None for the experiment's.
        rate_hz: Rows a second, of which the sensors' rate is a whole multiple; None for that rate.
    """
    return Predictor(experiment, (), channels=channels, start_s=start_s, end_s=end_s, rate_hz=rate_hz).signals(())


def derivatives(
    experiment: Experiment,
    keys: Sequence[str],
    *,
    channels: Sequence[str],
    start_s: float = 0.0,
    end_s: float | None = None,
    rate_hz: int | None = None,
    steps: Mapping[str, float] | None = None,
) -> Derivatives:
    """How channels change with values of the experiment, at the values that it has.

    Args:
        experiment: What is done.
        keys: Keys of the values.
        channels: Names of channels.
        start_s: Start of the window, simulated [s].
        end_s: End of the window [s]; None for the experiment's.
        rate_hz: As for `signals`.
        steps: Steps by key, in the value's unit, where others than the usual ones are wanted.
    """
    predictor = Predictor(experiment, keys, channels=channels, start_s=start_s, end_s=end_s, rate_hz=rate_hz)
    return predictor.derivatives(predictor.start, steps=steps)


class Predictor:
    """The channels of an experiment as a function of some of its values.

    Attributes:
        keys: Keys of the values.
        start: The values as the experiment has them, shape (keys,).
        scales: What counts as a change of size 1, shape (keys,).
        names: The channels.
        noise: Noise of each channel by the channel table, quantisation included, in its unit, shape (channels,).
        rate_hz: Rows a second.
        runs: How many simulations there have been.
    """

    def __init__(
        self,
        experiment: Experiment,
        keys: Sequence[str],
        *,
        channels: Sequence[str],
        start_s: float = 0.0,
        end_s: float | None = None,
        rate_hz: int | None = None,
    ) -> None:
        known = default_table().channels
        unknown = [name for name in channels if name not in known]
        if unknown or not channels:
            raise InputError("channels", f"some of {', '.join(known)}", ", ".join(unknown))
        scene = experiment.scene
        rate_hz = rate_hz or scene.sensors.rate_hz
        if scene.sensors.rate_hz % rate_hz:
            raise InputError("rate_hz", f"a divisor of the sensors' {scene.sensors.rate_hz} Hz", rate_hz)
        end_s = scene.duration_s if end_s is None else end_s
        if not 0.0 <= start_s < end_s:
            raise InputError("window", "of times that rise from 0", [start_s, end_s])
        # The rows behind the samples are those of the recorded run; the samples themselves are made here.
        short = {"sensors.noise": False, "sensors.groups": [_ONE_GROUP], "duration_s": end_s, "fidelity": "given"}
        self._experiment = replace(experiment, scene=change_scene(scene, short))
        table = default_table().only(tuple(default_table().groups), scene.sensors.rate_hz).channels
        self._channels = [table[name] for name in channels]
        self.rate_hz = rate_hz
        self._window = (start_s, end_s)
        self.keys = tuple(keys)
        self.names = tuple(channels)
        self.start = np.array([value_of(experiment, key) for key in self.keys])
        self.scales = np.array([scale_of(experiment, key) for key in self.keys])
        self.noise = np.array([channel_noise(channel) for channel in self._channels])
        self.runs = 0
        self._cache: dict[tuple[float, ...], Signals] = {}

    def signals(self, values: Sequence[float] | np.ndarray) -> Signals:
        """The channels at some values, shape (keys,).

        What a simulation rounds to its rows (times and durations of blows) is interpolated between two simulations.

        Raises:
            InputError: A value that the model does not take.
            SimulationError: The state became non-finite.
        """
        values = tuple(float(value) for value in values)
        for place, (key, value) in enumerate(zip(self.keys, values, strict=True)):
            grid = _GRIDS.get(key.split(".")[-1]) if _COMMAND_KEY.fullmatch(key) else None
            below = math.floor(value / grid + 1e-6) * grid if grid else value
            if grid and value - below > 1e-6 * grid:
                # Rounded, so that both find what was simulated before.
                ends = [round(below, 9), round(below + grid, 9)]
                low, high = (self.signals((*values[:place], end, *values[place + 1 :])) for end in ends)
                weight = (value - below) / grid
                return replace(low, values=(1.0 - weight) * low.values + weight * high.values)
        if values not in self._cache:
            if len(self._cache) > 4:
                self._cache.pop(next(iter(self._cache)))
            self._cache[values] = self._run(with_values(self._experiment, dict(zip(self.keys, values, strict=True))))
        return self._cache[values]

    def derivatives(
        self,
        values: Sequence[float] | np.ndarray,
        *,
        steps: Mapping[str, float] | None = None,
        check: bool = True,
    ) -> Derivatives:
        """How the channels change with the values, by central differences; one-sided at the edge of what is possible.

        A step over which the number of contacts changes, or the slope does, is shortened.

        Args:
            values: Where, shape (keys,).
            steps: By key, in the value's unit, where others than the usual ones are wanted.
            check: Also try half the step and tell the difference; else the differences are 0.
        """
        values = np.asarray(values, dtype=float)
        base = self.signals(values)
        chosen = np.array([self._step(place, steps) for place in range(len(self.keys))])
        found = np.zeros((len(self.keys), *base.values.shape))
        differences, smooth = np.zeros(len(self.keys)), np.zeros(len(self.keys), dtype=bool)
        for place in range(len(self.keys)):
            grid = self._grid(place)
            for step in _shorter(chosen[place], grid or _LEAST_STEP * self.scales[place]):
                found[place], smooth[place] = self._quotient(values, place, step, base)
                chosen[place] = step
                if check and grid is None:
                    half, same = self._quotient(values, place, step / 2.0, base)
                    differences[place] = self._difference(half, found[place])
                    if same:  # Richardson: the error of both goes with the square of the step
                        found[place] = half + (half - found[place]) / 3.0
                if smooth[place] and differences[place] < SAME_SLOPE:
                    break
        return Derivatives(base, self.keys, found, chosen, differences, smooth)

    def _difference(self, quotient: np.ndarray, other: np.ndarray) -> float:
        size = float(np.linalg.norm(quotient / self.noise))
        return float(np.linalg.norm((quotient - other) / self.noise)) / size if size > 0.0 else 0.0

    def _grid(self, place: int) -> float | None:
        key = self.keys[place]
        return _GRIDS.get(key.split(".")[-1]) if _COMMAND_KEY.fullmatch(key) else None

    def _step(self, place: int, steps: Mapping[str, float] | None) -> float:
        own = (steps or {}).get(self.keys[place])
        return own or self._grid(place) or _STEP * self.scales[place]

    def _quotient(self, values: np.ndarray, place: int, step: float, base: Signals) -> tuple[np.ndarray, bool]:
        """A difference quotient, and whether the contacts were the same ones on both sides."""
        sides: list[tuple[float, Signals]] = []
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[place] += sign * step
            try:
                sides.append((moved[place], self.signals(moved)))
            except (InputError, SimulationError):
                sides.append((values[place], base))
        (above, up), (below, down) = sides
        if above == below:
            raise InputError(self.keys[place], "a value with room for a change on one side", float(values[place]))
        same = up.contacts == down.contacts == base.contacts
        return (up.values - down.values) / (above - below), same

    def _run(self, experiment: Experiment) -> Signals:
        simulation = experiment.simulation()
        columns = [COLUMN[channel.signal] for channel in self._channels]
        rows = [frame.rows[:, columns].copy() for frame in experiment.frames(simulation, chunk_s=1.0)]
        self.runs += 1
        row_rate_hz = simulation.tick_rate_hz // simulation.row_ticks
        ideal = simulation.scene.sensors.chain == "ideal"
        values = _conditioned(np.concatenate(rows), self._channels, row_rate_hz=row_rate_hz, ideal=ideal)
        every = row_rate_hz // self.rate_hz
        first, last = (math.ceil(round(time * self.rate_hz, 6)) for time in self._window)
        values = values[first * every : last * every : every]
        times_s = (first + np.arange(len(values))) / self.rate_hz
        return Signals(times_s, self.names, values, simulation.health()["contacts"])


def _conditioned(rows: np.ndarray, channels: Sequence[Channel], *, row_rate_hz: int, ideal: bool) -> np.ndarray:
    """What the sensors' chain makes of its signals, but for noise and the converter's rounding.

    Rounding would hide how a signal changes with a value, and make values look different that act alike.

    Args:
        rows: Signal of each channel at every row from the start of the experiment, SI, shape (n, channels).
        channels: The channels.
        row_rate_hz: Rows a second.
        ideal: Range only, no filters.

    Returns:
        In each channel's unit, shape (n, channels).
    """
    from scipy.signal import sosfilt

    bias, sensitivity, si, adc = (
        np.array([getattr(channel, field) for channel in channels])
        for field in ("bias_v", "sensitivity_v", "si", "adc_v")
    )
    volts = np.clip(bias + rows * (sensitivity / si), *np.array([channel.range_v for channel in channels]).T)
    if not ideal:
        alike: dict[tuple[float, float], list[int]] = {}
        for column, channel in enumerate(channels):
            alike.setdefault((channel.bandwidth_hz, channel.highpass_hz), []).append(column)
        for (bandwidth_hz, highpass_hz), columns in alike.items():
            sections, settled = _filter(bandwidth_hz, highpass_hz, row_rate_hz)
            # The instruments have been on for long: filters start in the steady state of the first row.
            volts[:, columns], _ = sosfilt(
                sections, volts[:, columns], axis=0, zi=settled[:, :, None] * volts[0, columns]
            )
    return (np.clip(volts, -adc, adc) - bias) / sensitivity


@cache
def _filter(bandwidth_hz: float, highpass_hz: float, row_rate_hz: int) -> tuple[np.ndarray, np.ndarray]:
    """The chain's filter, and its memory in the steady state of 1."""
    from scipy.signal import sosfilt_zi

    channel = next(iter(default_table().channels.values()))
    channel = channel.model_copy(update={"bandwidth_hz": bandwidth_hz, "highpass_hz": highpass_hz})
    sections = channel_filter(channel, float(row_rate_hz))
    return sections, sosfilt_zi(sections)


def channel_noise(channel: Channel) -> float:
    """Noise of a channel of the table, with what rounding in the converter adds, in its unit."""
    return math.hypot(channel.noise_v, channel.lsb_v / math.sqrt(12.0)) / abs(channel.sensitivity_v)


def _shorter(step: float, least: float) -> Iterator[float]:
    yield step
    while step / 4.0 >= least:
        step /= 4.0
        yield step


def _commands(experiment: Experiment) -> list[TimedCommand]:
    """Every command: the scene's own, then those that were sent."""
    sent = [
        TimedCommand(at_s=command.tick / TICK_RATE_HZ, request=parse_command(command.name, command.request))
        for command in experiment.commands
    ]
    return [*experiment.scene.commands, *sent]


def _place(experiment: Experiment, key: str) -> int:
    """Where in `_commands` the command of a key stands: they are numbered by time, each kind from 1."""
    kind, number, field = key.split(".")
    commands = _commands(experiment)
    places = [place for place, command in enumerate(commands) if command.request.command == kind]
    places.sort(key=lambda place: commands[place].at_s)
    if int(number) > len(places):
        raise InputError(key, f"a command of the experiment, which has {len(places)} of {kind}", int(number))
    known = ["at_s", *(name for name in type(commands[places[int(number) - 1]].request).model_fields)]
    if field not in known or field == "command":
        raise InputError(key, f"a field of {kind}: {', '.join(name for name in known if name != 'command')}", field)
    return places[int(number) - 1]


@cache
def _resolved_by(scene: str) -> dict[str, float]:
    whole = Scene.model_validate_json(scene)
    return build_model(whole.load_parameters(), whole.model).resolved


def _resolved(scene: Scene) -> dict[str, float]:
    return _resolved_by(scene.model_dump_json())
