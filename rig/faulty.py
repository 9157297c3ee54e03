"""Channels that misbehave: beside the chain that goes on as if nothing were wrong, another one of the faulty channels.

What the sound chain says is never touched: a fault ends on the row, and what comes then is as if it had never been.
Its twin begins with the state and the noise of the sound one, and differs from it by the faults alone.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rig.calibrator import Calibrator, Generated
from rig.channels import Channel, ChannelTable
from rig.commands import ClearCommand, FaultCommand
from rig.errors import InputError, Words
from rig.faults import (
    DOORS,
    At,
    Draws,
    Kind,
    NoFilter,
    OfBlocks,
    Restart,
    Setting,
    Swap,
    channels_of,
    stream_of,
)  # fmt: skip
from rig.kernels.observe import EDGE, KEYPHASOR_WIDTH
from rig.kernels.signals import COLUMN, N_ROW
from rig.sampling import TICKS_HZ, first_row, lagrange
from rig.sending import Active, Sending
from rig.sensors.conditioning import Conditioner
from rig.sensors.keyphasor import FRACTIONS, TURN
from rig.wire import sensor_key

_MOST = 64
"""Faults at a time."""
_NO_CORNER_HZ = 1e9
"""Above what rows can show there is no low-pass; an AC coupling stays."""
_FINE = 8
"""Samples that are taken at times of their own are read off so many between two, ..."""
_NODES = 6
"""... by the polynomial through so many."""
_REACH_V = 1e3
"""What a faulty cable carries is limited by the converter alone."""


@dataclass
class _Twin:
    """Chain of some faulty channels of one conditioner: `made` of names, and how their filters were changed."""

    conditioner: Conditioner
    channels: dict[str, Channel]
    first: int
    """Number of its first sample."""
    past: np.ndarray
    """Samples that are kept, shape (n, channels), ..."""
    at: int
    """... of which the first has this number."""


class Faulty:
    """All faults of a run.

    Args:
        table: Its channels.
        conditioners: Their chains.
        seed: Of the faults' own numbers.
        row_ticks: Ticks between rows.
        setting: What else decides which make sense.
    """

    def __init__(
        self, table: ChannelTable, conditioners: Sequence[Any], *, seed: int, row_ticks: int, setting: Setting
    ) -> None:
        self.table, self.conditioners, self._seed, self.row_ticks = table, conditioners, seed, row_ticks
        self._setting = setting
        self.sending = Sending()
        """Where blocks go, and what befalls them."""
        self.doors: tuple[str, ...] = DOORS
        """Where they leave the rig."""
        self.channels = table.channels
        """All channels by name, ..."""
        self._marks = {name for name, channel in self.channels.items() if channel.signal == "keyphasor"}
        """... those that show pulses."""
        self.active: list[Active] = []
        self._begun = 0
        self._last_edge = math.nan
        self._held = np.empty(0)
        """Edges that come later than the ones that they stand for [ticks]."""
        self._twins: dict[tuple[int, bool], _Twin] = {}

    @cached_property
    def columns(self) -> dict[str, int]:
        """Column of each channel's signal in the rows, or behind them."""
        found = {}
        for conditioner in self.conditioners:
            names = (channel.name for group in conditioner.groups for channel in group.channels)
            found |= zip(names, conditioner.columns.tolist(), strict=True)
        return found

    def targets(self, command: FaultCommand, tick: int) -> tuple[str, ...]:
        """Channels that a fault would change, or whose blocks it is about.

        Raises:
            InputError: It makes no sense on them.
        """
        what = command.what
        if not isinstance(what, OfBlocks):
            return channels_of(what, command.channel, self.table, **self._setting._asdict())
        if isinstance(what, Restart) and self._row_at(tick) == 0:
            raise InputError("kind", "one that shows from the first row on, such as dropout", what.name())
        return self.table.groups[stream_of(what, command.channel, self.table, self.doors)].names

    def check_all(self, timed: Iterable[tuple[int, object]]) -> None:
        """Refuse what a scene asks for and cannot be.

        Args:
            timed: Ticks and commands.

        Raises:
            InputError: The first fault that makes no sense.
        """
        for tick, command in timed:
            if isinstance(command, FaultCommand):
                self.targets(command, tick)

    def check(self, command: FaultCommand | ClearCommand, tick: int, waiting: Sequence[object]) -> dict[str, Any]:
        """What a command that is given now will come to, as `begin` reports it.

        Args:
            command: To begin a fault, or to end some.
            tick: Now.
            waiting: Commands that are carried out before it.

        Raises:
            InputError: It cannot be carried out.
        """
        begun, known = self._begun, [one.id for one in self._all() if one.end > tick]
        for other in waiting:
            if isinstance(other, FaultCommand):
                known.append(begun := begun + 1)
            elif isinstance(other, ClearCommand):
                known = [number for number in known if other.id not in ("all", number)]
        if isinstance(command, FaultCommand):
            if len(known) >= _MOST:
                raise InputError("fault", f"one of at most {_MOST} at a time", Words("another"))
            return self._told(begun + 1, self.targets(command, tick), tick)
        if command.id != "all" and command.id not in known:
            there = ", ".join(map(str, known)) or "none"
            raise InputError("clear.id", f"the number of a fault that there is ({there}), or all", command.id)
        return {}

    def clear(self, command: ClearCommand, tick: int) -> list[dict[str, Any]]:
        """End faults at the first row at or after a tick.

        Args:
            command: Which faults end.
            tick: Tick of the command.

        Returns:
            For each fault that ends its number as `id` and in the list `fault`, its channels, and the first sound rows
            by group. Where none ends, one entry with an empty list, as every command has an effect that is reported.
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
            pending: Commands that wait; the end of a fault that lasts for some time is added to them.

        Returns:
            Its number, its channels, and the first rows that it changes, by group.
        """
        row = self._row_at(tick)
        self._begun += 1
        names, what = self.targets(command, tick), command.what
        places = {name: n for n, name in enumerate(self.channels)}
        # A hum, a clock and a loose plug are one for all channels of a group; noise is each channel's own.
        own = what.stage == "converter"
        draws = {name: Draws(self._seed, self._begun, places[name] + 1 if own else 0) for name in names}
        if isinstance(what, OfBlocks):
            draws = {"": Draws(self._seed, self._begun, 0)}
            self.sending.active.append(Active(self._begun, what, names, row, draws, sensor_key(command.channel)))
        else:
            self.active.append(Active(self._begun, what, names, row, draws))
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
        """Samples from the first of these rows on that lie before the last one, by group.

        Args:
            rows: Observed rows, shape (n, N_ROW).
            made: Signals by formulas, shape (n, m).
            tick: Of the first row.
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
        """The same of rows between which no fault begins or ends."""
        active = [one for one in self.active if one.begin <= tick < one.end]
        found: dict[str, np.ndarray] = {}
        volts = _Volts(self, rows, made, tick, active)
        for place, conditioner in enumerate(self.conditioners):
            names = [channel.name for group in conditioner.groups for channel in group.channels]
            faulty = {name: [one for one in active if name in one.names] for name in names}
            faulty = {name: faults for name, faults in faulty.items() if faults}
            if isinstance(conditioner, Calibrator):
                found |= conditioner.counts(rows, made, Generated(conditioner, faulty) if faulty else None)
                continue
            shown = self._shown(place, conditioner, faulty, volts, tick) if faulty else {}
            if not faulty:
                self._twins = {key: twin for key, twin in self._twins.items() if key[0] != place}
            counts = conditioner.counts(rows, made)
            for group in conditioner.groups:
                for c, name in enumerate(group.names):
                    if name in shown:
                        counts[group.name][:, c] = shown[name]
            found |= counts
        return found

    def edges(self, edges: np.ndarray, rows: np.ndarray, tick: int) -> np.ndarray:
        """Keyphasor edges as they are shown [ticks from the first row], shape (edges,).

        Args:
            edges: Those that there are.
            rows: Observed rows that they lie in.
            tick: Of the first row.
        """
        # An edge may lie before the first row; what ended before that is over.
        self.active = [one for one in self.active if one.end > tick - self.row_ticks]
        before = self._last_edge
        if len(edges):
            self._last_edge = float(edges[-1] + tick)
        faults = [(one, mark) for one in self.active for mark in one.names if mark in self._marks]
        if not faults and not len(self._held):
            return edges
        real, end = edges + tick, tick + self.row_ticks * len(rows)
        # What has ended since shows none of them.
        lasts = [(self._held >= one.begin) & (self._held < one.end) for one, _ in faults]
        self._held = self._held[np.any(lasts, axis=0)] if lasts else np.empty(0)
        # The rate that edges tell: what rows tell there depends on where a block begins.
        rate = 2e6 * math.pi / np.diff(real, prepend=before)
        # Before the first of all there is none: the row behind it tells, wherever the block begins.
        behind = np.ceil(edges / self.row_ticks).astype(int)
        rate = np.where(np.isnan(rate), rows[np.minimum(behind, len(rows) - 1), COLUMN["theta_rate"]], rate)
        turns = np.rint(np.interp(edges, self.row_ticks * np.arange(len(rows)), rows[:, COLUMN["theta"]]) / TURN) * TURN
        found = real
        for one, mark in faults:
            inside = (found >= one.begin) & (found < one.end)
            here, nearest = found[inside], np.maximum(np.searchsorted(real, found[inside], side="right") - 1, 0)
            angles, rates = turns[nearest], rate[nearest]
            if tick <= one.begin < end:
                # The turn that it begins in has pulses to come, too; its edge, as what there is then tells.
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
                _nothing, angles, rates, _mark,
            )  # fmt: skip
            shown = np.rint(one.what.edges(here, at) * FRACTIONS) / FRACTIONS
            # As the signal: behind its end there is what there is.
            shown = shown[(shown >= one.begin) & (shown < one.end)]
            found = np.sort(np.concatenate([found[~inside], shown]))
        found = np.sort(np.concatenate([self._held, found]))
        self._held = found[found >= end]
        return found[found < end] - tick

    def _shown(
        self, place: int, conditioner: Conditioner, faulty: Mapping[str, list[Active]], volts: _Volts, tick: int
    ) -> dict[str, np.ndarray]:
        """Counts of the faulty channels of one conditioner by name, each shape (samples,)."""
        shown: dict[str, np.ndarray] = {}
        span = (len(volts.rows) - 1) * self.row_ticks
        rate = conditioner.groups[0].rate_hz
        n = np.arange(first_row(tick, rate), first_row(tick + span, rate))
        for fine in (False, True):
            names = [name for name, faults in faulty.items() if fine == any(_is_late(one.what) for one in faults)]
            channels = {name: self._channel(name, faulty[name]) for name in names}
            twin = self._twin((place, fine), conditioner, channels, tick)
            if twin is None:
                continue
            signals = np.stack([volts.signal(name) for name in names], axis=1)
            (counts,) = twin.conditioner.counts(volts.rows, signals).values()
            for c, name in enumerate(names):
                channel, faults = self.channels[name], faulty[name]
                values = counts[:, c].astype(float)
                if fine:
                    values = self._late(twin, values, c, n, channel, faults)
                for one in faults:
                    values = one.what.counts(values, self._at(one, channel, n, n / rate, volts.signal))
                most = 2.0 ** (channel.adc_bits - 1)
                shown[name] = np.clip(values, -most, most - 1.0).astype(np.int32)
            if fine:
                twin.at, twin.past = _kept(twin, counts, rate)
        return shown

    def _twin(
        self, key: tuple[int, bool], conditioner: Conditioner, channels: dict[str, Channel], tick: int
    ) -> _Twin | None:
        """The chain of some channels, as it was, or begun from the sound one."""
        before = self._twins.pop(key, None)
        if not channels:
            return None
        if before is not None and before.channels == channels:
            self._twins[key] = before
            return before
        rate = conditioner.groups[0].rate_hz * (_FINE if key[1] else 1)
        first = first_row(tick, rate)
        made = conditioner.twin(channels, rate_hz=rate, first=first, row=tick // self.row_ticks, columns=N_ROW)
        if before is not None:
            made.take_over(
                before.conditioner, [name for name in channels if channels[name] == before.channels.get(name)]
            )
        twin = _Twin(made, channels, first, np.empty((0, len(channels)), np.int32), first)
        if before is not None and key[1] and set(channels) <= set(before.channels):
            columns = [list(before.channels).index(name) for name in channels]
            twin.first, twin.past, twin.at = before.first, before.past[:, columns], before.at
        self._twins[key] = twin
        return twin

    def _channel(self, name: str, faults: Sequence[Active]) -> Channel:
        """A channel as its twin's chain has it: with another filter, limited by the converter alone."""
        channel = self.channels[name]
        for one in faults:
            channel = one.what.chain(channel)
        late = any(_is_late(one.what) for one in faults)
        wide = {"range_v": (-_REACH_V, _REACH_V), **({"adc_bits": 32, "noise_v": 0.0} if late else {})}
        bare = any(type(one.what) is NoFilter for one in faults)
        return channel.model_copy(update={**wide, **({"bandwidth_hz": _NO_CORNER_HZ} if bare else {})})

    def _at(
        self, one: Active, channel: Channel, n: np.ndarray, times_s: np.ndarray, other: Callable[[str], np.ndarray]
    ) -> At:
        none = np.empty(0)
        t = times_s - one.begin / TICKS_HZ
        return At(t, n, channel, one.draws[channel.name], one.kept, other, none, none, _mark)

    def _late(
        self, twin: _Twin, counts: np.ndarray, c: int, n: np.ndarray, channel: Channel, faults: list[Active]
    ) -> np.ndarray:
        """Counts of samples that are taken late, not yet rounded, shape (n,)."""
        rate = channel.rate_hz
        late_s = np.zeros(len(n))
        for one in faults:
            more = one.what.late_s(self._at(one, channel, n, n / rate, _nothing))
            late_s += 0.0 if more is None else more
        # Not from before the fault, and with samples enough to read between.
        here = n * _FINE
        wanted = np.maximum(here - late_s * rate * _FINE, np.minimum(here, twin.first + _NODES - 1))
        known = np.concatenate([twin.past[:, c], counts])
        whole = np.floor(wanted).astype(np.int64)
        places = (whole - (_NODES - 1) - twin.at)[:, None] + np.arange(_NODES)
        weights = lagrange(wanted - whole + _NODES - 1, range(_NODES)).T
        exact = wanted == whole
        values = np.where(
            exact, known[np.clip(whole - twin.at, 0, len(known) - 1)],
            (known[np.clip(places, 0, len(known) - 1)] * weights).sum(axis=1),
        )  # fmt: skip
        values *= 2.0 ** (channel.adc_bits - 32)
        if self._setting.noisy and not self._setting.ideal:
            values += channel.noise_v / channel.lsb_v * Draws(self._seed, faults[0].id, -1 % 2**32).normal(n)
        return np.rint(values)


class _Volts:
    """What faulty channels feel, in SI, over some rows: signal faults, range, and faults of cables."""

    def __init__(self, faulty: Faulty, rows: np.ndarray, made: np.ndarray, tick: int, active: list[Active]) -> None:
        self.rows, self._made, self._active, self._faulty = rows, made, active, faulty
        self._times_s = (tick + faulty.row_ticks * np.arange(len(rows))) / TICKS_HZ
        self._n = tick // faulty.row_ticks + np.arange(len(rows))
        self._conditioned: dict[str, np.ndarray] = {}

    def _at(self, one: Active, channel: Channel) -> At:
        t = self._times_s - one.begin / TICKS_HZ
        angle, rate = self.rows[:, COLUMN["theta"]], self.rows[:, COLUMN["theta_rate"]]
        return At(t, self._n, channel, one.draws[channel.name], one.kept, self._beyond_bias, angle, rate, _mark)

    def _felt(self, name: str) -> np.ndarray:
        """What the sensor feels [its unit], with the faults of transducers."""
        channel, column = self._faulty.channels[name], self._faulty.columns[name]
        x = self.rows[:, column] if column < N_ROW else self._made[:, column - N_ROW]
        x = x / channel.si
        for one in self._active:
            if name in one.names:
                x = one.what.signal(x, self._at(one, channel))
        return x

    def conditioned(self, name: str) -> np.ndarray:
        """What its conditioner puts out [V]."""
        if name not in self._conditioned:
            channel = self._faulty.channels[name]
            volts = channel.bias_v + channel.sensitivity_v * self._felt(name)
            self._conditioned[name] = np.clip(volts, *channel.range_v)
        return self._conditioned[name]

    def _beyond_bias(self, name: str) -> np.ndarray:
        return self.conditioned(name) - self._faulty.channels[name].bias_v

    def signal(self, name: str) -> np.ndarray:
        """A signal [SI] that gives what arrives at the converter's filter, shape (rows,)."""
        channel = self._faulty.channels[name]
        swapped = [one for one in self._active if name in one.names and isinstance(one.what, Swap)]
        source = name
        for one in swapped:
            source = next(other for other in one.names if other != name)
        volts = self.conditioned(source)
        for one in self._active:
            if name in one.names:
                volts = one.what.volts(volts, self._at(one, channel))
        return (volts - channel.bias_v) / channel.sensitivity_v * channel.si


def _mark(angle: np.ndarray) -> np.ndarray:
    """What the keyphasor sees of its mark, as rows have it (`rig.kernels.observe`), shape (n,)."""
    ahead = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return np.clip(0.5 + np.minimum(ahead, KEYPHASOR_WIDTH - ahead) / EDGE, 0.0, 1.0)


def _is_late(what: Kind) -> bool:
    return type(what).late_s is not Kind.late_s


def _nothing(_: str) -> np.ndarray:
    return np.empty(0)


def _kept(twin: _Twin, counts: np.ndarray, rate: int) -> tuple[int, np.ndarray]:
    """Samples that later ones may still be read off: the number of the first, and they."""
    known = np.concatenate([twin.past, counts])
    most = round(rate * _FINE * 0.0201) + 2 * _NODES
    return twin.at + max(0, len(known) - most), known[-most:]
