"""Topics and message definitions of a recording, other than the payloads of the rig, with their encoding.

Plot messages are standard ROS 2 messages, so that a generic viewer plots them with labels.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from rig.base.wire import SCHEMAS

FORMAT = "rig-recording"
VERSION = "2"
READ_VERSIONS = ("1", VERSION)
"""Format versions that can be read. In version 1, documents are plain JSON without a ROS 2 message around them."""
GAPS = "recorder/gaps"
CLOCK = "recorder/clock"
VIEW = "view"
VIEW_EVENTS = f"{VIEW}/events"


@dataclass(frozen=True)
class Definition:
    """Message definition of a topic, as stored in the file.

    Attributes:
        name: Name of the message type.
        encoding: Encoding of its messages.
        language: Language of the definition.
        text: The definition.
    """

    name: str
    encoding: str
    language: str
    text: bytes


def _ros2(name: str, text: str) -> Definition:
    return Definition(name, "cdr", "ros2msg", text.encode())


_SEPARATOR = "=" * 80 + "\n"
_TIME = _SEPARATOR + "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
BLOCKS = {name: _ros2(name, text) for name, text in SCHEMAS.items()}
JOINT_STATE = _ros2(
    "sensor_msgs/msg/JointState",
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    + _SEPARATOR
    + "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + _TIME,
)
LOG = _ros2(
    "rcl_interfaces/msg/Log",
    "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line\n"
    + _TIME,
)
TEXT = _ros2("std_msgs/msg/String", "string data\n")
"""Definition of document topics; the field `data` is the JSON document."""
LOG_INFO, LOG_WARN, LOG_ERROR = 20, 30, 40

_ENCAPSULATION = b"\x00\x01\x00\x00"


class _Cdr:
    """Builder of one little-endian CDR message; offsets count from the end of the encapsulation header."""

    def __init__(self) -> None:
        self.body = bytearray()

    def align(self, size: int) -> int:
        self.body.extend(bytes(-len(self.body) % size))
        return len(self.body)

    def u32(self, value: int) -> None:
        self.align(4)
        self.body += struct.pack("<I", value)

    def string(self, text: str) -> None:
        data = text.encode(errors="replace") + b"\0"  # JSON can contain lone surrogates
        self.u32(len(data))
        self.body += data

    def message(self) -> bytes:
        return _ENCAPSULATION + bytes(self.body)


def wrap_text(text: bytes) -> bytes:
    """Return a `std_msgs/msg/String` message with these bytes as its text."""
    return _ENCAPSULATION + struct.pack("<I", len(text) + 1) + text + b"\0"


def unwrap_text(message: bytes) -> bytes:
    """Return the text of a `std_msgs/msg/String` message; any other bytes, such as plain JSON, unchanged."""
    text = message[len(_ENCAPSULATION) + 4 : -1]
    return text if message == wrap_text(text) else message


SLOTS = ("position", "velocity", "effort")


class JointStateRows:
    """Encoder of rows as `sensor_msgs/msg/JointState`, one message per row, in one numpy pass.

    The messages of a topic differ only in stamp and values, so each is a copy of a template.
    """

    def __init__(self, names: tuple[str, ...], slots: tuple[str, ...]) -> None:
        """Build the message template.

        Args:
            names: Column labels.
            slots: Arrays of `SLOTS` to fill; each filled array has a value for every label.
        """
        start = len(_ENCAPSULATION)
        fields: dict[str, tuple[str | tuple[str, tuple[int]], int]] = {
            "sec": ("<i4", start),
            "nanosec": ("<u4", start + 4),
        }
        cdr = _Cdr()
        cdr.body += bytes(8)  # stamp
        cdr.string("rig")  # frame_id
        cdr.u32(len(names))
        for name in names:
            cdr.string(name)
        for slot in SLOTS:
            cdr.u32(len(names) if slot in slots else 0)
            if slot in slots:
                fields[slot] = (("<f8", (len(names),)), start + cdr.align(8))
                cdr.body += bytes(8 * len(names))
        template = cdr.message()
        self._slots = slots
        self._dtype = np.dtype(
            {
                "names": list(fields),
                "formats": [kind for kind, _ in fields.values()],
                "offsets": [offset for _, offset in fields.values()],
                "itemsize": len(template),
            }
        )
        self._template = np.frombuffer(template, np.uint8)

    def encode(self, times_ns: np.ndarray, values: dict[str, np.ndarray]) -> np.ndarray:
        """Encode rows.

        Args:
            times_ns: Simulated time of each row [ns], int64, shape (n,).
            values: Values by filled array, shape (n, names); nan in columns without a value.

        Returns:
            One CDR message per row, uint8, shape (n, bytes).
        """
        raw = np.empty((len(times_ns), len(self._template)), np.uint8)
        raw[:] = self._template
        rows = raw.reshape(-1).view(self._dtype)
        rows["sec"] = times_ns // 1_000_000_000
        rows["nanosec"] = times_ns % 1_000_000_000
        for slot in self._slots:
            rows[slot] = values[slot]
        return raw


def encode_log(time_ns: int, level: int, name: str, text: str) -> bytes:
    """Return a `rcl_interfaces/msg/Log` message at a simulated time [ns]."""
    cdr = _Cdr()
    seconds, rest = divmod(time_ns, 1_000_000_000)
    cdr.body += struct.pack("<iIB", min(seconds, 2**31 - 1), rest, level)
    for field in (name, text, "", ""):
        cdr.string(field)
    cdr.u32(0)
    return cdr.message()


def event_text(event: dict[str, Any]) -> tuple[int, str]:
    """Return the log level and a readable line for an event."""
    kind = str(event.get("event", "event"))
    reason = str(event.get("reason", ""))
    if kind == "note":
        tags = event.get("tags")
        tags = "".join(f" #{tag}" for tag in tags) if isinstance(tags, list) else ""
        return LOG_INFO, f"note: {event.get('text', '')}{tags}{_origin(event)}"
    if kind == "fault" and isinstance(what := event.get("what"), dict):
        given = {name: value for name, value in what.items() if name != "kind" and value is not None}
        numbers = "".join(f", {name} {_brief(value)}" for name, value in given.items())
        lasts = "" if event.get("for_s") is None else f", for {_brief(event['for_s'])} s"
        text = f"{event.get('channel')} {what.get('kind')}{numbers}{lasts}"
        return LOG_INFO, f"fault {event.get('fault')}: {text}{_origin(event)}"
    if kind == "clear" and event.get("channels"):
        return LOG_INFO, f"clear: fault {_join(event.get('fault'))} of {_join(event['channels'])}{_origin(event)}"
    if kind == "warning":
        return LOG_WARN, str(event.get("text", "warning"))
    level = LOG_ERROR if kind == "end" and reason.startswith("failed") else LOG_INFO
    hidden = {"event", "tick", "time_s", "wall_s", "rows", "request"}
    request = event.get("request")
    shown = {name: value for name, value in event.items() if name not in hidden}
    shown |= request if isinstance(request, dict) else {}
    details = ", ".join(f"{name} {_brief(value)}" for name, value in shown.items())
    return level, f"{kind}: {details}" if details else kind


def _join(values: Any) -> str:
    return ", ".join(map(str, values)) if isinstance(values, list) else str(values)


def _origin(event: dict[str, Any]) -> str:
    """Return the sender of an event in brackets, or an empty text."""
    return f" (from {event['from']})" if event.get("from") else ""


def _brief(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 160 else text[:157] + "..."
