"""The page on keys, messages and units: generated from the tables, committed, and complete."""

from __future__ import annotations

import pytest

from rig.base import wire
from rig.channels.table import default_table
from rig.cli.main import main
from rig.physics.kernels.signals import ROW, TRUTH
from rig.run.commands.table import COMMANDS
from rig.serve.interface import page

ROWS = page().splitlines()


def test_command_prints_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["keys", "--markdown"])
    assert end.value.code == 0
    assert capsys.readouterr().out == page()


@pytest.mark.parametrize("channel", default_table().channels.values(), ids=lambda channel: channel.name)
def test_every_channel_is_on_the_page_with_its_calibration(channel) -> None:
    (row,) = [
        row
        for row in ROWS
        if row.startswith("|") and row.split("|")[2].strip() == f"`{channel.name}`" and channel.label in row
    ]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    group = default_table().groups[channel.group]
    assert cells[0] == str(group.names.index(channel.name))
    assert cells[2:5] == [channel.unit, f"{channel.sensitivity_v:g}", f"{channel.bias_v:g}"]
    assert cells[6:9] == [f"{channel.bandwidth_hz:g}", f"{channel.highpass_hz:g}", f"{channel.noise_v:g}"]
    assert any(line.startswith(f"### `{wire.sensor_key(group.name)}`") for line in ROWS)


@pytest.mark.parametrize("table", TRUTH)
def test_every_column_of_the_truth_is_on_the_page_in_order(table: str) -> None:
    units = {signal.name: signal.unit for signal in ROW}
    start = ROWS.index(f"### `{wire.truth_key(table)}`")
    rows = [row for row in ROWS[start : start + 6 + len(TRUTH[table])] if row.startswith("| ") and "`" in row]
    cells = [[cell.strip() for cell in row.strip("|").split("|")][:3] for row in rows]
    assert cells == [[str(n), f"`{name}`", units[name]] for n, name in enumerate(TRUTH[table])]


@pytest.mark.parametrize(
    "key", [wire.EVENTS, wire.STATUS, wire.CATALOGUE, wire.PARAMETERS, wire.SCENE, wire.EDGES, wire.ALIVE]
)
def test_every_key_is_on_the_page(key: str) -> None:
    assert f"`{key}`" in page()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_on_the_page_with_its_fields_and_ranges(name: str) -> None:
    (row,) = [row for row in ROWS if row.startswith(f"| `{wire.command_key(name)}`")]
    for field, about in COMMANDS[name].model_fields.items():
        if field == "command":
            continue
        assert f"`{'kind' if field == 'what' else field}`" in row
        for item in about.metadata:
            if hasattr(item, "ge"):
                assert f"from {item.ge:g}" in row
            if hasattr(item, "le"):
                assert f"to {item.le:g}" in row


def test_definition_of_the_message_is_the_codecs() -> None:
    assert wire.SCHEMAS[wire.SAMPLE_SCHEMA] in page()
