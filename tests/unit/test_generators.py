"""Test signals: every kind against its closed form, to the bit of the converter."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.export import write_run
from replays.recordings.validation import validate
from rig.base.errors import InputError
from rig.channels.generators import KINDS, Instants, chips, multisine_phases
from rig.channels.sensors.noise import noise_streams
from rig.physics.kernels.signals import N_ROW
from rig.run.offline import simulate
from rig.run.scenes import Scene, load_scene, parse_scene, scene_document, scene_names
from rig.run.simulation import Simulation

SIGNALS: dict[str, dict[str, Any]] = {
    "sine": {"amplitude_v": 4.0, "frequency_hz": 997.3},
    "two-tone": {"amplitude_v": 4.0, "frequencies": [79.0, 1999.0]},
    "chirp": {"amplitude_v": 4.0, "frequencies": [1.0, 9000.0], "period_s": 0.07},
    "step": {"amplitude_v": 2.0, "period_s": 0.01},
    "pulse": {"amplitude_v": 2.0, "frequency_hz": 60.0},
    "prbs": {"amplitude_v": 2.0, "frequency_hz": 4000.0, "order": 9},
    "multisine": {"amplitude_v": 4.0, "frequencies": [100.0, 200.0, 300.0, 500.0, 800.0]},
    "ramp": {"period_s": 0.05},
    "quiet": {},
}


def scene_of(generator: dict[str, Any], **more: Any) -> Scene:
    return parse_scene({"name": "test", "duration_s": 0.2, "generator": generator, **more})


def closed_form(kind: str, given: dict[str, Any], t: list[Fraction], ahead: Fraction) -> np.ndarray:
    """Compute the wave by its equation, in rational time; phases are reduced before they become floating point."""

    def cycles(hz: Fraction, start: Fraction = ahead) -> np.ndarray:
        return np.array([float((hz * each + start) % 1) for each in t])

    f = Fraction(str(given.get("frequency_hz", 1)))
    tones = [Fraction(str(hz)) for hz in given.get("frequencies", [])]
    period = Fraction(str(given.get("period_s", 1)))
    part = [(each / period + ahead) % 1 for each in t]
    match kind:
        case "sine":
            return np.sin(2.0 * np.pi * cycles(f))
        case "two-tone":
            return (np.sin(2.0 * np.pi * cycles(tones[0])) + np.sin(2.0 * np.pi * cycles(tones[1]))) / 2.0
        case "chirp":
            s = [each * period for each in part]
            turns = [tones[0] * x + (tones[1] - tones[0]) * x * x / (2 * period) for x in s]
            return np.sin(2.0 * np.pi * np.array([float(each % 1) for each in turns]))
        case "step":
            return np.array([-1.0 if each < Fraction(1, 2) else 1.0 for each in part])
        case "pulse":
            return np.array([1.0 if (f * each + ahead) % 1 < Fraction(1, 36) else 0.0 for each in t])
        case "prbs":
            length = 2 ** given["order"] - 1
            shift = round(ahead * length)
            return np.array([chips(given["order"], 1)[(int(f * each // 1) + shift) % length] for each in t])
        case "multisine":
            phases, peak = multisine_phases(tuple(given["frequencies"]), None)
            return np.sum([np.cos(2 * np.pi * cycles(hz) + p) for hz, p in zip(tones, phases, strict=True)], 0) / peak
        case "ramp":
            return np.array([2.0 * float(each) - 1.0 for each in part])
    return np.zeros(len(t))


@pytest.mark.parametrize("rate_hz", [20_000, 51_200])
@pytest.mark.parametrize("kind", SIGNALS)
def test_counts_are_the_closed_form_to_half_a_step_of_the_converter(kind: str, rate_hz: int) -> None:
    given = SIGNALS[kind]
    shifted = {"offset_v": 0.25} if kind == "quiet" else {"phase_deg": 36.0, "delay_us": 30.0, "offset_v": 0.25}
    scene = scene_of(
        {"kind": kind, **given, "channels": {"P_E": shifted}}, sensors={"noise": False, "rate_hz": rate_hz}
    )
    simulation = Simulation(scene)
    counts = np.concatenate([simulation.advance(20_000).samples["forces"].values for _ in range(5)])
    channels = scene.table.groups["forces"].channels
    t = [Fraction(n, rate_hz) for n in range(len(counts))]
    for name, late, ahead, middle in (("P_N", 0, 0, 0.0), ("P_E", Fraction(30, 10**6), Fraction(1, 10), 0.25)):
        c = next(c for c, channel in enumerate(channels) if channel.name == name)
        late, ahead = (0, 0) if kind == "quiet" else (late, ahead)
        wave = closed_form(kind, given, [each - late for each in t], Fraction(ahead))
        peak = channels[c].adc_v if kind == "ramp" else given.get("amplitude_v", 0.0)
        volts = np.clip(middle + peak * wave, -10.0, 10.0 - channels[c].lsb_v)
        off = np.abs(counts[:, c] * channels[c].lsb_v - volts).max() / channels[c].lsb_v
        assert off <= 0.5 + 1e-4
        times_s = np.arange(len(counts)) / rate_hz
        known = np.clip(scene.sources()[name].volts(times_s), -10.0, 10.0 - channels[c].lsb_v)
        assert np.abs(counts[:, c] * channels[c].lsb_v - known).max() / channels[c].lsb_v <= 0.5 + 1e-4


@pytest.mark.parametrize("kind", SIGNALS)
def test_a_wave_is_as_exact_after_a_day_as_at_the_start(kind: str) -> None:
    source = scene_of({"kind": kind, **SIGNALS[kind]}).sources()["disk_x"]
    index = 86_399 * 51_200 + 777 + np.arange(500)
    found = source.compute_wave(Instants.from_samples(index, 51_200))
    expected = closed_form(kind, SIGNALS[kind], [Fraction(int(n), 51_200) for n in index], Fraction(0))
    assert np.abs(found - expected).max() < 1e-10


@pytest.mark.parametrize("name", ["test-prbs", "test-multisine", "test-whirl"])
def test_how_a_run_is_cut_changes_no_bit(name: str) -> None:
    def run(block_ms: int, rates: bool) -> list[bytes]:
        changes = {"sensors.rate_hz": 51_200} if rates else {"drive.speed_hz": 13.7}
        simulation = Simulation(load_scene(name, changes))
        frames = [simulation.advance(1000 * block_ms) for _ in range(300 // block_ms)]
        edges = [f.edges.tick + f.edges.values[:, 0] for f in frames if f.edges is not None]
        groups = [np.concatenate([f.samples[g].values for f in frames]).tobytes() for g in simulation.table.groups]
        return [*groups, np.concatenate(edges).tobytes() if edges else b""]

    for rates in (False, True):
        assert run(1, rates) == run(10, rates) == run(300, rates)


def test_a_snapshot_continues_bit_by_bit() -> None:
    simulation = Simulation("test-sine")
    simulation.advance(10_000)
    kept = simulation.snapshot()
    first = simulation.advance(10_000).samples["probes"].values
    simulation.restore(kept)
    assert np.array_equal(simulation.advance(10_000).samples["probes"].values, first)


@pytest.mark.parametrize("order", range(3, 15))
def test_a_prbs_correlates_with_itself_at_no_other_shift(order: int) -> None:
    sequence = chips(order, 5)
    spectrum = np.fft.rfft(sequence)
    correlation = np.fft.irfft(spectrum * spectrum.conj(), len(sequence))
    assert correlation[0] == pytest.approx(2**order - 1)
    assert np.abs(correlation[1:] + 1.0).max() < 1e-6


def test_channels_of_a_prbs_differ_by_their_shift() -> None:
    sources = load_scene("test-prbs").sources()
    index = np.arange(0, 4095 * 5)
    waves = {name: source.compute_wave(Instants.from_samples(index, 20_000)) for name, source in sources.items()}
    shifts = []
    for wave in waves.values():
        lagged = np.fft.irfft(np.fft.rfft(wave) * np.fft.rfft(waves["disk_x"]).conj(), len(wave))
        shifts.append(int(np.argmax(lagged)))
    assert shifts == [-round(4095 * n / 15) % 4095 * 5 for n in range(15)]
    fewer = load_scene("test-prbs", {"sensors.groups": ["forces"]}).sources()
    assert np.array_equal(fewer["P_W"].compute_wave(Instants.from_samples(index, 20_000)), waves["P_W"])


@pytest.mark.parametrize("crest", [None, 2.0, 3.5, 7.0])
def test_a_multisine_has_the_documented_crest_factor(crest: float | None) -> None:
    options = {} if crest is None else {"crest": crest}
    frequencies = [257.0 * k for k in range(1, 32)]
    source = scene_of({"kind": "multisine", "amplitude_v": 3.0, "frequencies": frequencies, **options}).sources()["P_N"]
    period_s = 1.0 / 257.0
    volts = source.volts(np.arange(100_000) * period_s / 100_000)
    assert np.abs(volts).max() == pytest.approx(3.0, rel=1e-4)
    assert np.abs(volts).max() / np.sqrt(np.mean(volts**2)) == pytest.approx(crest or 1.760, rel=1e-3)
    levels = np.abs(np.fft.rfft(volts))[1:32]
    assert np.ptp(levels) / levels.mean() < 1e-9


def test_a_ramp_takes_every_code_of_a_converter_of_12_bits(tmp_path: Path) -> None:
    (tmp_path / "twelve.toml").write_text('drop = ["forces"]\n[channels.disk_x]\nadc_bits = 12\n')
    scene = load_scene("test-ramp", {"channels": str(tmp_path / "twelve.toml"), "generator.period_s": 1.0})
    scene = scene.model_copy(update={"sensors": scene.sensors.model_copy(update={"noise": False})})
    counts = Simulation(scene).advance(1_000_000).samples["probes"].values[:, 0]
    codes, times = np.unique(counts, return_counts=True)
    assert np.array_equal(codes, np.arange(-2048, 2048))
    assert set(times[1:-1]) <= {4, 5}


def test_the_residual_is_the_noise_of_the_sensor() -> None:
    scene = load_scene("test-sine", {"duration_s": 1.0})
    quiet = load_scene("test-sine", {"duration_s": 1.0, "sensors.noise": False})
    loud, still = (Simulation(each).advance(1_000_000).samples["probes"].values for each in (scene, quiet))
    channels = scene.table.groups["probes"].channels
    residual = (loud - still) * np.array([channel.lsb_v for channel in channels])
    for c, channel in enumerate(channels):
        bits = np.random.SFC64(0)
        bits.state = {**bits.state, "state": {"state": noise_streams([channel.name], scene.seed)[0]}}
        drawn = channel.noise_v * np.random.Generator(bits).standard_normal(len(residual))
        assert np.abs(residual[:, c] - drawn).max() <= 1.001 * channel.lsb_v


def test_amplitude_in_units_uses_the_channels_calibration() -> None:
    settings = {"amplitude": 1.5, "offset": 0.25, "frequency_hz": 50.0, "channels": {"P_N": {"amplitude_v": 1.0}}}
    run = simulate(scene_of({"kind": "sine", **settings}, sensors={"noise": False}))
    disk, force = run.samples["disk_x"], run.samples["P_N"]
    assert (disk.max(), disk.min()) == pytest.approx((1.75, -1.25), abs=1e-6)
    assert force.max() == pytest.approx(1000.25, abs=1e-2)  # 1 mV/N


def test_edges_and_drive_channels_follow_the_nominal_speed_and_are_quiet_without() -> None:
    settings = {"kind": "quiet"}
    run = simulate(scene_of(settings, drive={"speed_hz": 13.7}, sensors={"noise": False}))
    assert run.edges_s == pytest.approx(np.arange(1, 3) / 13.7, abs=2e-12)
    assert run.samples["speed"] == pytest.approx(13.7, abs=1e-5)
    rising = np.flatnonzero(np.diff(run.samples["keyphasor"]) > 0.5) + 1
    assert np.array_equal(rising, np.ceil(run.edges_s * 20_000))
    assert simulate(scene_of(settings)).edges_s.size == 0


def test_a_waveform_repeats_its_points() -> None:
    scene = load_scene("test-whirl", {"sensors.noise": False})
    waveform = scene.generator.file if scene.generator is not None else None
    assert waveform is not None
    volts = scene.sources()["ring_y"].volts(np.arange(3 * 367) / 5000.0)
    values = np.tile(waveform.values["ring_y"], 3)
    channel = scene.table.channels["ring_y"]
    assert (volts - channel.bias_v) / channel.sensitivity_v == pytest.approx(values, abs=1e-9)
    whole = parse_scene(scene_document(scene))
    assert whole == scene


WRONG = [
    ({"frequency_hz": 50.0}, "generator.kind must be one of sine"),
    ({"kind": "sinus", "amplitude_v": 1.0}, "generator.kind must be 'sine'"),
    ({"kind": "sine", "frequency_hz": 50.0}, "generator.amplitude_v must be given with kind sine"),
    ({"kind": "sine", "amplitude_v": 1.0}, "generator.frequency_hz must be given with kind sine"),
    ({"kind": "sine", "amplitude_v": 1.0, "amplitude": 1.0, "frequency_hz": 5.0}, "generator.amplitude must be left"),
    ({"kind": "sine", "amplitude_v": 1.0, "frequency_hz": 10_000.0}, "generator.frequency_hz must be below 10000 Hz"),
    ({"kind": "sine", "amplitude_v": 1.0, "frequency_hz": "5"}, "generator.frequency_hz must be a valid number"),
    ({"kind": "sine", "amplitude_v": 1.0, "frequency_hz": 5.0, "crest": 2.0}, "generator.crest must be left out with"),
    ({"kind": "quiet", "amplitude_v": 1.0}, "generator.amplitude_v must be left out with kind quiet"),
    ({"kind": "two-tone", "amplitude_v": 1.0, "frequencies": [1.0, 2.0, 3.0]}, "generator.frequencies must be two"),
    ({"kind": "prbs", "amplitude_v": 1.0, "frequency_hz": 20_001.0, "order": 9}, "generator.frequency_hz must be at"),
    ({"kind": "prbs", "amplitude_v": 1.0, "frequency_hz": 4000.0, "order": 40}, "generator.order must be less than"),
    (
        {"kind": "multisine", "amplitude_v": 1.0, "frequencies": [1.0, 2.0], "crest": 9.0},
        "generator.crest must be",
    ),
    (
        {"kind": "multisine", "amplitude_v": 1.0, "frequencies": [1.0, 2.0001]},
        "generator.frequencies must be",
    ),
    ({"kind": "quiet", "channels": {"disc_x": {"offset_v": 1.0}}}, "generator.channels must be names of channels"),
    ({"kind": "quiet", "channels": {"disk_x": {"period_s": 1.0}}}, "generator.channels.disk_x.period_s must be left"),
    ({"kind": "recorded"}, "generator.file must be given with kind recorded"),
    ({"kind": "recorded", "file": "nowhere.csv"}, "generator.file must be a file that can be read"),
]


@pytest.mark.parametrize(("generator", "line"), WRONG, ids=[line for _, line in WRONG])
def test_errors_are_one_line_with_the_field(generator: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as error:
        scene_of(generator)
    assert str(error.value).startswith(line)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "must"),
    [
        ("", "a CSV file"),
        ("time [s],disk_x [mm]\n0,1\n1,x\n", "a CSV file"),
        ("time [s],disk_x [mm]\n0,1\n1,2\n", "of 4 rows"),
        ("time [s],disk_x [mm]\n0,1\n1,2\n2,1\n7,1\n", "of rows at one rate"),
        ("time [s],disk_x [V]\n0,1\n1,2\n2,1\n3,1\n", "with a column `disk_x [mm]`"),
    ],
)
def test_an_invalid_waveform_is_refused(text: str, must: str, tmp_path: Path) -> None:
    (tmp_path / "wave.csv").write_text(text)
    with pytest.raises(InputError, match=r"^generator\.file must be") as error:
        scene_of({"kind": "recorded", "file": str(tmp_path / "wave.csv")})
    assert error.value.must.startswith(must)


def test_physics_is_not_run_and_commands_for_it_are_refused() -> None:
    simulation = Simulation("test-sine")
    for name, request in {"hammer": {}, "speed": {"speed_hz": 5.0}, "release": {}}.items():
        with pytest.raises(InputError, match=rf"^{name} must be left out: signals of a \[generator\]"):
            simulation.submit(name, request)
    with pytest.raises(InputError, match=r"^commands must be left out with a \[generator\]"):
        scene_of({"kind": "quiet"}, commands=[{"at_s": 0.1, "command": "hammer"}])
    with pytest.raises(InputError, match=r"^scene must be one of the physics"):
        simulation.scene.check_physics()
    frame = simulation.advance(simulation.block_ticks)
    assert frame.truth == {}
    assert simulation.catalogue()["truth"] == {}
    assert not frame.rows.any()
    assert frame.rows.shape[1] == N_ROW
    assert simulation.health()["warnings"] == []
    run = simulate("test-sine", duration_s=0.01)
    assert run.names == ()
    with pytest.raises(KeyError, match="name must be one of the signals it keeps"):
        _ = run["disk_x"]
    with pytest.raises(InputError, match=r"^scene must be one of the physics"):
        simulate("test-sine", duration_s=0.01, signals=["disk_x"])
    assert simulation.parameters_document()


def test_a_signal_beyond_the_converter_is_clipped_and_reported() -> None:
    simulation = Simulation(load_scene("test-sine", {"generator.amplitude_v": 7.0}))
    channel = simulation.table.channels["hammer"]
    counts = simulation.advance(100_000).samples["hammer"].values
    assert counts.max() == 2 ** (channel.adc_bits - 1) - 1
    assert counts.min() == -(2 ** (channel.adc_bits - 1))
    (warning,) = simulation.health()["warnings"]
    assert warning.endswith("inner_x, inner_y, outer_x, outer_y, hammer")


@pytest.mark.parametrize("name", [name for name in scene_names() if name.startswith("test-")])
def test_a_recording_of_test_signals_is_reproduced_bit_by_bit(name: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(Simulation(load_scene(name, {"duration_s": 0.1})), path)
    found = validate(Recording.open(path))
    assert found.bit_exact
    assert found.good


def test_a_recording_of_other_signals_is_detected_by_channel(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(Simulation(load_scene("test-sine", {"duration_s": 0.2})), path)
    assert validate(Recording.open(path), declared=True).good
    other = {"generator.amplitude_v": 4.01}
    found = validate(Recording.open(path), changes=other)
    assert not found.bit_exact
    assert [one.good for one in found.residuals if one.channel in ("disk_x", "P_N", "hammer")] == [False] * 3


def test_files_have_the_sensors_and_no_model(tmp_path: Path) -> None:
    import soundfile

    scene = load_scene("test-sine", {"duration_s": 0.1, "sensors.noise": False})
    write_run(Simulation(scene), tmp_path / "run.wav")
    write_run(Simulation(scene), tmp_path / "run.csv")
    samples, rate = soundfile.read(tmp_path / "run.wav")
    assert rate == 20_000
    expected = scene.sources()["P_N"].volts(np.arange(2000) / 20_000)
    assert samples[:, 4] * 10.0 == pytest.approx(expected, abs=1e-6)  # full scale: the converter's range
    assert "truth" not in (tmp_path / "run.csv").read_text()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["run.csv", "run.wav", "run.wav.json"]


def test_every_kind_has_a_closed_form_here_or_plays_a_file() -> None:
    assert {*SIGNALS, "recorded"} == {*KINDS}
