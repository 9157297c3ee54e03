from __future__ import annotations

import json
import resource
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from recorder.contents.documents import parse_document
from recorder.contents.metadata import Beginning
from recorder.contents.views import Views
from recorder.files import schemas
from recorder.files.unfinished_file import check_destination
from recorder.reader import Recording
from recorder.writer import RecordingError, RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import (
    CATALOGUE,
    EVENTS,
    PARAMETERS,
    SAMPLE_SCHEMA,
    SCENE,
    Gap,
    decode_block,
    encode_block,
    encode_document,
    sensor_key,
    truth_key,
)
from rig.channels.table import default_table

from .recorder_stream import generate_stream, make_block, make_documents

PROBES = sensor_key("probes")


def writer(path: Path, **options) -> RecordingWriter:
    about = make_documents()
    return RecordingWriter(
        path, catalogue=about[CATALOGUE], parameters=about[PARAMETERS], scene=about[SCENE], **options
    )


def write(path: Path, items, **options) -> RecordingWriter:
    with writer(path, **options) as file:
        for number, (key, payload) in enumerate(items):
            file.write(key, payload, 1_700_000_000_000_000_000 + number)
        file.finish("completed")
    return file


@pytest.fixture(scope="module")
def items() -> list[tuple[str, bytes]]:
    return list(generate_stream(40))


@pytest.fixture(scope="module")
def path(tmp_path_factory, items) -> Path:
    path = tmp_path_factory.mktemp("recorder") / "run.mcap"
    write(path, items)
    return path


def decode_topic(path: Path, topic: str) -> list:
    """Read a topic by the decoder of an independent project."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(row.message, row.decoded_message) for row in reader.iter_decoded_messages(topics=[topic])]


def test_every_payload_is_read_byte_for_byte(path, items):
    recording = Recording.open(path)
    sent = defaultdict(list)
    for key, payload in items:
        sent[key].append(payload)
    for key, payloads in sent.items():
        assert [payload for _, payload in recording.payloads(key)] == payloads, key
    assert recording.complete
    assert recording.end_reason == "completed"
    assert not path.with_name(path.name + ".part").exists()


def test_log_time_is_simulated_time_and_publish_time_is_arrival(path, items):
    messages = [message for message, _ in decode_topic(path, PROBES)]
    assert [message.log_time for message in messages] == [number * 10_000_000 for number in range(40)]
    first = next(number for number, (key, _) in enumerate(items) if key == PROBES)
    assert messages[0].publish_time == 1_700_000_000_000_000_000 + first


@pytest.mark.parametrize("key", [PROBES, sensor_key("hammer"), truth_key("state")])
def test_a_foreign_reader_decodes_the_blocks(path, key):
    for number, (_, message) in enumerate(decode_topic(path, key)):
        block = make_block(key, number)
        assert (message.tick, message.index, message.columns) == (block.tick, block.index, block.values.shape[1])
        assert (message.rate_hz, message.tick_rate_hz) == (block.rate_hz, block.tick_rate_hz)
        np.testing.assert_array_equal(np.reshape(message.values, block.values.shape), block.values)


def test_channel_metadata_turns_counts_into_units(path):
    from mcap.reader import make_reader

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    channel = next(channel for channel in summary.channels.values() if channel.topic == PROBES)
    about = {name: json.loads(channel.metadata[name]) for name in ("names", "units", "scales", "offsets", "labels")}
    group = default_table().groups["probes"]
    assert about["names"] == list(group.names)
    assert about["units"] == ["mm"] * 4
    counts = make_block(PROBES, 3).values
    np.testing.assert_allclose(
        counts * np.array(about["scales"]) + np.array(about["offsets"]), group.engineering(counts), rtol=1e-14
    )


def test_plots_are_labelled_and_show_the_samples(path):
    recording = Recording.open(path)
    table = default_table()
    names = set()
    for topic in (topic for topic in recording.messages if topic.startswith("view/") and topic != "view/events"):
        messages = [message for _, message in decode_topic(path, topic)]
        assert len(messages) == 0.4 * 500
        times_s = [message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec for message in messages]
        np.testing.assert_allclose(times_s, np.arange(200) / 500, atol=1e-9)
        arrays = {
            slot: np.array([getattr(message, slot) for message in messages])
            for slot in ("position", "velocity", "effort")
        }
        for column, label in enumerate(messages[0].name):
            channel = table.channels[label.split(" [")[0]]
            assert label == f"{channel.name} [{channel.unit}]"
            slot = {"mm": "position", "N": "effort"}.get(channel.unit, "velocity")
            expected = recording.samples(channel.group)[channel.name][::40]
            np.testing.assert_array_equal(arrays[slot][:, column], expected)
            for other in arrays:
                if other != slot and arrays[other].size:
                    assert np.isnan(arrays[other][:, column]).all()
            names.add(channel.name)
    assert names == set(table.channels)


def test_the_number_of_plots_fits_a_viewer_with_eight():
    views = Views(default_table(), rate_hz=500.0).all
    assert 3 * len(views) <= 8
    for view in views:
        for slot in set(view.slots):
            units = {channel.unit for channel, used in zip(view.channels, view.slots, strict=True) if used == slot}
            assert len(units) == 1 or view.groups == ["drive"]


def test_view_does_not_depend_on_the_size_of_the_blocks(tmp_path):
    views = []
    for block_ms in (10, 5, 7):
        path = tmp_path / f"{block_ms}.mcap"
        rows = np.arange(2800, dtype=np.int32)[:, None] * np.ones(4, dtype=np.int32)
        blocks = []
        for start in range(0, 2800, 20 * block_ms):
            whole = make_block(PROBES, 0)
            values = rows[start : start + 20 * block_ms]
            block = type(whole)(start * 50, start, whole.rate_hz, whole.tick_rate_hz, values)
            blocks.append((PROBES, encode_block(block)))
        write(path, blocks)
        topic = next(topic for topic in Recording.open(path).messages if topic.startswith("view/probes"))
        views.append(list(Recording.open(path).payloads(topic)))
    assert len(views[0]) == 70
    assert views[0] == views[1] == views[2]


def test_history_received_key_by_key_is_merged(tmp_path, path, items):
    by_key = sorted(items, key=lambda item: item[0])
    write(tmp_path / "sorted.mcap", by_key)
    joined, straight = Recording.open(tmp_path / "sorted.mcap"), Recording.open(path)
    topics = [topic for topic in straight.messages if topic.startswith("view/")]
    assert len(topics) == 3
    for topic in topics:
        assert list(joined.payloads(topic)) == list(straight.payloads(topic))


def test_missing_groups_do_not_block_the_others_for_ever(monkeypatch):
    monkeypatch.setattr("recorder.contents.views._MAX_WAITING_INSTANTS", 3)
    monkeypatch.setattr("recorder.contents.views._BATCH_INSTANTS", 1)
    table = default_table()
    views = Views(table, rate_hz=500.0)
    counts = []
    for number in range(6):
        shown = views.add(table.groups["probes"], make_block(PROBES, number), number * 10_000_000)
        assert shown is not None
        counts.append(len(shown[1][0]))
    assert counts == [0, 0, 0, 5, 5, 5]


def test_a_view_row_with_a_missing_group_is_nan_there(tmp_path):
    path = tmp_path / "run.mcap"
    forces = sensor_key("forces")
    items = [(key, encode_block(make_block(key, number))) for number in range(3) for key in (PROBES, forces)]
    del items[3]  # the second block of the forces
    write(path, items)
    topic = next(topic for topic in Recording.open(path).messages if topic.startswith("view/probes"))
    messages = [message for _, message in decode_topic(path, topic)]
    assert len(messages) == 15
    efforts = np.array([message.effort for message in messages])
    positions = np.array([message.position for message in messages])
    assert np.isfinite(positions[:, :4]).all()
    column = list(messages[0].name).index("P_N [N]")
    np.testing.assert_array_equal(np.isnan(efforts[:, column]), np.repeat([False, True, False], 5))


def test_events_become_log_messages(path):
    logs = [message for _, message in decode_topic(path, "view/events")]
    assert [log.msg for log in logs] == ["start: scene hammer, seed 7", "end: reason completed"]
    assert [log.level for log in logs] == [20, 20]
    assert logs[1].stamp.nanosec == 400_000_000


def test_viewing_rate_zero_writes_no_views(tmp_path, items):
    path = tmp_path / "run.mcap"
    write(path, items, view_rate_hz=0.0)
    assert not [topic for topic in Recording.open(path).messages if topic.startswith("view/")]


@pytest.mark.parametrize("rate", [-1.0, float("nan"), float("inf")])
def test_impossible_viewing_rate_is_refused(tmp_path, rate):
    with pytest.raises(InputError, match="view_rate_hz must be"):
        writer(tmp_path / "run.mcap", view_rate_hz=rate)
    assert not list(tmp_path.iterdir())


def test_calibration_parameters_and_scene_are_in_the_file(path):
    recording = Recording.open(path)
    about = make_documents()
    assert recording.catalogue == about[CATALOGUE]
    assert recording.parameters == about[PARAMETERS]
    assert recording.scene == about[SCENE]
    assert recording.table == default_table()
    assert recording.metadata["rig"]["seed"] == "7"
    assert json.loads(recording.metadata["end"]["rows"])[PROBES] == 8000
    from mcap.reader import make_reader

    with path.open("rb") as file:
        readme = next(a for a in make_reader(file).iter_attachments() if a.name == "README.txt").data.decode()
    assert "disk_x [mm] = counts *" in readme
    assert f"rig/truth/state: {about[CATALOGUE]['truth']['state']['rate_hz']} Hz" in readme


def test_gaps_are_recorded_at_their_place(tmp_path, items):
    path = tmp_path / "run.mcap"
    kept = [
        (key, payload)
        for key, payload in items
        if key != PROBES or decode_block(payload, SAMPLE_SCHEMA).index // 200 not in (7, 8, 20)
    ]
    file = write(path, kept)
    recording = Recording.open(path)
    assert recording.gaps == [Gap(PROBES, 1400, 400), Gap(PROBES, 4000, 200)]
    assert file.tally.gaps == 2
    assert json.loads(recording.metadata["end"]["lost_rows"]) == {PROBES: 600}
    assert recording.streams[PROBES].lost == 600
    index = recording.samples("probes").index
    assert len(index) == 7400
    np.testing.assert_array_equal(index[np.flatnonzero(np.diff(index) != 1)], [1399, 3999])


@pytest.mark.parametrize(("from_start", "gaps"), [(True, [Gap(PROBES, 0, 600)]), (False, [])])
def test_a_late_start_is_a_gap_only_if_the_whole_run_was_requested(tmp_path, from_start, gaps):
    path = tmp_path / "run.mcap"
    late = [(PROBES, encode_block(make_block(PROBES, number))) for number in (3, 4)]
    write(path, late, beginning=Beginning(from_start=from_start))
    assert Recording.open(path).gaps == gaps


def test_a_catalogue_without_a_table_is_refused(tmp_path):
    about = make_documents()
    with pytest.raises(InputError, match="catalogue must be a document with a channel table"):
        RecordingWriter(
            tmp_path / "run.mcap", catalogue={"root": "rig"}, parameters=about[PARAMETERS], scene=about[SCENE]
        )
    assert not list(tmp_path.iterdir())


def test_losses_of_the_transport_are_recorded(tmp_path, items):
    path = tmp_path / "run.mcap"
    with writer(path) as file:
        file.write(EVENTS, items[0][1], 0)
        file.write_missed(EVENTS, 3, 0)
        file.finish("completed")
    recording = Recording.open(path)
    assert recording.gaps == [Gap(EVENTS, -1, 3)]
    assert json.loads(recording.metadata["end"]["missed_messages"]) == {EVENTS: 3}


def test_rows_missing_at_the_end_are_a_gap(tmp_path):
    path = tmp_path / "run.mcap"
    with writer(path) as file:
        file.write(PROBES, encode_block(make_block(PROBES, 0)), 0)
        assert file.tally.find_missing_rows({PROBES: 200}) == {}
        assert file.tally.find_missing_rows({PROBES: 300, truth_key("state"): 9}) == {PROBES: 300}
        file.note_short({PROBES: 300}, 0)
        file.finish("completed")
    assert Recording.open(path).gaps == [Gap(PROBES, 200, 100)]


def test_payloads_that_contradict_their_key_are_kept(tmp_path, items):
    path = tmp_path / "run.mcap"
    odd = [(PROBES, b"\x00\x01\x00\x00short"), (EVENTS, b"not json"), ("rig/sensors/unknown", b""), (EVENTS, b"[1]")]
    file = write(path, [items[0], *odd, *items[1:]])
    assert file.tally.malformed == 4
    recording = Recording.open(path)
    for key, payload in odd:
        assert payload in [found for _, found in recording.payloads(key)]
    assert recording.samples("probes").values.shape == (8000, 4)
    assert [event["event"] for event in recording.events] == ["start", "end"]


def test_unknown_streams_are_recorded(tmp_path):
    path = tmp_path / "run.mcap"
    block = encode_block(make_block(PROBES, 0))
    write(path, [("rig/sensors/later", block), ("rig/truth/later", encode_block(make_block(truth_key("state"), 0)))])
    recording = Recording.open(path)
    assert [payload for _, payload in recording.payloads("rig/sensors/later")] == [block]
    assert recording.streams["rig/truth/later"].rows == 20


def test_nothing_is_overwritten_without_force(tmp_path, items):
    path = tmp_path / "run.mcap"
    part = tmp_path / "run.mcap.part"
    for existing in (path, part):
        existing.write_text("precious")
        with pytest.raises(InputError, match="a new file"):
            check_destination(path)
        with pytest.raises(InputError, match="a new file"):
            writer(path)
        assert existing.read_text() == "precious"
        existing.unlink()
    path.write_text("precious")
    part.write_text("left over")
    write(path, items, force=True)
    assert Recording.open(path).complete
    assert not part.exists()


@pytest.mark.parametrize(
    ("name", "must"),
    [("run.txt", "ends in .mcap"), ("run", "ends in .mcap"), ("missing/run.mcap", "a folder that exists")],
)
def test_impossible_destinations_are_refused(tmp_path, name, must):
    with pytest.raises(InputError, match=must):
        check_destination(tmp_path / name)


def test_a_folder_is_no_destination(tmp_path):
    (tmp_path / "run.mcap").mkdir()
    with pytest.raises(InputError, match="not a folder"):
        check_destination(tmp_path / "run.mcap", force=True)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder that nobody can write, root included")
def test_a_read_only_folder_is_refused_before_anything_is_written():
    with pytest.raises(InputError, match="output must be"):
        writer(Path("/proc/self/run.mcap"))


def test_a_full_disk_ends_the_recording_and_keeps_its_data(tmp_path):
    path = tmp_path / "run.mcap"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    written = []

    def fill() -> None:
        for number in range(1000):
            file.write(PROBES, encode_block(make_block(PROBES, number)), 0)
            written.append(number)

    with writer(path, sync_every_s=0.0) as file:
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
        try:
            with pytest.raises(RecordingError, match=r"stopped by the disk.*run\.mcap\.part"):
                fill()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert file.closed
        with pytest.raises(RecordingError, match="is closed"):
            file.write(PROBES, encode_block(make_block(PROBES, 0)), 0)
    assert len(written) > 10
    assert not path.exists()
    recording = Recording.open(file.part)
    assert not recording.complete
    assert recording.streams[PROBES].rows == 200 * len(written)


def test_an_error_in_the_body_leaves_a_finished_file(tmp_path, items):
    path = tmp_path / "run.mcap"

    def fail() -> None:
        with writer(path) as file:
            file.write(EVENTS, items[0][1], 0)
            raise ZeroDivisionError("of the caller")

    with pytest.raises(ZeroDivisionError):
        fail()
    assert Recording.open(path).end_reason == "failed: of the caller"


def test_flushed_data_survive_without_finish(tmp_path, items):
    now_s = [0.0]
    file = writer(tmp_path / "run.mcap", monotonic_s=lambda: now_s[0])
    for number, (key, payload) in enumerate(items):
        now_s[0] = number * 0.01
        file.write(key, payload, 0)
    copy = tmp_path / "copy.mcap.part"
    copy.write_bytes(file.part.read_bytes())
    found = sum(count for topic, count in Recording.open(copy).messages.items() if topic.startswith("rig/"))
    assert len(items) - 26 <= found < len(items)  # a flush each 0.25 s of that clock, 0.01 s per payload
    file.finish("completed")


def test_clock_pairs_join_simulated_and_wall_time(tmp_path):
    path = tmp_path / "run.mcap"
    with writer(path) as file:
        for number in range(200):
            file.write(PROBES, encode_block(make_block(PROBES, number)), 10_000_000_000 + number * 10_000_000)
        file.finish("completed")
    pairs = Recording.open(path).clock
    assert pairs.shape == (4, 2)
    np.testing.assert_allclose(pairs[:, 1] - pairs[:, 0], 10.0, atol=1e-9)


def test_the_size_of_the_index_is_known_beforehand(tmp_path, items):
    with writer(tmp_path / "run.mcap", sync_every_s=0.0) as file:
        for number, (key, payload) in enumerate(items):
            file.write(key, payload, number)
        before, promised = file.part.stat().st_size, file.file.index_bytes
        begun = writer(tmp_path / "empty.mcap")
        head = begun.part.stat().st_size
        begun.finish("completed")
        file.finish("completed")
    index = (tmp_path / "run.mcap").stat().st_size - before
    assert len(items) > 100
    assert index - ((tmp_path / "empty.mcap").stat().st_size - head) < promised
    assert promised < 6 * index


def test_recording_continues_after_the_wall_clock_is_set_back(tmp_path):
    with writer(tmp_path / "run.mcap") as file:
        for number in range(400):
            wall_ns = 10**18 + number * 10_000_000 - (3600 * 10**9 if number >= 200 else 0)
            file.write(PROBES, encode_block(make_block(PROBES, number)), wall_ns)
        file.finish("completed")
    clock = Recording.open(tmp_path / "run.mcap").clock
    assert len(clock) == 8
    assert clock[4][1] < clock[3][1]


def test_a_document_without_a_tick_takes_the_latest_time(tmp_path, items):
    path = tmp_path / "run.mcap"
    write(path, [*items, (EVENTS, encode_document({"event": "warning", "text": "late"}))])
    times = [time_ns for time_ns, _ in Recording.open(path).payloads(EVENTS)]
    assert times == [0, 400_000_000, 399_950_000]


def test_a_recording_in_the_making_is_not_replaced(tmp_path, items):
    path = tmp_path / "run.mcap"
    with writer(path) as first:
        for number, (key, payload) in enumerate(items[:50]):
            first.write(key, payload, number)
        with pytest.raises(InputError, match="no other recording is writing to"):
            writer(path, force=True)
        for number, (key, payload) in enumerate(items[50:], 50):
            first.write(key, payload, number)
        first.finish("completed")
    assert sum(Recording.open(path).messages[key] for key in {key for key, _ in items}) == len(items)


def test_the_remainder_of_a_killed_recording_is_replaced(tmp_path, items):
    path = tmp_path / "run.mcap"
    remainder = path.with_name(path.name + ".part")
    remainder.write_bytes(b"what a kill left")
    write(path, items, force=True)
    assert Recording.open(path).complete
    assert not remainder.exists()


@pytest.mark.filterwarnings("ignore:.*mcap_ros1.reader:DeprecationWarning")  # its users still import it
def test_a_stock_reader_decodes_every_message_of_a_recording(path):
    from mcap.reader import make_reader
    from mcap_ros2.reader import read_ros2_messages

    recording = Recording.open(path)
    found = defaultdict(list)
    for row in read_ros2_messages(path):
        found[row.channel.topic].append(row.ros_msg)
    assert {topic: len(rows) for topic, rows in found.items()} == {
        topic: count for topic, count in recording.messages.items() if count
    }
    for topic in (EVENTS, "recorder/clock"):
        assert [row.data.encode() for row in found[topic]] == [payload for _, payload in recording.payloads(topic)]
        assert all(json.loads(row.data) for row in found[topic])
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"  # rosbags refuses another one
        assert summary is not None
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}


@pytest.mark.parametrize("text", ['{"a": 1}', "", "\0", "Grüße \ud7ff", '{"a": "\0"}', "x" * 70_000])
def test_a_document_is_wrapped_as_a_ros2_string_and_unwrapped_byte_for_byte(text):
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    wrapped, form = schemas.wrap_text(text.encode()), schemas.TEXT
    decode = DecoderFactory().decoder_for("cdr", Schema(data=form.text, encoding="ros2msg", id=1, name=form.name))
    assert decode is not None
    assert decode(wrapped).data == text
    assert schemas.unwrap_text(wrapped) == text.encode()
    assert schemas.unwrap_text(text.encode()) == text.encode()  # plain, as versions up to 0.2 wrote it


@pytest.mark.parametrize("spoil", [lambda data: data[:-1], lambda data: data + b"\0", lambda data: b"\1" + data[1:],
                                   lambda data: data[:4] + b"\xff" + data[5:], lambda data: data[:3]])  # fmt: skip
def test_a_damaged_string_message_is_no_document(spoil):
    data = spoil(schemas.wrap_text(b'{"event": "end"}'))
    assert schemas.unwrap_text(data) == data
    assert parse_document(EVENTS, data) is None
