"""Judgement of a DAQ's file by the session that the rig sent: choice of the path, and the scorecard."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from replays.recordings.formats import mapping as formats
from replays.score.alignment.row_matching import SignalRows, identify_signals
from replays.score.analogue import score_analogue
from replays.score.card.limits import ScoreLimits, load_limits
from replays.score.card.scorecard import (
    FAIL,
    INCONCLUSIVE,
    NO_LIMIT,
    PASS,
    QUANTITIES,
    Scorecard,
    ScoreRow,
    Verdict,
    text_row,
)
from replays.score.converter import score_converter
from replays.score.digital import score_digital
from replays.score.records.can_log import is_can_log, open_can_log
from replays.score.records.live import Arrivals
from replays.score.records.recorded import Recorded, map_signals, open_recorded, separate_rates
from replays.score.records.scale import COUNTS
from replays.score.records.sent import Formula, Session
from replays.score.records.wiring import Wire, find_wires
from rig.base import units
from rig.base.errors import InputError, UnknownNameError, Words
from rig.channels.table import Channel

_RATE_TOLERANCE = 0.01
"""Largest relative error of the rate by stamps, of a DAQ that recorded rows."""
_MIN_LIKENESS = 0.7
"""Correlation from which a signal may be a channel with another kind of unit."""
_CORE = {"digital": "altered values", "analogue": "gain"}
"""Quantity that each channel must have for a pass."""


def judge(
    file: Path, against: Sequence[Path], *, limits: ScoreLimits | None = None,
    path: Literal["digital", "analogue"] | None = None, formulas: Mapping[str, Formula] | None = None,
    options: formats.FileOptions | None = None, arrivals: Arrivals | None = None,
    channels: Sequence[str] | None = None, mapping: formats.Mapping | None = None,
    step: Callable[[str], None] = lambda _text: None, report: Callable[[str], None] = lambda _text: None,
) -> Scorecard:  # fmt: skip
    """Return the scorecard for a DAQ's file.

    Args:
        file: Recording of the DAQ, in any format that `rig import` reads, or of the rig.
        against: Session that the rig sent, in one file or its parts.
        limits: Limits; the set `as-calibrated` by default.
        path: Path; None: digital if the counts of most signals can be recovered, otherwise analogue.
        formulas: Exact signals by channel: functions from the session's times [s] to values [unit]; by default the
            scene's test signal, or the session's samples.
        options: Format of a text file, if it does not say so itself.
        arrivals: Arrival times of the lines of a text file, including headings, if delivered live.
        channels: Channels or groups of the session that were to be recorded; all by default.
        mapping: Format of the file, and source and unit of each channel; only its tables [file] and [channels] are
            used.
        step: Function that is called with the current step.
        report: Function that is called with the channel of each signal, before the long work.

    Raises:
        InputError: A file cannot be read, or none of its signals was sent.
    """
    limits = load_limits() if limits is None else limits
    step("reading rows")
    session = Session(against)
    due = _select_channels(session, channels)
    remarks: list[str] = []
    options = options if mapping is None else mapping.file
    opened = open_can_log(file, session.recording.table) if is_can_log(file) else open_recorded(file, options, remarks)
    opened = opened if mapping is None else map_signals(opened, mapping.channels, session.channels)
    sent = {}
    for group, names in session.groups.items():
        _, early = session.early(group)
        sent |= {name: (early[:, n], session.rate_hz(group)) for n, name in enumerate(names)}
    rate = max(each for _, each in sent.values())
    recorded = _name_signals(separate_rates(opened, rate))
    step("assigning signals to channels")
    wires: dict[str, Wire] = {}
    rows: dict[str, SignalRows] = {}
    if path != "analogue":
        # Rows of counts are in the order in which they were sent, whatever their stamps: the last trial ignores stamps.
        for trial in (recorded, {name: replace(each, timed=False) for name, each in recorded.items()}):
            wires = _connect(
                trial, sent, session.channels, {name: _snap(each.rate_hz or rate, rate) for name, each in trial.items()}
            )
            wires, rows = identify_signals(trial, wires, session)
            if 2 * sum(each.scale.known for each in rows.values()) > len(wires):
                break
    if path is None:
        exact = sum(each.scale.known for each in rows.values())
        path = "digital" if 2 * exact > len(wires) else "analogue"
    if path == "analogue":
        whole = {name: (values, hz) for name in session.channels for values, _, hz in [session.whole(name)]}
        rates = {name: each.rate_hz or rate for name, each in recorded.items()}
        wires = _connect(recorded, whole, session.channels, rates, whole=True)
    if not any(wire.channel for wire in wires.values()) and recorded.keys().isdisjoint(session.channels):
        raise InputError("FILE", f"a recording of channels of {session.path.name}", Words(f"{file}, which has none"))
    for name, wire in wires.items():
        if (wire.channel or name in session.channels) and (unit := recorded[name].unit) not in COUNTS:
            units.parse(unit, field=f"unit of {name}, or that of -m MAPPING,", also=COUNTS)
    if path == "digital" and not rows:
        raise InputError("--path", "analogue, as the values are not counts", path)
    report(_describe_wires(wires))
    as_mapped = () if mapping is None else mapping.channels.keys()
    card = Scorecard(f"{file.name} against {session.path.name}", path, limits.title, limits.bounds, remarks=remarks)
    _score_wires(card, wires, session, rows if path == "digital" else {}, as_mapped)
    _score_recorded(card, recorded, wires, due)
    if path == "digital":
        if arrivals is not None:
            headings = int(arrivals.rows[-1]) - max(each.rows for each in recorded.values())
            arrivals = replace(arrivals, rows=arrivals.rows - headings)
        step("comparing rows")
        score_digital(card, recorded, wires, rows, session, arrivals)
    else:
        known = {**session.formulas(), **(formulas or {})}
        fitted = score_analogue(card, recorded, wires, session, known, as_mapped, step)
        step("quantities of the converter")
        score_converter(card, fitted)
    card.evidence_gaps += _missing_evidence(card, due)
    return card


def _missing_evidence(card: Scorecard, due: Sequence[str]) -> list[str]:
    """Return the reasons why channels that were to be recorded are inconclusive.

    A channel is conclusive by its core quantity: on the digital path its counts, on the analogue path its gain. If that
    quantity has a limit, its whole interval must be inside or outside the limit.
    """
    core, reasons = _CORE[card.path], []
    signals = {str(row.value): row.channel for row in card.rows if row.quantity == "mapping"}
    absent = {row.channel for row in card.rows if row.quantity == "recorded" and row.verdict == FAIL}
    for channel in (name for name in due if name not in absent):
        rows = [row for row in card.rows if (row.quantity, row.channel) == (core, signals.get(channel))]
        if not any(row.verdict != INCONCLUSIVE for row in rows):
            notes = (row.note or ("its interval crosses the limit" if row.is_known else "") for row in rows)
            note = next(filter(None, notes), "")
            reasons.append(f"{channel}: {core} is inconclusive{': ' if note else ''}{note}")
    return reasons


def _describe_wires(wires: Mapping[str, Wire]) -> str:
    """Return the channel that each signal is most similar to, with the correlation, in one line."""
    return "signals assigned: " + ", ".join(
        f"{name} is {each.channel or 'no channel'} ({each.likeness:.3f})" for name, each in wires.items()
    )


def _snap(rate_hz: float, sent_hz: float) -> float:
    """Return a rate, or that of every n-th row that was sent if it is nearly equal."""
    exact = sent_hz / max(1, round(sent_hz / rate_hz))
    return exact if abs(rate_hz / exact - 1.0) < _RATE_TOLERANCE else rate_hz


def _connect(
    recorded: Mapping[str, Recorded], sent: Mapping[str, tuple[np.ndarray, float]], channels: Mapping[str, Channel],
    rates: Mapping[str, float], *, whole: bool = False,
) -> dict[str, Wire]:  # fmt: skip
    """Return the wires of all signals that have values; tables with separate stamps need not start together.

    The whole record is searched, or its first rows. A signal in another kind of unit than a channel's is assigned to
    that channel only if it is clearly similar.
    """
    tables: dict[int, dict[str, tuple[np.ndarray, float]]] = {}
    for name, signal in recorded.items():
        if signal.rows > 1 and np.isfinite(signal.early).any():
            own = id(signal.table) if signal.table.stamped else 0
            tables.setdefault(own, {})[name] = signal.values if whole else signal.early, rates[name]
    wires = {name: wire for part in tables.values() for name, wire in find_wires(part, sent).items()}
    for name, wire in wires.items():
        kind = units.get_quantity(recorded[name].unit)
        other = wire.channel and kind not in ("", "voltage", "number", units.get_quantity(channels[wire.channel].unit))
        if other and wire.likeness < _MIN_LIKENESS:
            wires[name] = replace(wire, channel="", rivals=())
    return {name: wires[name] for name in recorded if name in wires}


def _name_signals(signals: Sequence[Recorded]) -> dict[str, Recorded]:
    """Return signals by name, with a number after a repeated name."""
    by_name: dict[str, Recorded] = {}
    for signal in signals:
        name, number = signal.name, 2
        while name in by_name:
            name, number = f"{signal.name} #{number}", number + 1
        by_name[name] = signal
    return by_name


def _score_wires(
    card: Scorecard, wires: Mapping[str, Wire], session: Session, rows: Mapping[str, SignalRows],
    as_mapped: Collection[str],
) -> None:  # fmt: skip
    """Add mapping and polarity on the digital path: a signal with a channel's name must be that channel."""
    for name, wire in (wires if card.path == "digital" else {}).items():
        channels = session.channels.keys()
        verdict: Verdict = NO_LIMIT
        note = f"correlation {wire.likeness:.4f}"
        scale = rows[name].scale if name in rows else None
        certain = not wire.rivals if scale is None else scale.known
        if not wire.channel or not certain:
            verdict = INCONCLUSIVE
            note += f"; equally similar to {', '.join(wire.rivals)}" if wire.rivals else ""
            if name == wire.channel and name in as_mapped:
                verdict, note = NO_LIMIT, f"as mapped; {note}"
        elif name in channels:
            verdict = PASS if wire.channel == name else FAIL
        card.rows.append(text_row(card.path, "mapping", name, wire.channel or "-", verdict, note))
        if wire.channel:
            inverted = wire.polarity < 0 if scale is None else scale.inverted
            open_ = wire.ambiguous if scale is None else not scale.known
            verdict = INCONCLUSIVE if open_ else FAIL if inverted else PASS
            note = "inverted half a period later" if wire.ambiguous and open_ else ""
            if open_ and name in as_mapped and not inverted:
                verdict, note = NO_LIMIT, f"as mapped; {note}".removesuffix("; ")
            card.rows.append(text_row(card.path, "polarity", name, "turned" if inverted else "as sent", verdict, note))
    wired = [wire.channel for wire in wires.values() if wire.channel]
    for channel in dict.fromkeys(each for each in wired if wired.count(each) > 1):
        names = ", ".join(name for name, wire in wires.items() if wire.channel == channel)
        card.remarks.append(f"{channel} is recorded more than once: {names}")


def _select_channels(session: Session, channels: Sequence[str] | None) -> list[str]:
    """Return the names of the channels that were to be recorded.

    Raises:
        InputError: The list is empty.
        UnknownNameError: A name is neither a channel nor a group of the session.
    """
    if channels is None:
        return list(session.channels)
    if not channels:
        raise InputError("--channels", "names of channels or groups, or omitted for all", "")
    for name in channels:
        if name not in session.channels and name not in session.groups:
            names = (*session.channels, *session.groups)
            raise UnknownNameError("--channels", f"channels or groups of {session.path.name}", name, names)
    return list(dict.fromkeys(each for name in channels for each in session.groups.get(name, (name,))))


def _score_recorded(
    card: Scorecard, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], due: Sequence[str]
) -> None:
    """Add for each channel that was to be recorded whether the file has it, by its name or its values."""
    present = {wire.channel for wire in wires.values()}
    present |= {name for name, signal in recorded.items() if np.isfinite(signal.early).any()}
    about = QUANTITIES[card.path]["recorded"]
    for name in due:
        verdict: Verdict = PASS if name in present else FAIL
        note = "" if verdict == PASS else "not in the file, or not found in it; " + about.run
        value = "yes" if verdict == PASS else "no"
        card.rows.append(ScoreRow("recorded", name, value, 0.0, 0.0, "1", about.method, None, verdict, "", note))
