"""The table of CAN messages: layout, load, packing, and commands that noise cannot imitate."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from drivers.can import analysis
from drivers.can.bus.timing import speed
from drivers.can.devices import DeviceKind, DeviceRequest, NoteKind, device_frame, find_value, note_frame, sender_frame
from drivers.can.message import checksum, crc8
from drivers.can.schedule import Schedule, schedule_from
from drivers.can.signals import (
    ABSENT,
    CLASSIC_SHARE,
    KEY,
    MAX_LEAD,
    ODDS,
    CanMessage,
    Command,
    CommandKind,
    Result,
    command_frame,
    default_messages,
    make_table,
    parse_command,
)
from rig.base.errors import InputError
from rig.channels.table import ChannelTable, default_table

TABLE = default_messages()
SAMPLED = (*TABLE.classic, *TABLE.fd)


def test_every_channel_is_in_both_layouts_once_an_instant() -> None:
    names = list(default_table().channels)
    for messages in (TABLE.classic, TABLE.fd):
        assert sorted(names) == sorted(row.name for each in messages for row in each.samples.channels)  # type: ignore[union-attr]


def test_signals_do_not_overlap_and_fit_their_message() -> None:
    for message in TABLE.messages:
        choices = {value for signal in message.signals for value in signal.selected_by} or {None}
        for choice in choices:
            taken = 0
            for signal in message.signals:
                if not signal.selected_by or choice in signal.selected_by:
                    mask = (1 << signal.bits) - 1 << signal.start
                    assert not taken & mask, (message.name, signal.name)
                    taken |= mask
            assert taken.bit_length() <= 8 * message.length


def test_commands_win_the_bus_and_slow_messages_lose_it() -> None:
    order = [row.name for row in TABLE.messages]
    assert order[:7] == ["Stop", "Command", "Acknowledge", "Fault", "Device", "DeviceState", "Sync"]
    # The end, an event, must not overtake samples.
    assert order[-7:] == ["Keyphasor", "Event", "Block", "Clock", "Status", "Heartbeat", "Rates"]
    assert [row.identifier for row in TABLE.messages] == sorted(row.identifier for row in TABLE.messages)


def test_classic_frames_take_at_most_their_share_of_1_mbit() -> None:
    rows = Schedule().messages()
    # The longest classic frame of 8 bytes with an 11-bit identifier: 111 bits and 24 stuff bits, with intermission.
    assert all(row.length == 8 and not row.fd for row in rows)
    by_hand = math.fsum(135e-6 / period for period in rows.values())
    assert Schedule().load(speed("1M")) == pytest.approx(by_hand, rel=1e-9)
    assert 0.675 < by_hand <= CLASSIC_SHARE
    # A frame of this length exists.
    assert analysis.worst_bits(analysis.PeriodicMessage(0x201, 1e-3)) == (135, 0)


def test_all_channels_at_10_khz_need_more_than_5_mbit_and_8_carry_them() -> None:
    schedule = Schedule(None, 10_000)
    # 7500 frames per second of 64 bytes: even without a stuff bit in the data 29 us and 549 bits of 0.2 us each.
    assert 7500 * (29e-6 + 549 * 0.2e-6) > 1.0
    with pytest.raises(InputError, match=r"CAN load must be .* at most 100 %.* received 1\d\d\.\d % of 1M/5M"):
        schedule.check(speed("1M/5M"))
    assert schedule.check(speed("1M/8M")) < 0.9
    assert all(row.schedulable for _, row in schedule.response_times(speed("1M/8M")))
    with pytest.raises(InputError, match="--can-bitrate must be two rates"):
        schedule.check(speed("1M"))


def test_both_layouts_fit_together_at_1_khz() -> None:
    assert Schedule(1000, 1000).check(speed("1M/5M")) < 0.85


def test_rates_of_the_options() -> None:
    assert schedule_from(classic=False, fd=False, rate_hz=None) == Schedule(1000, None)
    assert schedule_from(classic=False, fd=True, rate_hz=None) == Schedule(None, 10_000)
    assert schedule_from(classic=True, fd=True, rate_hz=2000) == Schedule(1000, 2000)
    assert schedule_from(classic=True, fd=False, rate_hz=500) == Schedule(500, None)
    with pytest.raises(InputError, match="--can-rate must be at most 1000 Hz for classic frames"):
        schedule_from(classic=False, fd=False, rate_hz=10_000)
    with pytest.raises(InputError, match="--can-rate must be between 1"):
        schedule_from(classic=False, fd=True, rate_hz=0)


@pytest.mark.parametrize("message", SAMPLED, ids=lambda row: row.name)
def test_packing_agrees_with_the_positions_of_the_signals(message: CanMessage) -> None:
    samples = message.samples
    assert samples is not None
    random = np.random.default_rng(message.identifier)
    frames, columns = 20, len(samples.channels)
    counts = random.integers(-(2**23), 2**23, (frames * samples.rows, columns), dtype=np.int32)
    counts[0], counts[-1] = -(2**23), 2**23 - 1
    numbers = random.integers(0, 2 ** (8 * samples.index_width), frames)
    data = samples.pack(numbers, counts, message.length)
    assert data.shape == (frames, message.length)
    expected = counts if message.fd else np.maximum(counts >> 8, ABSENT + 1)
    for frame in range(frames):
        # Bit by bit, by the table of signals, as a receiver with the DBC decodes.
        raw = message.decode(data[frame].tobytes())
        assert raw["index"] == numbers[frame]
        rows = expected[frame * samples.rows : (frame + 1) * samples.rows]
        for row in range(samples.rows):
            for column, channel in enumerate(samples.channels):
                name = channel.name if samples.rows == 1 else f"{channel.name}_{row}"
                assert raw[name] == rows[row, column]
        assert message.encode(**raw) == data[frame].tobytes()
    found, values = samples.unpack(data)
    np.testing.assert_array_equal(found, numbers)
    np.testing.assert_array_equal(values, expected)


def test_numbers_wrap_at_their_width() -> None:
    message = TABLE.by_name["Samples_1"]
    assert message.samples is not None
    data = message.samples.pack(np.array([65536 + 7]), np.zeros((1, 3), np.int32), 8)
    assert message.decode(data.tobytes())["index"] == 7


def test_values_are_those_of_the_channel_table() -> None:
    for message in SAMPLED:
        samples = message.samples
        assert samples is not None
        counts = np.full((samples.rows, len(samples.channels)), 0x12345, np.int32)
        _, values = samples.unpack(samples.pack(np.array([0]), counts, message.length))
        got = samples.engineering(values)
        for column, channel in enumerate(samples.channels):
            group = default_table().groups[channel.group]
            place = group.names.index(channel.name)
            whole = np.zeros((samples.rows, len(group.channels)))
            whole[:, place] = counts[:, column]
            exact = group.engineering(whole)[:, place]
            step = channel.scale * (1 if message.fd else 256)
            assert np.all(np.abs(got[:, column] - exact) <= (1e-12 if message.fd else step))


def test_an_absent_channel_is_no_value() -> None:
    samples = TABLE.by_name["Samples_1"].samples
    assert samples is not None
    values = samples.engineering(np.array([[ABSENT, 0, 1]]))
    assert np.isnan(values[0, 0])
    assert np.isfinite(values[0, 1:]).all()


def test_a_value_beyond_its_bits_is_refused() -> None:
    with pytest.raises(ValueError, match=r"Heartbeat.beat must be between 0 and 255; received 256"):
        TABLE.by_name["Heartbeat"].encode(beat=256)


def test_a_table_that_exceeds_the_bus_is_refused() -> None:
    group = default_table().groups["hammer"]
    wide = group.channels[0].model_copy(update={"adc_bits": 32})
    with pytest.raises(ValueError, match=r"channel hammer.adc_bits must be at most 24 on a CAN bus"):
        make_table(ChannelTable(groups={"hammer": group.model_copy(update={"channels": (wide,)})}))


def test_crc8_agrees_with_sae_j1850() -> None:
    # The check value of the catalogue of CRC algorithms (G. Cook), CRC-8/SAE-J1850.
    assert crc8(b"123456789") == 0x4B


HAMMER = command_frame(CommandKind.HAMMER, 8, force_n=123.4, duration_ms=5.25, direction=90.0)


def test_commands_are_decoded_unchanged() -> None:
    assert parse_command(*HAMMER, 7) == Command(
        CommandKind.HAMMER, 8, {"force_n": 123.4, "duration_ms": 5.25, "direction": 90.0}
    )
    assert parse_command(*command_frame(CommandKind.SPEED, 1, speed_hz=6.2), 0) == Command(
        CommandKind.SPEED, 1, {"speed_hz": 6.2}
    )
    assert parse_command(*command_frame(CommandKind.RELEASE, 0), 255) == Command(CommandKind.RELEASE, 0, {})
    identifier, data = command_frame(CommandKind.STOP, 1)
    assert identifier == 0x010
    assert parse_command(identifier, data, 0) == Command(CommandKind.STOP, 1, {})


def _signed(identifier: int, data: bytes) -> tuple[int, bytes]:
    return identifier, data[:7] + bytes([checksum(identifier, data)])


def test_each_kind_of_invalid_command_has_its_result() -> None:
    identifier, data = HAMMER

    def change(place: int, value: int) -> tuple[int, bytes]:
        return _signed(identifier, data[:place] + bytes([value]) + data[place + 1 :])

    assert parse_command(identifier, data[:7], 7) is Result.BAD_LENGTH
    assert parse_command(identifier, data[:7] + bytes([data[7] ^ 1]), 7) is Result.BAD_CHECKSUM
    # The same data on the identifier of Stop: the checksum covers it.
    assert parse_command(0x010, data, 7) is Result.BAD_CHECKSUM
    assert parse_command(*_signed(0x010, data), 7) is Result.BAD_KIND
    assert parse_command(*change(6, KEY ^ 1), 7) is Result.BAD_KEY
    assert parse_command(*change(0, 0), 7) is Result.BAD_KIND
    assert parse_command(*change(0, CommandKind.STOP), 7) is Result.BAD_KIND
    assert parse_command(*change(5, 240), 7) is Result.RESERVED_BITS
    for kind in (CommandKind.RELEASE, CommandKind.STOP):
        place, plain = command_frame(kind, 8)
        assert parse_command(*_signed(place, plain[:3] + b"\x01" + plain[4:]), 7) is Result.RESERVED_BITS
    place, plain = command_frame(CommandKind.SPEED, 8, speed_hz=5.0)
    assert parse_command(*_signed(place, plain[:5] + b"\x01" + plain[6:]), 7) is Result.RESERVED_BITS


@pytest.mark.parametrize(
    ("kind", "values", "line"),
    [
        (CommandKind.SPEED, {}, "speed_hz must be a value for SPEED from 0 to 16777.2 Hz; received nothing"),
        (
            CommandKind.SPEED,
            {"speed_hz": 5.0, "force_n": 10.0},
            "force_n must be left out: SPEED has no such value; received",
        ),
        (
            CommandKind.HAMMER,
            {"force_n": 1e6, "duration_ms": 5.0},
            "force_n must be a value for HAMMER from 0 to 6553.5 N; ",
        ),
        (
            CommandKind.HAMMER,
            {"force_n": 1.0, "duration_ms": 5.0, "direction": np.nan},
            "direction must be a value for",
        ),
    ],
)
def test_a_frame_has_the_values_of_its_kind(kind: CommandKind, values: dict[str, float], line: str) -> None:
    with pytest.raises(InputError, match=re.escape(line)):
        command_frame(kind, 1, **values)


def test_only_an_advancing_counter_is_accepted() -> None:
    accepted = [last for last in range(256) if isinstance(parse_command(*HAMMER, last), Command)]
    assert sorted((8 - last) % 256 for last in accepted) == list(range(1, MAX_LEAD + 1))
    assert parse_command(*HAMMER, 8) is Result.STALE_COUNTER


def test_every_error_of_one_or_two_bits_is_found() -> None:
    identifier, data = HAMMER
    value = int.from_bytes(data, "little")
    for first in range(64):
        for second in range(first, 64):
            wrong = value ^ (1 << first | 1 << second)
            assert isinstance(parse_command(identifier, wrong.to_bytes(8, "little"), 7), Result)


def test_kinds_differ_in_four_bits() -> None:
    kinds = list(CommandKind)
    assert min((one ^ other).bit_count() for one in kinds for other in kinds if one != other) >= 4


def test_the_odds_of_noise_are_as_stated() -> None:
    hammer = 1 / 256 * MAX_LEAD / 256 / 256 / 256 * (9991 / 65536) * (199 / 256) * (240 / 256)
    # No limit on the speed; 8 reserved bits.
    other = 1 / 256 * MAX_LEAD / 256 / 256 / 256 * (1 / 256 + 1 / 2**32)
    assert 1 / (hammer + other) == pytest.approx(ODDS, rel=0.1)
    assert 100_000 / ODDS < 1e-4


def test_random_frames_are_not_commands_at_the_rate_of_the_checksum() -> None:
    random = np.random.default_rng(20_240)
    data = random.integers(0, 256, (100_000, 8), dtype=np.uint8).tobytes()
    results = [parse_command(0x020, data[at : at + 8], 0) for at in range(0, len(data), 8)]
    assert not any(isinstance(result, Command) for result in results)
    passed = sum(result is not Result.BAD_CHECKSUM for result in results)
    assert passed == pytest.approx(100_000 / 256, abs=5 * math.sqrt(100_000 / 256))


def test_device_frames_are_decoded_and_all_others_refused() -> None:
    message = TABLE.by_name["Device"]
    kinds = (DeviceKind.JOIN, DeviceKind.DONE, DeviceKind.LEAVE)
    decoded = {kind: parse_command(*device_frame(message, kind, 7, block=300, patience_s=2.5), 0) for kind in kinds}
    assert decoded == {
        DeviceKind.JOIN: DeviceRequest(DeviceKind.JOIN, 7, {"device": "CAN 7", "patience_s": 2.5}),
        DeviceKind.DONE: DeviceRequest(DeviceKind.DONE, 7, {"device": "CAN 7", "block": 300}),
        DeviceKind.LEAVE: DeviceRequest(DeviceKind.LEAVE, 7, {"device": "CAN 7"}),
    }
    assert all((one ^ other).bit_count() >= 4 for one in DeviceKind for other in DeviceKind if one != other)
    identifier, data = device_frame(message, DeviceKind.LEAVE, 7)
    for wrong, result in ((b"\x34", Result.BAD_KIND), (data[:1] + b"\x07\x01", Result.BAD_KIND)):
        changed = wrong + data[len(wrong) : 7]
        assert parse_command(identifier, changed + bytes([checksum(identifier, changed)]), 0) is result
    assert parse_command(identifier, data[:7] + bytes([data[7] ^ 1]), 0) is Result.BAD_CHECKSUM
    assert parse_command(identifier, data[:7], 0) is Result.BAD_LENGTH
    with pytest.raises(InputError, match="device must be one with a node from 0 to 255"):
        device_frame(message, DeviceKind.JOIN, 256)


@pytest.mark.parametrize(
    ("kind", "fields", "text"),
    [
        (NoteKind.DANGER, {"channel": "disk_x", "value": 512.4}, "danger disk_x 512"),
        (NoteKind.ALERT, {"channel": "probes", "value": -0.0123}, "alert probes -0.0123"),
        (NoteKind.NOT_OK, {"channel": "disk_y", "value": 0.0}, "not-ok disk_y 0"),
        (NoteKind.TRIP, {}, "trip"),
        (NoteKind.CLEAR, {"alarm": NoteKind.SPEED_LOST}, "clear speed-lost"),
        (NoteKind.RESET, {"alarm": NoteKind.DANGER, "channel": "disk_x"}, "reset danger disk_x"),
        (NoteKind.ROWS_LOST, {"value": 2e9}, "rows-lost 2e+09"),
    ],
)
def test_a_note_of_a_device_has_its_tag_channel_and_value(kind: NoteKind, fields: dict[str, Any], text: str) -> None:
    identifier, data = note_frame(TABLE.by_name["Device"], kind, 7, **fields)
    found = parse_command(identifier, data, 0)
    assert found == DeviceRequest(DeviceKind.NOTE, 7, {"text": text, "tags": [kind.tag]})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.123456 s  danger  disk_x  512.4", 512.4), ("rows-lost    5", 5.0), ("trip 0", 0.0),
        ("danger probes -3 um", -3.0),
        ("trip at 0.1 s", None), ("0.1", None), ("trip", None), ("trip nan", None), ("trip 1e300", None), ("", None),
    ],
)  # fmt: skip
def test_the_value_of_a_note_is_the_number_after_its_kind_or_channel(text: str, value: float | None) -> None:
    assert find_value(text.split(), {"danger", "rows-lost", "trip", "disk_x", "probes"}) == value
    if value is not None:
        note_frame(TABLE.by_name["Device"], NoteKind.DANGER, 7, value=value)


def test_acknowledge_has_no_room_for_the_number_of_a_device() -> None:
    """docs/lockstep.md says how to number the devices because of this."""
    assert sum(signal.bits for signal in TABLE.by_name["Acknowledge"].signals) == 64


def test_kinds_of_notes_keep_their_numbers() -> None:
    tags = [
        "alert",
        "danger",
        "not-ok",
        "trip",
        "clear",
        "reset",
        "overspeed",
        "speed-lost",
        "rows-lost",
        "on",
        "reverse",
        "trip-refused",
    ]
    assert {kind.tag: int(kind) for kind in NoteKind} == {tag: number for number, tag in enumerate(tags, start=1)}


@pytest.mark.parametrize(
    "raw",
    [
        {"note": 0}, {"note": 15}, {"note": 2, "alarm": 1}, {"note": 5, "alarm": 13}, {"note": 2, "channel": 21},
        {"note": 2, "channel": 255}, {"note": 2, "number": -2048, "exponent": 1},
    ],
)  # fmt: skip
def test_a_note_with_an_invalid_field_is_refused(raw: dict[str, int]) -> None:
    message = TABLE.by_name["Device"]
    frame = message.encode(kind=int(DeviceKind.NOTE), node=7, key=KEY, **raw)
    assert parse_command(message.identifier, frame[:7] + bytes([checksum(0x23, frame)]), 0) is Result.BAD_KIND


def test_a_note_that_does_not_fit_its_frame_is_refused() -> None:
    message = TABLE.by_name["Device"]
    with pytest.raises(InputError, match="name of a channel or channel group, such as disk_y"):
        note_frame(message, NoteKind.DANGER, 7, channel="disk_z")
    for value in (math.nan, math.inf, 3e10):
        with pytest.raises(InputError, match=r"note\.value must be at most 2.047e10 in a CAN frame"):
            note_frame(message, NoteKind.DANGER, 7, value=value)


def test_a_device_announces_the_counter_and_checksum_of_its_command() -> None:
    message, command = TABLE.by_name["Device"], command_frame(CommandKind.SPEED, 9, speed_hz=1.0)[1]
    identifier, data = sender_frame(message, 7, command)
    assert parse_command(identifier, data, 0) == DeviceRequest(
        DeviceKind.COMMAND, 7, {"counter": 9, "signature": command[7]}
    )
    wrong = data[:5] + b"\1" + data[6:7]
    assert parse_command(identifier, wrong + bytes([checksum(identifier, wrong)]), 0) is Result.BAD_KIND
