"""The codec: blocks and documents in both directions, ValueError only for anything else, and the count of gaps."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rig.base import wire
from rig.base.wire import (
    SAMPLE_SCHEMA,
    TRUTH_SCHEMA,
    Block,
    Continuity,
    Gap,
    decode_block,
    decode_document,
    encode_block,
    encode_document,
)

HEAD = 4 + 40
"""Encapsulation and fixed fields before the values [bytes]."""

int64 = st.integers(-(2**63) + 1, 2**63 - 1)
numbers = st.integers(0, 2**53 - 100)
shapes = st.tuples(st.integers(0, 12), st.integers(1, 6))
rates = st.floats(1e-3, 1e12)


@st.composite
def blocks(draw: st.DrawFn, dtype: type | None = None) -> Block:
    dtype = dtype or draw(st.sampled_from([np.int32, np.float64]))
    values = draw(hnp.arrays(dtype, shapes))
    rate_hz, tick_rate_hz = sorted((draw(rates), max(1.0, draw(rates))))
    return Block(draw(numbers), draw(numbers), rate_hz, max(1.0, tick_rate_hz), values)


def schema(block: Block) -> str:
    return SAMPLE_SCHEMA if block.values.dtype == np.int32 else TRUTH_SCHEMA


def small() -> Block:
    return Block(tick=7, index=3, rate_hz=20e3, tick_rate_hz=1e6, values=np.arange(12, dtype=np.int32).reshape(4, 3))


@given(block=blocks())
def test_block_is_decoded_unchanged(block: Block) -> None:
    back = decode_block(encode_block(block), schema(block))
    assert (back.tick, back.index, back.rate_hz, back.tick_rate_hz) == (
        block.tick,
        block.index,
        block.rate_hz,
        block.tick_rate_hz,
    )
    assert back.values.shape == block.values.shape
    assert back.values.dtype == block.values.dtype
    assert back.values.tobytes() == block.values.tobytes(), "bit for bit, also nan"


def test_layout_is_little_endian_cdr() -> None:
    payload = encode_block(small())
    assert payload[:4] == b"\x00\x01\x00\x00"
    assert struct.unpack_from("<qqddII", payload, 4) == (7, 3, 20e3, 1e6, 3, 12)
    assert struct.unpack_from("<12i", payload, HEAD) == tuple(range(12))
    assert len(payload) == HEAD + 12 * 4
    # CDR aligns a double to 8 bytes from the end of the encapsulation; the fixed fields end there.
    assert (HEAD - 4) % 8 == 0


def test_values_of_any_memory_order_are_sent_row_after_row() -> None:
    values = np.arange(12, dtype=np.float64).reshape(3, 4).T
    assert not values.flags.c_contiguous
    back = decode_block(encode_block(Block(0, 0, 1.0, 1.0, values)), TRUTH_SCHEMA)
    np.testing.assert_array_equal(back.values, values)


@pytest.mark.parametrize("values", [np.zeros((2, 2), np.float32), np.zeros((2, 2), np.int64), np.zeros(4, np.int32)])
def test_values_of_another_type_are_not_encoded(values: np.ndarray) -> None:
    with pytest.raises(TypeError, match="int32 or float64 in columns"):
        encode_block(Block(0, 0, 1.0, 1.0, values))


@pytest.mark.parametrize("kind", [SAMPLE_SCHEMA, TRUTH_SCHEMA])
def test_every_truncation_is_refused(kind: str) -> None:
    block = small() if kind == SAMPLE_SCHEMA else Block(0, 0, 1.0, 1.0, np.ones((3, 2)))
    payload = encode_block(block)
    decode_block(payload, kind)
    for cut in range(len(payload)):
        with pytest.raises(ValueError, match="payload must"):
            decode_block(payload[:cut], kind)


@given(block=blocks(), tail=st.binary(min_size=1, max_size=20))
def test_bytes_after_the_message_are_refused(block: Block, tail: bytes) -> None:
    with pytest.raises(ValueError, match="payload must hold whole rows"):
        decode_block(encode_block(block) + tail, schema(block))


@given(block=blocks(np.float64).filter(lambda block: block.values.size > 0))
def test_truth_is_no_sample_block(block: Block) -> None:
    with pytest.raises(ValueError, match="payload must"):
        decode_block(encode_block(block), SAMPLE_SCHEMA)


@given(
    block=blocks(),
    damage=st.lists(st.tuples(st.integers(0, HEAD - 1), st.integers(0, 255)), min_size=1, max_size=8),
    kind=st.sampled_from([SAMPLE_SCHEMA, TRUTH_SCHEMA]),
)
@settings(max_examples=300)
def test_a_damaged_header_gives_a_block_or_value_error(block: Block, damage: list[tuple[int, int]], kind: str) -> None:
    payload = bytearray(encode_block(block))
    for place, value in damage:
        payload[place] = value
    try:
        back = decode_block(bytes(payload), kind)
    except ValueError:
        return
    assert back.values.ndim == 2
    assert HEAD + back.values.nbytes == len(payload), "nothing that was sent is left out"


@pytest.mark.parametrize("kind", [SAMPLE_SCHEMA, TRUTH_SCHEMA])
@pytest.mark.parametrize(
    "head",
    [
        (-1, 0, 1.0, 1e6),
        (2**53 + 1, 0, 1.0, 1e6),
        (0, -1, 1.0, 1e6),
        (0, 2**53, 1.0, 1e6),
        (0, 2**62, 1.0, 1e6),
        (0, 0, -1.0, 1e6),
        (0, 0, float("nan"), 1e6),
        (0, 0, float("inf"), 1e6),
        (0, 0, 1e-300, 1e6),
        (0, 0, 2e6, 1e6),
        (0, 0, 1.0, 0.0),
        (0, 0, 1.0, float("nan")),
        (0, 0, 1.0, 1e300),
    ],
)
def test_a_block_at_no_time_that_a_clock_can_have_is_refused(kind: str, head: tuple[int, int, float, float]) -> None:
    values = bytes(4 if kind == SAMPLE_SCHEMA else 8)
    with pytest.raises(ValueError, match="payload must have times and numbers that a clock can have"):
        decode_block(b"\x00\x01\x00\x00" + struct.pack("<qqddII", *head, 1, 1) + values, kind)


@given(payload=st.binary(max_size=120), kind=st.sampled_from([SAMPLE_SCHEMA, TRUTH_SCHEMA]))
@example(payload=b"\x00\x01\x00\x00" + struct.pack("<qqddII", 0, 0, 0, 0, 2**32 - 1, 0), kind=TRUTH_SCHEMA)
@example(payload=b"\x00\x01\x00\x00" + struct.pack("<qqddII", 0, 0, 0, 0, 0, 0), kind=SAMPLE_SCHEMA)
@example(payload=b"\x00\x01\x00\x00" + struct.pack("<qqddII", 0, 0, 0, 0, 1, 2**32 - 1), kind=SAMPLE_SCHEMA)
def test_any_bytes_are_a_block_or_value_error(payload: bytes, kind: str) -> None:
    try:
        block = decode_block(payload, kind)
    except ValueError:
        return
    assert HEAD + block.values.nbytes == len(payload)


def test_times_of_rows_follow_from_ticks() -> None:
    block = Block(tick=1_000_050, index=0, rate_hz=20e3, tick_rate_hz=1e6, values=np.zeros((3, 1)))
    np.testing.assert_allclose(block.times_s, [1.00005, 1.0001, 1.00015], rtol=0, atol=1e-15)


scalars = st.none() | st.booleans() | int64 | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8)
documents = st.dictionaries(
    st.text(max_size=8),
    st.recursive(
        scalars,
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
        max_leaves=8,
    ),
    max_size=5,
)


@given(document=documents)
def test_document_is_decoded_unchanged(document: dict) -> None:
    assert decode_document(encode_document(document)) == document


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_numbers_outside_json_are_not_encoded(number: float) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        encode_document({"value": number})


@given(payload=st.binary(max_size=60) | st.text(max_size=40).map(str.encode))
@example(payload=b"")
@example(payload=b"[]")
@example(payload=b"null")
@example(payload=b"\xff\xfe{}")
@example(payload=b'{"a": 1')
@example(payload=b"9" * 5000)
def test_any_bytes_are_a_document_or_value_error(payload: bytes) -> None:
    try:
        assert isinstance(decode_document(payload), dict)
    except ValueError:
        return
    assert isinstance(json.loads(payload), dict)


@pytest.mark.parametrize("payload", [b"[" * 100_000, b'{"a":' * 100_000], ids=["lists", "objects"])
def test_deep_nesting_is_refused(payload: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 any will do
        decode_document(payload)


def test_schemas_follow_from_the_key() -> None:
    assert wire.get_schema(wire.sensor_key("probes")) == SAMPLE_SCHEMA
    assert wire.get_schema(wire.EDGES) == TRUTH_SCHEMA
    assert wire.get_schema(wire.truth_key("state")) == TRUTH_SCHEMA
    for key in (wire.EVENTS, wire.STATUS, wire.CATALOGUE, wire.SCENE, wire.PARAMETERS, wire.command_key("hammer")):
        assert wire.get_schema(key) is None, key


def test_schemas_describe_the_bytes() -> None:
    sizes = {"int64": 8, "float64": 8, "uint32": 4}
    for name, last in ((SAMPLE_SCHEMA, "int32[] values"), (TRUTH_SCHEMA, "float64[] values")):
        lines = [line.split("#")[0].split() for line in wire.SCHEMAS[name].splitlines()]
        assert [field for _, field in lines] == ["tick", "index", "rate_hz", "tick_rate_hz", "columns", "values"]
        assert sum(sizes[kind] for kind, _ in lines[:-1]) + 4 == HEAD - 4, "and the length of the sequence"
        assert " ".join(lines[-1]) == last


@given(
    sent=st.lists(st.tuples(st.sampled_from("ab"), st.integers(1, 50), st.booleans()), max_size=30),
    first=st.integers(0, 1000),
)
def test_continuity_finds_every_lost_run_with_its_size(sent: list[tuple[str, int, bool]], first: int) -> None:
    continuity = Continuity()
    index = {"a": first, "b": 0}
    missing: dict[str, Gap] = {}
    met: dict[str, int] = {}
    expected: list[Gap] = []
    found: list[Gap] = []
    for key, rows, arrives in sent:
        start = index[key]
        index[key] += rows
        if not arrives:
            if key in met:
                begin = missing[key].index if key in missing else start
                missing[key] = Gap(key=key, index=begin, size=index[key] - begin)
            continue
        if key in missing:
            expected.append(missing.pop(key))
        met[key] = met.get(key, 0) + rows
        gap = continuity.follow(key, start, rows)
        if gap is not None:
            found.append(gap)
    assert found == expected
    assert continuity.received == met
    assert continuity.lost == {key: sum(gap.size for gap in expected if gap.key == key) for key in met}


def test_a_backward_jump_is_a_gap_without_loss() -> None:
    continuity = Continuity()
    assert continuity.follow("k", 100, 10) is None
    assert continuity.follow("k", 50, 10) == Gap(key="k", index=110, size=-60)
    assert continuity.lost == {"k": 0}
    assert continuity.follow("k", 60, 5) is None, "the stream goes on from there"
