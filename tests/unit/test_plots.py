"""Plots against closed forms: whirl, phase, run-out, chirp; and pictures of data with gaps and of many channels."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from replays.plots.methods import KINDS
from replays.plots.plot import Plot
from replays.plots.signals import find_pieces, measure_runout, read_signals
from rig.base.errors import InputError
from rig.base.samples import Samples

RATE_HZ = 5000.0
SPEED_HZ = 7.0
SESSION = "replays/sessions/hammer-6.2.mcap"


def build_samples(
    duration_s: float = 4.0, *, speed_hz: tuple[float, float] = (SPEED_HZ, SPEED_HZ), **channels: Any
) -> Samples:
    """Return samples of functions of time [s] and shaft angle [rad], with a keyphasor; the speed changes linearly."""
    times_s = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    begin_hz, end_hz = speed_hz
    turns = begin_hz * times_s + 0.5 * (end_hz - begin_hz) / duration_s * times_s**2 - 0.1
    columns = {name: function(times_s, 2.0 * math.pi * turns) for name, function in channels.items()}
    columns["keyphasor"] = np.interp(turns % 1.0, [0.0, 0.02, 0.03, 0.99, 1.0], [0.5, 1.0, 0.0, 0.0, 0.5])
    units = ("mm",) * (len(columns) - 1) + ("1",)
    values = np.column_stack(list(columns.values()))
    return Samples("test", times_s, np.arange(len(times_s)), values, tuple(columns), units, RATE_HZ)


def build_whirl(forward: float, backward: float, *, order: float = 1.0, phase: float = 0.7, **options: Any) -> Samples:
    """Return an orbit of one forward and one backward circle at an order of the speed, around (0.2, -0.1) mm."""
    return build_samples(
        disk_x=lambda _, angle: 0.2 + (forward + backward) * np.cos(order * angle - phase),
        disk_y=lambda _, angle: -0.1 + (forward - backward) * np.sin(order * angle - phase),
        **options,
    )


def drop_rows(samples: Samples, begin_s: float, end_s: float) -> Samples:
    kept = (samples.times_s < begin_s) | (samples.times_s >= end_s)
    return Samples(
        samples.name, samples.times_s[kept], samples.index[kept], samples.values[kept], samples.names, samples.units,
        samples.rate_hz,
    )  # fmt: skip


@pytest.mark.parametrize(("forward", "backward", "order"), [(0.3, 0.1, 1), (0.05, 0.2, 1), (0.2, 0.0, 2)])
def test_orbit_shows_amplitudes_sense_and_keyphasor(forward: float, backward: float, order: int) -> None:
    axes, table = build_whirl(forward, backward, order=order).plot.orbit()
    assert [each.get_title(loc="left").split(":")[0] for each in axes] == ["raw", "1X", "2X"]
    sense = "forward" if forward > backward else "backward"
    assert axes[0].get_title(loc="left").startswith(f"raw: {sense}\n")
    assert float(axes[0].get_title(loc="left").split()[-2]) == pytest.approx(order * SPEED_HZ, rel=0.01)
    assert sense in axes[order].get_title(loc="left")
    assert np.ptp(table[f"x {order}X"]) / 2.0 == pytest.approx(forward + backward, rel=0.01)
    assert np.ptp(table[f"y {order}X"]) / 2.0 == pytest.approx(abs(forward - backward), rel=0.01)
    dot = axes[order].lines[-1].get_xydata()[0]  # the peak lags the notch by 0.7 rad
    assert dot[0] == pytest.approx((forward + backward) * math.cos(0.7), rel=0.01)
    assert np.hypot(table[f"x {3 - order}X"], table[f"y {3 - order}X"]).max() < 0.01 * (forward + backward)
    raw = axes[0].lines[-1].get_xydata()
    assert len(raw) == 7, "one for each revolution of the last second"
    assert raw[:, 0] == pytest.approx(0.2 + (forward + backward) * math.cos(0.7), abs=0.01 * (forward + backward))


def test_probes_at_45_degrees_are_turned_to_right_and_up() -> None:
    upright = build_whirl(0.3, 0.1)
    z = (upright["disk_x"] + 1j * upright["disk_y"]) * np.exp(-0.25j * math.pi)
    values = np.column_stack([z.real, z.imag, upright["keyphasor"]])
    turned = Samples("", upright.times_s, upright.index, values, upright.names, upright.units, RATE_HZ)
    table = turned.plot.orbit(probe_angles_deg=(45.0, 135.0)).table
    assert table.values == pytest.approx(upright.plot.orbit().table.values, abs=1e-9)
    with pytest.raises(InputError, match="probe_angles_deg must be two directions that differ"):
        turned.plot.orbit(probe_angles_deg=(45.0, 225.0))


def test_centreline_is_the_mean_of_each_revolution() -> None:
    _, table = build_whirl(0.3, 0.1).plot.centreline()
    assert len(table) == pytest.approx(4.0 * SPEED_HZ, abs=2)
    assert table["x"] == pytest.approx(0.2, abs=1e-3)
    assert table["y"] == pytest.approx(-0.1, abs=1e-3)
    assert table["speed"] == pytest.approx(SPEED_HZ, rel=0.01)


def test_a_gap_is_not_drawn_through() -> None:
    samples = drop_rows(build_whirl(0.3, 0.1, duration_s=0.4), 0.13, 0.22)
    (axes, _), table = samples.plot.timebase(channels=["disk_x", "disk_y"])
    times_s, values = axes.lines[0].get_xydata().T
    assert np.isnan(values).sum() == 1
    assert times_s[np.flatnonzero(np.isnan(values)) - 1] == pytest.approx(0.13, abs=3e-4)
    assert axes.get_title(loc="right") == "450 rows missing in 1 gap"
    assert np.isfinite(table.values).all()
    assert len(table) == len(samples)
    inside = read_signals(samples).edges_s
    assert np.isnan(axes.lines[1].get_ydata()[(inside > 0.13) & (inside < 0.22)]).all()
    orbit = samples.plot.orbit(components="raw").axes[0]
    assert np.isnan(orbit.lines[0].get_xdata()).sum() == 1


def test_a_long_record_is_an_envelope_with_its_extremes_and_gaps() -> None:
    samples = build_samples(20.0, p=lambda times_s, _: np.sin(2.0 * math.pi * 50.0 * times_s))
    samples.values[70_003, 0] = 9.0
    axes, table = drop_rows(samples, 4.0, 6.0).plot.timebase(channels="p")
    assert axes[0].get_title(loc="right") == "envelope, 10000 rows missing in 1 gap"
    assert "envelope: minimum and maximum" in table.note
    assert table["p.max"][np.nanargmax(table["p.max"])] == 9.0
    assert table["time"][np.nanargmax(table["p.max"])] == pytest.approx(70_003 / RATE_HZ, abs=0.02)
    empty = np.isnan(table["p.min"])
    assert table["time"][empty][[0, -1]] == pytest.approx([4.0, 6.0], abs=0.02)
    assert (table["p.min"][~empty] < -0.99).all()


def test_rows_that_arrive_late_or_twice_are_in_order() -> None:
    samples = build_whirl(0.3, 0.1, duration_s=0.3)
    rows = np.r_[0:500, 700:1000, 400:700, 1000:1500]
    mixed = Samples(
        "", samples.times_s[rows], samples.index[rows], samples.values[rows], samples.names, samples.units, RATE_HZ
    )
    read = read_signals(mixed).read("disk_x")
    assert read["disk_x"].tolist() == samples["disk_x"].tolist()
    assert find_pieces(read) == [slice(0, 1500)]


def test_runout_is_removed_by_vector_and_by_waveform() -> None:
    def bend(angle: np.ndarray) -> np.ndarray:
        return 0.04 * np.cos(angle - 2.0) + 0.02 * np.cos(2.0 * angle + 1.0) + 0.01 * np.cos(5.0 * angle)

    slow = build_samples(6.0, speed_hz=(1.0, 1.5), disk_x=lambda _, a: bend(a), disk_y=lambda _, a: bend(a - 1.5))
    fast = build_samples(
        disk_x=lambda _, angle: bend(angle) + 0.1 * np.cos(angle - 0.7),
        disk_y=lambda _, angle: bend(angle - 1.5) + 0.1 * np.sin(angle - 0.7),
    )
    runout = measure_runout(slow, max_hz=1.4)
    assert abs(runout.vectors["disk_x"]) == pytest.approx([0.04], rel=0.01)
    vector, waveform = (
        fast.plot.orbit(runout=runout).table,
        fast.plot.orbit(runout=measure_runout(slow, orders=8)).table,
    )
    for table in (vector, waveform):
        assert np.hypot(table["x 1X"], table["y 1X"]) == pytest.approx(0.1, rel=0.01)
    assert np.ptp(vector["x 2X"]) / 2.0 == pytest.approx(0.02, rel=0.01)
    assert np.hypot(waveform["x raw"], waveform["y raw"]) == pytest.approx(0.1, rel=0.01)


def test_a_run_a_recording_and_samples_give_the_same_orbit(tmp_path: Path) -> None:
    import rig
    from replays.recordings.export import write_run

    changes = {"duration_s": 0.4, "sensors.rate_hz": 5000}
    run = rig.simulate("hammer", changes)
    write_run(rig.Simulation(rig.load_scene("hammer", changes)), tmp_path / "hammer.mcap")
    recording = Recording.open(tmp_path / "hammer.mcap")
    ours = run.plot.orbit(last_s=0.2)
    assert recording.plot.orbit(last_s=0.2).table.values == pytest.approx(ours.table.values, abs=1e-9)
    assert run.samples.plot.orbit(last_s=0.2).table["x raw"].tolist() == ours.table["x raw"].tolist()
    circle = ours.axes[0].lines[0].get_xydata()
    assert np.hypot(*circle.T) == pytest.approx(0.926 * 314.0 / 197.0, rel=1e-3), "the ring's clearance, at the disk"
    ring = run.plot.orbit(pair="ring", last_s=0.05).axes[0].lines[0].get_xydata()
    assert np.hypot(*ring.T) == pytest.approx(0.926, rel=1e-3)
    force = run.plot.timebase(channels=["truth.normal_force"], from_s=0.3).table
    assert force["truth.normal_force"] == pytest.approx(run["normal_force"][run.times_s >= 0.3], rel=1e-12)


def test_tables_are_written_with_units_and_conventions(tmp_path: Path) -> None:
    from pyarrow import parquet

    plot = build_whirl(0.3, 0.1).plot.orbit()
    assert plot.save(tmp_path / "orbit.png") == [tmp_path / "orbit.png", tmp_path / "orbit.csv"]
    rows = list(csv.reader(io.StringIO((tmp_path / "orbit.csv").read_text(encoding="utf-8"))))
    assert rows[0][:2] == ["time [s]", "x raw [mm]"]
    assert np.array(rows[1:], dtype=float) == pytest.approx(plot.table.values, rel=1e-8)
    table = parquet.read_table(plot.table.write(tmp_path / "orbit.parquet"))
    assert table.column_names == rows[0]
    assert b"x right, y up" in table.schema.metadata[b"note"]
    with pytest.raises(InputError, match=r"table must be a .csv or .parquet file; received '.*orbit.txt'"):
        plot.table.write(tmp_path / "orbit.txt")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda plot: plot.orbti(), "plot must be a kind of plot, such as orbit"),
        (lambda plot: plot.orbit(lats_s=1.0), "option of orbit must be one that it has, such as last_s"),
        (lambda plot: plot.orbit(pair="disc"), "pair must be a pair of probes, such as disk"),
        (lambda plot: plot.orbit(components="3X"), "components must be some of raw, 1X and 2X; received '3X'"),
        (lambda plot: plot.timebase(channels=["disk_z"]), "channels must be channels of the data, such as disk_"),
        (lambda plot: plot.orbit(last_s=0.0), "last_s must be greater than 0; received 0.0"),
        (lambda plot: plot.orbit(from_s=9.0), "from_s and to_s must be within 0 to 3.9998 s; received 9.0 to None"),
        (lambda plot: plot.orbit(axes=[None, None]), "axes must be 3 axes; received 2"),
    ],
)
def test_wrong_arguments_name_the_nearest(call: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call(build_whirl(0.3, 0.1).plot)


def test_unknown_methods_are_no_attributes() -> None:
    plot = build_whirl(0.3, 0.1).plot
    assert dir(plot) == sorted(KINDS)
    assert hasattr(plot, "orbit")
    assert not hasattr(plot, "orbti")
    assert not hasattr(plot, "_repr_html_")
    with pytest.raises(InputError, match="source must be a run, a recording or samples; received dict"):
        KINDS["orbit"]({})


@pytest.mark.parametrize("name", list(KINDS))
def test_every_kind_draws_a_recording_without_a_warning(name: str, tmp_path: Path) -> None:
    plot = getattr(Recording.open(SESSION).plot, name)()
    assert isinstance(plot, Plot)
    assert len(plot.table) > 1
    assert plot.table.note
    figure: Any = plot.axes[0].figure
    assert figure.get_supxlabel() == plot.table.note
    assert all(path.stat().st_size > 100 for path in plot.save(tmp_path / f"{name}.svg", table=".parquet"))
