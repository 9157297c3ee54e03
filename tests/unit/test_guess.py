"""Guesses for the signals of foreign logs, and no change of samples without a request."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.formats import clock
from replays.recordings.formats.conversion import Conversion, block_starts, convert, write_recording
from replays.recordings.formats.events.motion import ChannelMotion, estimate_speed
from replays.recordings.formats.guessing import noise, overview
from replays.recordings.formats.guessing.guess import Guess
from replays.recordings.formats.guessing.naming import read_name
from replays.recordings.formats.guessing.template import CHECK, guess_mapping
from replays.recordings.formats.mapping import parse_mapping
from rig.base.wire import sensor_key
from rig.serve.stream_check import Catalogue
from tests import foreign
from tests.commands import run_captured, run_for_output


@pytest.mark.parametrize(
    ("name", "kind", "place", "axis", "side"),
    [
        ("disk X", "", "disk", "x", ""),
        ("Sonde_X", "length", "", "x", ""),
        ("prox1", "length", "", "", ""),
        ("Wegaufnehmer Scheibe vertikal", "length", "disk", "y", ""),
        ("Déplacement disque horizontal", "length", "disk", "x", ""),
        ("Kraft Süd", "force", "", "", "S"),
        ("F_north", "force", "", "", "N"),
        ("LoadCellWest", "force", "", "", "W"),
        ("ai2 FN", "force", "", "", "N"),
        ("P_o", "force", "", "", "O"),
        ("FO", "force", "", "", "O"),
        ("fuerza_este", "force", "", "", "E"),
        ("Kraftaufnehmer O", "force", "", "", "O"),
        ("Beschl. Innengehäuse x", "acceleration", "inner", "x", ""),
        ("accelOuterY", "acceleration", "outer", "y", ""),
        ("Beschl. außen H", "acceleration", "outer", "x", ""),
        ("Beschl. innen V", "acceleration", "inner", "y", ""),
        ("Drehzahlsignal", "speed", "", "", ""),
        ("Shaft RPM", "speed", "", "", ""),
        ("KPH", "keyphasor", "", "", ""),
        ("hammer force", "hammer", "", "", ""),
        ("Impulshammer", "hammer", "", "", ""),
        ("oil temperature", "", "", "", ""),
        ("AI0", "", "", "", ""),
        ("F12h", "force", "", "", "N"),
        ("Prox 3h Disk", "length", "disk", "", "E"),
        ("Kraft 9 Uhr", "force", "", "", "W"),
        ("load 6 o'clock", "force", "", "", "S"),
        ("Accel 3 H", "acceleration", "", "x", ""),
    ],
)
def test_names_in_many_languages(name: str, kind: str, place: str, axis: str, side: str) -> None:
    found = read_name(name)
    assert (found.kind, found.place, found.axis, found.side) == (kind, place, axis, side)


def test_the_o_of_compass_points_is_recognised_from_the_others() -> None:
    assert read_name("Kraft O").resolve_side({"N", "S", "W", "O"}) == "E"
    assert read_name("Effort O").resolve_side({"N", "S", "E", "O"}) == "W"


LOGS = {
    "m.mf4": foreign.write_mdf, "t.tdms": foreign.write_tdms, "g.csv": foreign.write_german_csv,
    "c.csv": foreign.write_nameless_csv,
}  # fmt: skip
LINES_TO_CHECK = {"m.mf4": 1, "t.tdms": 3, "g.csv": 1, "c.csv": 3}
"""Lines to check: filters of all; which probe is x, and pulses per turn or the side of nameless forces."""


@pytest.fixture(scope="module", params=LOGS)
def log(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, tuple[float, np.ndarray]], str, list[Guess]]:
    path = tmp_path_factory.mktemp("foreign") / request.param
    kept = LOGS[request.param](path)
    return path, kept, *guess_mapping([path])


def test_each_signal_is_guessed_correctly(
    log: tuple[Path, dict[str, tuple[float, np.ndarray]], str, list[Guess]],
) -> None:
    path, kept, text, guesses = log
    found = {guess.channel: guess for guess in guesses}
    assert set(found) == set(kept)
    for channel, (_, values) in kept.items():
        np.testing.assert_allclose(found[channel].features.values, values, rtol=0, atol=1e-9)
    assert text.count(CHECK) == LINES_TO_CHECK[path.name]
    named = path.name in ("m.mf4", "g.csv")
    assert all(guess.confidence == "sure" for guess in guesses) == named
    if not named:
        assert "90° from" in found["disk_x"].why
        assert "pairs move 1.6:1, the disk more" in found["ring_x"].why
    if path.name == "c.csv":
        assert (found["speed"].unit, found["speed"].confidence) == ("rpm", "sure")
        assert "against CH8; loaded as CH4 rises" in found["P_N"].why
        assert found["P_N"].confidence == "likely"
        assert "name" in found["P_N"].asks


@pytest.mark.parametrize(
    ("names", "channels"),
    [
        (("Trigger [V]", "Grid frequency [Hz]"), ("", "speed likely")),
        (("oil film [mm]", "p [bar]"), ("", "")),
        (("prox [mm]",), ("disk_x open",)),
        (("disk_x [N]", "Wirbelstrom Ring vertikal [mil]"), ("", "ring_y sure")),
        (("Disk 1 [mm]", "Disk 2 [mm]", "Disk 3 [mm]"), ("disk_x open", "disk_y open", "")),
        (("F_N [kN]", "F_N2 [kN]"), ("P_N open", "")),
        (("F1 [N]", "F2 [N]", "F3 [N]", "F4 [N]", "F5 [N]"), ("",) * 5),
        (("Effort O [kN]", "Effort E [kN]"), ("P_W sure", "P_E sure")),
        (("disk_x [mm]", "disk_x_ [mm]"), ("disk_x sure", "")),
        (("Drehzahl [V]",), ("speed sure",)),
        (("ai0 ring x [V]", "ai1 ring y [V]"), ("ring_x sure", "ring_y sure")),
    ],
)
def test_a_signal_without_evidence_remains_an_unknown_channel(
    names: tuple[str, ...], channels: tuple[str, ...], tmp_path: Path
) -> None:
    """Noise alone: only names and units give evidence; each template imports unchanged."""
    path, t = tmp_path / "x.csv", np.arange(600) / 1000
    noise_of = np.random.default_rng(0).standard_normal((600, len(names)))
    head = ",".join(["time", *names])
    np.savetxt(path, np.column_stack([t, 0.3 + 0.1 * noise_of]), delimiter=",", header=head, comments="", fmt="%.9f")
    text, guesses = guess_mapping([path])
    assert tuple(f"{one.channel} {one.confidence}" if one.channel else "" for one in guesses) == channels
    conversion, _ = imported(path, text, tmp_path)
    assert len(conversion.channels) == len(names)


def imported(path: Path, text: str, folder: Path) -> tuple[Conversion, Recording]:
    conversion = convert([path], parse_mapping(tomllib.loads(text), name="m.toml"))
    write_recording(conversion, folder / "out.mcap")
    return conversion, Recording.open(folder / "out.mcap")


def test_samples_are_not_changed_without_a_request(
    log: tuple[Path, dict[str, tuple[float, np.ndarray]], str, list[Guess]], tmp_path: Path
) -> None:
    """Imported as guessed, without an edit: values, rates and edges are those of the log, and it can be played."""
    path, kept, text, _ = log
    conversion, recording = imported(path, text, tmp_path)
    truth = {rate: foreign.make_signals(rate) for rate in {rate for rate, _ in kept.values()}}
    assert [channel.time.split("; ")[1] for channel in conversion.channels] == ["samples as they were"] * len(kept)
    for channel, (rate, _) in kept.items():
        samples = recording.samples(channel)
        assert samples.rate_hz == pytest.approx(rate, rel=1e-10)
        assert samples.rate_hz == next(one.rate_hz for one in conversion.channels if one.name == channel)
        np.testing.assert_allclose(samples.times_s, foreign.instants(rate), rtol=0, atol=1e-9)
        scale = {"keyphasor": 5.0}.get(channel, 1.0)  # its volts
        within = {"keyphasor": 1e-3, "hammer": 0.006 if path.suffix == ".mf4" else 1e-3}.get(channel, 1e-3)
        np.testing.assert_allclose(samples[channel], scale * truth[rate][channel], rtol=0, atol=within)
    edges = recording.edges()
    np.testing.assert_allclose(edges, foreign.pulse_times()[: len(edges)], rtol=0, atol=5e-9)
    assert len(edges) == 8
    assert len(conversion.pulses) == 1
    assert conversion.pulses[0].force_n == pytest.approx(foreign.PULSE_FORCE_N, rel=0.01)
    assert conversion.pulses[0].at_s == pytest.approx(foreign.IMPACT_S, abs=2e-4)
    assert not recording.doubts
    formats = Catalogue.read(recording.catalogue).get_formats()
    for name in recording.table.groups:
        key = sensor_key(name)
        assert {formats[key].find_mismatch(block) for block in recording.blocks(key)} == {""}
    untold = [remark for remark in conversion.remarks if remark.startswith("no bandwidth_hz for")]
    assert len(untold) == 1
    assert "µs late" in untold[0]
    if path.name == "c.csv":  # the error of a clock is not corrected
        assert recording.table.groups["probes"].rate_hz == 10_000
        assert all(channel.drift_ppm == pytest.approx(80.0, abs=1e-3) for channel in conversion.channels)
        ring = recording.table.channels["ring_x"]
        assert ring.noise_v / abs(ring.sensitivity_v) == pytest.approx(3e-4, rel=0.06)


@pytest.mark.parametrize(("method", "gain"), [("linear", 0.8165), ("polyphase", 0.9694)])
def test_noise_reduced_by_resampling_is_not_reported(method: str, gain: float, tmp_path: Path) -> None:
    """Straight lines between samples at all phases leave 2/3 of the variance of white noise."""
    path, rate = tmp_path / "x.csv", 10_000.8
    t, generator = np.arange(30_000) / rate, np.random.default_rng(4)
    values = np.sin(40 * t) + 0.003 * generator.standard_normal(len(t))
    np.savetxt(path, np.column_stack([t, values]), delimiter=",", header="time,d [mm]", comments="", fmt="%.9f")
    text = f"[resample]\nmethod = '{method}'\nrate_hz = 10000\n[channels.disk_x]\nsource = 'd'\n"
    conversion, recording = imported(path, text, tmp_path)
    samples = recording.samples("probes")
    residual = samples["disk_x"][200:-200] - np.sin(40 * samples.times_s[200:-200])
    noise_v = recording.table.channels["disk_x"].noise_v
    assert float(residual.std()) == pytest.approx(gain * 0.003, rel=0.02)
    assert noise_v == pytest.approx(float(residual.std()), rel=0.04)
    said_gain = float(conversion.channels[0].time.split("; noise ")[1].split(" ")[0])
    assert said_gain == pytest.approx(gain, rel=0.01)


def behind_a_low_pass(white: np.ndarray, corner_hz: float, rate_hz: float) -> np.ndarray:
    from scipy.signal import butter, sosfilt

    return np.asarray(sosfilt(butter(4, corner_hz, fs=rate_hz, output="sos"), white, axis=0))


@pytest.mark.parametrize("corner_hz", [3000.0, 5000.0, 7000.0, None])
def test_noise_of_any_colour_and_where_it_ends(corner_hz: float | None) -> None:
    """Noise older than a low-pass ends at its corner; a converter's own gives no evidence."""
    rate, several = 20_000, 8
    generator = np.random.default_rng(2)
    white = 1e-3 * generator.standard_normal(40_000 * several)
    if corner_hz is not None:
        white = behind_a_low_pass(white, corner_hz, rate * several)
    recorded = white[::several]
    signal = recorded + 0.5 * np.sin(2 * np.pi * 6.2 * np.arange(len(recorded)) / rate)
    assert noise.estimate_noise(signal) == pytest.approx(float(recorded.std()), rel=0.07)
    found = noise.corner_hz(signal, float(rate))
    assert found is None if corner_hz is None else found == pytest.approx(corner_hz, rel=0.05)


def test_a_detected_corner_is_proposed_for_confirmation(tmp_path: Path) -> None:
    rate, several, path = 20_000, 8, tmp_path / "x.csv"
    generator = np.random.default_rng(2)
    wide = generator.standard_normal((20_000 * several, 2))
    filtered = behind_a_low_pass(wide, 4000.0, rate * several)[::several]
    rows = np.column_stack([np.arange(len(filtered)) / rate, filtered])
    np.savetxt(path, rows, delimiter=",", header="time,inner_x [m/s^2],inner_y [m/s^2]", comments="", fmt="%.9f")
    text, _ = guess_mapping([path])
    questions = [line for line in text.splitlines() if CHECK in line]
    assert len(questions) == 1
    assert questions[0].endswith(f"# {CHECK}: the noise of 2 of 2 signals ends there, as after a low-pass of order 4")
    mapping = parse_mapping(tomllib.loads(text), name="m.toml")
    assert mapping.channels["inner_y"].bandwidth_hz == pytest.approx(4000.0, rel=0.06)


@pytest.mark.parametrize(("taken", "entry"), [("evenly", '[time]\nstamps = "line"\n'), ("when stamped", "[resample]\n"),
                                             ("at rest", 'stamps = "line"    # PLEASE CHECK')])  # fmt: skip
def test_whether_samples_or_only_their_stamps_are_uneven(taken: str, entry: str, tmp_path: Path) -> None:
    generator, path = np.random.default_rng(3), tmp_path / "x.csv"
    even = np.arange(3000) / 1000
    stamps = even + generator.uniform(-2e-4, 2e-4, 3000)
    noise_of = 1e-3 * generator.standard_normal(3000)
    values = noise_of + (0.0 if taken == "at rest" else np.sin(60 * (even if taken == "evenly" else stamps)))
    rows = np.column_stack([stamps, values])
    np.savetxt(path, rows, delimiter=",", header="time,P_N [N]", comments="", fmt="%.9f")
    text, _ = guess_mapping([path])
    assert entry in text
    conversion, recording = imported(path, text, tmp_path)
    assert ("samples as they were" in conversion.channels[0].time) == (taken != "when stamped")
    found, at_s = recording.samples("P_N"), conversion.document["zero_s"]
    if taken != "at rest":
        np.testing.assert_allclose(found["P_N"], np.sin(60 * (found.times_s + at_s)), rtol=0, atol=6e-3)


def test_a_channels_setting_overrides_the_default() -> None:
    data = {"defaults": {"bandwidth_hz": 4000.0}, "channels": {
        "disk_x": {"source": "a"}, "speed": {"source": "b", "bandwidth_hz": 200.0},
    }}  # fmt: skip
    mapping = parse_mapping(data, name="m.toml")
    assert {name: one.bandwidth_hz for name, one in mapping.channels.items()} == {"disk_x": 4000.0, "speed": 200.0}
    assert mapping.document()["channels"]["disk_x"]["bandwidth_hz"] == 4000.0, "as the recording has it"


@pytest.mark.parametrize("rate", [20_001.6, 19_998.4, 12.5, 48_000.123])
def test_blocks_begin_nearest_to_a_tick(rate: float) -> None:
    first = 12.34
    starts = block_starts(20_000 if rate > 100.0 else 200, first, rate)
    ticks = first + np.array(starts[1:]) * 1e6 / rate
    assert np.abs(ticks - np.rint(ticks)).max() < (0.1 if rate > 100.0 else 0.5)
    assert np.diff(starts).max() <= max(1, round(0.05 * rate))


def test_resampling_gains_are_those_of_the_filters() -> None:
    generator = np.random.default_rng(0)
    values, axis = generator.standard_normal(60_000), clock.TimeAxis(0.0, 1000.0, 60_000)
    for rate in (999.0, 400.0):
        instants = np.arange(round(59.0 * rate)) / rate
        straight = clock.interpolate_linear(values, axis, instants)
        assert float(straight.std()) == pytest.approx(clock.linear_gain(axis, instants), rel=0.02)
        banded = clock.resample_polyphase(values, axis, 0.0, rate, len(instants))[100:-100]
        assert float(banded.std()) == pytest.approx(clock.polyphase_gain(axis, rate), rel=0.02)


def test_a_log_is_imported_in_one_step(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "g.csv"
    foreign.write_german_csv(path, rate_hz=2000.0)
    printed = run_for_output(capsys, "import", path)
    assert "Kraft O [N]" in printed
    assert "Not contained in the logs:\n  [defaults] bandwidth_hz = HZ: the anti-aliasing low-pass" in printed
    assert list(tmp_path.iterdir()) == [path], "nothing is written unasked"
    found = json.loads(run_for_output(capsys, "import", path, "--json"))
    assert {one["signal"]: one["channel"] for one in found}["Kraft O"] == "P_E"
    printed = run_for_output(capsys, "import", path, "-o", tmp_path / "g.mcap")
    assert "imported by the guess" in printed
    assert "assumed, not in the mapping: [defaults] bandwidth_hz" in printed
    assert len(Recording.open(tmp_path / "g.mcap").table.channels) == 13


def test_a_picture_shows_short_impacts_in_long_signals(tmp_path: Path) -> None:
    path, t = tmp_path / "x.csv", np.arange(6100) / 3000
    np.savetxt(path, np.column_stack([t, foreign.hammer(t), np.sin(40 * t)]), delimiter=",", comments="", fmt="%.6f",
               header="time,hammer [N],disk_x [mm]")  # fmt: skip
    _, guesses = guess_mapping([path])
    times, values = overview.reduce_samples(guesses[0].features.axis.instants(), guesses[0].features.values)
    assert len(times) == len(values) == 2000
    assert values.max() == guesses[0].features.extent[1]
    assert times[-1] > 0.998 * t[-1]
    overview.draw(guesses, tmp_path / "x.png")
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("name", "at_s", "channel"),
    [("tach [V]", (0.1, 0.5), "keyphasor"), ("keyphasor", (0.3,), "keyphasor"), ("tach [V]", (0.3,), "speed"),
     ("gate [V]", (0.1, 0.5), "")],
)  # fmt: skip
def test_few_pulses_are_interpreted_by_the_name(
    name: str, at_s: tuple[float, ...], channel: str, tmp_path: Path
) -> None:
    """A short log, or a slow shaft. If there was no impact, the template explains how to specify that."""
    path, t = tmp_path / "x.csv", np.arange(3000) / 3000
    train = np.sum([(t >= at) & (t < at + 0.01) for at in at_s], axis=0)
    np.savetxt(path, np.column_stack([t, train]), delimiter=",", header=f"time,{name}", comments="", fmt="%.6f")
    text, (found,) = guess_mapping([path])
    assert found.channel == channel
    assert ("\n[keyphasor]" in text) == (channel == "keyphasor")
    assert "# commands = []" in text


def test_a_question_on_a_commented_line_has_no_comment_sign(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, t = tmp_path / "x.csv", np.arange(3000) / 3000
    noise = np.random.default_rng(1).standard_normal(3000)
    np.savetxt(path, np.column_stack([t, noise]), delimiter=",", header="t [s],disk_x [mm]", comments="")
    out = run_for_output(capsys, "import", path)
    assert "[experiment] speed_hz = HZ: no speed" in out


@pytest.mark.parametrize("unit", ["TTL", "counts", ""])
def test_the_unit_of_a_keyphasor_does_not_stop_an_import(
    unit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, t = tmp_path / "x.csv", np.arange(3000) / 3000
    columns = np.column_stack([t, foreign.make_keyphasor(t), foreign.hammer(t)])
    np.savetxt(path, columns, delimiter=",", header=f"time [s],keyphasor [{unit}],hammer [N]", comments="", fmt="%.6f")
    out = run_for_output(capsys, "import", path, "-o", tmp_path / "x.mcap", "--wide")
    assert len(Recording.open(tmp_path / "x.mcap").edges()) > 2
    assert ("not the unit" in out) == bool(unit)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((), "FILE must be given: the logs to import"),
        (("x.csv", "-m", "m.toml"), "--output must be given: a recording to write"),
        (("x.csv", "-m", "m.toml", "--template", "t.toml"), "import must be given either --mapping or --template"),
        (("x.csv", "--template", "t.toml", "-o", "o.mcap"), "--output must be left out with --template"),
        (("x.csv", "-m", "m.toml", "-o", "o.mcap", "--picture", "p.png"), "--picture must be left out with --mapping"),
        (("x.csv", "--picture", "p.gif"), "--picture must be"),
        (("--template", "t.toml", "--picture", "p.png"), "FILE must be given"),
        (("x.csv", "-o", "o.wav"), "--output must be a file name that ends in .mcap"),
        (("nowhere.csv",), "file must be a file that can be read"),
        (("x.csv", "-o", "o.mcap"), "the guess (--template writes it): time.rate_hz must be set"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    arguments: tuple[str, ...],
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("x.csv").write_text("x [mm]\n1\n2\n3\n")
    Path("m.toml").write_text("[channels.disk_x]\nsource = 'x'\n")
    status, _, complaints = run_captured(capsys, "import", *arguments)
    assert (status, complaints.count("\n")) == (2, 1), complaints
    assert complaint in complaints
    assert {path.name for path in tmp_path.iterdir()} == {"x.csv", "m.toml"}


@pytest.mark.parametrize("missing", [("disk_x",), ("disk_y",), ("disk_x", "disk_y"), ()])
def test_a_channel_without_a_number_does_not_turn(missing: tuple[str, ...]) -> None:
    axis = clock.TimeAxis(first_s=0.0, rate_hz=2000.0, rows=40_000)
    angle = 2.0 * np.pi * 6.2 * axis.instants()
    signals = {"disk_x": np.cos(angle), "disk_y": np.sin(angle)}
    motions = [
        ChannelMotion(name, np.full(axis.rows, np.nan) if name in missing else x, axis) for name, x in signals.items()
    ]
    found = estimate_speed(motions)
    if len(missing) == 2:
        assert found is None
    else:
        assert found is not None
        assert found[0] == pytest.approx(6.2, abs=0.05)
