"""A file of a DAQ under test against the session that the rig sent: which path it is, and its scorecard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from replays.recordings.formats.mapping import FileOptions
from replays.score.analogue import Formula, score_analogue
from replays.score.digital import Scale, score_digital, settle
from replays.score.limits import Limits, load_limits
from replays.score.scorecard import FAIL, NO_LIMIT, NOT_SHOWN, PASS, QUANTITIES, Scorecard, ScoreRow, Verdict
from replays.score.signals import Recorded, Session, open_recorded, rate_of
from replays.score.wiring import Wire, find_wires
from rig.errors import InputError, Words

_LOUD = 4.0
"""Noises of a channel from which on what was sent has to be seen."""
_NEAR = 0.01
"""Part by which the rate of a DAQ that took rows may be off by its stamps."""


def judge(
    file: Path, against: Sequence[Path], *, limits: Limits | None = None,
    path: Literal["digital", "analogue"] | None = None, formulas: Mapping[str, Formula] | None = None,
    options: FileOptions | None = None,
) -> Scorecard:  # fmt: skip
    """Make the scorecard of a DAQ.

    Args:
        file: What it recorded, in any format that `rig import` reads, or a recording.
        against: The session that the rig sent, in one file or its parts.
        limits: What is asked; the set `as-calibrated` unless given.
        path: Which of the two; None: digital where counts can be told from what most signals have, else analogue.
        formulas: What was sent exactly, by channel: value [unit] of the session's time [s]; otherwise its own samples.
        options: How a text file is read, where it does not say so itself.

    Raises:
        InputError: A file cannot be read, or nothing in it is like what was sent.
    """
    limits = load_limits() if limits is None else limits
    session = Session(against)
    recorded = _by_name(open_recorded(file, options))
    sent = {}
    for group, names in session.groups.items():
        early = session.early(group)
        sent |= {name: (early[:, n], session.rate_hz(group)) for n, name in enumerate(names)}
    rate = max(each for _, each in sent.values())
    taken = {name: (signal.values, rate_of(signal) or rate) for name, signal in recorded.items() if signal.rows > 1}
    wires: dict[str, Wire] = {}
    scales: dict[str, Scale] = {}
    if path != "analogue" and taken:
        # Rows of counts come as they were sent, whatever their stamps say.
        near = {name: rate if abs(each / rate - 1.0) < _NEAR else each for name, (_, each) in taken.items()}
        wires = find_wires({name: (values, near[name]) for name, (values, _) in taken.items()}, sent)
        wires, scales = settle(recorded, wires, session)
    if path is None:
        told = sum(each.known for each in scales.values())
        path = "digital" if 2 * told > len(wires) else "analogue"
    if path == "analogue" and taken:
        wires = find_wires(taken, sent)
    if not any(wire.channel for wire in wires.values()):
        raise InputError("FILE", f"a recording of what {session.path.name} has", Words(f"{file}, of which nothing is"))
    if path == "digital" and not scales:
        raise InputError("--path", "analogue, as no counts can be told from the values", path)
    card = Scorecard(f"{file.name} against {session.path.name}", path, limits.title)
    _score_wires(card, wires, session, scales if path == "digital" else {})
    if path == "digital":
        score_digital(card, recorded, wires, scales, session, limits)
    else:
        score_analogue(card, recorded, wires, session, limits, formulas or {})
    return card


def _by_name(signals: Sequence[Recorded]) -> dict[str, Recorded]:
    """Signals by name, with a number behind one that comes again."""
    found: dict[str, Recorded] = {}
    for signal in signals:
        name, number = signal.name, 2
        while name in found:
            name, number = f"{signal.name} #{number}", number + 1
        found[name] = signal
    return found


def _score_wires(card: Scorecard, wires: Mapping[str, Wire], session: Session, scales: Mapping[str, Scale]) -> None:
    """Mapping and polarity: a name of the rig's has to be that channel."""
    counts = {
        name: values
        for group, names in session.groups.items()
        for name, values in zip(names, session.early(group).T, strict=True)
    }
    loud = {
        name
        for name, channel in session.channels.items()
        if np.std(counts[name]) > _LOUD * channel.noise_v / channel.lsb_v
    }
    for name, wire in wires.items():
        known = session.channels.keys()
        verdict: Verdict = NO_LIMIT
        note = f"correlation {wire.likeness:.4f}"
        scale = scales.get(name)
        certain = not wire.rivals if scale is None else scale.known
        if not wire.channel and card.path == "analogue" and name in loud:
            verdict, note = FAIL, "nothing of what was sent is in it"
        elif not wire.channel or not certain:
            verdict = NOT_SHOWN
            note += f"; as like {', '.join(wire.rivals)}" if wire.rivals else ""
        elif name in known:
            verdict = PASS if wire.channel == name else FAIL
        card.rows.append(_row(card, "mapping", name, wire.channel or "-", verdict, note))
        if wire.channel:
            turned = wire.polarity < 0 if scale is None else scale.turned
            open_ = wire.turned if scale is None else not scale.known
            verdict = NOT_SHOWN if open_ else FAIL if turned else PASS
            note = "half a period later it would be the other" if wire.turned and open_ else ""
            card.rows.append(_row(card, "polarity", name, "turned" if turned else "as sent", verdict, note))
    taken = [wire.channel for wire in wires.values() if wire.channel]
    for channel in dict.fromkeys(each for each in taken if taken.count(each) > 1):
        names = ", ".join(name for name, wire in wires.items() if wire.channel == channel)
        card.remarks.append(f"{channel} is recorded more than once: {names}")


def _row(card: Scorecard, quantity: str, name: str, value: str, verdict: Verdict, note: str) -> ScoreRow:
    about = QUANTITIES[card.path][quantity]
    run = about.run if verdict == NOT_SHOWN else ""
    return ScoreRow(quantity, name, value, 0.0, 0.0, "1", about.method, None, verdict, run, note)
