"""Documents of a hostile client: nearly valid JSON, values out of range, deep or long documents, and no JSON at all."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

SCALARS: tuple[Any, ...] = (
    *(0, 1, -1, 2**31, 2**53, 2**62, 2**63 - 1, 2**63, -(2**63), 10**30, 0.0, -0.0, 1.5, 1e300, -1e300, 5e-324),
    *(True, False, None, "", "x", "100", "1e5", "\x00", "\x1b[2J", "a\nb", "\u202e", "\U0001f4a9", "[/]", "[red]x"),
    *("x" * 1001, [], {}, [1, 2], {"a": 1}, [[]], "../../etc", "%s%n", "NaN", "inf"),
)
RAW = (
    b"NaN",
    b"Infinity",
    b"-Infinity",
    b"1e999",
    b"-1" + b"0" * 400,
    b"9" * 5000,
    b'"\\ud800"',
    b"01",
    b"+1",
    b"0x10",
)
JUNK = (
    b"",
    b"\x00",
    b"\xff\xfe",
    b"{",
    b"[",
    b"null",
    b"[]",
    b'"x"',
    b"{}" * 2,
    b"[" * 3000,
    b'{"a":' * 1500,
    b"\xef\xbb\xbf{}",
)


def generate_documents(random: np.random.Generator, count: int, examples: list[dict[str, Any]]) -> Iterator[bytes]:
    """Yield payloads: an example with one to three changes, or an unrelated document."""
    fields = sorted({name for example in examples for name in example})
    for _ in range(count):
        kind = random.integers(10)
        if kind == 0:
            yield JUNK[random.integers(len(JUNK))]
            continue
        document = dict(examples[random.integers(len(examples))])
        for _ in range(random.integers(1, 4)):
            name = fields[random.integers(len(fields))] if random.random() < 0.8 else _name(random)
            change = random.integers(4)
            if change == 0:
                document.pop(name, None)
            elif change == 1:
                document[name] = _nested(random)
            elif change == 2:
                document[name] = _number(random)
            else:
                document[name] = SCALARS[random.integers(len(SCALARS))]
        payload = json.dumps(document, ensure_ascii=bool(random.integers(2))).encode("utf-8", "replace")
        if kind == 1:
            payload = _spoil(random, payload)
        elif kind == 2 and document:
            name = json.dumps(next(iter(document))).encode()
            payload = payload[:-1] + b", " + name + b": " + RAW[random.integers(len(RAW))] + b"}"
        elif kind == 3:
            raw = RAW[random.integers(len(RAW))]
            payload = b'{"' + fields[random.integers(len(fields))].encode() + b'": ' + raw + b"}"
        elif kind == 4:
            payload = payload.decode("utf-8", "replace").encode(("utf-16", "utf-32", "utf-8-sig")[random.integers(3)])
        yield payload


def _name(random: np.random.Generator) -> str:
    return str(SCALARS[random.integers(len(SCALARS))])[:200]


def _number(random: np.random.Generator) -> float | int:
    value = float(random.standard_normal()) * 10.0 ** int(random.integers(-5, 20))
    return round(value) if random.integers(2) else value


def _nested(random: np.random.Generator) -> Any:
    value: Any = SCALARS[random.integers(len(SCALARS))]
    for _ in range(random.integers(1, 900) if random.random() < 0.3 else random.integers(1, 40)):
        value = [value] if random.integers(2) else {"a": value}
    return value


def _spoil(random: np.random.Generator, payload: bytes) -> bytes:
    data = bytearray(payload)
    for _ in range(random.integers(1, 6)):
        at = int(random.integers(len(data)))
        if random.integers(2):
            data[at] = int(random.integers(256))
        else:
            del data[at : at + int(random.integers(1, 8))]
        if not data:
            break
    return bytes(data)
