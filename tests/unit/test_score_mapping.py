"""`rig score -m`: names, units, fractions of full scale, bits and signs by a mapping, and units that it must have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replays.recordings.formats.mapping import parse_mapping
from replays.score.card.scorecard import FAIL
from replays.score.judgement import judge
from rig.base.errors import InputError
from rig.channels.table import default_table
from tests.commands import run_captured
from tests.score_daqs import make_counts, write_parquet, write_session

PROBES = default_table().groups["probes"]
CHANNEL = PROBES.channels[0]


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Noise on the probes, within the converters' range."""
    return make_counts("probes", 0.25 * np.random.default_rng(7).standard_normal((4000, 4)), None)


@pytest.fixture(scope="module")
def session(counts: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("sent") / "session.mcap", {"probes": counts})


def write(path: Path, values: np.ndarray, unit: str = "") -> Path:
    return write_parquet(path, {f"ai{n}{unit}": values[:, n] for n in range(values.shape[1])})


def mapped(numbers: dict[str, Any]) -> Any:
    channels = {name: {"source": f"ai{n}", **numbers} for n, name in enumerate(PROBES.names)}
    return parse_mapping({"channels": channels}, name="map.toml")


UNIT_FORMS = {
    "volts": ({"unit": "V"}, lambda c: c * CHANNEL.lsb_v),
    "millivolts": ({"unit": "mV"}, lambda c: 1e3 * c * CHANNEL.lsb_v),
    "fractions": ({"unit": "FS"}, lambda c: c / 2.0**23),
    "fractions of 16 bits": ({"unit": "FS"}, lambda c: np.rint(c * (32767 / 2.0**23)) / 2.0**15),
    "16 bits": ({"bits": 16}, lambda c: c >> 8),
    "turned": ({"unit": "V", "sign": -1, "bias": 0.5, "factor": 0.25}, lambda c: 0.5 - 4.0 * c * CHANNEL.lsb_v),
    "micrometres": ({"unit": "um"}, lambda c: 1e3 * PROBES.engineering(c)),
}


@pytest.mark.parametrize("way", UNIT_FORMS)
def test_a_mapping_gives_names_and_units(way: str, session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    numbers, columns = UNIT_FORMS[way]
    card = judge(write(tmp_path / "daq.parquet", columns(counts[1000:])), [session], mapping=mapped(numbers))
    assert (card.path, card.outcome) == ("digital", "pass"), card.verdict_line


@pytest.mark.parametrize("way", ["fractions", "16 bits", "turned"])
def test_values_are_those_of_the_mapping_on_the_analogue_path(
    way: str, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    gains = []
    for numbers, made in (({"unit": "mm"}, PROBES.engineering), UNIT_FORMS[way]):
        daq = write(tmp_path / "daq.parquet", made(counts[1000:]))
        gains.append(judge(daq, [session], mapping=mapped(numbers), path="analogue").row("gain", "disk_x").value)
    assert gains[1] == pytest.approx(gains[0], abs=20.0)


def test_a_channel_mapped_to_another_signal_fails(session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    daq = write(tmp_path / "daq.parquet", counts[:, [1, 0, 2, 3]] * CHANNEL.lsb_v)
    card = judge(daq, [session], mapping=mapped({"unit": "V"}))
    assert {(row.quantity, row.channel) for row in card.rows if row.verdict == FAIL} == {
        ("mapping", "disk_x"), ("mapping", "disk_y"),
    }  # fmt: skip


@pytest.mark.parametrize("unit", ["milimetre", "MN", "um pk-pk"])
def test_an_unknown_unit_must_be_given(
    unit: str, session: Path, counts: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = {f"{name} [{unit}]": PROBES.engineering(counts)[:, n] for n, name in enumerate(PROBES.names)}
    daq = write_parquet(tmp_path / "daq.parquet", columns)
    status, _, err = run_captured(capsys, "score", daq, "--against", str(session))
    assert (status, err.count("\n")) == (2, 1), err
    assert "unit of disk_x" in err
    assert "-m" in err
    lines = [f'[channels.{name}]\nsource = "{name}"\nunit = "mm"\n' for name in PROBES.names]
    (tmp_path / "map.toml").write_text("".join(lines))
    status, out, err = run_captured(capsys, "score", daq, "--against", str(session), "-m", str(tmp_path / "map.toml"))
    assert (status, err.partition(": ")[0], err.count("\n")) == (0, "signals assigned", 1), out


@pytest.mark.parametrize(
    ("unit", "meant"), [("conuts", "counts"), ("LSBs", "LSB"), ("cods", "codes"), ("micorn", "um"), ("milimetre", "mm")]
)
def test_a_misspelt_name_of_counts_is_proposed(
    unit: str, meant: str, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    daq = write_parquet(tmp_path / "daq.parquet", {f"{c.name} [{unit}]": counts[:, 0] for c in PROBES.channels[:1]})
    wanted = {"disk_x": {"source": "disk_x", "unit": unit}}
    for mapping in (None, parse_mapping({"channels": wanted}, name="map.toml")):
        with pytest.raises(InputError, match=f"a known unit, such as {meant};"):
            judge(daq, [session], mapping=mapping)


@pytest.mark.parametrize("unit", ["counts", "raw", "LSB"])
def test_a_mapping_accepts_counts(unit: str, session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    card = judge(write(tmp_path / "daq.parquet", counts[1000:]), [session], mapping=mapped({"unit": unit}))
    assert (card.path, card.outcome) == ("digital", "pass"), card.verdict_line


@pytest.mark.parametrize(
    ("table", "field"),
    [
        ({"disk_z": {"source": "ai0"}}, "channels.disk_z"),
        ({"disk_x": {"source": "ai9"}}, "channels.disk_x.source"),
        ({"disk_x": {"source": "ai0", "unit": "MN"}}, "channels.disk_x.unit"),
        ({"disk_x": {"source": "ai0", "bias": "mean"}}, "channels.disk_x.bias"),
        ({"disk_x": {"source": "ai0"}, "disk_y": {"source": "ai0", "sign": -1}}, "channels.disk_y.source"),
        ({"disk_x": {"source": "ai0", "unit": "mm", "sensitivity": "7.87 V/mm"}}, "channels.disk_x.unit"),
    ],
)
def test_errors_in_a_mapping_are_named(
    table: dict[str, Any], field: str, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    daq = write(tmp_path / "daq.parquet", counts[:100])
    with pytest.raises(InputError) as error:
        judge(daq, [session], mapping=parse_mapping({"channels": table}, name="map.toml"))
    assert error.value.field == field
