"""The DBC: its committed copy, and cantools' own decoding of the rig's frames."""

from __future__ import annotations

import io
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from drivers.can import dbc
from drivers.can.bus.timing import speed
from drivers.can.schedule import Schedule
from drivers.can.signals import (
    CLASSIC_HZ,
    FD_HZ,
    Command,
    CommandKind,
    command_frame,
    default_messages,
    parse_command,
)
from rig.base.errors import InputError
from rig.channels.channel_file import read_channels
from rig.channels.table import default_table
from rig.cli.connections.can_output import CanMessages, CanOptions, CanOutput
from rig.run.commands.table import COMMANDS
from tests.commands import run_captured, run_for_output

TABLE = default_messages()
DATABASE = dbc.database()
SAMPLED = (*TABLE.classic, *TABLE.fd)


def test_the_command_shows_and_writes_the_dbc(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_for_output(capsys, "can", "dbc") == dbc.text()
    run_for_output(capsys, "can", "dbc", "-o", tmp_path / "rig.dbc")
    assert (tmp_path / "rig.dbc").read_text(encoding="utf-8") == dbc.text()


def test_the_load_command_shows_every_message(capsys: pytest.CaptureFixture[str]) -> None:
    output = run_for_output(capsys, "can", "load")
    for name in (row.name for row in Schedule().messages()):
        assert name in output
    assert "load: at most 69.2 % of the bus" in output
    assert "load: at most 126.1 % of the bus" in run_for_output(
        capsys, "can", "load", "--can-fd", "--can-bitrate", "1M/5M"
    )


def test_an_overloaded_bus_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "fuller.toml"
    more = ", ".join(f'{{ name = "P_N_{side}", signal = "P_N" }}' for side in "ab")
    path.write_text(f"[groups.forces]\nchannels = [{more}]")
    warning = (
        "rig: warning: CAN load must be at most 70 % of 1M with classic frames, to leave room for other nodes; "
        "received 80.7 % with 6 frames an instant (a lower --can-rate or --can-fd helps)\n"
    )
    for command in (["can", "load"], ["can", "dbc"]):
        assert run_captured(capsys, *command, "--channels", str(path))[2] == warning
    table = read_channels(path)
    assert warning in f"{CanOutput('virtual:full', channels=table)}\n"
    # Messages that are still transmitted are only reported; missing ones are refused.
    assert (
        CanOutput("virtual:full", CanOptions(messages=CanMessages(can_rate=500)), table).schedule.warnings(speed("1M"))
        == []
    )
    with pytest.raises(InputError, match="CAN load must be a schedule of at most 100 % of the bus"):
        CanOutput("virtual:full", CanOptions(messages=CanMessages(can_bitrate="500k")), table)


def test_the_default_bus_is_not_overloaded(capsys: pytest.CaptureFixture[str]) -> None:
    for command in (["can", "load"], ["can", "dbc"], ["can", "load", "--can-fd"]):
        assert run_captured(capsys, *command)[2] == ""


def test_cantools_sees_the_messages_of_the_table() -> None:
    assert {row.name for row in DATABASE.messages} == set(TABLE.by_name)
    for row in TABLE.messages:
        found = DATABASE.get_message_by_name(row.name)
        assert (found.frame_id, found.length, found.is_fd) == (row.identifier, row.length, row.fd)
        assert found.senders == [row.sender]
        assert found.comment == f"{row.label}."
        assert {signal.name for signal in found.signals} == {signal.name for signal in row.signals}


def test_signals_have_unit_and_provenance_and_layouts_their_decimation() -> None:
    for row in SAMPLED:
        found = DATABASE.get_message_by_name(row.name)
        assert row.samples is not None
        rate = FD_HZ if row.fd else CLASSIC_HZ
        assert f"(n = {20_000 // rate} at {rate} Hz;" in (found.comment or "")
        for channel in row.samples.channels:
            signal = found.get_signal_by_name(channel.name if row.samples.rows == 1 else f"{channel.name}_0")
            assert signal.unit == channel.unit
            assert channel.label in (signal.comment or "")
            assert "Assumed calibration" in (signal.comment or "")


@pytest.mark.parametrize("row", SAMPLED, ids=lambda row: row.name)
def test_cantools_decodes_to_the_values_of_the_channel_table(row) -> None:  # type: ignore[no-untyped-def]
    samples = row.samples
    random = np.random.default_rng(7)
    # Below the converter's range, as all conditioners are; full scale is -32767 in classic frames.
    counts = random.integers(-(2**23) + 512, 2**23, (samples.rows, len(samples.channels)), dtype=np.int32)
    decoded = DATABASE.decode_message(row.identifier, samples.pack(np.array([40]), counts, row.length).tobytes())
    assert decoded["index"] == 40
    for column, channel in enumerate(samples.channels):
        group = default_table().groups[channel.group]
        place = group.names.index(channel.name)
        whole = np.zeros((samples.rows, len(group.channels)))
        whole[:, place] = counts[:, column]
        exact = group.engineering(whole)[:, place]
        names = [channel.name] if samples.rows == 1 else [f"{channel.name}_{n}" for n in range(samples.rows)]
        got = np.array([decoded[name] for name in names])
        step = channel.scale * (1 if row.fd else 256)
        assert np.all(np.abs(got - exact) <= (1e-6 if row.fd else 1.0) * step)


def test_a_command_encoded_by_cantools_is_accepted() -> None:
    from drivers.can.signals import checksum

    values = {"kind": "hammer", "counter": 3, "force": 80, "duration": 5, "direction": 0, "key": 0x9D, "checksum": 0}
    data = DATABASE.encode_message("Command", values)
    data = data[:7] + bytes([checksum(0x020, data)])
    expected = Command(CommandKind.HAMMER, 3, {"force_n": 80.0, "duration_ms": 5.0, "direction": 0.0})
    assert parse_command(0x020, data, 2) == expected


def test_cantools_decodes_every_command() -> None:
    for kind in CommandKind:
        fields = {} if kind is CommandKind.STOP else COMMANDS[kind.name.lower()].quantities()
        values = {name: max(1.0, field.low) for name, field in fields.items() if not field.takes_text}
        decoded = DATABASE.decode_message(*command_frame(kind, 9, **values))
        assert str(decoded["kind"]) == kind.name.lower()
        assert decoded["counter"] == 9


def test_cantools_decode_reads_a_log(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "rig.dbc").write_text(dbc.text(), encoding="utf-8")
    probes = TABLE.by_name["Probes"]
    assert probes.samples is not None
    data = probes.samples.pack(np.array([10]), np.full((5, 4), 0x1000, np.int32), 64).tobytes()
    hammer = command_frame(CommandKind.HAMMER, 1, force_n=50.0, duration_ms=5.0)[1]
    lines = [
        f"(1700000000.000000) can0 {probes.identifier:03X}##1{data.hex().upper()}",
        f"(1700000000.000100) can0 {0x020:03X}#{hammer.hex().upper()}",
    ]
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join(lines) + "\n"))
    monkeypatch.setattr(sys, "argv", ["cantools", "decode", str(tmp_path / "rig.dbc")])
    runpy.run_module("cantools", run_name="__main__")
    output = capsys.readouterr().out
    assert "Probes(" in output
    assert "index: 10" in output
    assert "disk_x_4: " in output
    assert "force: 50.0 N" in output
