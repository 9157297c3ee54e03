"""The container, read by the `mcap` package's own readers."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest

from recorder.container import Container


def write(messages: int = 400, *, chunk_bytes: int = 5000) -> tuple[bytes, list[tuple[str, int, int, int, bytes]]]:
    """A file, and what was put in: topic, log time, publish time, sequence, data."""
    rng = np.random.default_rng(1)
    file = BytesIO()
    container = Container(file, chunk_bytes=chunk_bytes)
    container.start("ros2", "a test")
    container.add_metadata("about", {"a": "1"})
    container.add_attachment(5, 6, "x.txt", "text/plain", b"attached")
    schema = container.register_schema("T", "ros2msg", b"int32 a\n")
    channels = {topic: container.register_channel(topic, "cdr", schema, {"of": topic}) for topic in ("a", "b", "c")}
    sent = []
    for number in range(messages):
        if number % 7 == 0:
            times = np.sort(rng.integers(0, 10**12, 5))
            rows = rng.integers(0, 255, (5, 24)).astype(np.uint8)
            container.add_rows(channels["c"], times, rows, number, 2**32 - 3)
            sent += [
                ("c", int(times[k]), number, (2**32 - 3 + k) % 2**32, rows[k].tobytes()) for k in range(len(times))
            ]
        topic = "ab"[number % 2]
        data = rng.bytes(int(rng.integers(0, 200)))
        container.add_message(channels[topic], 10**9 * number, data, number, number)
        sent.append((topic, 10**9 * number, number, number, data))
        if number % 50 == 0:
            container.flush()
    container.add_metadata("end", {"b": "2"})
    container.finish()
    return file.getvalue(), sent


@pytest.fixture(scope="module")
def written() -> tuple[bytes, list[tuple[str, int, int, int, bytes]]]:
    return write()


def test_the_messages_come_back_in_file_order_with_their_sums_checked(written):
    from mcap.reader import NonSeekingReader

    data, sent = written
    reader = NonSeekingReader(BytesIO(data), validate_crcs=True)
    found = [
        (channel.topic, message.log_time, message.publish_time, message.sequence, message.data)
        for _, channel, message in reader.iter_messages(log_time_order=False)
    ]
    assert found == sent


def test_the_index_finds_topics_and_times(written):
    from mcap.reader import make_reader

    data, sent = written
    reader = make_reader(BytesIO(data), validate_crcs=True)
    for topic in "abc":
        for start, end in ((0, 10**13), (5 * 10**10, 2 * 10**11)):
            expected = sorted(row[1] for row in sent if row[0] == topic and start <= row[1] < end)
            rows = reader.iter_messages(topics=[topic], starting_at=start, ending_before=end)
            found = [message.log_time for _, _, message in rows]
            assert found == expected
            assert expected


def test_each_message_index_points_at_its_message(written):
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk, Message, MessageIndex
    from mcap.stream_reader import StreamReader, get_chunk_data_stream

    data, sent = written
    unpacked, seen = b"", 0
    for record in StreamReader(BytesIO(data), emit_chunks=True, validate_crcs=True).records:
        if isinstance(record, Chunk):
            stream, length = get_chunk_data_stream(record, validate_crc=True)
            unpacked = stream.read(length)
        elif isinstance(record, MessageIndex):
            for log_time, offset in record.records:
                assert unpacked[offset] == 5
                body = ReadDataStream(BytesIO(unpacked[offset + 9 :]))
                message = Message.read(body, int.from_bytes(unpacked[offset + 1 : offset + 9], "little"))
                assert (message.channel_id, message.log_time) == (record.channel_id, log_time)
                seen += 1
    assert seen == len(sent)


def test_the_summary_counts_and_the_rest_is_found(written):
    from mcap.reader import make_reader

    data, sent = written
    reader = make_reader(BytesIO(data), validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None
    statistics = summary.statistics
    assert statistics is not None
    assert statistics.message_count == len(sent)
    assert statistics.channel_message_counts == {
        number: sum(row[0] == topic for row in sent) for number, topic in enumerate("abc", 1)
    }
    times = [row[1] for row in sent]
    assert (statistics.message_start_time, statistics.message_end_time) == (min(times), max(times))
    assert statistics.chunk_count == len(summary.chunk_indexes) > 8
    assert [(each.name, each.data) for each in reader.iter_attachments()] == [("x.txt", b"attached")]
    assert {each.name: each.metadata for each in reader.iter_metadata()} == {"about": {"a": "1"}, "end": {"b": "2"}}
    assert {channel.topic: channel.metadata for channel in summary.channels.values()} == {
        topic: {"of": topic} for topic in "abc"
    }


def test_a_file_without_messages_is_whole():
    from mcap.reader import make_reader

    data, sent = write(0)
    summary = make_reader(BytesIO(data), validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(sent) == 0
    assert len(summary.channels) == 3
