"""The channel table: complete calibrations only, conversion of counts, and the signals that the model must provide."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from rig.base.errors import InputError
from rig.channels import table as channels
from rig.channels.sensors.conditioning import Conditioner
from rig.channels.table import TABLE, Channel, ChannelTable, default_table, parse_table
from rig.cli.app import start
from rig.physics.kernels.signals import ROW
from rig.run.commands.table import HammerCommand
from rig.run.scenes import rig_table

TABLE_TEXT = TABLE.read_text()
CHANNELS = list(default_table().channels.values())
VALID_CHANNEL = CHANNELS[0].model_dump()
LOW_PASS = {"filter", "filter_order", "ripple_db", "group_delay_us"}


def one_channel(row: str = "") -> str:
    return f"""
    [groups.g]
    title = "t"
    rate_hz = 1000
    kind = "assumed"
    [groups.g.defaults]
    unit = "mm"
    si = 1e-3
    sensitivity_v = 2.0
    bias_v = -1.0
    range_v = [-9.0, 9.0]
    bandwidth_hz = 100.0
    highpass_hz = 0.0
    noise_v = 0.0
    adc_v = 10.0
    adc_bits = 16
    [[groups.g.channels]]
    name = "c"
    label = "l"
    signal = "disk_x"
    {row}
    """


def test_every_channel_has_a_model_signal_with_a_compatible_unit() -> None:
    si = {"mm": ("m", 1e-3), "N": ("N", 1.0), "m/s^2": ("m/s^2", 1.0), "Hz": ("rad/s", 2 * math.pi), "1": ("1", 1.0)}
    units = {signal.name: signal.unit for signal in ROW}
    for channel in CHANNELS:
        assert (units[channel.signal], channel.si) == (si[channel.unit][0], pytest.approx(si[channel.unit][1])), channel


def test_names_are_unique_and_groups_whole() -> None:
    table = default_table()
    assert list(table.groups) == re.findall(r"^\[groups\.(\w+)\]", TABLE_TEXT, re.MULTILINE)
    names = [name for group in table.groups.values() for name in group.names]
    assert len(set(names)) == len(names) == len(table.channels) == TABLE_TEXT.count("{ name = ")
    for group in table.groups.values():
        assert {channel.group for channel in group.channels} == {group.name}
        assert {channel.rate_hz for channel in group.channels} == {group.rate_hz}
        # The sensor's signal must not fold back: the corner is below half the sample rate.
        assert all(channel.bandwidth_hz < channel.rate_hz / 2 for channel in group.channels)


def test_the_largest_accepted_impact_can_be_measured() -> None:
    hammer = default_table().channels["hammer"]
    (limit,) = [item.le for item in HammerCommand.model_fields["force_n"].metadata if hasattr(item, "le")]
    assert hammer.bias_v + hammer.sensitivity_v * limit < hammer.range_v[1]


@given(channel=st.sampled_from(CHANNELS), count=st.integers(-(2**23), 2**23 - 1))
def test_counts_are_volts_are_values(channel: Channel, count: int) -> None:
    volts = count * 2.0 * channel.adc_v / 2**channel.adc_bits
    value = (volts - channel.bias_v) / channel.sensitivity_v
    assert count * channel.scale + channel.offset == pytest.approx(value, rel=1e-12, abs=1e-12)


@given(st.data())
def test_engineering_round_trip(data: st.DataObject) -> None:
    group = data.draw(st.sampled_from(list(default_table().groups.values())))
    row = st.tuples(*(st.integers(-(2 ** (c.adc_bits - 1)), 2 ** (c.adc_bits - 1) - 1) for c in group.channels))
    counts = np.array(data.draw(st.lists(row, min_size=1, max_size=5)), dtype=np.int32)
    values = group.engineering(counts)
    assert values.shape == counts.shape
    for c, channel in enumerate(group.channels):
        back = (channel.bias_v + channel.sensitivity_v * values[:, c]) / channel.lsb_v
        np.testing.assert_array_equal(np.rint(back).astype(np.int32), counts[:, c])
        assert abs(back - counts[:, c]).max() < 1e-6


def test_range_and_converter_of_the_small_table() -> None:
    channel = parse_table(one_channel()).channels["c"]
    assert channel.lsb_v == 20.0 / 65536
    assert channel.scale == pytest.approx(20.0 / 65536 / 2.0)
    assert channel.offset == 0.5


@pytest.mark.parametrize("missing", sorted(set(VALID_CHANNEL) - LOW_PASS))
def test_a_row_with_a_missing_field_is_refused(missing: str) -> None:
    with pytest.raises(ValidationError, match=missing):
        Channel(**{key: value for key, value in VALID_CHANNEL.items() if key != missing})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sensitivity_v", 0.0),
        ("range_v", (-2.0, -18.0)),
        ("range_v", (-21.0, 0.0)),
        ("range_v", (0.0, 20.5)),
        ("adc_v", 0.0),
        ("adc_bits", 7),
        ("adc_bits", 33),
        ("bandwidth_hz", 0.0),
        ("highpass_hz", -1.0),
        ("noise_v", -1.0),
        ("rate_hz", 0),
        ("si", 0.0),
        ("colour", "red"),
    ],
)
def test_half_or_wrong_scale_is_refused(field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=field):
        Channel(**{**VALID_CHANNEL, field: value})


def test_rows_take_the_defaults_of_their_group_and_may_differ() -> None:
    table = parse_table(one_channel("sensitivity_v = -4.0\nbandwidth_hz = 50.0"))
    channel = table.channels["c"]
    assert (channel.sensitivity_v, channel.bandwidth_hz, channel.bias_v) == (-4.0, 50.0, -1.0)
    assert channel.scale < 0.0


def test_names_are_unique() -> None:
    twice = TABLE_TEXT.replace('name = "P_N"', 'name = "disk_x"')
    assert twice != TABLE_TEXT
    with pytest.raises(ValueError, match="disk_x must be in the table once"):
        parse_table(twice)


def test_unknown_field_in_a_row_is_refused() -> None:
    with pytest.raises(InputError, match=r"channel c\.colour must be a known field"):
        parse_table(one_channel('colour = "red"'))


@pytest.mark.parametrize(
    "command",
    [
        ("keys",),
        ("can", "load"),
        ("can", "dbc"),
        ("simulate", "drop", "-o", "x.csv"),
        ("import", "x.csv", "--template", "x.toml"),
    ],
)
@pytest.mark.parametrize(
    ("was", "becomes", "line"),
    [
        (
            'sensitivity_v = 7.87, label = "Shaft in the ring, horizontal',
            'label = "Shaft in the ring, horizontal',
            "rig: channel ring_x.sensitivity_v must be given; received nothing",
        ),
        (
            'signal = "ring_x"',
            'signal = "rinx"',
            "rig: channel ring_x.signal must be one of the model's, such as ring_x",
        ),
    ],
    ids=["a missing field", "a wrong signal"],
)
def test_every_command_reports_a_wrong_table_in_one_line(
    command: tuple[str, ...],
    was: str,
    becomes: str,
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert was in TABLE_TEXT
    wrong = tmp_path / "channels.toml"
    wrong.write_text(TABLE_TEXT.replace(was, becomes))
    monkeypatch.setattr(channels, "TABLE", wrong)
    monkeypatch.chdir(tmp_path)
    default_table.cache_clear()
    rig_table.cache_clear()
    try:
        with pytest.raises(SystemExit) as ended:
            start(list(command))
    finally:
        default_table.cache_clear()
        rig_table.cache_clear()
    error = capsys.readouterr().err
    assert error.startswith(line), error
    assert error.count("\n") == 1
    assert ended.value.code == 2


def test_a_channel_without_sensitivity_or_signal_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match=r"channel c\.sensitivity_v must be given; received nothing"):
        parse_table(one_channel().replace("sensitivity_v", "# "))
    table = parse_table(one_channel().replace('"disk_x"', '"endx"'))
    must = r"channel c\.signal must be one of the model's, such as .*received 'endx'"
    with pytest.raises(InputError, match=must):
        Conditioner(list(table.groups.values()), row_rate_hz=20_000, seed=1, noise=True)


@given(names=st.permutations(list(default_table().groups)), n=st.integers(0, 5), rate=st.none() | st.integers(1, 10**6))
def test_only_keeps_the_groups_and_lowers_the_corner_with_the_rate(names: list[str], n: int, rate: int | None) -> None:
    before = default_table().model_dump()
    table = default_table().select_groups(tuple(names[:n]), rate)
    assert list(table.groups) == (names[:n] or list(default_table().groups))
    for name, group in table.groups.items():
        original = default_table().groups[name]
        assert group.names == original.names
        assert group.rate_hz == (rate or original.rate_hz)
        for channel, was in zip(group.channels, original.channels, strict=True):
            assert channel.rate_hz == group.rate_hz
            assert channel.bandwidth_hz == (was.bandwidth_hz if rate is None else min(was.bandwidth_hz, rate / 4))
            assert (channel.scale, channel.offset) == (was.scale, was.offset)
    assert default_table().model_dump() == before


def test_table_travels_as_json() -> None:
    document = json.loads(json.dumps(default_table().model_dump(mode="json"), allow_nan=False))
    assert ChannelTable.model_validate(document) == default_table()


def test_every_row_of_the_file_is_in_the_table() -> None:
    assert re.findall(r'name = "(\w+)"', TABLE_TEXT) == list(default_table().channels)
