"""Logs of another rig whose probes have run-out, other directions and other planes."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.validation import validate
from rig.base.errors import InputError
from rig.cli.options import subtract_run_out
from rig.cli.output.provenance import recording_origin
from tests import second_rig
from tests.commands import run_captured
from tests.unit.test_nuisance import MATRIX, QUIET, WHOLE, import_log

SESSION = Path(__file__).parents[2] / "replays/sessions/hammer-5.2.mcap"
NAMES = ("disk_x", "disk_y", "ring_x", "ring_y", "P_N", "P_E", "outer_y", "inner_x", "speed", "hammer", "keyphasor")
MAPPING = WHOLE.split("[channels.")[0] + "".join(
    f"[channels.{part}" for part in WHOLE.split("[channels.")[1:] if part.partition("]")[0] in NAMES
).replace("5000", "4000")
RUNOUT_MM = {1: 0.004, 2: 0.003, 3: 0.0015, 5: 0.001}
"""Amplitudes of a run-out by order."""


@pytest.fixture(scope="module")
def motion() -> second_rig.Motion:
    return second_rig.simulate_pulse(turned=2.1, before_s=0.42, after_s=0.06, settled_s=2.0)


def compute_runout(angle: np.ndarray, size: float = 1.0) -> np.ndarray:
    return size * sum(mm * np.cos(k * angle + 0.7 * k * k) for k, mm in RUNOUT_MM.items())


def add_runout(values: dict[str, np.ndarray], rate_hz: float, size: float = 1.0) -> dict[str, np.ndarray]:
    """Return the signals with a run-out of disk_x, by the angle from the keyphasor's edge."""
    turns = np.cumsum(values["speed"]) / rate_hz
    edge = np.flatnonzero(np.diff(values["keyphasor"]) > 0.5)[0]
    return values | {"disk_x": values["disk_x"] + compute_runout(2.0 * math.pi * (turns - turns[edge]), size)}


def import_probes(folder: Path, motion: second_rig.Motion, mapping: str = MAPPING, *, size: float = 1.0) -> Recording:
    own_s, values = second_rig.record_log(
        motion, seed=8, rate_hz=10_000.0, bandwidth_hz=4000.0, ppm=40.0,
        edit=lambda values: add_runout(values, motion.rate_hz, size) if size else values,
    )  # fmt: skip
    folder.mkdir(exist_ok=True)
    return import_log(folder, {"time": own_s, **{name: values[name] for name in NAMES}}, mapping)


def import_slow_roll(folder: Path, speed_hz: float, turns: float) -> Recording:
    """Return a log of a shaft that turns slowly, without motion of its centre."""
    rate_hz = 2000.0
    own_s = np.arange(round(turns / speed_hz * rate_hz)) / rate_hz
    angle, rng = 2.0 * math.pi * (speed_hz * own_s - 0.3), np.random.default_rng(4)
    columns = {
        "time": own_s, "speed": np.full(len(own_s), speed_hz),
        "disk_x": 0.05 + compute_runout(angle) + 4e-4 * rng.standard_normal(len(own_s)),
        "disk_y": 4e-4 * rng.standard_normal(len(own_s)),
        "keyphasor": 1.0 * (angle % (2.0 * math.pi) < 0.17),
    }  # fmt: skip
    parts = (f"[channels.{part}" for part in MAPPING.split("[channels.") if part.partition("]")[0] in columns)
    folder.mkdir(exist_ok=True)
    mapping = MAPPING.split("[channels.")[0] + "".join(parts).replace("4000", "900")
    return import_log(folder, columns, mapping, head="")


QUIET_NAMES = ("disk_x", "disk_y", "ring_x", "ring_y", "speed", "keyphasor")


@pytest.fixture(scope="module")
def quiet(motion: second_rig.Motion, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Return a log that ends before the hammer pulse, with run-out of one probe."""
    return import_quiet(
        tmp_path_factory.mktemp("quiet"), motion, lambda values: add_runout(values, motion.rate_hz), lambda text: text
    )


def import_quiet(
    folder: Path, motion: second_rig.Motion,
    edit: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], change: Callable[[str], str],
) -> Recording:  # fmt: skip
    """Return a log that ends before the hammer pulse, with changed signals and mapping."""
    own_s, values = second_rig.record_log(
        motion, seed=8, rate_hz=10_000.0, bandwidth_hz=4000.0, ppm=40.0, edit=edit
    )  # fmt: skip
    rows = own_s < 0.4
    parts = (f"[channels.{part}" for part in MAPPING.split("[channels.") if part.partition("]")[0] in QUIET_NAMES)
    mapping = MAPPING.split("[channels.")[0] + "".join(parts)
    columns = {"time": own_s[rows], **{name: values[name][rows] for name in QUIET_NAMES}}
    return import_log(folder, columns, change(mapping), QUIET)


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return import_slow_roll(tmp_path_factory.mktemp("slow"), 0.5, 6.5)


def test_run_out_of_one_probe_has_its_name(quiet: Recording) -> None:
    """It is neither hum nor unbalance, which the other probes would show."""
    found = validate(quiet).explained
    assert found is not None
    assert found.best == ("disk_x run-out",)
    assert re.search(r"disk_x run-out 0\.013\d* mm peak to peak \(1X 0\.004, 2X 0\.003, 3X", found.conclusion)


def test_a_log_without_the_run_out_of_its_slow_roll_passes(
    quiet: Recording, slow: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run_captured(capsys, "validate", str(quiet.path), "--run-out", f"{slow.path}:1-13", "--json")
    text = "; ".join(json.loads(out)["calibration"])
    assert code == 0, out
    assert re.search(
        r"run-out subtracted: disk_x 0\.0133\d* ±0\.000\d+ mm, disk_y .* from 5 revolutions at 0.5 Hz", text
    )
    assert "up to 0.7% of the 1X of unbalance" in text
    assert text.split("; up")[0] in err


def test_run_out_is_subtracted_by_the_angle_where_samples_are_read(quiet: Recording, slow: Recording) -> None:
    corrected = subtract_run_out(str(slow.path), quiet, show=print)[0]
    before, after = (one.samples("disk_x", "ring_x") for one in (quiet, corrected))
    np.testing.assert_array_equal(before["ring_x"], after["ring_x"])
    turns = 6.2 * before.times_s
    edge_s = quiet.edges()[0]
    known = compute_runout(2.0 * math.pi * (turns - 6.2 * edge_s))
    assert np.std(before["disk_x"] - after["disk_x"] - known) < 1e-4  # of 0.0037 mm
    part = corrected.between(0.1, 0.3).samples("disk_x")
    np.testing.assert_array_equal(part.values, after.select("disk_x").values[np.isin(after.times_s, part.times_s)])


def test_both_recordings_of_a_comparison_are_corrected(
    quiet: Recording, slow: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    found = []
    for options in ((), ("--run-out", str(slow.path))):
        _, out, err = run_captured(capsys, "compare", str(quiet.path), str(quiet.path), *options, "--json")
        rows = {(row["channel"], row["quantity"]): row for row in json.loads(out)["rows"]}
        found.append(rows["disk_x", "RMS"])
    assert abs(found[0]["a"] - found[1]["a"]) > 5e-4
    assert found[1]["a"] == found[1]["b"]
    assert err.count("run-out subtracted") == 1
    (corrected,) = subtract_run_out(str(slow.path), quiet, show=print)
    assert recording_origin("log", corrected)["correction"] in err  # in the head of reports


@pytest.mark.parametrize(("command", "option", "message"), [
    ("validate QUIET", "FAST", "a slow roll of at most 1.55 Hz, a quarter of the recording's speed; received 2 Hz in"),
    ("validate QUIET", "SLOW:1-5.5", "a slow roll of at least 2 whole revolutions; received 1 in"),
    ("validate QUIET", "MUTE", "used with recordings that have a keyphasor, and at least two of its passages; rec"),
    ("compare QUIET MUTE", "SLOW", "used with recordings that have a keyphasor, and at least two of its passages"),
    ("validate QUIET", "SESSION", "a slow roll of at most 1.55 Hz"),
    ("validate SESSION", "SLOW", "used with a log of another system; received"),
    ("identify SESSION --fit contact.friction", "SLOW", "used with a log of another system; received"),
    ("validate QUIET", "SLOW:4-1", "a recording, with ascending times such as SLOW.mcap:1.5-9; received"),
])  # fmt: skip
def test_an_unusable_slow_roll_is_refused(
    command: str, option: str, message: str, quiet: Recording, slow: Recording, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    paths = {"QUIET": quiet.path, "SLOW": slow.path, "SESSION": SESSION}
    if "FAST" in option:
        paths["FAST"] = import_slow_roll(tmp_path / "fast", 2.0, 6.5).path
    if "MUTE" in command + option:
        paths["MUTE"] = import_slow_roll(tmp_path / "mute", 0.5, 0.6).path
    words = f"{command} --run-out {option}"
    for name, path in paths.items():
        words = words.replace(name, str(path))
    code, out, err = run_captured(capsys, *words.split())
    assert (code, out) == (2, "")
    assert f"--run-out must be {message}" in err
    assert err.count("\n") == 1


ARM = 0.25
"""Distance of another plane of probes from the pivot [m]."""


@pytest.mark.parametrize(("plane", "angle", "good"), [
    (ARM, 140, True), pytest.param(0.26, 140, False, marks=MATRIX), pytest.param(ARM, 130, False, marks=MATRIX),
])  # fmt: skip
def test_probes_in_any_direction_and_plane_are_predicted_as_told(
    plane: float, angle: int, good: bool, motion: second_rig.Motion, tmp_path: Path
) -> None:
    """Probes at 30 and 140 degrees: the log fails if another plane or direction is told."""

    def turn(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        z = (values["disk_x"] + 1j * values["disk_y"]) * ARM / second_rig.Rig().arm_disk
        return values | {f"disk_{n}": np.real(z * np.exp(-1j * math.radians(a))) for n, a in (("x", 30), ("y", 140))}

    def tell(mapping: str) -> str:
        for old, new, degrees in (("disk_x", "right", 30), ("disk_y", "left", angle)):
            signal = f"along(shaft_x({plane}), shaft_y({plane}), {degrees})"
            lines = f'[channels.{new}]\nto = "probes"\nto_unit = "mm"\nsignal = "{signal}"\n'
            mapping = mapping.replace(f"[channels.{old}]\n", lines)
        return mapping

    assert validate(import_quiet(tmp_path, motion, turn, tell)).good == good


@pytest.mark.parametrize(("lines", "message"), [
    ('to = "probes"\nto_unit = "mm"\nsignal = "along(shaft_x(350), shaft_y(0.3), 45)"', "a distance from the pivot"),
    ('to = "probes"\nto_unit = "mm"\nsignal = "disk_z"', "channel left.signal must be one of the model's"),
])  # fmt: skip
def test_an_invalid_signal_of_a_mapping_is_refused(
    lines: str, message: str, motion: second_rig.Motion, tmp_path: Path
) -> None:
    for head, must in (("left", message), ("disk_x", "omitted, as disk_x is one of the rig's channels")):
        table = f"[channels.{head}]\n{lines}"
        with pytest.raises(InputError, match=must):
            import_quiet(tmp_path, motion, dict, lambda text, table=table: text.replace("[channels.disk_x]", table))
