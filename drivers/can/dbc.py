"""DBC file of the rig, generated from the message table.

`rig can dbc -o FILE` writes it; drivers/can/rig.dbc is the committed copy.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.can.message import CanMessage, MessageTable, Signal
from drivers.can.signals import CONTROLLER, RIG, default_messages

if TYPE_CHECKING:
    from cantools.database.can import Database

COPY = Path(__file__).with_name("rig.dbc")
"""Path of the committed copy."""

_COMMENT = (
    "Virtual rotor-stator test rig. Made from the channel table by rig can dbc; do not edit by hand. Calibrations of "
    "channels are assumed values of the usual class of each instrument. Where a frame has several instants, the names "
    "of signals end in the number of theirs (_0 is the first)."
)
_NODES = {
    RIG: "The test rig: instruments, drive, hammer, magnets",
    CONTROLLER: "Who gives commands; several share the one counter",
}
_FRAME_FORMATS = (
    "StandardCAN",
    "ExtendedCAN",
    *[f"reserved{n}" for n in range(2, 14)],
    "StandardCAN_FD",
    "ExtendedCAN_FD",
)
"""Frame formats in the order of Vector's attribute VFrameFormat."""


def text(table: MessageTable | None = None) -> str:
    """Return the text of the DBC file."""
    rows = (table or default_messages()).messages
    return "\n".join([*_header(), *_messages(rows), *_comments(rows), *_attributes(rows), *_values(rows), ""])


def _sanitise_text(text: str) -> str:
    """Replace quotes, backslashes and characters that readers of DBC files reject."""
    return text.replace('"', "'").replace("\\", "/").encode("cp1252", "replace").decode("cp1252")


def database(table: MessageTable | None = None) -> Database:
    """Load the messages as a cantools database."""
    from cantools.database import load_string
    from cantools.database.can import Database

    loaded = load_string(text(table), "dbc")
    assert isinstance(loaded, Database)
    return loaded


def _header() -> Iterator[str]:
    yield from ('VERSION "1"', "", "NS_ :", "", "BS_:", "", f"BU_: {' '.join(_NODES)}", "")


def _messages(rows: tuple[CanMessage, ...]) -> Iterator[str]:
    multiplexed = []
    for row in rows:
        yield f"BO_ {row.identifier} {row.name}: {row.length} {row.sender}"
        selector = next((signal.name for signal in row.signals if signal.selects), "")
        for signal in row.signals:
            yield _format_signal(row, signal)
            if signal.selected_by:
                spans = ", ".join(f"{value}-{value}" for value in signal.selected_by)
                multiplexed.append(f"SG_MUL_VAL_ {row.identifier} {signal.name} {selector} {spans};")
        yield ""
    yield from (*multiplexed, "")


def _format_signal(row: CanMessage, signal: Signal) -> str:
    selection = " M" if signal.selects else f" m{int(signal.selected_by[0])}" if signal.selected_by else ""
    low, high = (raw * signal.scale + signal.offset for raw in signal.raw_range)
    receiver = CONTROLLER if row.sender == RIG else RIG
    return (
        f" SG_ {signal.name}{selection} : {signal.start}|{signal.bits}@1{'-' if signal.signed else '+'} "
        f"({_number(signal.scale)},{_number(signal.offset)}) [{_number(low)}|{_number(high)}] "
        f'"{_sanitise_text(signal.unit)}" {receiver}'
    )


def _number(value: float) -> str:
    """Format a float with all its digits, so that decoded values equal the channel table's; 1 for 1.0."""
    return f"{int(value)}" if value == int(value) else repr(float(value))


def _comments(rows: tuple[CanMessage, ...]) -> Iterator[str]:
    yield f'CM_ "{_COMMENT}";'
    for name, label in _NODES.items():
        yield f'CM_ BU_ {name} "{label}.";'
    for row in rows:
        yield f'CM_ BO_ {row.identifier} "{_sanitise_text(row.label)}.";'
        for signal in row.signals:
            if signal.label:
                yield f'CM_ SG_ {row.identifier} {signal.name} "{_sanitise_text(signal.label)}.";'


def _attributes(rows: tuple[CanMessage, ...]) -> Iterator[str]:
    names = ",".join(f'"{name}"' for name in _FRAME_FORMATS)
    yield 'BA_DEF_ "BusType" STRING ;'
    yield f'BA_DEF_ BO_ "VFrameFormat" ENUM {names};'
    yield 'BA_DEF_ BO_ "CANFD_BRS" ENUM "0","1";'
    yield 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 3600000;'
    yield 'BA_DEF_DEF_ "BusType" "CAN";'
    yield 'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";'
    yield 'BA_DEF_DEF_ "CANFD_BRS" "0";'
    yield 'BA_DEF_DEF_ "GenMsgCycleTime" 0;'
    yield 'BA_ "BusType" "CAN FD";'
    for row in rows:
        if row.fd:
            yield f'BA_ "VFrameFormat" BO_ {row.identifier} {_FRAME_FORMATS.index("StandardCAN_FD")};'
            yield f'BA_ "CANFD_BRS" BO_ {row.identifier} 1;'
        # The attribute has whole milliseconds; faster frames have their period in the comment.
        if row.periodic and row.period_s >= 1e-3:
            yield f'BA_ "GenMsgCycleTime" BO_ {row.identifier} {round(1e3 * row.period_s)};'


def _values(rows: tuple[CanMessage, ...]) -> Iterator[str]:
    for row in rows:
        for signal in row.signals:
            if signal.choices:
                named = " ".join(f'{value} "{name}"' for value, name in signal.choices.items())
                yield f"VAL_ {row.identifier} {signal.name} {named} ;"
