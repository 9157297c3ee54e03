"""Recordings derived from recordings: recovered and cut."""

from __future__ import annotations

import contextlib
import json
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from recorder.reader import Recording, join
from recorder.rewrite import cut, recover, recovered_path
from recorder.writer import RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import CATALOGUE, EDGES, EVENTS, PARAMETERS, SCENE, STATUS, encode_document, sensor_key, truth_key

from .recorder_stream import generate_stream, make_documents

PROBES = sensor_key("probes")
HEAD = 9
"""Bytes of an opcode and a length."""


def writer(path: Path, **options: Any) -> RecordingWriter:
    about = make_documents()
    return RecordingWriter(
        path, catalogue=about[CATALOGUE], parameters=about[PARAMETERS], scene=about[SCENE], **options
    )


def write_recording(path: Path, items: list[tuple[str, bytes]]) -> Path:
    """Write a recording with chunks of the largest size."""
    with writer(path, sync_every_s=1e9) as file:
        for number, (key, payload) in enumerate(items):
            file.write(key, payload, 1_700_000_000_000_000_000 + number * 1_250_000)
        file.finish("completed")
    return path


def of(items: list[tuple[str, bytes]]) -> dict[str, list[bytes]]:
    found = defaultdict(list)
    for key, payload in items:
        found[key].append(payload)
    return dict(found)


@pytest.fixture(scope="module")
def items() -> list[tuple[str, bytes]]:
    return list(generate_stream(100))


@pytest.fixture(scope="module")
def path(tmp_path_factory, items) -> Path:
    return write_recording(tmp_path_factory.mktemp("rewrite") / "run.mcap", items)


@pytest.fixture(scope="module")
def chunks(path) -> list[tuple[int, int]]:
    """Start and end of each chunk, from the library's own reader."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [(row.chunk_start_offset, row.chunk_start_offset + row.chunk_length) for row in summary.chunk_indexes]


def test_a_file_truncated_in_a_chunk_gives_its_complete_messages(path, chunks, items, tmp_path):
    data = path.read_bytes()
    sent = of(items)
    part = tmp_path / "run.mcap.part"
    start, end = chunks[1]
    before = Recording.open(_part(part, data[:start])).messages[PROBES]
    after = Recording.open(_part(part, data[:end])).messages[PROBES]
    found = []
    for at in np.linspace(start, end - 1, 12).astype(int).tolist():
        recording = Recording.open(_part(part, data[:at]))
        for key, payloads in sent.items():
            got = [payload for _, payload in recording.payloads(key)]
            assert got == payloads[: len(got)], (at, key)
        found.append(recording.messages[PROBES])
    assert found[0] == before
    assert found == sorted(found)
    assert before < found[6] < after


def _part(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def test_a_recovered_file_is_finished_with_the_sources_messages(path, chunks, tmp_path):
    part = _part(tmp_path / "run.mcap.part", path.read_bytes()[: chunks[-1][1] - 1000])
    source = Recording.open(part)
    raw = part.read_bytes()
    recovered = recover(part)
    assert recovered.path == tmp_path / "run.recovered.mcap"
    assert part.read_bytes() == raw
    recording = Recording.open(recovered.path)
    assert recording.complete
    assert recording.end_reason == "recovered"
    assert recording.metadata["recovered"]["source"] == "run.mcap.part"
    assert recording.metadata["rig"] == source.metadata["rig"]
    assert recording.streams == source.streams
    for topic in (topic for topic in source.messages if topic.startswith("rig/")):
        made_of, had = ([one for one in each.everything() if one[0] == topic] for each in (recording, source))
        assert made_of == had, topic
    # Recomputed: the messages for plots of the last rows included.
    views = [topic for topic in recording.messages if topic.startswith("view/")]
    for topic in views:
        again = [payload for _, payload in recording.payloads(topic)]
        assert [payload for _, payload in source.payloads(topic)] == again[: source.messages.get(topic, 0)], topic
    np.testing.assert_array_equal(recording.clock[: len(source.clock)], source.clock)


def test_a_damaged_chunk_is_passed_over_and_its_rows_are_a_gap(path, chunks, items, tmp_path):
    data = bytearray(path.read_bytes())
    start, end = chunks[1]
    data[(start + end) // 2] ^= 0xFF
    damaged = tmp_path / "run.mcap"
    damaged.write_bytes(data)
    recovered = recover(damaged)
    assert recovered.damaged == 1
    recording = Recording.open(recovered.path)
    assert [payload for _, payload in recording.payloads(PROBES)] != of(items)[PROBES]
    rows = recording.streams[PROBES].rows
    assert 0 < rows < 20_000
    (gap,) = [gap for gap in recording.gaps if gap.key == PROBES]
    assert rows + gap.size == 20_000


def test_losses_of_the_transport_remain_recorded(tmp_path, items):
    with writer(tmp_path / "run.mcap") as file:
        for key, payload in items[:30]:
            file.write(key, payload, 0)
        file.write_missed(STATUS, 2, 0)
        file.finish("completed")
    recover(tmp_path / "run.mcap")
    assert [(gap.key, gap.size) for gap in Recording.open(tmp_path / "run.recovered.mcap").gaps] == [(STATUS, 2)]


def test_a_file_in_the_making_is_not_recovered(tmp_path, items):
    with writer(tmp_path / "run.mcap", sync_every_s=0.0) as file:
        for key, payload in items[:30]:
            file.write(key, payload, 0)
        with pytest.raises(InputError, match="a file that no recorder is writing to"):
            recover(file.part)
        file.finish("completed")
    assert list(tmp_path.iterdir()) == [tmp_path / "run.mcap"]


@pytest.mark.parametrize("output", ["run.mcap", "run.mcap.part"])
def test_the_source_is_never_overwritten(path, tmp_path, output):
    part = _part(tmp_path / "run.mcap.part", path.read_bytes()[:-100])
    raw = part.read_bytes()
    with pytest.raises(InputError, match="output must be"):
        recover(part, tmp_path / output, force=True)
    assert part.read_bytes() == raw


def test_a_file_truncated_in_its_calibration_is_refused_without_output(path, tmp_path):
    part = _part(tmp_path / "run.mcap.part", path.read_bytes()[:5000])
    with pytest.raises(InputError, match="cut off in it"):
        recover(part)
    assert list(tmp_path.iterdir()) == [part]


def test_a_file_cut_at_any_byte_loses_nothing_that_was_flushed(tmp_path):
    items = list(generate_stream(4, block_ms=2))
    file = writer(tmp_path / "run.mcap", sync_every_s=0.0, view_rate_hz=100.0)
    flushed = [(file.part.stat().st_size, 0)]
    for number, (key, payload) in enumerate(items):
        file.write(key, payload, number)
        flushed.append((file.part.stat().st_size, number + 1))
    raw = file.part.read_bytes()
    file.finish("completed")
    source, target = tmp_path / "cut.mcap.part", tmp_path / "whole.mcap"
    for size in np.random.default_rng(3).integers(flushed[0][0], len(raw) + 1, 60).tolist():
        source.write_bytes(raw[:size])
        recover(source, target, force=True)
        kept = [(key, payload) for key, *_, payload in Recording.open(target).everything() if key.startswith("rig/")]
        assert kept == items[: len(kept)]
        assert len(kept) >= max(count for end, count in flushed if end <= size)


def test_damage_after_the_calibration_is_always_recovered(path, chunks, items, tmp_path):
    raw, sent = path.read_bytes(), of(items)
    first = chunks[0][0]
    rng = np.random.default_rng(4)
    for place in rng.integers(first, len(raw) - 8, 25).tolist():
        damaged = bytearray(raw)
        damaged[place] ^= 0xFF
        source = tmp_path / "damaged.mcap"
        source.write_bytes(damaged)
        recovered = Recording.open(recover(source, tmp_path / "new.mcap", force=True).path)
        for key in recovered.messages:
            if key in sent:
                assert {payload for _, payload in recovered.payloads(key)} <= set(sent[key])
        if place > chunks[-1][0] + chunks[-1][1] + HEAD:
            assert recovered.messages[PROBES] == len(sent[PROBES])


def test_the_name_of_a_recovered_file():
    assert recovered_path(Path("a/x.mcap.part")) == recovered_path(Path("a/x.mcap")) == Path("a/x.recovered.mcap")


def test_a_cut_keeps_the_rows_between_two_times_and_complete_payloads(path, items, tmp_path):
    piece = cut(Recording.open(path), tmp_path / "cut.mcap", from_s=0.2034, to_s=0.75)
    recording = Recording.open(piece.path)
    assert recording.complete
    whole = Recording.open(path)
    for group in whole.table.groups:
        old, new = whole.samples(group), recording.samples(group)
        rows = slice(4068, 15_000)
        np.testing.assert_array_equal(new.values, old.values[rows])
        np.testing.assert_array_equal(new.index, old.index[rows])
        np.testing.assert_allclose(new.times_s, old.times_s[rows], atol=1e-12)
    # Rows are at every 0.5 ms: the first one not before 0.2034 s is number 407.
    np.testing.assert_array_equal(recording.truth("state").index, np.arange(407, 1500))
    edges = whole.edges()
    np.testing.assert_array_equal(recording.edges(), edges[(edges >= 0.2034) & (edges < 0.75)])
    inside = [payload for _, payload in recording.payloads(PROBES)][1:]
    assert inside == of(items)[PROBES][21:75]
    about = recording.metadata["cut"]
    assert json.loads(about["sources"]) == ["run.mcap"]
    assert (about["from_s"], about["to_s"]) == ("0.2034", "0.75")
    assert recording.gaps == []


def test_consecutive_cuts_join_to_the_whole(path, tmp_path):
    whole = Recording.open(path)
    pieces = []
    for number, (start, end) in enumerate([(0.0, 0.31234), (0.31234, 0.6), (0.6, 9.0)]):
        pieces.append(cut(whole, tmp_path / f"{number}.mcap", from_s=start, to_s=end).path)
    joined = cut(join(pieces[::-1]), tmp_path / "joined.mcap")
    again = Recording.open(joined.path)
    for group in whole.table.groups:
        np.testing.assert_array_equal(again.samples(group).values, whole.samples(group).values)
        np.testing.assert_array_equal(again.samples(group).index, whole.samples(group).index)
    np.testing.assert_array_equal(again.truth("state").values, whole.truth("state").values)
    np.testing.assert_array_equal(again.edges(), whole.edges())


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> Recording:
    """280 ms in blocks of 7 ms, which no round time divides."""
    return Recording.open(
        write_recording(tmp_path_factory.mktemp("short") / "run.mcap", list(generate_stream(40, block_ms=7)))
    )


def read_rows(recording: Recording, key: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ticks, numbers and values of all rows."""
    blocks = list(recording.blocks(key))
    ticks = [
        block.tick + (block.values[:, 0] if key == EDGES else block.times_s * 1e6 - block.tick) for block in blocks
    ]
    numbers = [np.arange(block.index, block.index + len(block.values)) for block in blocks]
    return np.concatenate(ticks), np.concatenate(numbers), np.concatenate([block.values for block in blocks])


@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(
    st.lists(
        st.one_of(st.integers(1, 279_000).map(lambda tick: tick / 1e6), st.integers(1, 39).map(lambda n: n * 0.007)),
        min_size=2,
        max_size=2,
        unique=True,
    )
)
@example([5.1e-05, 5.2e-05])  # no row between them
def test_pieces_contain_each_row_once_and_join_to_the_whole(short, tmp_path_factory, times_s):
    folder = tmp_path_factory.mktemp("cuts")
    edges_s = [-np.inf, *sorted(times_s), np.inf]
    pieces = []
    for from_s, to_s in pairwise(edges_s):
        # A piece between two rows of all streams contains nothing and is refused.
        with contextlib.suppress(InputError):
            pieces.append(cut(short, folder / f"{len(pieces)}.mcap", from_s=from_s, to_s=to_s).path)
    joined = Recording.open(cut(join(pieces), folder / "joined.mcap").path)
    for key in (PROBES, truth_key("state"), EDGES):
        for found, expected in zip(read_rows(joined, key), read_rows(short, key), strict=True):
            assert np.array_equal(found, expected)
        assert joined.streams[key].lost == 0
    for piece, (from_s, to_s) in zip(pieces, pairwise(edges_s), strict=len(pieces) == 3):
        if len(pieces) == 3 and PROBES in (recording := Recording.open(piece)).messages:
            ticks = read_rows(recording, PROBES)[0]
            assert ticks[0] >= from_s * 1e6 - 1e-6
            assert ticks[-1] < to_s * 1e6 - 1e-6


def test_excluded_channels_are_removed_with_their_calibration(path, tmp_path):
    whole = Recording.open(path)
    recording = Recording.open(cut(whole, tmp_path / "a.mcap", only="sensors", channels=("P_W", "disk_y")).path)
    assert {key for key in recording.messages if key.startswith("rig/s")} == {PROBES, sensor_key("forces"), STATUS}
    assert recording.table.groups["forces"].names == ("P_W",)
    assert recording.catalogue["truth"] == {}
    for group, name in (("forces", "P_W"), ("probes", "disk_y")):
        np.testing.assert_array_equal(recording.samples(group)[name], whole.samples(group)[name])
    truth = Recording.open(cut(whole, tmp_path / "b.mcap", only="truth").path)
    assert not truth.table.groups
    np.testing.assert_array_equal(truth.truth("state").values, whole.truth("state").values)
    assert EDGES not in truth.messages
    assert truth_key("contact") in truth.messages


def test_a_cut_contains_earlier_commands(tmp_path, items):
    def command(number: int, tick: int) -> tuple[str, bytes]:
        about = {"event": "command", "tick": tick, "id": number, "command": "speed", "request": {"speed_hz": 2.0}}
        return EVENTS, encode_document(about)

    path = write_recording(
        tmp_path / "run.mcap", [*items[:200], command(1, 100_000), command(2, 500_000), *items[200:]]
    )
    recording = Recording.open(cut(Recording.open(path), tmp_path / "cut.mcap", from_s=0.3).path)
    assert [entry["id"] for entry in recording.scene["taken"]] == [1]
    assert [event["id"] for event in recording.events if event["event"] == "command"] == [2]


@pytest.mark.parametrize(
    ("options", "must"),
    [
        ({"from_s": 2.0, "to_s": 1.0}, "from and to must be times in ascending order"),
        ({"from_s": float("nan")}, "from and to must be times"),
        ({"from_s": 50.0}, "from and to must be an interval with rows of the recording"),
        ({"channels": ("disk_z",)}, "channels must be among disk_x"),
    ],
)
def test_impossible_cuts_are_refused_without_output(path, tmp_path, options, must):
    with pytest.raises(InputError, match=must):
        cut(Recording.open(path), tmp_path / "cut.mcap", **options)
    assert list(tmp_path.iterdir()) == []


def test_a_foreign_reader_reads_them(path, chunks, tmp_path):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    part = _part(tmp_path / "run.mcap.part", path.read_bytes()[: chunks[1][1] - 500])
    for result in (recover(part), cut(Recording.open(path), tmp_path / "cut.mcap", from_s=0.1, to_s=0.2)):
        with result.path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            rows = sum(
                len(row.decoded_message.values) // row.decoded_message.columns
                for row in reader.iter_decoded_messages(topics=[PROBES])
            )
        assert rows == result.counts.rows[PROBES] > 0
