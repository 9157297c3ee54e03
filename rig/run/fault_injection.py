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
    TRANSPORTS,
    At,
    BlockFault,
    Draws,
    Kind,
    NoFilter,
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
from rig.run.calibrator import Calibrator, GeneratedFaults
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
_CONVERTER_NOISE_KEY = 1
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
    fault_numbers: tuple[tuple[str, tuple[int, ...]], ...]
    """Numbers of the faults of each channel."""
    first: int
    """Index of its first sample."""
    stored: np.ndarray
    """Stored samples, shape (n, channels), ..."""
    stored_start: int
    """... and the index of the first of them."""


class FaultInjector:
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
        self.transports: tuple[str, ...] = TRANSPORTS
        """Transports of the rig."""
        self.channels = table.channels
        """All channels by name, ..."""
        self._marks = {name for name, channel in self.channels.items() if channel.signal == "keyphasor"}
        """... and those with keyphasor pulses."""
        self.active: list[Active] = []
        self._fault_count = 0
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
        columns = {}
        for conditioner in self.conditioners:
            if isinstance(conditioner, Calibrator):
                continue
            names = (channel.name for group in conditioner.groups for channel in group.channels)
            columns |= zip(names, conditioner.columns.tolist(), strict=True)
        return columns

    def find_targets(self, command: FaultCommand, tick: int) -> tuple[str, ...]:
        """Return the channels that a fault changes, or whose blocks it affects.

        Raises:
            InputError: The fault is impossible on them.
        """
        kind = command.what
        if not isinstance(kind, BlockFault):
            return find_channels(kind, command.channel, self.table, **self._setting._asdict())
        if isinstance(kind, Restart) and self._next_row_tick(tick) == 0:
            raise InputError("kind", "one that shows from the first row on, such as dropout", kind.name())
        return self.table.groups[find_group(kind, command.channel, self.table, self.transports)].names

    def check_all(self, timed: Iterable[tuple[int, object]]) -> None:
        """Raise an error for the first impossible fault of a scene.

        Args:
            timed: Ticks and commands.

        Raises:
            InputError: A fault is impossible.
        """
        number = self._fault_count
        for tick, command in timed:
            if isinstance(command, FaultCommand):
                number += 1
                self._check_effect(command, self.find_targets(command, tick), tick, number)

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
        kind, positions = command.what, {name: n for n, name in enumerate(self.channels)}
        for name in names[:1] if isinstance(kind, BlockFault) else names:
            channel = self.channels[name]
            source = self.channels[kind.reads[0]] if kind.reads else None
            check_time(kind, channel.rate_hz, tick, self.row_ticks, command.for_s)
            check_size(kind, channel, source, command.for_s)
            row, draws = (
                first_row(self._next_row_tick(tick), channel.rate_hz),
                self._build_draws(number, kind, positions[name]),
            )
            check_draws(kind, channel.rate_hz, row, tick, command.for_s, draws)

    def _build_draws(self, number: int, kind: Kind, position: int) -> Draws:
        """Return a fault's random numbers on a channel.

        Hum, clock, loose contact and blocks are common to the channels of a group; noise is separate for each channel.
        """
        return Draws(self._seed, number, position + 1 if kind.stage == "converter" else 0)

    def check(self, command: FaultCommand | ClearCommand, tick: int, waiting: Sequence[object]) -> dict[str, Any]:
        """Return the effect of a command sent now, in the form of `begin`.

        Args:
            command: Injects a fault, or clears some.
            tick: Current tick.
            waiting: Commands executed before it.

        Raises:
            InputError: The command is impossible.
        """
        fault_count, active_ids = self._fault_count, [fault.id for fault in self._list_active() if fault.end > tick]
        for other in waiting:
            if isinstance(other, FaultCommand):
                active_ids.append(fault_count := fault_count + 1)
            elif isinstance(other, ClearCommand):
                active_ids = [number for number in active_ids if other.id not in ("all", number)]
        if isinstance(command, FaultCommand):
            if len(active_ids) >= _MAX_FAULTS:
                raise InputError("fault", f"one of at most {_MAX_FAULTS} at a time", Words("another"))
            names = self.find_targets(command, tick)
            self._check_effect(command, names, tick, fault_count + 1)
            return self._describe_effect(fault_count + 1, names, tick)
        if command.id != "all" and command.id not in active_ids:
            ids = ", ".join(map(str, active_ids)) or "none"
            raise InputError("clear.id", f"the number of an active fault ({ids}), or all", command.id)
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
        row = self._next_row_tick(tick)
        ended = [fault for fault in self._list_active() if command.id in ("all", fault.id) and fault.end > row]
        for fault in ended:
            fault.end = row
        if not ended:
            number = None if command.id == "all" else command.id
            return [{**self._describe_effect(0, (), tick), "id": number, "fault": []}]
        return [{**self._describe_effect(0, fault.names, tick), "id": fault.id, "fault": [fault.id]} for fault in ended]

    def begin(self, command: FaultCommand, tick: int, pending: list[tuple[int, Any]]) -> dict[str, Any]:
        """Begin a fault at the first row at or after a tick.

        Args:
            command: The fault.
            tick: Tick of the command.
            pending: Waiting commands; the end of a fault with a duration is added.

        Returns:
            Its number, its channels, and the first rows that it changes, by group.
        """
        row = self._next_row_tick(tick)
        self._fault_count += 1
        names, kind = self.find_targets(command, tick), command.what
        positions = {name: n for n, name in enumerate(self.channels)}
        draws = {name: self._build_draws(self._fault_count, kind, positions[name]) for name in names}
        if isinstance(kind, BlockFault):
            draws = {"": self._build_draws(self._fault_count, kind, 0)}
            self.sending.active.append(Active(self._fault_count, kind, names, row, draws, sensor_key(command.channel)))
        else:
            noise: dict[str, np.random.Generator] = {}
            if acts(kind, "late_s"):
                keys = {
                    name: (self._seed, self._fault_count, positions[name] + 1, _CONVERTER_NOISE_KEY) for name in names
                }
                noise = {
                    name: np.random.Generator(np.random.SFC64(np.random.SeedSequence(key)))
                    for name, key in keys.items()
                }
            self.active.append(Active(self._fault_count, kind, names, row, draws, noise=noise))
        if command.for_s is not None:
            end_tick = tick + max(1, round(command.for_s * TICKS_HZ))
            insort(pending, (end_tick, ClearCommand(id=self._fault_count)), key=lambda entry: entry[0])
        return self._describe_effect(self._fault_count, names, tick)

    def _list_active(self) -> list[Active]:
        return [*self.active, *self.sending.active]

    def _next_row_tick(self, tick: int) -> int:
        return -(-tick // self.row_ticks) * self.row_ticks

    def _describe_effect(self, number: int, names: Sequence[str], tick: int) -> dict[str, Any]:
        row = self._next_row_tick(tick)
        groups = {name: group for name, group in self.table.groups.items() if set(group.names) & set(names)}
        first = {name: first_row(row, group.rate_hz) for name, group in groups.items()}
        return {"fault": number, "channels": list(names), "first_row": first}

    def counts(self, rows: np.ndarray, formula_values: np.ndarray, tick: int) -> dict[str, np.ndarray]:
        """Return the samples from the first of these rows up to the last one, by group.

        Args:
            rows: Observed rows, shape (n, N_ROW).
            formula_values: Signals by formulas, shape (n, m).
            tick: Tick of the first row.
        """
        if not self.active:
            return {
                name: counts for each in self.conditioners for name, counts in each.counts(rows, formula_values).items()
            }
        end = tick + (len(rows) - 1) * self.row_ticks
        changes = {int(limit) for fault in self.active for limit in (fault.begin, fault.end) if tick < limit < end}
        ticks = [tick, *sorted(changes), end]
        positions = [(each - tick) // self.row_ticks for each in ticks]
        parts = [
            self._counts(rows[a : b + 1], formula_values[a : b + 1], begin)
            for begin, a, b in zip(ticks, positions, positions[1:], strict=False)
        ]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _counts(self, rows: np.ndarray, formula_values: np.ndarray, tick: int) -> dict[str, np.ndarray]:
        """Return the samples of rows between which no fault begins or ends."""
        active = [fault for fault in self.active if fault.begin <= tick < fault.end]
        if (ids := [fault.id for fault in active]) != self._planned[0]:
            self._planned = ids, [Plan(conditioner.groups, active) for conditioner in self.conditioners]
        counts_by_name: dict[str, np.ndarray] = {}
        volts = Volts(self.scales, rows, formula_values, tick, self.row_ticks, active)
        for position, (conditioner, plan) in enumerate(zip(self.conditioners, self._planned[1], strict=True)):
            if isinstance(conditioner, Calibrator):
                counts_by_name |= conditioner.counts(
                    rows, formula_values, GeneratedFaults(conditioner, plan.faulty) if plan.faulty else None
                )
                continue
            if not plan.faulty:
                self._twins = {key: twin for key, twin in self._twins.items() if key[0] != position}
                counts_by_name |= conditioner.counts(rows, formula_values)
                continue
            # Twins first: they start from the state of the healthy chain before these rows.
            rate = conditioner.groups[0].rate_hz
            n = np.arange(first_row(tick, rate), first_row(tick + (len(rows) - 1) * self.row_ticks, rate))
            shown = self._twin_counts(position, conditioner, plan, volts, n, tick)
            counts = conditioner.counts(rows, formula_values)
            for name, values in shown.items():
                group, c = plan.homes[name]
                counts[group][:, c] = values
            for name, faults in plan.converters.items():
                (group, c), channel = plan.homes[name], self.channels[name]
                values, t = counts[group][:, c].astype(float), n / rate
                for fault in faults:
                    values = fault.what.counts(values, make_place(fault, channel, n, t))
                most = 2.0 ** (channel.adc_bits - 1)
                counts[group][:, c] = np.clip(values, -most, most - 1.0)
            counts_by_name |= counts
        return counts_by_name

    def edges(self, edges: np.ndarray, rows: np.ndarray, tick: int) -> np.ndarray:
        """Return the keyphasor edges with faults [ticks from the first row], shape (edges,).

        Args:
            edges: The true edges.
            rows: Observed rows that contain them.
            tick: Tick of the first row.
        """
        # An edge may lie before the first row; faults that ended earlier have no effect.
        self.active = [fault for fault in self.active if fault.end > tick - self.row_ticks]
        previous = self._last_edge
        if len(edges):
            self._last_edge = float(edges[-1] + tick)
        faults = [(fault, mark) for fault in self.active for mark in fault.names if mark in self._marks]
        faults = [(fault, mark) for fault, mark in faults if acts(fault.what, "edges")]
        if not faults:
            return edges
        true_edges, end = edges + tick, tick + self.row_ticks * len(rows)
        # Faults that have ended show no delayed edges.
        holds = [(self._held >= fault.begin) & (self._held < fault.end) for fault, _ in faults]
        self._held = self._held[np.any(holds, axis=0)]
        # The rate from the edges: that of the rows would depend on where a block begins.
        rate = 2e6 * math.pi / np.diff(true_edges, prepend=previous)
        # Before the first edge there is none: use the row after it, independent of where the block begins.
        next_rows = np.ceil(edges / self.row_ticks).astype(int)
        rate = np.where(np.isnan(rate), rows[np.minimum(next_rows, len(rows) - 1), COLUMN["theta_rate"]], rate)
        turns = np.rint(np.interp(edges, self.row_ticks * np.arange(len(rows)), rows[:, COLUMN["theta"]]) / TURN) * TURN
        shown_edges = true_edges
        for fault, mark in faults:
            in_fault = (shown_edges >= fault.begin) & (shown_edges < fault.end)
            here, nearest = (
                shown_edges[in_fault],
                np.maximum(np.searchsorted(true_edges, shown_edges[in_fault], side="right") - 1, 0),
            )
            angles, rates = turns[nearest], rate[nearest]
            if tick <= fault.begin < end:
                # The turn in which the fault begins has later pulses too; its edge follows from the angle and rate now.
                at_rows = np.interp(fault.begin, tick + self.row_ticks * np.arange(len(rows)), np.arange(len(rows)))
                low, part = int(at_rows), at_rows % 1.0
                theta, speed = (
                    rows[low, COLUMN[name]] * (1.0 - part) + rows[min(low + 1, len(rows) - 1), COLUMN[name]] * part
                    for name in ("theta", "theta_rate")
                )
                if speed > 0.0:
                    turn = math.floor(theta / TURN) * TURN
                    here = np.append(fault.begin - TICKS_HZ * (theta - turn) / speed, here)
                    angles, rates = np.append(turn, angles), np.append(speed, rates)
            instants = At(
                (here - fault.begin) / TICKS_HZ, np.arange(len(here)), self.channels[mark], fault.draws[mark], {},
                read_nothing, angles, rates, mark_signal,
            )  # fmt: skip
            shown = np.rint(fault.what.edges(here, instants) * FRACTIONS) / FRACTIONS
            # As with the signal, the true edges apply after the end of the fault.
            shown = shown[(shown >= fault.begin) & (shown < fault.end)]
            shown_edges = np.sort(np.concatenate([shown_edges[~in_fault], shown]))
        shown_edges = np.sort(np.concatenate([self._held, shown_edges]))
        self._held = shown_edges[shown_edges >= end]
        return shown_edges[shown_edges < end] - tick

    def _twin_counts(
        self, position: int, conditioner: Conditioner, plan: Plan, volts: Volts, n: np.ndarray, tick: int
    ) -> dict[str, np.ndarray]:
        """Return the counts of channels that differ before the converter, each of shape (samples,)."""
        counts: dict[str, np.ndarray] = {}
        for fine, faulty in plan.twins.items():
            twin = self._twin((position, fine), conditioner, faulty, tick)
            if twin is None:
                continue
            names = list(faulty)
            (values,) = twin.conditioner.counts(volts.rows, volts.signals(names)).values()
            if fine:
                values = self._delay_samples(twin, values, n, list(faulty.values()))
            counts |= zip(names, values.T, strict=True)
        return counts

    def _twin(
        self, key: tuple[int, bool], conditioner: Conditioner, faulty: dict[str, list[Active]], tick: int
    ) -> _Twin | None:
        """Return the twin chain of some channels: the existing one, or one started from the healthy chain."""
        previous = self._twins.pop(key, None)
        if not faulty:
            return None
        fault_numbers = tuple((name, tuple(fault.id for fault in faults)) for name, faults in faulty.items())
        if previous is not None and previous.fault_numbers == fault_numbers:
            self._twins[key] = previous
            return previous
        channels = {name: self._channel(name, faults) for name, faults in faulty.items()}
        noise = np.array([channel.noise_v / channel.lsb_v for channel in channels.values()])
        if not self._setting.noisy or self._setting.ideal:
            noise = 0.0 * noise
        if key[1]:
            # Interpolated samples have no noise or quantisation; those of the converter are added afterwards.
            fine = {"adc_bits": _FINE_BITS, "noise_v": 0.0}
            channels = {name: channel.model_copy(update=fine) for name, channel in channels.items()}
        if previous is not None and previous.channels == channels:
            previous.fault_numbers, previous.noise = fault_numbers, noise
            self._twins[key] = previous
            return previous
        rate = conditioner.groups[0].rate_hz * (_OVERSAMPLING if key[1] else 1)
        first = first_row(tick, rate)
        chain = conditioner.twin(channels, rate_hz=rate, first=first, row=tick // self.row_ticks, columns=N_ROW)
        if previous is not None:
            chain.take_over(
                previous.conditioner, [name for name in channels if channels[name] == previous.channels.get(name)]
            )
        twin = _Twin(chain, channels, noise, fault_numbers, first, np.empty((0, len(channels)), np.int32), first)
        if previous is not None and key[1] and set(channels) <= set(previous.channels):
            columns = [list(previous.channels).index(name) for name in channels]
            twin.first, twin.stored, twin.stored_start = (
                previous.first,
                previous.stored[:, columns],
                previous.stored_start,
            )
        self._twins[key] = twin
        return twin

    def _channel(self, name: str, faults: Sequence[Active]) -> Channel:
        """Return a channel as in its twin's chain: with its changed filter, limited only by the converter."""
        channel = self.channels[name]
        for fault in faults:
            channel = fault.what.chain(channel)
        bare = any(type(fault.what) is NoFilter for fault in faults)
        more = {"bandwidth_hz": _NO_CORNER_HZ} if bare else {}
        return channel.model_copy(update={"range_v": (-_REACH_V, _REACH_V), **more})

    def _delay_samples(
        self, twin: _Twin, counts: np.ndarray, n: np.ndarray, faulty: Sequence[Sequence[Active]]
    ) -> np.ndarray:
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
        late_s, noise_counts = np.zeros((len(n), len(channels))), np.zeros((len(n), len(channels)))
        for c, (channel, faults) in enumerate(zip(channels, faulty, strict=True)):
            late = [fault for fault in faults if acts(fault.what, "late_s")]
            for fault in late:
                late_s[:, c] += fault.what.late_s(make_place(fault, channel, n, n / rate))
            noise_counts[:, c] = late[0].noise[channel.name].standard_normal(len(n))
        # Not before the fault, and with enough samples to interpolate.
        here = (n * _OVERSAMPLING)[:, None]
        instants = np.maximum(here - late_s * (rate * _OVERSAMPLING), np.minimum(here, twin.first + _NODES - 1))
        samples = np.concatenate([twin.stored, counts])
        whole = np.floor(instants).astype(np.int64)
        part, width = instants - whole, len(channels)
        # Nodes outside the known samples have a weight of 0: there the instants coincide with samples.
        positions = (whole - (_NODES - 1) - twin.stored_start) * width + np.arange(width)
        # Weights of the polynomial through the nodes -5 to 0: products of the distances from all others.
        apart = [part + (_NODES - 1 - node) for node in range(_NODES)]
        values, flat = np.zeros(instants.shape), samples.ravel()
        for node in range(_NODES):
            weight = apart[node - 1] * _NODE_SCALES[node]
            for other in range(_NODES):
                if other not in (node, (node - 1) % _NODES):
                    weight *= apart[other]
            values += weight * flat.take(positions + node * width, mode="clip")
        kept = round(rate * _OVERSAMPLING * 0.0201) + 2 * _NODES
        twin.stored_start, twin.stored = twin.stored_start + max(0, len(samples) - kept), samples[-kept:]
        bits = np.array([channel.adc_bits for channel in channels])
        limit = 2.0 ** (bits - 1)
        return np.clip(np.rint(values * 2.0 ** (bits - _FINE_BITS) + twin.noise * noise_counts), -limit, limit - 1.0)
