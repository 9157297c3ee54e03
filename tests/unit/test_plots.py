"""Plots against closed forms: whirl, phase, run-out, chirp; and pictures of data with gaps and of many channels."""

from __future__ import annotations

import csv
import errno
import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from replays.plots.methods import KINDS
from replays.plots.plot import Plot
from replays.plots.signals import find_pieces, measure_runout, read_signals
from replays.recordings.export import write_run
from rig.base.errors import InputError
from rig.base.samples import Samples
from rig.run.offline import simulate
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

RATE_HZ = 5000.0
SPEED_HZ = 7.0
NEED_MORE = ("frequency_response", "modes", "campbell", "contact", "restitution", "rolling")
"""Kinds that need a model or its truth."""
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
    circle = next(line for line in ours.axes[0].lines if line.get_linestyle() == "--").get_xydata()
    assert np.hypot(*circle.T) == pytest.approx(0.926 * 314.0 / 197.0, rel=1e-3), "the ring's clearance, at the disk"
    wide = run.plot.orbit(pair="ring", last_s=0.05, clearance=2.0).axes[0]
    circle = next(line for line in wide.lines if line.get_linestyle() == "--").get_xydata()
    assert np.hypot(*circle.T) == pytest.approx(2.0)
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
        (lambda plot: plot.orbit(last_s=0.0), "last_s must be a number greater than 0; received 0.0"),
        (lambda plot: plot.orbit(last_s="1"), "last_s must be a number greater than 0; received '1'"),
        (lambda plot: plot.orbit(from_s=math.nan), "from_s must be a number; received nan"),
        (lambda plot: plot.orbit(pair=["disk"]), r"pair must be a name; received \['disk'\]"),
        (lambda plot: plot.orbit(source=1), "option of orbit must be one that it has, .*; received 'source'"),
        (lambda plot: plot.orbit(clearance=math.nan), "clearance must be a number of at least 0; received nan"),
        (
            lambda plot: plot.orbit(probe_angles_deg=45),
            "probe_angles_deg must be two directions in degrees; received 45",
        ),
        (lambda plot: plot.orbit(runout=0.1), "runout must be a run-out, of measure_runout; received 0.1"),
        (lambda plot: plot.full_spectrum(max_hz=-5), "max_hz must be a number greater than 0; received -5"),
        (lambda plot: plot.full_spectrum(max_hz=1e-3), "spectrum must be of at least 3 lines; .*; received 1"),
        (lambda plot: plot.waterfall(window_s=math.nan), "window_s must be a number greater than 0; received nan"),
        (lambda plot: plot.orders(turns=0), "turns must be a whole number of at least 1; received 0"),
        (lambda plot: plot.bode(orders=1), "orders must be a list of whole numbers from 1 to 100; received 1"),
        (lambda plot: plot.trend(orders=[]), r"orders must be a list of whole numbers from 1 to 100; received \[\]"),
        (lambda plot: plot.trend(orders=[0.5, 1]), r"orders must be a list of whole .*; received \[0.5, 1\]"),
        (lambda plot: plot.timebase(channels=5), "channels must be a name or a list; received 5"),
        (lambda plot: plot.orbit(axes=[1, 2, 3]), "axes must be matplotlib axes; received int"),
        (lambda plot: plot.orbit(from_s=9.0), "from_s and to_s must be within 0 to 3.9998 s; received 9.0 to None"),
        (lambda plot: plot.orbit(axes=[None, None]), "axes must be 3 axes; received 2"),
    ],
)
def test_wrong_arguments_name_the_nearest(call: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call(build_whirl(0.3, 0.1).plot)


def test_orders_of_runout_are_a_whole_number() -> None:
    with pytest.raises(InputError, match="orders must be a whole number of at least 1; received 0"):
        measure_runout(build_whirl(0.3, 0.1), orders=0)
    with pytest.raises(InputError, match="max_hz must be a number greater than 0; received 0"):
        measure_runout(build_whirl(0.3, 0.1), max_hz=0)


@pytest.mark.parametrize("name", ["full_spectrum", "waterfall", "orders"])
@pytest.mark.parametrize("level", [0.0, 0.5])
def test_a_channel_that_does_not_move_is_drawn(name: str, level: float, tmp_path: Path) -> None:
    still = build_samples(disk_x=lambda times_s, _: 0.0 * times_s + level, disk_y=lambda times_s, _: 0.0 * times_s)
    plot = getattr(still.plot, name)()
    plot.save(tmp_path / f"{name}.png")
    assert plot.table["amplitude"].max() < 1e-12


@pytest.mark.parametrize(("name", "rows"), [("full_spectrum", 2), ("waterfall", 10)])
def test_few_rows_have_no_spectrum(name: str, rows: int) -> None:
    with pytest.raises(InputError, match=r"spectrum must be of at least 3 lines; .*; received 1"):
        getattr(build_whirl(0.3, 0.1, duration_s=rows / RATE_HZ).plot, name)()


def test_noise_of_a_keyphasor_at_standstill_is_no_passage() -> None:
    noise = 0.5 + 1e-3 * np.random.default_rng(1).normal(size=1000)
    samples = build_whirl(0.3, 0.1, duration_s=0.2)
    still = np.column_stack([samples.values[:, :2], noise])
    rest = Samples("", samples.times_s, samples.index, still, samples.names, samples.units, RATE_HZ)
    assert len(read_signals(rest).edges_s) == 0
    assert len(read_signals(samples).edges_s) == 2


def test_unknown_methods_are_no_attributes() -> None:
    plot = build_whirl(0.3, 0.1).plot
    assert dir(plot) == sorted(KINDS)
    assert hasattr(plot, "orbit")
    assert not hasattr(plot, "orbti")
    assert not hasattr(plot, "_repr_html_")
    with pytest.raises(InputError, match="source must be a run, a recording or samples; received dict"):
        KINDS["orbit"]({})


@pytest.mark.parametrize("name", [name for name in KINDS if name not in NEED_MORE])
def test_every_kind_draws_without_a_warning(name: str, tmp_path: Path) -> None:
    plot = getattr(build_resonance().plot, name)()
    assert isinstance(plot, Plot)
    assert len(plot.table) > 1
    figure: Any = plot.axes[0].figure
    assert figure.get_supxlabel() == plot.table.note != ""
    assert all(path.stat().st_size > 100 for path in plot.save(tmp_path / f"{name}.svg", table=".parquet"))
    axes = [*plot.axes]
    again = KINDS[name](build_resonance(), axes=axes)
    assert [*again.axes] == axes, "drawn on the caller's axes"


def respond(speed_hz: np.ndarray) -> np.ndarray:
    """Return amplitude and phase of a rotor with unbalance, natural frequency 8 Hz, damping ratio 0.1."""
    ratio = speed_hz / 8.0
    return 0.02 * ratio**2 / (1.0 - ratio**2 + 2j * 0.1 * ratio)


def build_resonance(speed_hz: tuple[float, float] = (3.0, 13.0)) -> Samples:
    """Return a run-up in which each instant has the stationary response, on x and, a quarter later, on y."""

    def follow(times_s: np.ndarray, angle: np.ndarray, lag: float) -> np.ndarray:
        speeds = np.interp(times_s, [0.0, times_s[-1]], speed_hz)
        return np.real(respond(speeds) * np.exp(1j * (angle - lag)))

    return build_samples(
        30.0,
        speed_hz=speed_hz,
        disk_x=lambda times_s, angle: follow(times_s, angle, 0.0),
        disk_y=lambda times_s, angle: follow(times_s, angle, 0.5 * math.pi),
    )


@pytest.mark.parametrize("speed_hz", [(3.0, 13.0), (13.0, 3.0)])
@pytest.mark.parametrize("name", ["bode", "polar", "trend"])
def test_bode_polar_and_trend_show_the_transfer_function(name: str, speed_hz: tuple[float, float]) -> None:
    axes, table = getattr(build_resonance(speed_hz).plot, name)()
    expected = respond(table["speed"])
    assert table["time"] == pytest.approx((table["speed"] - speed_hz[0]) / np.diff(speed_hz) * 30.0, abs=0.02)
    assert len(table) > 200
    for channel, lag in (("disk_x", 0.0), ("disk_y", 90.0)):
        vectors = table[f"{channel} 1X"] * np.exp(-1j * np.radians(table[f"{channel} 1X lag"] - lag))
        assert np.abs(vectors - expected).max() < 0.01 * np.abs(expected).max()
        # A component that changes within a revolution is not purely 1X.
        assert table[f"{channel} 2X"].max() < 0.02 * np.abs(expected).max()
    assert (table["disk_x 1X lag"] % 360.0 >= 0.0).all()
    at_resonance = int(np.argmin(np.abs(table["speed"] - 8.0)))
    assert table["disk_x 1X lag"][at_resonance] == pytest.approx(90.0, abs=4.0)
    if name == "bode":
        way = "run-up" if speed_hz[1] > speed_hz[0] else "coast-down"
        assert [line.get_label() for line in axes[2].lines] == [f"disk_x, {way}", f"disk_y, {way}"]
        assert axes[0].get_ylim()[0] > axes[0].get_ylim()[1], "the lag increases downwards"
    if name == "polar":
        assert [axis.get_theta_offset() for axis in axes] == pytest.approx([0.0, math.pi / 2.0] * 2)
        assert [axis.get_theta_direction() for axis in axes] == [-1] * 4, "the lag is against the rotation"


def test_slow_roll_is_subtracted_from_a_bode_plot() -> None:
    clean = build_resonance()
    angle = np.interp(clean.times_s, read_signals(clean).edges_s, np.arange(len(read_signals(clean).edges_s)))
    values = clean.values.copy()
    values[:, 0] += 0.1 * np.cos(2.0 * math.pi * angle - 1.0)
    bent = Samples("", clean.times_s, clean.index, values, clean.names, clean.units, RATE_HZ)
    vector = measure_runout(bent, max_hz=3.5).vectors["disk_x"]
    assert vector == pytest.approx(0.1 * np.exp(-1j) + respond(np.array([3.3])), abs=0.002), "with the response there"
    table = bent.plot.bode(channels="disk_x", orders=[1], runout=measure_runout(bent, max_hz=3.5)).table
    expected = respond(table["speed"]) - respond(np.array([3.3]))
    assert table["disk_x 1X"][2:-2] == pytest.approx(np.abs(expected)[2:-2], abs=0.003)


def test_bode_needs_a_keyphasor_and_a_changing_speed() -> None:
    with pytest.raises(InputError, match=r"speed must be that of a run-up .*; received 7.00 to 7.00 Hz"):
        build_whirl(0.3, 0.1).plot.bode()
    with pytest.raises(InputError, match="Bode must be drawn with at least two keyphasor passages; received 0"):
        build_whirl(0.3, 0.1).select("disk_x", "disk_y").plot.bode()
    with pytest.raises(InputError, match=r"orders must be a list of whole numbers from 1 to 100; received \[0\]"):
        build_whirl(0.3, 0.1).plot.trend(orders=[0])


def test_spectra_show_a_known_chirp() -> None:
    from scipy.signal import chirp

    times_s = np.arange(round(10.0 * RATE_HZ)) / RATE_HZ
    x, y = (0.25 * chirp(times_s, 20.0, 10.0, 60.0, phi=phi) for phi in (0.0, 90.0))  # backward: y = -sin
    samples = Samples(
        "", times_s, np.arange(len(times_s)), np.column_stack([x, y]), ("a_x", "a_y"), ("mm",) * 2, RATE_HZ
    )
    table = samples.plot.waterfall(window_s=0.5).table
    for at_s in np.unique(table["time"])[::10]:
        rows = table["time"] == at_s
        power = table["amplitude"][rows] ** 2
        assert np.sum(table["frequency"][rows] * power) / power.sum() == pytest.approx(-(20.0 + 4.0 * at_s), rel=0.01)
    gap = drop_rows(samples, 4.0, 6.0).plot.waterfall(window_s=0.5).table
    empty = np.unique(gap["time"][np.isnan(gap["amplitude"])])
    assert len(empty) == 2
    assert 3.7 < empty[0] < empty[1] < 6.3
    assert not ((gap["time"] > empty[0]) & (gap["time"] < empty[1])).any()


def test_the_peak_of_a_frequency_between_two_lines_has_its_amplitude() -> None:
    for hz in (20.25, 40.13, -61.4):  # lines of 2 s are 0.5 Hz apart
        turn = 2.0 * math.pi * hz
        samples = build_samples(
            3.0, speed_hz=(2.0, 12.0), disk_x=lambda t, _, turn=turn: 1.5 * np.cos(turn * t),
            disk_y=lambda t, _, turn=turn: 1.5 * np.sin(turn * t),
        )  # fmt: skip
        table = samples.plot.full_spectrum().table
        assert table["amplitude"].max() == pytest.approx(1.5, rel=0.004)
        assert table["frequency"][table["amplitude"].argmax()] == pytest.approx(hz, abs=0.04)


def test_full_spectrum_and_cascade_separate_forward_and_backward() -> None:
    def build(sign: float) -> Any:
        function = np.cos if sign > 0.0 else np.sin
        return lambda times_s, _: (
            0.3 * function(80.0 * math.pi * times_s) + sign * 0.1 * function(50.0 * math.pi * times_s)
        )

    samples = build_samples(20.0, speed_hz=(2.0, 12.0), disk_x=build(1.0), disk_y=build(-1.0))
    table = samples.plot.full_spectrum().table
    for hz, amplitude in ((40.0, 0.3), (-25.0, 0.1)):
        assert table["amplitude"][np.argmin(np.abs(table["frequency"] - hz))] == pytest.approx(amplitude, rel=0.01)
        assert table["amplitude"][np.argmin(np.abs(table["frequency"] + hz))] < 1e-4
    (axes,), table = samples.plot.cascade(window_s=1.0)
    for hz, amplitude in ((40.0, 0.3), (-25.0, 0.1)):
        assert table["amplitude"][np.abs(table["frequency"] - hz) < 1e-6] == pytest.approx(amplitude, rel=0.01)
    speeds = np.unique(table["speed"])
    assert speeds[[0, -1]] == pytest.approx([2.25, 11.75], abs=0.15)
    assert 30 <= len(speeds) <= 40
    assert axes.get_ylabel() == "speed [Hz]"


def test_orders_follow_the_speed() -> None:
    table = build_whirl(0.3, 0.05, order=2.5, speed_hz=(2.0, 12.0), duration_s=20.0).plot.orders(max_order=4.0).table
    for order, amplitude in ((2.5, 0.3), (-2.5, 0.05)):
        assert table["amplitude"][table["order"] == order] == pytest.approx(amplitude, rel=0.01)
    apart = np.abs(np.abs(table["order"]) - 2.5) > 0.3
    assert table["amplitude"][apart].max() < 0.003
    assert np.abs(table["order"]).max() == 4.0
    whole = build_whirl(0.3, 0.05, speed_hz=(5.0, 25.0), duration_s=8.0)
    slow = replace(
        whole, times_s=whole.times_s[::5], index=whole.index[::5] // 5, values=whole.values[::5], rate_hz=1e3
    )
    table = slow.plot.orders(max_order=40.0).table  # from 40 to 200 samples per revolution
    assert table["amplitude"][table["order"] == 1.0] == pytest.approx(0.3, rel=0.01)
    gap = drop_rows(build_whirl(0.3, 0.05, duration_s=10.0), 4.0, 6.0).plot.orders().table
    assert not ((gap["time"] > 3.5) & (gap["time"] < 6.5)).any()


@pytest.mark.parametrize("count", [1, 24])
def test_any_number_of_channels_is_drawn(count: int, tmp_path: Path) -> None:
    samples = build_samples(0.2, **{f"c{n}": lambda times_s, _: np.sin(50.0 * times_s) for n in range(count)})
    plot = samples.plot.timebase()
    assert len(plot.axes) == count
    assert plot.save(tmp_path / "timebase.png")
    with pytest.raises(InputError, match="channels must be with a pair of probes, such as disk_x and disk_y"):
        samples.plot.orbit()


def rig_plot(*arguments: object) -> int:
    from rig.cli.main import main

    with pytest.raises(SystemExit) as end:
        main(["plot", *map(str, arguments)])
    return int(end.value.code or 0)


def test_the_command_draws_each_pair_and_group(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {name: KINDS[name] for name in ("orbit", "timebase", "bode")}
    monkeypatch.setattr("replays.plots.methods.KINDS", few)
    assert rig_plot(SESSION, "-o", tmp_path / "out", "--from", "0.1", "--svg") == 0
    out, err = capsys.readouterr()
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {Path(line).name for line in out.splitlines()} == names
    assert {"orbit-disk.svg", "orbit-ring.csv", "timebase-forces.svg", "timebase-drive.csv"} <= names
    assert not any(name.startswith("bode") for name in names)
    assert err.count("left out: ") == 1
    assert "left out: bode-disk, bode-ring: speed must be that of a run-up" in err
    table = np.genfromtxt(tmp_path / "out/orbit-disk.csv", delimiter=",", skip_header=1)
    assert table[0, 0] >= 0.1
    assert rig_plot(SESSION, "-o", tmp_path / "few", "--only", "orbit", "--parquet") == 0
    assert {path.name for path in (tmp_path / "few").iterdir()} == {
        f"orbit-{pair}.{suffix}" for pair in ("disk", "ring") for suffix in ("png", "parquet")
    }


def test_the_command_subtracts_the_run_out_of_a_slow_roll(tmp_path: Path) -> None:
    slow, fast = tmp_path / "slow.mcap", tmp_path / "fast.mcap"
    write_run(Simulation(load_scene("slow-roll", {"duration_s": 3.5})), slow)
    write_run(Simulation(load_scene("slow-roll", {"duration_s": 1.0, "drive.speed_hz": 6.0})), fast)
    assert rig_plot(fast, "-o", tmp_path, "--only", "orbit", "--run-out", slow) == 0
    orbit = np.genfromtxt(tmp_path / "orbit-disk.csv", delimiter=",", skip_header=1)
    clean = simulate("slow-roll", {"drive.speed_hz": 6.0}, duration_s=1.0, signals=["disk_x"])["disk_x"]
    assert np.std(orbit[:, 1] - 1e3 * clean) < 0.004  # [mm]; the run-out has 0.019


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "orbti"], "rig: --only must be kinds of plots, such as orbit (16 in all); received 'orbti'\n"),
        (["--only", "bode"], "rig: speed must be that of a run-up or a coast-down, which changes by a tenth; received"),
        (["--from", "5"], "rig: --from and --to must be within 0 to 0.5998 s; received 5.0 to None\n"),
        (["--onyl", "orbit"], "rig: option must be one of `rig plot -h`, such as --only"),
    ],
)
def test_wrong_options_of_the_command_are_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig_plot(SESSION, "-o", tmp_path / "out", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_command_names_the_reason_why_a_folder_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: Any) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    assert rig_plot(SESSION, "-o", tmp_path) == 2
    must = f"rig: --output must be a folder that can be written to; received {tmp_path} (Read-only file system)\n"
    assert capsys.readouterr().err == must


def test_a_recording_is_read_once_for_all_plots_of_a_group(monkeypatch: pytest.MonkeyPatch) -> None:
    from replays.plots.methods import list_pictures

    read: list[str] = []
    original = Recording.samples
    monkeypatch.setattr(Recording, "samples", lambda self, *names: (read.extend(names), original(self, *names))[1])
    monkeypatch.setattr("replays.plots.signals._CACHE_BYTES", 0)  # as for a long recording
    with Recording.open(SESSION) as recording:
        pictures = list_pictures(read_signals(recording), ["timebase", "centreline", "waterfall", "trend"])
        assert list(pictures)[:3] == ["timebase-probes", "centreline-disk", "waterfall-disk"]
        for draw in pictures.values():
            draw()
    assert "probes" in read
    assert sorted(read) == sorted(set(read))


def test_interrupting_the_command_keeps_the_pictures_that_are_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: Any) -> Plot:
        raise KeyboardInterrupt

    monkeypatch.setattr("replays.plots.methods.KINDS", {"orbit": KINDS["orbit"], "trend": interrupt})
    assert rig_plot(SESSION, "-o", tmp_path) == 130
    assert capsys.readouterr().err.endswith("rig: interrupted\n")
    assert {path.suffix for path in tmp_path.iterdir()} == {".png", ".csv"}


def test_samples_of_a_client_have_the_same_plots() -> None:
    from drivers.sources import samples as client

    ours = build_whirl(0.3, 0.1, duration_s=1.0)
    theirs = client.Samples(0, 0, RATE_HZ, 1e6, ours.names, ours.units, ours.values)
    assert theirs.plot.orbit().table.values == pytest.approx(ours.plot.orbit().table.values, abs=1e-9)


def test_an_imported_recording_is_drawn(tmp_path: Path) -> None:
    from rig.cli.main import main

    ours = build_whirl(0.3, 0.1, duration_s=1.0)
    rows = np.column_stack([ours.times_s, ours.values])
    heading = '"time [s]","disk_x [mm]","disk_y [mm]","keyphasor [1]"'
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=heading, comments="", fmt="%.9g")
    for arguments in (["--template", "m.toml"], ["-m", "m.toml", "-o", "log.mcap"]):
        given = [str(tmp_path / each) if "." in each else each for each in arguments]
        with pytest.raises(SystemExit) as end:
            main(["import", str(tmp_path / "log.csv"), *given])
        assert end.value.code == 0
    table = Recording.open(tmp_path / "log.mcap").plot.orbit(components="1X").table
    assert np.ptp(table["x 1X"]) / 2.0 == pytest.approx(0.4, rel=0.01)
    assert np.ptp(table["y 1X"]) / 2.0 == pytest.approx(0.2, rel=0.01)
