"""Tables for notebooks: DataFrames, Datasets, Arrow and HTML of what the product returns."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import rig
from recorder.reader import Recording
from replays.plots.plot import Table
from replays.recordings.validation import validate
from replays.recordings.verdict import Verdict, VerdictRow
from replays.score.judgement import judge
from replays.sessions import FOLDER, SESSIONS
from rig.base.errors import UnknownNameError
from rig.base.samples import Samples
from rig.base.text import build_html_table
from rig.cli.main import main
from rig.cli.output import progress


@pytest.fixture(scope="module")
def session() -> Recording:
    return rig.open_session("hammer-6.2")


@pytest.fixture(scope="module")
def forces(session: Recording) -> Samples:
    return session.samples("forces")


def read_html(value: Any) -> tuple[str, list[list[str]]]:
    """Return title and rows of the HTML of an object."""
    tree = ElementTree.fromstring(f"<div>{value._repr_html_()}</div>")
    title, table = tree.find("p"), tree.find("table")
    assert title is not None
    assert table is not None
    return str(title.text), [[cell.text or "" for cell in row] for row in table.iter("tr")]


def test_a_frame_has_the_values_over_time_and_their_units(forces: Samples) -> None:
    frame = forces.to_pandas()
    assert list(frame.columns) == ["P_N", "P_S", "P_E", "P_W"]
    assert frame.index.name == "time_s"
    assert np.array_equal(frame.index.to_numpy(), forces.times_s)
    assert np.array_equal(frame["P_E"].to_numpy(), forces["P_E"])
    assert frame.attrs["units"] == dict.fromkeys(frame.columns, "N")


def test_a_dataset_has_units_as_attributes(forces: Samples) -> None:
    data = forces.to_xarray()
    assert np.array_equal(data.P_W.values, forces["P_W"])
    assert (data.P_W.attrs, data.time_s.attrs) == ({"units": "N"}, {"units": "s"})
    assert float(data.sel(time_s=0.1, method="nearest").P_W) == forces["P_W"][np.abs(forces.times_s - 0.1).argmin()]


def test_an_arrow_table_has_units_in_its_fields(forces: Samples) -> None:
    table = forces.to_arrow()
    assert table.column_names == ["time_s", "P_N", "P_S", "P_E", "P_W"]
    assert [field.metadata[b"unit"] for field in table.schema] == [b"s", *[b"N"] * 4]
    assert np.array_equal(table["P_N"].to_numpy(), forces["P_N"])


def test_the_table_of_a_plot_has_no_time() -> None:
    table = Table.from_columns("", speed=("Hz", [1.0, 2.0]), amplitude=("mm", [0.1, np.nan]))
    assert table.to_pandas().columns.tolist() == ["speed", "amplitude"]
    assert table.to_xarray().amplitude.dims == ("row",)
    assert table.to_arrow().column_names == ["speed", "amplitude"]
    assert read_html(table)[1][2] == ["amplitude", "mm", "0.1", "0.1", "0.1"]


def test_a_missing_package_is_named_with_its_extra(forces: Samples, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ModuleNotFoundError, match=r"^xarray is not installed: pip install .*\[notebook\]"):
        forces.to_xarray()


def test_samples_show_statistics(forces: Samples) -> None:
    title, rows = read_html(forces)
    assert title == repr(forces)
    assert rows[0] == ["column", "unit", "minimum", "mean", "maximum"]
    assert rows[1][:2] == ["P_N", "N"]
    assert [float(each) for each in rows[1][2:]] == pytest.approx(
        [forces["P_N"].min(), forces["P_N"].mean(), forces["P_N"].max()], rel=1e-3
    )
    empty = replace(forces, values=forces.values[:0], times_s=forces.times_s[:0], index=forces.index[:0])
    assert read_html(empty)[1][1] == ["P_N", "N", "", "", ""]


def test_runs_recordings_scenes_and_parameters_show_what_they_have(session: Recording) -> None:
    scene = rig.load_scene("hammer", {"drive.speed_hz": 5.25})
    run = rig.simulate(scene, duration_s=0.05)
    title, rows = read_html(run)
    assert title == repr(run)
    assert ["disk_x", "mm"] in [row[:2] for row in rows]
    assert rows[-1][:2] == ["0.02 s", "hammer"]
    assert ["forces", "P_N, P_S, P_E, P_W", "5000 Hz"] in [row[:3] for row in read_html(session)[1]]
    assert ["drive.speed_hz", "5.25"] in read_html(scene)[1]
    friction = next(row for row in read_html(rig.load_parameters())[1] if row[0] == "contact.friction")
    assert friction[1:3] == ["0.25", "1"]


def test_verdicts_show_their_outcome(session: Recording) -> None:
    found = validate(session)
    title, rows = read_html(found)
    assert f"pass; {'' if found.bit_exact else 'not '}bit-exact" in title  # other machines round differently
    assert rows == [["criterion not met", "recorded", "model", "limit"]]
    verdict = Verdict((VerdictRow("whirl", "83.9 Hz", "83.7 Hz", True), VerdictRow("spin", "6.2 Hz", "", None)))
    assert read_html(verdict)[1][1:] == [["whirl", "83.9 Hz", "83.7 Hz", "pass"], ["spin", "6.2 Hz", "", ""]]
    card = judge(session.path, [session.path])
    assert read_html(card)[0] == f"{card.title}: {card.verdict_line}"
    assert len(read_html(card)[1]) == len(card.rows) + 1


def test_text_of_others_is_not_markup() -> None:
    shown = build_html_table("<b>x</b>", ("a",), [("<script>alert(1)</script>\x1b",)])
    assert "<b>" not in shown
    assert "<script" not in shown
    assert "\x1b" not in shown


def test_reference_sessions_are_opened_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["sessions"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.split() == [str(FOLDER / f"{name}.mcap") for name in SESSIONS]
    with pytest.raises(UnknownNameError, match=r"session must be a reference session, such as hammer-6\.2"):
        rig.open_session("hammer-6.1")


def test_progress_is_a_bar_in_a_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    with rig.show_progress("work") as show:
        show(0.5)  # a line, as stderr is no terminal; every 15 s
    shown: list[tuple[Any, ...]] = []
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace())
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr(progress, "_bar", lambda: _Bar(shown))
    with rig.show_progress("work") as show:
        rig.simulate("hammer", duration_s=0.25, progress=show)
    assert shown[-1] == (1.0, "work")
    assert len(shown) == 3


class _Bar:
    """A bar that keeps what it is told."""

    def __init__(self, shown: list[tuple[Any, ...]]) -> None:
        self._shown = shown

    def __enter__(self) -> Any:
        return SimpleNamespace(part=lambda done, text: self._shown.append((done, text)))

    def __exit__(self, *_: object) -> None:
        pass
