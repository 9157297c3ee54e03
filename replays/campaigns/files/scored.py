"""Expectation about the scorecard of a DAQ under test: one quantity, or completeness of the record."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from replays.campaigns.files.case_results import CaseRecording, Expected, Time, Units, convert_unit, parse_limit
from replays.campaigns.measurement import Measurement, Must
from rig.base.errors import InputError, UnknownNameError
from rig.base.outcome import Outcome
from rig.base.wire import sensor_key

if TYPE_CHECKING:
    from replays.score.card.scorecard import Scorecard, ScoreRow


class ExpectScore(Expected):
    """Rows of the scorecard of a file that the DAQ under test has written: a quantity, or `all`.

    `must` compares the quantity's value and its whole interval with a limit, instead of the limits of the card. It also
    applies to quantities without limits there, such as the trigger row, and to rows that are expected to be missing.
    `all` requires every channel and sample that was sent, with the exceptions given by the fields.
    """

    score: str
    channel: str | list[str] = ""
    channels: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Channels that the device was to record, as in `rig score --channels`; default: all channels of the session."""
    file: Annotated[str, Field(min_length=1)]
    limits: str | None = None
    path: Literal["digital", "analogue"] | None = None
    must: str = ""
    begins_s: Time = 0.0
    """Longest allowed delay of the DAQ's first sample after the start of the case [s]."""
    ends_s: Time = 0.0
    """Longest allowed gap between the DAQ's last sample and the end of the case [s]."""
    every: Annotated[int, Field(ge=1)] = 1
    """Decimation factor of the DAQ."""

    @property
    def _channels(self) -> tuple[str, ...]:
        return (*filter(None, [self.channel]),) if isinstance(self.channel, str) else tuple(self.channel)

    def check(self, units: Units, *, where: str) -> Must:
        """Return the limit of the quantity, or "no failing rows" if there is none.

        Raises:
            InputError: If the quantity or limits are unknown, or the unit does not fit the quantity.
        """
        from replays.score.card.limits import load_limits
        from replays.score.card.scorecard import QUANTITIES

        scores = {quantity: about for quantities in QUANTITIES.values() for quantity, about in quantities.items()}
        if self.score not in {*scores, "all"}:
            raise UnknownNameError(f"{where}.score", "a quantity of `rig score`, or all", self.score, sorted(scores))
        load_limits(self.limits)
        for name, usual in (("begins_s", 0.0), ("ends_s", 0.0), ("every", 1)):
            if self.score != "all" and getattr(self, name) != usual:
                raise InputError(f"{where}.{name}", "left out, unless score is all", getattr(self, name))
        for name in self.channels or ():
            if name not in units[""]:
                raise UnknownNameError(f"{where}.channels", "channels that the rig sends", name, units[""])
        if not self.must:
            return Must("==", 0.0, "1")
        if self.score in ("all", "recorded", "mapping", "polarity"):
            raise InputError(f"{where}.must", f"left out where score is {self.score}", self.must)
        if not (unit := scores[self.score].unit or units[""].get(" ".join(self._channels), "")):
            what = f"one of the channels with must, as {self.score} is in the unit of its channel"
            raise UnknownNameError(f"{where}.channel", what, " ".join(self._channels), units[""])
        return parse_limit(self.must, unit, where=where, of=self.score)

    def measure(self, case: CaseRecording, units: Units) -> Iterator[Measurement]:
        """Yield a measurement per failing or inconclusive row, or one for all rows."""
        from replays.score.card.scorecard import FAIL, INCONCLUSIVE, PASS

        must = self.check(units, where="expect")
        what = self.name or " ".join(("failing rows of", self.score, *self._channels))
        try:
            card = case.card(self.file, self.limits, self.path, self.channels)
        except InputError as error:
            yield Measurement(what, math.nan, must, self.source, note=str(error))
            return
        rows = list(self._select_rows(card, case))
        if self.must:
            yield from self._values(rows, must)
            return
        judged = list(self._losses(card, rows, case)) if self.score == "all" else []
        for row in rows:
            # A single quantity must have a verdict; with `all`, some quantities never have one.
            if row.verdict == FAIL or (row.verdict == INCONCLUSIVE and self.score != "all"):
                text = " ".join(filter(None, (*row.cells(), row.note)))
                judged.append((row.channel, text, Outcome(row.verdict)))
        failing = [(channel, text) for channel, text, outcome in judged if outcome is Outcome.FAIL]
        reasons = [text for _, text, outcome in judged if outcome is Outcome.INCONCLUSIVE]
        reasons += card.evidence_gaps if self.score == "all" else []
        limits = [row.limit.source for row in rows if row.verdict == FAIL and row.limit is not None]
        shown, hidden = (sum(row.verdict == verdict for row in rows) for verdict in (PASS, INCONCLUSIVE))
        note = f"{card.path} path, {shown} quantities pass, {hidden} inconclusive"
        if not shown and not failing and not reasons:
            reasons.append("no row of this quantity has a verdict")
        yield Measurement(
            what, float(len(failing)), must, self.source or ", ".join(dict.fromkeys(limits)),
            note="; ".join([text for _, text in failing][:4]) or note,
            channels=tuple(channel for channel, _, _ in judged if channel)[:2],
            open_reason="" if failing else "; ".join(reasons[:4]),
        )  # fmt: skip

    def _select_rows(self, card: Scorecard, case: CaseRecording) -> Iterator[ScoreRow]:
        """Yield the rows of the quantity that concern the channels or their groups."""
        groups = _sent_channels(case)
        wanted = {name for each in self._channels for name in (each, *groups.get(each, ()))}
        wires = {row.channel: str(row.value) for row in card.rows if row.quantity == "mapping"}
        for row in card.rows:
            tables = groups if row.channel == "all groups" else row.channel.split(", ")
            own = {row.channel, wires.get(row.channel)}.union(tables, *(groups.get(each, ()) for each in tables))
            if self.score in ("all", row.quantity) and (not wanted or own & wanted):
                yield row

    def _losses(self, card: Scorecard, rows: list[ScoreRow], case: CaseRecording) -> Iterator[tuple[str, str, Outcome]]:
        """Yield channel (if known), text and outcome of sent data that are not shown to be in the record."""
        from replays.score.card.scorecard import INCONCLUSIVE, PASS

        groups = _sent_channels(case)
        wires = {row.value: row for row in card.rows if row.quantity == "mapping"}
        recorded = {row.channel for row in card.rows if row.quantity == "recorded" and row.verdict == PASS}
        for name in [name for each in self._channels or groups for name in groups.get(each, [each])]:
            wire = wires.get(name)
            if wire is None:
                if name in recorded:  # otherwise `recorded` fails already, or the channel was not to be recorded
                    yield name, f"no data of {name} are in the file", Outcome.FAIL
            elif wire.verdict == INCONCLUSIVE:
                text = f"whether {wire.channel} is {name} is inconclusive; to find out, run {wire.run}"
                yield name, text, Outcome.INCONCLUSIVE
            elif not any(row.verdict == PASS for row in rows if row.channel == wire.channel and row is not wire):
                yield name, f"no quantity of {name} has a verdict", Outcome.INCONCLUSIVE
        granted_s = {"rows before the first": case.origin_s + self.begins_s, "rows after the last": self.ends_s}
        for row in rows:
            about = f"{row.quantity} of {row.channel}: {row.cells()[2]}"
            if row.quantity == "row step" and row.value != self.every:
                yield "", f"{about}, not {self.every}", Outcome.FAIL
            elif row.quantity in granted_s:
                table = case.recording.table.groups
                rate_hz = max(table[name].rate_hz for name in groups if name in row.channel or "all" in row.channel)
                if float(row.value) * self.every / rate_hz > granted_s[row.quantity] + 1e-9:
                    yield "", about, Outcome.FAIL

    def _values(self, rows: Sequence[ScoreRow], must: Must) -> Iterator[Measurement]:
        """Yield a measurement per row: the value or the end of its interval with the smallest margin."""
        for row in rows:
            what = self.name or f"{row.quantity} {row.channel}".strip()
            ends = [convert_unit(float(each), row.unit, must) for each in (row.value, row.low, row.high)]
            value = min(ends, key=must.margin) if all(map(math.isfinite, ends)) else math.nan
            reason = "" if math.isfinite(value) else row.note or f"not shown by this run; to find out, run {row.run}"
            yield Measurement(
                what, value, must, self.source, note=row.note, channels=(row.channel,), open_reason=reason
            )
        if not rows:
            what = self.name or " ".join((self.score, *self._channels))
            yield Measurement(what, math.nan, must, self.source, open_reason="the scorecard has no such quantity")


def _sent_channels(case: CaseRecording) -> dict[str, tuple[str, ...]]:
    """Return the channels that were sent, by group."""
    groups = case.recording.table.groups
    return {name: tuple(group.names) for name, group in groups.items() if sensor_key(name) in case.recording.streams}
