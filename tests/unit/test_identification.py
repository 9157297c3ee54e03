"""`rig identify`: input, output and refusals; judgement of a fit; length of the window."""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.export import write_run
from replays.recordings.identification import ask, identify
from replays.recordings.identification.horizon import find_horizon
from replays.recordings.identification.judgement import Finding, widen_interval
from replays.recordings.identification.request import measure_noise
from replays.recordings.identification.window import Window
from replays.recordings.resimulation.experiment import Experiment
from rig.base.errors import InputError
from rig.cli.main import main
from rig.physics.parameters import load_parameters
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation
from tests.commands import run as command


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "h.mcap"
    simulation = Simulation(load_scene("hammer", {"duration_s": 0.035, "contact.friction": 0.24}))
    write_run(simulation, path)
    return path


def run(*arguments: str | Path) -> int:
    return command("identify", *arguments)


def test_identification_writes_a_usable_parameter_set_and_a_report(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fitted, page = tmp_path / "fitted.toml", tmp_path / "page.html"
    keys = "contact.friction,contact.stiffness,contact.smoothing_speed,hammer.1.force_n"
    window = ("--from", "0.015", "--to", "0.03")
    status = run(file, "--fit", keys, "--parameters", "corrected", *window, "-o", fitted, "--report", page)
    output = capsys.readouterr().out
    assert status == 0
    assert "contact.smoothing_speed" in output
    assert "not seen" in output
    document = tomllib.loads(fitted.read_text(encoding="utf-8"))
    assert document["base"] == "corrected"
    assert set(document["contact"]) == {"friction", "stiffness"}  # an unidentified value stays unchanged
    parameters = load_parameters(str(fitted))
    friction = parameters.entries["contact.friction"]
    assert friction.kind == "fitted"
    assert "h.mcap, 0.0150 to" in friction.source
    assert friction.value == pytest.approx(0.24, rel=1e-3)
    assert "# hammer.1.force_n = " in fitted.read_text(encoding="utf-8")
    assert (
        Simulation(load_scene("hammer", {"parameters": str(fitted)})).model.constants.contact.friction == friction.value
    )
    assert page.read_bytes().count(b"data:image/png") == 2
    assert run(file, "--fit", "contact.friction", "-o", fitted) == 2
    assert "--force replaces one" in capsys.readouterr().err
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["fitted.toml", "page.html"]


def test_json_has_null_for_unidentified_values(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(file, "--fit", "contact.friction,magnet.stiffness", "--from", "0", "--to", "0.018", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    friction, magnet = document["values"]["contact.friction"], document["values"]["magnet.stiffness"]
    assert friction["standing"] == "not seen"
    assert friction["value"] is None
    assert friction["half_width_95"] is None
    assert magnet["value"] == pytest.approx(1.7, abs=0.05)
    assert magnet["half_width_95"] > 0.0


def test_bounds_decide_which_values_are_identified(file: Path) -> None:
    recording = Recording.open(file)

    def half_width(given: dict[str, tuple[float, float]]) -> tuple[str, float]:
        question = ask(
            recording, Experiment.from_recording(recording), ["magnet.stiffness"], window=(0.0, 0.015), bounds=given
        )
        finding = identify(question).judgement.findings[0]
        return finding.standing, finding.half_width

    standing, wide = half_width({})
    assert standing == "identified"
    assert half_width({"magnet.stiffness": (1.7 - wide / 2, 1.7 + wide / 2)})[0] == "not seen"


def test_an_interval_wider_than_the_prior_is_no_result(file: Path) -> None:
    recording = Recording.open(file)
    (unknown,) = ask(recording, Experiment.from_recording(recording), ["hammer.1.force_n"]).unknowns
    finding = Finding(unknown, 110.0, 1.0, "identified", "identified")
    wider = widen_interval(finding, 20.0)
    assert (wider.standing, wider.half_width) == ("identified", 21.0)
    lost = widen_interval(finding, unknown.reach)
    assert (lost.standing, lost.half_width) == ("not seen", math.inf)
    assert lost.words.endswith("its interval would be wider than the value itself")


def test_a_prior_narrows_the_interval_as_two_measurements_do(file: Path) -> None:
    recording = Recording.open(file)
    experiment = Experiment.from_recording(recording)
    ask_for = {"keys": ["magnet.stiffness"], "window": (0.0, 0.01), "channels": ["disk_x"]}
    alone = identify(ask(recording, experiment, **ask_for)).judgement.findings[0].half_width
    prior = {"magnet.stiffness": (1.7, alone / 1.96)}
    both = identify(ask(recording, experiment, **ask_for, priors=prior)).judgement.findings[0]
    assert both.half_width == pytest.approx(alone / np.sqrt(2.0), rel=0.05)


def test_lost_samples_are_left_out(file: Path) -> None:
    recording = Recording.open(file)
    question = ask(recording, Experiment.from_recording(recording), ["contact.friction"])
    whole = Window(question, 0.03)
    question.observation.values[100:120, 3] = np.nan
    window = Window(question, 0.03)
    residuals = window.residuals(np.zeros(1))
    assert np.isfinite(residuals).all()
    assert not residuals[100:120, 3].any()
    assert whole.rows == window.rows


def test_the_window_is_shorter_for_less_certain_starts(file: Path) -> None:
    recording = Recording.open(file)
    question = ask(recording, Experiment.from_recording(recording), ["magnet.stiffness", "contact.restitution"])
    window = Window(question, 0.035)
    vague, sharp = (find_horizon(window, np.zeros(2), np.diag([size, size]) ** 2) for size in (0.1, 1e-5))
    assert not vague.whole
    assert vague.time_s < 0.034
    assert sharp.whole


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fit", "contact.frictionn"], "a parameter, of a number of the scene"),
        (["--fit", "contact.frictionn"], "such as contact.friction"),
        (["--fit", "engine.step_us"], "not the simulation"),
        (["--fit", "sensors.rate_hz"], "not the simulation"),
        (["--fit", "contact.friction,contact.friction"], "different keys"),
        (["--fit", "contact.friction", "--bounds", "contact.friction=0.3:0.2"], "ascending"),
        (["--fit", "contact.friction", "--bounds", "contact.friction"], "KEY="),
        (["--fit", "contact.friction", "--prior", "contact.friction=0.25"], "+- between them"),
        (["--fit", "contact.friction", "--start", "magnet.stiffness=1"], "of a key that is fitted"),
        (["--fit", "contact.friction", "--start", "contact.friction=much"], "a number"),
        (["--fit", "contact.friction", "--channels", "truth_x"], "channels of the recording"),
        (["--fit", "contact.friction", "--from", "5", "--to", "6"], "a window with samples"),
        (["--fit", "hammer.2.force_n"], "which has 1 of hammer"),
        (["--fit", "contact.friction", "-o", "fitted.json"], "ends in .toml"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    file: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert run(file, *arguments) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1


def test_no_truth_is_read(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("truth was read")

    monkeypatch.setattr(Recording, "truth", refuse)
    recording = Recording.open(file)
    ask(recording, Experiment.from_recording(recording), ["contact.friction"])
    with pytest.raises(InputError, match="different keys"):
        ask(recording, Experiment.from_recording(recording), [])


def test_outliers_have_less_weight(file: Path) -> None:
    recording = Recording.open(file)
    errors = []
    for robust in (False, True):
        question = ask(recording, Experiment.from_recording(recording), ["magnet.stiffness"], window=(0.0, 0.02))
        question.observation.values[50:400:35, 3] += 200.0 * question.observation.noise[3]
        finding = identify(question, robust=robust).judgement.findings[0]
        errors.append(abs(finding.value - 1.7))
    assert errors[1] < 0.2 * errors[0]


def test_a_wrong_model_yields_no_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Recorded with a restitution of 0.88 and fitted with 0.9: friction and magnets would compensate for it."""
    wrong, fitted = tmp_path / "w.mcap", tmp_path / "w.toml"
    write_run(Simulation(load_scene("hammer", {"duration_s": 0.035, "contact.restitution": 0.88})), wrong)
    arguments = ("--fit", "contact.friction,magnet.stiffness", "--parameters", "corrected", "-o", fitted)
    assert run(wrong, *arguments, "--json") == 1
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert document["fits"] is False
    for key, truth in (("contact.friction", 0.25), ("magnet.stiffness", 1.7)):
        value = document["values"][key]
        assert (value["standing"], value["value"], value["half_width_95"]) == ("not explained", None, None)
        found = re.search(r"the fit ended at ([0-9.]+).* may have moved it by (\S+)", value["words"])
        assert found is not None
        assert abs(float(found[1]) - truth) < float(found[2]) < 0.2 * truth
    assert not fitted.exists()
    assert "not written" in captured.err


@pytest.mark.parametrize(("lacking", "widened"), [(0.0, False), (0.8, True)])
def test_a_small_misfit_widens_the_intervals_by_its_size(lacking: float, widened: bool, file: Path) -> None:
    recording = Recording.open(file)
    question = ask(recording, Experiment.from_recording(recording), ["magnet.stiffness"], window=(0.0, 0.025))
    times_s, noise = question.observation.times_s, question.observation.noise
    question.observation.values[:, :4] += np.sin(2e3 * times_s)[:, None] * lacking * noise[:4]
    judged = identify(question).judgement
    assert judged.fits
    assert (judged.inflation > 3.0) is widened


def test_a_log_without_a_scene_uses_a_given_scene(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("--fit", "magnet.stiffness", "--from", "0", "--to", "0.02", "--channels", "ring_x,ring_y", "--json")
    assert run(file, *arguments) == 0
    own = json.loads(capsys.readouterr().out)
    assert run(file, *arguments, "--scene", "hammer") == 0
    given = json.loads(capsys.readouterr().out)
    assert given["values"] == own["values"]
    assert [channel["name"] for channel in given["channels"]] == ["ring_x", "ring_y"]


def test_noise_is_measured_if_the_table_has_none() -> None:
    noise = np.random.default_rng(1).normal(0.0, 0.02, 4000)
    smooth = np.sin(np.linspace(0.0, 30.0, 4000))
    assert measure_noise(smooth + noise) == pytest.approx(0.02, rel=0.1)


def test_samples_starting_after_the_impacts_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "late.mcap"
    simulation = Simulation(load_scene("hammer", {"duration_s": 0.3}))
    write_run(simulation, path)
    recording = Recording.open(path)
    question = ask(
        recording, Experiment.from_recording(recording), ["contact.friction", "magnet.stiffness"], window=(0.25, 0.3)
    )
    with pytest.raises(InputError, match="before the first contacts"):
        identify(question)


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("quiet") / "q.mcap"
    simulation = Simulation(load_scene("stable-run", {"duration_s": 0.5, "sensors.rate_hz": 2000}))
    write_run(simulation, path)
    return path


def test_a_late_begin_without_contact_needs_no_spread(quiet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From 0.37 s on, 10 % of the stiffness reverse the transient: the search reduces its step."""
    begun = ("--from", "0.37", "--start", "magnet.stiffness=1.65", "--json")
    assert run(quiet, "--fit", "contact.friction,magnet.stiffness", *begun) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["spread_made_smaller"]["magnet.stiffness"] < 0.1
    assert document["values"]["contact.friction"]["standing"] == "not seen"
    stiffness = document["values"]["magnet.stiffness"]
    assert abs(stiffness["value"] - 1.7) < 2.0 * stiffness["half_width_95"] < 1e-2


def test_nuisance_values_do_not_lengthen_the_window(quiet: Path) -> None:
    """Friction cannot be identified without contact: if requested, the window grows to the end of the samples."""
    recording = Recording.open(quiet)

    def end_s(along: tuple[str, ...]) -> float:
        keys = ["magnet.stiffness", "contact.friction"]
        question = ask(recording, Experiment.from_recording(recording), keys, window=(0.0, 0.3), nuisances=along)
        return identify(question, precision=1e-2).window.end_s

    assert end_s(()) == pytest.approx(0.3, abs=1e-3)
    assert end_s(("contact.friction",)) < 0.25


def test_parts_of_a_recording_are_one(tmp_path: Path, file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for path, span in zip(parts, (("--to", "0.01"), ("--from", "0.01")), strict=True):
        with pytest.raises(SystemExit):
            main(["cut", str(file), "-o", str(path), *span])
    capsys.readouterr()

    def value(*files: Path) -> float:
        assert run(*files, "--fit", "magnet.stiffness", "--from", "0", "--to", "0.018", "--json") == 0
        return json.loads(capsys.readouterr().out)["values"]["magnet.stiffness"]["value"]

    assert value(*reversed(parts)) == pytest.approx(value(file), rel=1e-9)
