"""Fault injection: a second signal chain for faulty channels, in parallel with the healthy chain.

The healthy chain always continues unchanged. A fault therefore ends exactly on a row, and later rows are as without it.
The twin chain starts with the state and the noise of the healthy one, and differs from it only by the faults.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rig.base.errors import InputError, Words
from rig.base.wire import sensor_key
from rig.channels.faults import (
    DOORS,
    At,
    Draws,
    Kind,
    NoFilter,
    OfBlocks,
    Restart,
    Setting,
    acts,
    check_draws,
    check_size,
    check_time,
    find_channels,
    find_group,
)  # fmt: skip
from rig.channels.faults.cabling import Plan, Scales, Volts, make_place, mark_signal, read_nothing
from rig.channels.faults.delivery import Active, Sending
from rig.channels.sampling import TICKS_HZ, first_row
from rig.channels.sensors.conditioning import Conditioner
from rig.channels.sensors.keyphasor import FRACTIONS, TURN
from rig.channels.table import Channel, ChannelTable
from rig.physics.kernels.signals import COLUMN, N_ROW
from rig.run.calibrator import Calibrator, Generated
from rig.run.commands.table import ClearCommand, FaultCommand

_MAX_FAULTS = 64
"""Largest number of simultaneous faults."""
_NO_CORNER_HZ = 1e9
"""Corner frequency that disables the low-pass, above what rows can show; an AC coupling remains."""
_OVERSAMPLING = 8
"""Oversampling of samples with their own instants, which are interpolated ..."""
_NODES = 6
"""... by the polynomial through this number of nodes."""
_NODE_SCALES = [1.0 / math.prod(node - other for other in range(_NODES) if other != node) for node in range(_NODES)]
_FINE_BITS = 32
"""Resolution of these samples: finer than that of any converter."""
_OF_CONVERTER = 1
"""Last part of the key of converter noise, which separates it from the fault's own random numbers."""
_REACH_V = 1e3
"""Range of a faulty cable [V]; only the converter limits it."""


@dataclass
class _Twin:
    """Signal chain of the faulty channels of one conditioner."""

    conditioner: Conditioner
    channels: dict[str, Channel]
    noise: np.ndarray
    """Noise of each channel added to interpolated samples [counts], shape (channels,)."""
    of: tuple[tuple[str, tuple[int, ...]], ...]
    """Numbers of the faults of each channel."""
    first: int
    """Index of its first sample."""
    past: np.ndarray
    """Stored samples, shape (n, channels), ..."""
    at: int
    """... and the index of the first of them."""


class Faulty:
    """All faults of a run.

    Args:
        table: Channel table of the run.
        conditioners: Signal chains of the channels.
        seed: Seed of the faults' random numbers.
        row_ticks: Ticks between rows.
        setting: Further conditions for valid faults.
    """

    def __init__(
        self, table: ChannelTable, conditioners: Sequence[Any], *, seed: int, row_ticks: int, setting: Setting
    ) -> None:
        self.table, self.conditioners, self._seed, self.row_ticks = table, conditioners, seed, row_ticks
        self._setting = setting
        self.sending = Sending()
        self.doors: tuple[str, ...] = DOORS
        """Transports of the rig."""
        self.channels = table.channels
        """All channels by name, ..."""
        self._marks = {name for name, channel in self.channels.items() if channel.signal == "keyphasor"}
        """... and those with keyphasor pulses."""
        self.active: list[Active] = []
        self._begun = 0
        self._last_edge = math.nan
        self._held = np.empty(0)
        """Delayed edges not yet shown [ticks]."""
        self._twins: dict[tuple[int, bool], _Twin] = {}
        self._planned: tuple[list[int], list[Plan]] = [], [Plan(each.groups, ()) for each in conditioners]

    @cached_property
    def scales(self) -> Scales:
        """Scales of all channels."""
        return Scales(self.channels, self.columns)

    @cached_property
    def columns(self) -> dict[str, int]:
        """Column of each channel's signal in the rows, or after them."""
        found = {}
        for conditioner in self.conditioners:
            if isinstance(conditioner, Calibrator):
                continue
            names = (channel.name for group in conditioner.groups for channel in group.channels)
            found |= zip(names, conditioner.columns.tolist(), strict=True)
        return found

    def targets(self, command: FaultCommand, tick: int) -> tuple[str, ...]:
        """Return the channels that a fault changes, or whose blocks it affects.

        Raises:
            InputError: The fault is impossible on them.
        """
        what = command.what
        if not isinstance(what, OfBlocks):
            return find_channels(what, command.channel, self.table, **self._setting._asdict())
        if isinstance(what, Restart) and self._row_at(tick) == 0:
            raise InputError("kind", "one that shows from the first row on, such as dropout", what.name())
        return self.table.groups[find_group(what, command.channel, self.table, self.doors)].names

    def check_all(self, timed: Iterable[tuple[int, object]]) -> None:
        """Raise an error for the first impossible fault of a scene.

        Args:
            timed: Ticks and commands.

        Raises:
            InputError: A fault is impossible.
        """
        number = self._begun
        for tick, command in timed:
            if isinstance(command, FaultCommand):
                number += 1
                self._check_effect(command, self.targets(command, tick), tick, number)

    def _check_effect(self, command: FaultCommand, names: tuple[str, ...], tick: int, number: int) -> None:
        """Raise an error for a fault that could not change a count or a block.

        Args:
            command: The fault.
            names: Its channels.
            tick: Its start.
            number: Its number.

        Raises:
            InputError: The fault is too small, too short or too rare; the message has the limit.
        """
        what, places = command.what, {name: n for n, name in enumerate(self.channels)}
        for name in names[:1] if isinstance(what, OfBlocks) else names:
            channel = self.channels[name]
            source = self.channels[what.reads[0]] if what.reads else None
            check_time(what, channel.rate_hz, tick, self.row_ticks, command.for_s)
            check_size(what, channel, source, command.for_s)
            row, draws = first_row(self._row_at(tick), channel.rate_hz), self._draws(number, what, places[name])
            check_draws(what, channel.rate_hz, row, tick, command.for_s, draws)

    def _draws(self, number: int, what: Kind, place: int) -> Draws:
        """Return a fault's random numbers on a channel.

        Hum, clock, loose contact and blocks are common to the channels of a group; noise is separate for each channel.
        """
        return Draws(self._seed, number, place + 1 if what.stage == "converter" else 0)

    def check(self, command: FaultCommand | ClearCommand, tick: int, waiting: Sequence[object]) -> dict[str, Any]:
        """Return the effect of a command sent now, in the form of `begin`.

        Args:
            command: Injects a fault, or clears some.
            tick: Current tick.
            waiting: Commands executed before it.

        Raises:
            InputError: The command is impossible.
        """
        begun, known = self._begun, [one.id for one in self._all() if one.end > tick]
        for other in waiting:
            if isinstance(other, FaultCommand):
                known.append(begun := begun + 1)
            elif isinstance(other, ClearCommand):
                known = [number for number in known if other.id not in ("all", number)]
        if isinstance(command, FaultCommand):
            if len(known) >= _MAX_FAULTS:
                raise InputError("fault", f"one of at most {_MAX_FAULTS} at a time", Words("another"))
            names = self.targets(command, tick)
            self._check_effect(command, names, tick, begun + 1)
            return self._told(begun + 1, names, tick)
        if command.id != "all" and command.id not in known:
            there = ", ".join(map(str, known)) or "none"
            raise InputError("clear.id", f"the number of an active fault ({there}), or all", command.id)
        return {}

    def clear(self, command: ClearCommand, tick: int) -> list[dict[str, Any]]:
        """End faults at the first row at or after a tick.

        Args:
            command: The faults to end.
            tick: Tick of the command.

        Returns:
            For each ended fault its number as `id` and in the list `fault`, its channels, and the first healthy rows by
            group. If none ends, one entry with an empty list, as every command reports an effect.
        """
        row = self._row_at(tick)
        ended = [one for one in self._all() if command.id in ("all", one.id) and one.end > row]
        for one in ended:
            one.end = row
        if not ended:
            number = None if command.id == "all" else command.id
            return [{**self._told(0, (), tick), "id": number, "fault": []}]
        return [{**self._told(0, one.names, tick), "id": one.id, "fault": [one.id]} for one in ended]

    def begin(self, command: FaultCommand, tick: int, pending: list[tuple[int, Any]]) -> dict[str, Any]:
        """Begin a fault at the first row at or after a tick.

        Args:
            command: The fault.
            tick: Tick of the command.
            pending: Waiting commands; the end of a fault with a duration is added.

        Returns:
            Its number, its channels, and the first rows that it changes, by group.
        """
        row = self._row_at(tick)
        self._begun += 1
        names, what = self.targets(command, tick), command.what
        places = {name: n for n, name in enumerate(self.channels)}
        draws = {name: self._draws(self._begun, what, places[name]) for name in names}
        if isinstance(what, OfBlocks):
            draws = {"": self._draws(self._begun, what, 0)}
            self.sending.active.append(Active(self._begun, what, names, row, draws, sensor_key(command.channel)))
        else:
            noise: dict[str, np.random.Generator] = {}
            if acts(what, "late_s"):
                keys = {name: (self._seed, self._begun, places[name] + 1, _OF_CONVERTER) for name in names}
                noise = {
                    name: np.random.Generator(np.random.SFC64(np.random.SeedSequence(key)))
                    for name, key in keys.items()
                }
            self.active.append(Active(self._begun, what, names, row, draws, noise=noise))
        if command.for_s is not None:
            over = tick + max(1, round(command.for_s * TICKS_HZ))
            insort(pending, (over, ClearCommand(id=self._begun)), key=lambda entry: entry[0])
        return self._told(self._begun, names, tick)

    def _all(self) -> list[Active]:
        return [*self.active, *self.sending.active]

    def _row_at(self, tick: int) -> int:
        return -(-tick // self.row_ticks) * self.row_ticks

    def _told(self, number: int, names: Sequence[str], tick: int) -> dict[str, Any]:
        row = self._row_at(tick)
        groups = {name: group for name, group in self.table.groups.items() if set(group.names) & set(names)}
        first = {name: first_row(row, group.rate_hz) for name, group in groups.items()}
        return {"fault": number, "channels": list(names), "first_row": first}

    def counts(self, rows: np.ndarray, made: np.ndarray, tick: int) -> dict[str, np.ndarray]:
        """Return the samples from the first of these rows up to the last one, by group.

        Args:
            rows: Observed rows, shape (n, N_ROW).
            made: Signals by formulas, shape (n, m).
            tick: Tick of the first row.
        """
        if not self.active:
            return {name: counts for each in self.conditioners for name, counts in each.counts(rows, made).items()}
        end = tick + (len(rows) - 1) * self.row_ticks
        changes = {int(at) for one in self.active for at in (one.begin, one.end) if tick < at < end}
        ticks = [tick, *sorted(changes), end]
        places = [(each - tick) // self.row_ticks for each in ticks]
        parts = [
            self._counts(rows[a : b + 1], made[a : b + 1], begin)
            for begin, a, b in zip(ticks, places, places[1:], strict=False)
        ]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _counts(self, rows: np.ndarray, made: np.ndarray, tick: int) -> dict[str, np.ndarray]:
        """Return the samples of rows between which no fault begins or ends."""
        active = [one for one in self.active if one.begin <= tick < one.end]
        if (ids := [one.id for one in active]) != self._planned[0]:
            self._planned = ids, [Plan(conditioner.groups, active) for conditioner in self.conditioners]
        found: dict[str, np.ndarray] = {}
        volts = Volts(self.scales, rows, made, tick, self.row_ticks, active)
        for place, (conditioner, plan) in enumerate(zip(self.conditioners, self._planned[1], strict=True)):
            if isinstance(conditioner, Calibrator):
                found |= conditioner.counts(rows, made, Generated(conditioner, plan.faulty) if plan.faulty else None)
                continue
            if not plan.faulty:
                self._twins = {key: twin for key, twin in self._twins.items() if key[0] != place}
                found |= conditioner.counts(rows, made)
                continue
            # Twins first: they start from the state of the healthy chain before these rows.
            rate = conditioner.groups[0].rate_hz
            n = np.arange(first_row(tick, rate), first_row(tick + (len(rows) - 1) * self.row_ticks, rate))
            shown = self._shown(place, conditioner, plan, volts, n, tick)
            counts = conditioner.counts(rows, made)
            for name, values in shown.items():
                group, c = plan.homes[name]
                counts[group][:, c] = values
            for name, faults in plan.converters.items():
                (group, c), channel = plan.homes[name], self.channels[name]
                values, t = counts[group][:, c].astype(float), n / rate
                for one in faults:
                    values = one.what.counts(values, make_place(one, channel, n, t))
                most = 2.0 ** (channel.adc_bits - 1)
                counts[group][:, c] = np.clip(values, -most, most - 1.0)
            found |= counts
        return found

    def edges(self, edges: np.ndarray, rows: np.ndarray, tick: int) -> np.ndarray:
        """Return the keyphasor edges with faults [ticks from the first row], shape (edges,).

        Args:
            edges: The true edges.
            rows: Observed rows that contain them.
            tick: Tick of the first row.
        """
        # An edge may lie before the first row; faults that ended earlier have no effect.
        self.active = [one for one in self.active if one.end > tick - self.row_ticks]
        before = self._last_edge
        if len(edges):
            self._last_edge = float(edges[-1] + tick)
        faults = [(one, mark) for one in self.active for mark in one.names if mark in self._marks]
        faults = [(one, mark) for one, mark in faults if acts(one.what, "edges")]
        if not faults:
            return edges
        real, end = edges + tick, tick + self.row_ticks * len(rows)
        # Faults that have ended show no delayed edges.
        lasts = [(self._held >= one.begin) & (self._held < one.end) for one, _ in faults]
        self._held = self._held[np.any(lasts, axis=0)]
        # The rate from the edges: that of the rows would depend on where a block begins.
        rate = 2e6 * math.pi / np.diff(real, prepend=before)
        # Before the first edge there is none: use the row after it, independent of where the block begins.
        behind = np.ceil(edges / self.row_ticks).astype(int)
        rate = np.where(np.isnan(rate), rows[np.minimum(behind, len(rows) - 1), COLUMN["theta_rate"]], rate)
        turns = np.rint(np.interp(edges, self.row_ticks * np.arange(len(rows)), rows[:, COLUMN["theta"]]) / TURN) * TURN
        found = real
        for one, mark in faults:
            inside = (found >= one.begin) & (found < one.end)
            here, nearest = found[inside], np.maximum(np.searchsorted(real, found[inside], side="right") - 1, 0)
            angles, rates = turns[nearest], rate[nearest]
            if tick <= one.begin < end:
                # The turn in which the fault begins has later pulses too; its edge follows from the angle and rate now.
                at_rows = np.interp(one.begin, tick + self.row_ticks * np.arange(len(rows)), np.arange(len(rows)))
                low, part = int(at_rows), at_rows % 1.0
                theta, fast = (
                    rows[low, COLUMN[name]] * (1.0 - part) + rows[min(low + 1, len(rows) - 1), COLUMN[name]] * part
                    for name in ("theta", "theta_rate")
                )
                if fast > 0.0:
                    turn = math.floor(theta / TURN) * TURN
                    here = np.append(one.begin - TICKS_HZ * (theta - turn) / fast, here)
                    angles, rates = np.append(turn, angles), np.append(fast, rates)
            at = At(
                (here - one.begin) / TICKS_HZ, np.arange(len(here)), self.channels[mark], one.draws[mark], {},
                read_nothing, angles, rates, mark_signal,
            )  # fmt: skip
            shown = np.rint(one.what.edges(here, at) * FRACTIONS) / FRACTIONS
            # As with the signal, the true edges apply after the end of the fault.
            shown = shown[(shown >= one.begin) & (shown < one.end)]
            found = np.sort(np.concatenate([found[~inside], shown]))
        found = np.sort(np.concatenate([self._held, found]))
        self._held = found[found >= end]
        return found[found < end] - tick

    def _shown(
        self, place: int, conditioner: Conditioner, plan: Plan, volts: Volts, n: np.ndarray, tick: int
    ) -> dict[str, np.ndarray]:
        """Return the counts of channels that differ before the converter, each of shape (samples,)."""
        found: dict[str, np.ndarray] = {}
        for fine, faulty in plan.twins.items():
            twin = self._twin((place, fine), conditioner, faulty, tick)
            if twin is None:
                continue
            names = list(faulty)
            (values,) = twin.conditioner.counts(volts.rows, volts.signals(names)).values()
            if fine:
                values = self._late(twin, values, n, list(faulty.values()))
            found |= zip(names, values.T, strict=True)
        return found

    def _twin(
        self, key: tuple[int, bool], conditioner: Conditioner, faulty: dict[str, list[Active]], tick: int
    ) -> _Twin | None:
        """Return the twin chain of some channels: the existing one, or one started from the healthy chain."""
        before = self._twins.pop(key, None)
        if not faulty:
            return None
        of = tuple((name, tuple(one.id for one in faults)) for name, faults in faulty.items())
        if before is not None and before.of == of:
            self._twins[key] = before
            return before
        channels = {name: self._channel(name, faults) for name, faults in faulty.items()}
        noise = np.array([channel.noise_v / channel.lsb_v for channel in channels.values()])
        if not self._setting.noisy or self._setting.ideal:
            noise = 0.0 * noise
        if key[1]:
            # Interpolated samples have no noise or quantisation; those of the converter are added afterwards.
            fine = {"adc_bits": _FINE_BITS, "noise_v": 0.0}
            channels = {name: channel.model_copy(update=fine) for name, channel in channels.items()}
        if before is not None and before.channels == channels:
            before.of, before.noise = of, noise
            self._twins[key] = before
            return before
        rate = conditioner.groups[0].rate_hz * (_OVERSAMPLING if key[1] else 1)
        first = first_row(tick, rate)
        made = conditioner.twin(channels, rate_hz=rate, first=first, row=tick // self.row_ticks, columns=N_ROW)
        if before is not None:
            made.take_over(
                before.conditioner, [name for name in channels if channels[name] == before.channels.get(name)]
            )
        twin = _Twin(made, channels, noise, of, first, np.empty((0, len(channels)), np.int32), first)
        if before is not None and key[1] and set(channels) <= set(before.channels):
            columns = [list(before.channels).index(name) for name in channels]
            twin.first, twin.past, twin.at = before.first, before.past[:, columns], before.at
        self._twins[key] = twin
        return twin

    def _channel(self, name: str, faults: Sequence[Active]) -> Channel:
        """Return a channel as in its twin's chain: with its changed filter, limited only by the converter."""
        channel = self.channels[name]
        for one in faults:
            channel = one.what.chain(channel)
        bare = any(type(one.what) is NoFilter for one in faults)
        more = {"bandwidth_hz": _NO_CORNER_HZ} if bare else {}
        return channel.model_copy(update={"range_v": (-_REACH_V, _REACH_V), **more})

    def _late(self, twin: _Twin, counts: np.ndarray, n: np.ndarray, faulty: Sequence[Sequence[Active]]) -> np.ndarray:
        """Return the counts of delayed samples, each channel with its own converter noise.

        Args:
            twin: Chain of the channels, sampled `_OVERSAMPLING` times as often.
            counts: Its new samples, shape (m, channels).
            n: Indices of the requested samples, shape (n,).
            faulty: Faults of each channel.

        Returns:
            Counts within the converter's range, shape (n, channels).
        """
        channels = [self.channels[name] for name in twin.channels]
        rate = channels[0].rate_hz
        late_s, loud = np.zeros((len(n), len(channels))), np.zeros((len(n), len(channels)))
        for c, (channel, faults) in enumerate(zip(channels, faulty, strict=True)):
            late = [one for one in faults if acts(one.what, "late_s")]
            for one in late:
                late_s[:, c] += one.what.late_s(make_place(one, channel, n, n / rate))
            loud[:, c] = late[0].noise[channel.name].standard_normal(len(n))
        # Not before the fault, and with enough samples to interpolate.
        here = (n * _OVERSAMPLING)[:, None]
        wanted = np.maximum(here - late_s * (rate * _OVERSAMPLING), np.minimum(here, twin.first + _NODES - 1))
        known = np.concatenate([twin.past, counts])
        whole = np.floor(wanted).astype(np.int64)
        part, width = wanted - whole, len(channels)
        # Nodes outside the known samples have a weight of 0: there the instants coincide with samples.
        places = (whole - (_NODES - 1) - twin.at) * width + np.arange(width)
        # Weights of the polynomial through the nodes -5 to 0: products of the distances from all others.
        apart = [part + (_NODES - 1 - node) for node in range(_NODES)]
        values, flat = np.zeros(wanted.shape), known.ravel()
        for node in range(_NODES):
            weight = apart[node - 1] * _NODE_SCALES[node]
            for other in range(_NODES):
                if other not in (node, (node - 1) % _NODES):
                    weight *= apart[other]
            values += weight * flat.take(places + node * width, mode="clip")
        kept = round(rate * _OVERSAMPLING * 0.0201) + 2 * _NODES
        twin.at, twin.past = twin.at + max(0, len(known) - kept), known[-kept:]
        bits = np.array([channel.adc_bits for channel in channels])
        most = 2.0 ** (bits - 1)
        return np.clip(np.rint(values * 2.0 ** (bits - _FINE_BITS) + twin.noise * loud), -most, most - 1.0)
