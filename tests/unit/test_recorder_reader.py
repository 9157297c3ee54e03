from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recorder.contents.documents import has_documents
from recorder.files.schemas import unwrap_text
from recorder.reader import Recording
from recorder.writer import RecordingWriter
from rig.base.errors import InputError
from rig.base.samples import merge_samples
from rig.base.wire import CATALOGUE, EDGES, PARAMETERS, SCENE, STATUS, sensor_key, truth_key
from rig.channels.table import default_table

from .recorder_stream import TRUTH_COLUMNS, generate_stream, make_block, make_documents

BLOCKS = 60


def write(path: Path, *, blocks: int = BLOCKS) -> None:
    about = make_documents()
    now_s = [0.0]
    with RecordingWriter(
        path,
        catalogue=about[CATALOGUE],
        parameters=about[PARAMETERS],
        scene=about[SCENE],
        sync_every_s=0.05,
        monotonic_s=lambda: now_s[0],
    ) as file:
        for number, (key, payload) in enumerate(generate_stream(blocks)):
            now_s[0] = number * 0.00125  # eight payloads per block: a flush every five blocks
            file.write(key, payload, number)
        file.finish("completed")


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("recorder") / "run.mcap"
    write(path)
    return path


@pytest.fixture(scope="module")
def recording(path) -> Recording:
    return Recording.open(path)


@pytest.mark.parametrize("group", list(default_table().groups))
def test_samples_are_the_published_counts_in_engineering_units(recording, group):
    samples = recording.samples(group)
    key = sensor_key(group)
    counts = np.concatenate([make_block(key, number).values for number in range(BLOCKS)])
    table = default_table().groups[group]
    np.testing.assert_allclose(samples.values, table.engineering(counts), rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(samples.index, np.arange(200 * BLOCKS))
    np.testing.assert_allclose(samples.times_s, np.arange(200 * BLOCKS) / 20_000, atol=1e-12)
    assert samples.names == table.names
    assert samples.units == tuple(channel.unit for channel in table.channels)
    assert (samples.name, samples.rate_hz) == (group, 20_000.0)
    for column, name in enumerate(samples.names):
        np.testing.assert_array_equal(samples[name], samples.values[:, column])


@pytest.mark.parametrize("table", list(TRUTH_COLUMNS))
def test_truth_equals_the_published_truth(recording, table):
    samples = recording.truth(table)
    values = np.concatenate([make_block(truth_key(table), number).values for number in range(BLOCKS)])
    np.testing.assert_array_equal(samples.values, values)
    np.testing.assert_array_equal(samples.index, np.arange(20 * BLOCKS))
    assert samples.names[0] == f"{table}_0"
    assert samples.rate_hz == 2000.0


def test_edges_lie_between_ticks(recording):
    np.testing.assert_allclose(recording.edges(), np.arange(BLOCKS) * 0.01 + 0.25e-6, atol=1e-12)


def test_documents_are_read_unchanged(recording):
    assert [event["event"] for event in recording.events] == ["start", "end"]
    assert recording.last_status["time_s"] == 0.5
    assert recording.gaps == []
    assert recording.path.name == "run.mcap"


def test_streams_tell_their_extent(recording):
    streams = recording.streams
    assert set(streams) == {*map(sensor_key, default_table().groups), *map(truth_key, TRUTH_COLUMNS), EDGES}
    probes = streams[sensor_key("probes")]
    assert (probes.messages, probes.rows, probes.lost) == (BLOCKS, 200 * BLOCKS, 0)
    assert (probes.first_time_s, probes.last_time_s) == (0.0, pytest.approx(0.6 - 50e-6))


@pytest.mark.parametrize(
    ("ask", "must"),
    [
        (
            lambda recording: recording.samples("probe"),
            "samples must be a channel or a group .*, such as probes",
        ),
        (
            lambda recording: recording.truth("energies"),
            "truth must be one of the recording's tables, such as state, contact",
        ),
        (
            lambda recording: recording.samples("probes")["disk"],
            "name must be one of the existing names.* such as disk_y",
        ),
        (lambda recording: list(recording.blocks(STATUS)), "key must be a key of blocks"),
    ],
)
def test_unknown_streams_are_refused(recording, ask, must):
    with pytest.raises(InputError, match=must):
        ask(recording)


def test_groups_are_joined_where_all_have_a_row(recording):
    with recording as opened:
        both = opened.samples("forces", "probes")
        whole = opened.samples()
    assert both.names == ("P_N", "P_S", "P_E", "P_W", "disk_x", "disk_y", "ring_x", "ring_y")
    probes, si = opened.samples("probes"), both.to_si()
    np.testing.assert_array_equal(both["ring_y"], probes["ring_y"])
    np.testing.assert_array_equal(both.times_s, probes.times_s)
    np.testing.assert_allclose(si["ring_y"], probes["ring_y"] * 1e-3, rtol=1e-15)
    assert (both.unit("ring_y"), si.unit("ring_y"), si.unit("P_N")) == ("mm", "m", "N")
    assert whole.names == tuple(recording.table.channels)
    few = opened.samples("ring_y", "P_N", "hammer")
    assert (few.names, few.units) == (("ring_y", "P_N", "hammer"), ("mm", "N", "N"))
    np.testing.assert_array_equal(few["ring_y"], probes["ring_y"])
    for ask in (lambda: few.select("ring_z"), lambda: opened.samples("ring_z")):
        with pytest.raises(KeyError, match="such as ring_y"):
            ask()
    shorter = replace(probes, index=probes.index[7:], times_s=probes.times_s[7:], values=probes.values[7:])
    np.testing.assert_array_equal(merge_samples([opened.samples("forces"), shorter]).index, shorter.index)
    late = replace(probes, times_s=probes.times_s + 20e-6)
    # A stretch of two rates, far from the start, has no row number in common.
    slow = replace(probes, rate_hz=probes.rate_hz / 4, index=probes.index + 10**9)
    for parts in ([], [opened.samples("forces"), late], [probes, slow]):
        with pytest.raises(InputError, match=r"^groups must be sampled at the same instants"):
            merge_samples(parts)


def test_a_recording_is_shown_in_a_line(recording):
    assert repr(recording).startswith(f"Recording({recording.path}: scene hammer, 0 to 0.59995 s, ")
    assert "\n" not in repr(recording)


def test_a_group_without_blocks_is_empty(tmp_path):
    path = tmp_path / "run.mcap"
    write(path, blocks=0)
    samples = Recording.open(path).samples("probes")
    assert samples.values.shape == (0, 4)
    assert samples.times_s.shape == samples.index.shape == (0,)
    assert samples.rate_hz == 20_000.0
    assert Recording.open(path).edges().shape == (0,)


def _chunks(path: Path) -> list[tuple[int, dict[str, list[bytes]]]]:
    """End in the file and payloads by topic of each chunk, read from the whole file by the library's own reader."""
    from mcap.data_stream import ReadDataStream
    from mcap.reader import make_reader
    from mcap.records import Chunk, Message
    from mcap.stream_reader import breakup_chunk

    chunks = []
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        for index in summary.chunk_indexes:
            file.seek(index.chunk_start_offset + 9)
            payloads: dict[str, list[bytes]] = {}
            for record in breakup_chunk(Chunk.read(ReadDataStream(file))):
                if isinstance(record, Message):
                    topic = summary.channels[record.channel_id].topic
                    data = unwrap_text(record.data) if has_documents(topic) else record.data
                    payloads.setdefault(topic, []).append(data)
            chunks.append((index.chunk_start_offset + index.chunk_length, payloads))
    return chunks


def test_a_truncated_file_gives_all_complete_chunks(path, tmp_path):
    data = path.read_bytes()
    chunks = _chunks(path)
    assert len(chunks) > 8
    rng = np.random.default_rng(2)
    boundaries = [end for end, _ in chunks] + [end - 1 for end, _ in chunks]
    cuts = [0, 1, 7, 8, len(data) - 1, len(data) - 8, *boundaries, *rng.integers(0, len(data), 50).tolist()]
    cut_file = tmp_path / "cut.mcap.part"
    readable = 0
    for cut in cuts:
        cut_file.write_bytes(data[:cut])
        try:
            recording = Recording.open(cut_file)
        except InputError:
            # Only the header was there, or a part of it.
            assert not [end for end, _ in chunks if end <= cut], cut
            continue
        readable += 1
        assert not recording.complete
        assert recording.end_reason.startswith("cut off")
        whole = [payloads for end, payloads in chunks if end <= cut]
        for topic in {topic for payloads in whole for topic in payloads}:
            expected = [payload for payloads in whole for payload in payloads.get(topic, [])]
            assert [payload for _, payload in recording.payloads(topic)] == expected, (cut, topic)
            assert recording.messages[topic] == len(expected)
        assert len(recording.samples("probes").values) == sum(
            s.rows for k, s in recording.streams.items() if "prob" in k
        )
        assert len(recording.edges()) == recording.messages.get(EDGES, 0)
    assert readable > 40


def test_a_damaged_byte_is_an_input_error_or_harmless(path, tmp_path):
    data = path.read_bytes()
    rng = np.random.default_rng(3)
    damaged_file = tmp_path / "damaged.mcap"
    refused = 0
    for position in rng.integers(0, len(data), 60).tolist():
        damaged = bytearray(data)
        damaged[position] ^= 0xFF
        damaged_file.write_bytes(damaged)
        try:
            recording = Recording.open(damaged_file)
            for group in recording.table.groups:
                recording.samples(group)
            for table in TRUTH_COLUMNS:
                recording.truth(table)
            assert recording.events is not None
        except InputError:
            refused += 1
    assert refused > 30


def test_zeros_after_the_last_flush_are_no_data(path, tmp_path):
    """A possible result of a power cut: the length of the file is right, the last pages are not."""
    chunks = _chunks(path)
    data = path.read_bytes()[: chunks[4][0]]
    torn = tmp_path / "torn.mcap.part"
    torn.write_bytes(data + bytes(5000))
    recording = Recording.open(torn)
    assert not recording.complete
    assert recording.messages[sensor_key("probes")] == sum(
        len(payloads.get(sensor_key("probes"), [])) for _, payloads in chunks[:5]
    )


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"PK\x03\x04", b"tick,disk_x\n0,1\n", bytes(10_000)])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match="file must be a recording made by `rig record`"):
        Recording.open(path)


def test_a_foreign_mcap_is_refused(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        other = Writer(file)
        other.start(profile="ros2", library="other")
        channel = other.register_channel("/x", "json", other.register_schema("X", "jsonschema", b"{}"))
        other.add_message(channel, 0, b"{}", 0)
        other.finish()
    with pytest.raises(InputError, match="a recording made by"):
        Recording.open(path)


@pytest.mark.parametrize("name", ["missing.mcap", "."])
def test_unreadable_files_are_refused(tmp_path, name):
    with pytest.raises(InputError, match="file must be a file that can be read"):
        Recording.open(tmp_path / name)


def test_opening_an_unfinished_recording_names_its_part_file(tmp_path):
    for name in ("a.mcap.part", "run.0000.mcap", "run.mcap.part", "run.toml"):
        (tmp_path / name).touch()
    for file, named in (("a.mcap", "a.mcap.part"), ("run.mcap", f"run.0000.mcap, {tmp_path}/run.mcap.part")):
        with pytest.raises(InputError) as caught:
            Recording.open(tmp_path / file)
        assert caught.value.must == f"a file that can be read, such as {tmp_path}/{named}"
