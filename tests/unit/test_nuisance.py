"""Logs of other systems: what they do not tell exactly comes out of them, and is named."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.experiment import Experiment
from replays.recordings.formats.conversion import convert, write_recording
from replays.recordings.formats.mapping import load_mapping
from replays.recordings.identification.nuisance import check_begin, is_imported, nuisances_of, tune
from replays.recordings.sensitivity import ANGLE, value_of, with_values
from rig.errors import InputError
from rig.offline import simulate
from rig.scenes import load_scene

AT_S = 5.6
PHASE = 2.1


def foreign_log(
    folder: Path, *, ppm: float, rate_hz: int, start_s: float, length_s: float, changes: dict[str, float] | None = None
) -> Path:
    """A rig of this kind behind a recorder of another make: mils at 45 degrees, pound-force, a clock of its own."""
    from scipy.interpolate import CubicSpline

    run = simulate(
        load_scene(
            "hammer",
            {
                "duration_s": start_s + length_s + 0.05,
                "shaft.unbalance_phase": PHASE,
                **(changes or {}),
                "sensors.rate_hz": 40_000,
                "sensors.noise": False,
                "sensors.groups": ["probes", "drive", "hammer"],
                "commands": [
                    {"at_s": AT_S, "command": "hammer", "force_n": 60.0, "duration_ms": 5.2, "direction": "x"}
                ],
            },
        )
    )
    clock_s = np.arange(round(length_s * rate_hz)) / rate_hz
    there_s = start_s + clock_s * (1.0 - ppm * 1e-6)
    rng = np.random.default_rng(3)

    def sampled(name: str) -> np.ndarray:
        channel = run.table.channels[name]
        noise = channel.noise_v / abs(channel.sensitivity_v) * rng.standard_normal(len(there_s))
        return CubicSpline(run.times_s, run.samples[name])(there_s) + noise

    x, y = sampled("ring_x"), sampled("ring_y")
    columns = {
        "time [s]": clock_s,
        "A [mil]": (x + y) / math.sqrt(2.0) / 0.0254,
        "B [mil]": (y - x) / math.sqrt(2.0) / 0.0254,
        "tacho [rpm]": 60.0 * sampled("speed"),
        "blow [lbf]": sampled("hammer") / 4.4482216152605,
    }
    path = folder / "log.csv"
    np.savetxt(path, np.column_stack(list(columns.values())), fmt="%.12g", delimiter=",", header=",".join(columns),
               comments="")  # fmt: skip
    return path


MAPPING = """
[hammer]
[experiment]
scene = "hammer"
speed_hz = "measured"
commands = "detected"
[[rotate]]
channels = ["ring_x", "ring_y"]
angles_deg = [45, 135]
[channels.ring_x]
source = "A"
bandwidth_hz = 5000
[channels.ring_y]
source = "B"
bandwidth_hz = 5000
[channels.speed]
source = "tacho"
bandwidth_hz = 200
[channels.hammer]
source = "blow"
bandwidth_hz = 5000
"""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("log")
    path = foreign_log(folder, ppm=40.0, rate_hz=12_800, start_s=5.43219, length_s=0.4)
    (folder / "log.toml").write_text(MAPPING, encoding="utf-8")
    write_recording(convert([path], load_mapping(folder / "log.toml")), folder / "log.mcap")
    return Recording.open(folder / "log.mcap")


# Motion dies out in a tenth of the time: the scene needs 1 s to settle, not 5.
DAMPED = {"shaft.damping_ratio_x": 0.15, "shaft.damping_ratio_y": 0.15}


@pytest.fixture(scope="module")
def damped_log(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("damped")
    path = foreign_log(folder, ppm=40.0, rate_hz=12_800, start_s=5.43219, length_s=0.4, changes=DAMPED)
    changes = ", ".join(f'"{key}" = {value}' for key, value in DAMPED.items())
    settled = f"[experiment]\nlead_s = 1\nset = {{ {changes} }}"
    (folder / "log.toml").write_text(MAPPING.replace("[experiment]", settled), encoding="utf-8")
    write_recording(convert([path], load_mapping(folder / "log.toml")), folder / "log.mcap")
    return Recording.open(folder / "log.mcap")


def test_a_log_is_one_and_its_scene_has_run_for_long_before_it(log: Recording) -> None:
    assert is_imported(log)
    experiment = Experiment.of(log)
    assert experiment.first_s >= 3.0
    assert value_of(experiment, "hammer.1.at_s") - experiment.first_s == pytest.approx(AT_S - 5.43219, abs=2e-4)


def test_clock_angle_speed_and_blow_come_out_of_a_log(damped_log: Recording) -> None:
    experiment = Experiment.of(damped_log)
    found = tune(damped_log, experiment)
    fitted = {one.key: one for one in found.fitted}
    assert found.chi2 < 1.25  # the noise is read off a short log
    assert fitted["drive.speed_hz"].value == pytest.approx(6.2, abs=2e-3)
    assert fitted["hammer.1.force_n"].value == pytest.approx(60.0, rel=1e-3)
    assert fitted["hammer.1.duration_ms"].value == pytest.approx(5.2, rel=1e-3)
    # The blow as the log has it, on the model's clock, is at the tick where the scene has it.
    began_s = (AT_S - 5.43219) * (1.0 + 40e-6) + experiment.first_s
    shift_s = fitted["clock.offset_s"].value
    scene_s = round(value_of(found.experiment, "hammer.1.at_s") * 1e6) * 1e-6
    assert began_s - shift_s == pytest.approx(scene_s, abs=5e-6)
    assert any(one.line.startswith("time: shifted by ") for one in found.fitted)
    # The angle at the first row of the log, which ran for 5.43219 s before.
    speed = fitted["drive.speed_hz"].value
    there = value_of(found.experiment, "shaft.unbalance_phase") + 2.0 * math.pi * speed * (experiment.first_s - shift_s)
    off = there - PHASE - 2.0 * math.pi * 6.2 * 5.43219
    assert math.remainder(off, 2.0 * math.pi) == pytest.approx(0.0, abs=0.02)


def test_a_clock_is_no_number_of_the_experiment(log: Recording) -> None:
    experiment = Experiment.of(log)
    assert with_values(experiment, {"clock.offset_s": 1e-3, "clock.rate_ppm": 3.0}) == experiment
    turned = with_values(experiment, {ANGLE: 0.5, "drive.speed_hz": experiment.scene.drive.speed_hz + 0.01})
    ahead = value_of(turned, "shaft.unbalance_phase") - value_of(experiment, "shaft.unbalance_phase")
    assert ahead == pytest.approx(0.5 - 2.0 * math.pi * 0.01 * experiment.first_s)


def test_nuisances_are_those_that_an_experiment_has() -> None:
    quiet = Experiment(load_scene("stable-run", {"duration_s": 0.1}))
    assert not any(key.startswith("hammer") for key in nuisances_of(quiet))
    assert "drive.speed_hz" not in nuisances_of(quiet, besides=["drive.speed_hz"])


def test_impacts_of_a_log_from_the_middle_of_a_run_are_not_searched(log: Recording) -> None:
    experiment = Experiment.of(log)
    blow_s = value_of(experiment, "hammer.1.at_s")
    with pytest.raises(InputError, match="a log that begins with the run"):
        check_begin(experiment, None)
    check_begin(experiment, blow_s - 0.01)
    check_begin(Experiment(load_scene("hammer")), None)
