"""Scorecard: a row per quantity and channel, with interval, limit and verdict; as a document and as JUnit."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from replays.report import junit
from rig.base.errors import UnknownNameError
from rig.base.outcome import Outcome
from rig.base.text import build_html_table, replace_nonfinite
from rig.channels.faults.defects import defects_shown

PASS, FAIL, INCONCLUSIVE, NO_LIMIT = "pass", "fail", "inconclusive", "no limit"
Verdict = Literal["pass", "fail", "inconclusive", "no limit"]
SignalPath = Literal["digital", "analogue"]
Interval = tuple[float, float, float]
"""Value, low and high end."""


@dataclass(frozen=True)
class Quantity:
    """Definition of a scored quantity.

    Attributes:
        unit: Unit; empty for that of the channel.
        method: Method of the interval.
        run: Test run that determines the quantity.
    """

    unit: str
    method: str
    run: str


_EXACT = "exact, row by row"
_SANDWICH = "least squares, block sandwich of 64 blocks, Student's t"
_STEP_DETECTION = "time error of each block, steps by whole samples by likelihood ratio"
_VARIANCE_SPLIT = "weighted least squares of squared residuals on squared slope, block sandwich, Student's t"
_DURATION = "a longer run"
_MULTI_FREQUENCY = "a signal of many frequencies on every channel (test-prbs, 2 s)"
_WIDE_BAND = "a signal beyond the corner (test-chirp, test-prbs)"
_SINE = "a sine near full scale on the channel (test-sine, 10 s)"
_TONES = "two tones on the channel (test-two-tone, 10 s)"
_RAMP = "a slow ramp over the whole range (test-ramp, 20 s)"
_STEPS = "at least 6 steps with plateaus of 100 samples (test-step, 10 s)"
_DIGITS = "a recording that keeps every digit of the counts"
_STAMPED = "a recording that keeps time stamps"
_RECORDED = Quantity(
    "1", "by name, equal counts or correlation", "--channels NAME,... if fewer channels were to be recorded"
)
DIGITAL = {
    "recorded": _RECORDED,
    "mapping": Quantity("1", "cross-correlation, then equal counts", _MULTI_FREQUENCY),
    "polarity": Quantity("1", "sign of the scale", _MULTI_FREQUENCY),
    "scale": Quantity("ppm", "least squares, then every count equal", _DIGITS),
    "offset": Quantity("counts", "least squares, then every count equal", _DIGITS),
    "altered values": Quantity("1", _EXACT, _DURATION),
    "missing rows": Quantity("1", _EXACT, _DURATION),
    "doubled rows": Quantity("1", _EXACT, _DURATION),
    "swapped rows": Quantity("1", _EXACT, _DURATION),
    "foreign rows": Quantity("1", _EXACT, _DURATION),
    "row step": Quantity("1", "by the rate of the stamps, then equal counts", _STAMPED),
    "rows before the first": Quantity("1", _EXACT, _DURATION),
    "rows after the last": Quantity("1", _EXACT, _DURATION),
    "stamp offset": Quantity("s", "straight line through batch means, Student's t", _STAMPED),
    "stamp rate": Quantity("ppm", "straight line through batch means, Student's t", _STAMPED),
    "stamp jitter": Quantity("s", "rms within batches, chi squared", _STAMPED),
    "stamps that go back": Quantity("1", _EXACT, _STAMPED),
    "latency": Quantity(
        "s",
        "stamps, or live the rows' arrival, less their arrival at the session's recorder, Student's t",
        "live, `my-daq | rig score -`; or with rows stamped by the computer's clock, recorded while `rig record` runs",
    ),
    "trigger row": Quantity("1", _EXACT, "a triggered recording of a scene with a hammer or another command"),
}
ANALOGUE = {
    "recorded": _RECORDED,
    "mapping": Quantity("1", "cross-correlation of all pairs", _MULTI_FREQUENCY),
    "polarity": Quantity("1", "cross-correlation of all pairs", _MULTI_FREQUENCY),
    "gain": Quantity("ppm", _SANDWICH, _DURATION),
    "offset": Quantity("", _SANDWICH, _DURATION),
    "skew": Quantity("ns", _SANDWICH, _MULTI_FREQUENCY),
    "start": Quantity("s", _SANDWICH, _MULTI_FREQUENCY),
    "clock": Quantity("ppm", f"{_SANDWICH}, weighted mean of channels", "a longer run with a signal above 100 Hz"),
    "clock drift": Quantity(
        "ppm/s", f"{_SANDWICH}, weighted mean of channels", "a longer run with a signal above 100 Hz"
    ),
    "lost samples": Quantity("1", _STEP_DETECTION, "a signal above 100 Hz on every channel"),
    "doubled samples": Quantity("1", _STEP_DETECTION, "a signal above 100 Hz on every channel"),
    "foreign rows": Quantity("1", "rows in unexplained blocks between explained ones", _DURATION),
    "judged part": Quantity("1", "rows explained over rows in the session", "a signal that does not repeat"),
    **{name: DIGITAL[name] for name in ("stamp rate", "stamp jitter", "stamps that go back")},
    "noise": Quantity("", _VARIANCE_SPLIT, _DURATION),
    "jitter": Quantity("ns", _VARIANCE_SPLIT, "a steep signal (test-sine at 1 kHz or more, or two tones), 10 s"),
    "effective bits": Quantity("bit", "from the rms of the whole residual, log2(range / (rms sqrt 12))", _DURATION),
    "dynamic range": Quantity("dB", "from the noise, full-scale sine over it", _DURATION),
    "corner": Quantity("Hz", "least squares with a Butterworth low-pass, else cross spectra", _WIDE_BAND),
    "SINAD": Quantity("dB", "IEEE 1057 four-parameter sine fit, chi squared", _SINE),
    "ENOB": Quantity("bit", "IEEE 1057 four-parameter sine fit, chi squared", _SINE),
    "THD": Quantity("dB", "harmonics 2 to 10 of the sine fit, delta method", _SINE),
    "SFDR": Quantity("dB", "largest line of the sine fit's residual, delta method", _SINE),
    "alias rejection": Quantity(
        "dB", f"of all components above half of the rate, {_SANDWICH}",
        "tones above half of the DAQ's rate, from a session at a higher rate",
    ),
    "IMD": Quantity("dB", "products of second and third order over two tones, least squares, delta method", _TONES),
    "INL": Quantity("ppm", "transfer curve of 64 straight pieces, simultaneous interval, of the range", _RAMP),
    "DNL": Quantity("LSB", "code density of a ramp, simultaneous interval", f"{_RAMP}, longer for more samples"),
    "crosstalk": Quantity("dB", f"worst of the other channels, in volts, {_SANDWICH}", _MULTI_FREQUENCY),
    "rise time": Quantity("s", "10 to 90 % of the mean step response", _STEPS),
    "overshoot": Quantity("%", "largest value of the mean step response, simultaneous interval", _STEPS),
    "settling time": Quantity("s", "from 50 % of the mean step response, simultaneous interval", _STEPS),
    "trigger row": DIGITAL["trigger row"],
}  # fmt: skip
QUANTITIES = {"digital": DIGITAL, "analogue": ANALOGUE}


@dataclass(frozen=True)
class Bounds:
    """Limits of a quantity.

    Attributes:
        low, high: The ends, in its unit.
        source: Source of the limits.
    """

    low: float
    high: float
    source: str

    def __str__(self) -> str:
        if math.isinf(self.low):
            return f"<= {self.high:.6g}"
        if math.isinf(self.high):
            return f">= {self.low:.6g}"
        return f"{self.low:.6g} to {self.high:.6g}"


@dataclass(frozen=True)
class ScoreRow:
    """A row of a scorecard.

    Attributes:
        quantity: A key of `QUANTITIES`.
        channel: Channel, or group; empty for all channels.
        value: Value; nan if unknown, or a text.
        low, high: Its 95 % interval; equal if it is exact.
        unit: Unit of these.
        method: Method of the interval.
        limit: Limits, or None.
        verdict: The verdict.
        run: Test run that determines the quantity.
        note: Further information, such as row numbers.
    """

    quantity: str
    channel: str
    value: float | str
    low: float
    high: float
    unit: str
    method: str
    limit: Bounds | None
    verdict: Verdict
    run: str = ""
    note: str = ""

    @property
    def is_known(self) -> bool:
        """True if there is a value."""
        return isinstance(self.value, str) or math.isfinite(self.value)

    def cells(self) -> tuple[str, ...]:
        """Return quantity, channel, value, interval, unit, limit and verdict as text."""
        is_known = self.is_known
        exact = self.low == self.high or not is_known
        digits = 6
        if not exact and math.isfinite(self.high - self.low):  # enough digits to distinguish the two ends
            largest = max(abs(self.low), abs(self.high))
            digits = min(15, max(6, math.ceil(math.log10(largest / (self.high - self.low))) + 2))
        interval = "" if exact else f"{self.low:.{digits}g} to {self.high:.{digits}g}"
        value = self.value if isinstance(self.value, str) else f"{self.value:.{digits}g}" if is_known else ""
        return (
            self.quantity, self.channel, value, interval, "" if self.unit == "1" else self.unit,
            "" if self.limit is None else str(self.limit), self.verdict,
        )  # fmt: skip


def _is_outside(value: float, low: float, high: float, limit: Bounds, *, rms: bool) -> bool:
    """Return whether an interval that is longer by `_MARGIN` is outside a limit as a whole."""
    power = 2 if rms else 1  # the interval of a variance is symmetric about the variance
    high = value**power + _MARGIN * (high**power - value**power)
    low = value**power - _MARGIN * (value**power - low**power)
    return high < limit.low or low > limit.high**power


def judge_row(
    path: SignalPath, quantity: str, channel: str, estimate: Interval | None, *, unit: str = "",
    limit: Bounds | None = None, note: str = "",
) -> ScoreRow:  # fmt: skip
    """Return a row with its verdict: the whole interval decides, and one that crosses a limit is inconclusive.

    A card has dozens of rows, and one in twenty 95 % intervals misses the true value. A row therefore fails only if its
    99.7 % interval is outside the limit.

    Args:
        path: Path of the scorecard.
        quantity: A key of `QUANTITIES`.
        channel: Channel, or group; empty for all channels.
        estimate: Value, low and high end of the 95 % interval; None if this run does not determine it.
        unit: Unit of a quantity in the channel's unit.
        limit: Limits of the quantity.
        note: Further information.
    """
    about = QUANTITIES[path][quantity]
    value, low, high = (math.nan,) * 3 if estimate is None else estimate
    verdict: Verdict = INCONCLUSIVE
    if estimate is not None:
        if limit is None:
            verdict = NO_LIMIT
        elif limit.low <= low and high <= limit.high:
            verdict = PASS
        elif _is_outside(value, low, high, limit, rms=quantity in _RMS):
            verdict = FAIL
    run = about.run if verdict == INCONCLUSIVE else ""
    return ScoreRow(quantity, channel, value, low, high, about.unit or unit, about.method, limit, verdict, run, note)


def text_row(path: SignalPath, quantity: str, channel: str, value: str, verdict: Verdict, note: str) -> ScoreRow:
    """Return a row with a text as its value, and a given verdict."""
    about = QUANTITIES[path][quantity]
    run = about.run if verdict == INCONCLUSIVE else ""
    return ScoreRow(quantity, channel, value, 0.0, 0.0, "1", about.method, None, verdict, run, note)


@dataclass
class Scorecard:
    """All rows of one path, and the outcome.

    Attributes:
        title: Title.
        path: Digital or analogue.
        limits: Title of the limits.
        find_limit: Function that returns the limits of a path's quantity, for a channel of the session's table.
        rows: The rows.
        remarks: Assumptions.
        evidence_gaps: Reasons why the record shows too little for a pass; the outcome is then inconclusive unless a
            quantity fails.
        pictures: Data for plots, by kind and channel.
        runs: Row numbers by event, as pairs of first and last.
    """

    title: str
    path: SignalPath
    limits: str
    find_limit: Callable[..., Bounds | None]
    rows: list[ScoreRow] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    evidence_gaps: list[str] = field(default_factory=list)
    pictures: dict[str, Any] = field(default_factory=dict)
    runs: dict[str, list[tuple[int, int]]] = field(default_factory=dict)

    def add(
        self, quantity: str, channel: str, estimate: Interval | None, *, of: Any = None, unit: str = "", note: str = "",
        **inputs: Any,
    ) -> None:  # fmt: skip
        """Judge an estimate by the limit for the session's channel `of` and for further inputs, and add the row."""
        limit = self.find_limit(self.path, quantity, of, **inputs)
        self.rows.append(judge_row(self.path, quantity, channel, estimate, unit=unit, limit=limit, note=note))

    def _repr_html_(self) -> str:
        headings = ("quantity", "channel", "value", "interval", "unit", "limit", "verdict")
        return build_html_table(f"{self.title}: {self.verdict_line}", headings, [row.cells() for row in self.rows])

    @property
    def outcome(self) -> Outcome:
        """Fail if a quantity fails; pass if one passes without any doubt; otherwise inconclusive."""
        verdicts = {row.verdict for row in self.rows}
        return Outcome.judge(failed=FAIL in verdicts, has_evidence=PASS in verdicts and not self.evidence_gaps)

    @property
    def verdict_line(self) -> str:
        """Path, outcome, number of quantities by verdict, and the first doubt, in one line."""
        counts = Counter(row.verdict for row in self.rows)
        failed = list(dict.fromkeys(row.quantity for row in self.rows if row.verdict == FAIL))
        parts = [f"{counts[PASS]} pass", f"{counts[FAIL]} fail" + (f" ({', '.join(failed)})" if failed else "")]
        parts += [f"{counts[INCONCLUSIVE]} inconclusive, {counts[NO_LIMIT]} without a limit"]
        reason = ""
        if self.outcome is Outcome.INCONCLUSIVE:
            more = f"; and {len(self.evidence_gaps) - 1} more" if self.evidence_gaps[1:] else ""
            reason = f"; {self.evidence_gaps[0]}{more}" if self.evidence_gaps else "; no quantity passes"
        return f"{self.path} path: {self.outcome}: {', '.join(parts)}{reason}"

    @property
    def defects(self) -> dict[str, list[str]]:
        """Defects (of the table of faults) that explain the failed quantities, by channel."""
        failed: dict[str, set[str]] = {}
        for row in self.rows:
            if row.verdict == FAIL:
                failed.setdefault(row.channel, set()).add(row.quantity)
        defects = {name: defects_shown(each, digital=self.path == "digital") for name, each in failed.items()}
        return {name: each for name, each in defects.items() if each}

    @property
    def findings(self) -> list[str]:
        """Remarks, and defects of each channel, as lines."""
        return [*self.remarks, *(f"{name or 'all'}: {' or '.join(each)}" for name, each in self.defects.items())]

    def row(self, quantity: str, channel: str = "") -> ScoreRow:
        """Return one of the rows.

        Raises:
            UnknownNameError: The row does not exist.
        """
        for row in self.rows:
            if (row.quantity, row.channel) == (quantity, channel):
                return row
        names = [f"{row.quantity} {row.channel}".strip() for row in self.rows]
        raise UnknownNameError("row", "one of the scorecard's", f"{quantity} {channel}".strip(), names)

    def document(self) -> dict[str, Any]:
        """Return the scorecard as a document for JSON."""
        rows = [{name: each or None for name, each in asdict(row).items()} for row in self.rows]
        for row, entry in zip(self.rows, rows, strict=True):
            entry |= {"value": row.value, "low": row.low, "high": row.high}
        return replace_nonfinite({
            "title": self.title, "path": self.path, "outcome": self.outcome.value, "good": self.outcome is Outcome.PASS,
            "verdict": self.verdict_line, "doubts": self.evidence_gaps, "limits": self.limits, "rows": rows,
            "defects": self.defects, "remarks": self.remarks, "runs": self.runs,
        })  # fmt: skip


_MARGIN = 1.5
"""Length of a 99.7 % interval over that of a 95 % interval, of a normal estimate."""
_RMS = ("noise", "jitter", "stamp jitter")
"""Quantities that are roots of variances."""
MARKS: dict[Verdict, str] = {FAIL: "X", INCONCLUSIVE: "?", PASS: "+", NO_LIMIT: "-"}
"""Marks of a matrix, the worst first."""
LEGEND = "+ pass, X fail, ? inconclusive: not determined by this run, - no limit, blank: not of this channel"


def make_matrix(card: Scorecard) -> tuple[list[str], list[tuple[str, ...]]]:
    """Return the channels, and for each quantity its name and the worst mark per channel.

    Quantities of all channels together are in the column "all"; fewer than two channels have an empty matrix.
    """
    names = dict.fromkeys(row.channel for row in card.rows if row.channel)
    columns = [*names, *([""] if any(not row.channel for row in card.rows) else [])]
    lines: list[tuple[str, ...]] = []
    for quantity in dict.fromkeys(row.quantity for row in card.rows) if len(names) > 1 else ():
        marks = [{row.verdict for row in card.rows if (row.quantity, row.channel) == (quantity, c)} for c in columns]
        lines.append((quantity, *(next((mark for each, mark in MARKS.items() if each in some), "") for some in marks)))
    return [each or "all" for each in columns], lines


def write_junit(card: Scorecard, path: Path) -> None:
    """Write a scorecard as JUnit XML.

    The outcome is a case, and so is each quantity that passes or fails; an inconclusive outcome is an error of that
    type. Quantities without a verdict, on which the outcome does not depend, are properties, not skipped cases.

    Raises:
        DiskError: The file cannot be written.
    """
    judged = [row for row in card.rows if row.verdict in (PASS, FAIL)]
    others = [(f"{row.quantity} {row.channel}".strip(), _line(row)) for row in card.rows if row not in judged]
    cases = [_outcome_case(card), *(_case(card, row) for row in judged)]
    junit.write_junit(path, [junit.Suite(f"rig score, {card.path}", cases, others)])


def _outcome_case(card: Scorecard) -> junit.JunitCase:
    result: dict[Outcome, junit.Outcome] = {
        Outcome.PASS: "passed", Outcome.FAIL: "failure", Outcome.INCONCLUSIVE: "inconclusive",
    }  # fmt: skip
    lines = "\n".join(card.evidence_gaps)
    return junit.JunitCase(f"score.{card.path}", "outcome", result[card.outcome], card.verdict_line, lines)


def _case(card: Scorecard, row: ScoreRow) -> junit.JunitCase:
    classname, name, line = f"score.{card.path}", f"{row.quantity} {row.channel}".strip(), _line(row)
    if row.verdict == PASS:
        return junit.JunitCase(classname, name, text=line)
    source = "" if row.limit is None else row.limit.source
    return junit.JunitCase(classname, name, "failure", line, f"{line}\nsource: {source}\n{row.note}")


def _line(row: ScoreRow) -> str:
    _, _, value, interval, unit, limit, verdict = row.cells()
    run = f"; to show it: {row.run}" if row.run else ""
    return f"{verdict}: {value} {unit} ({interval or 'exact'}); limit {limit or 'none'}{run}"
