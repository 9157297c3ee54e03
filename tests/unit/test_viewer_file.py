"""A recording drawn into an .rrd file, read back."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.files.schemas import event_text
from recorder.reader import Recording
from recorder.viewer import blueprint, file
from recorder.viewer.canvas import Canvas, new_stream, piped
from recorder.viewer.drawings import spectrum
from recorder.viewer.drawings.geometry import Geometry
from recorder.viewer.painter import list_missing_views
from replays.recordings.export import write_run
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import ChannelTable, default_table
from rig.cli.main import main
from rig.run.scenes import parse_scene
from rig.run.simulation import Simulation
from tests.unit.player_recording import BLOCKS, write_recording
from tests.unit.recorder_stream import generate_stream
from tests.unit.viewer_recording import (
    CLEARANCE_MM,
    DISK_RATIO,
    RADIUS_MM,
    RATE_HZ,
    SIMULATED,
    WALL,
    WALL_S,
    Saved,
    Synthetic,
)


def save(recording: Any, path: Path) -> file.Painted:
    stream = new_stream("test", batch_s=60.0)  # the size must not depend on the load of the machine
    plan = blueprint.layout(recording.table, Geometry.from_parameters(recording.parameters), live=False)
    stream.save(path, default_blueprint=plan)
    painted = file.paint(recording, Canvas(stream))
    stream.flush()
    stream.disconnect()
    return painted


@pytest.fixture(scope="module")
def recording() -> Synthetic:
    return Synthetic()


@pytest.fixture(scope="module")
def painted(recording: Synthetic, tmp_path_factory: pytest.TempPathFactory) -> tuple[file.Painted, Saved, int]:
    path = tmp_path_factory.mktemp("viewer") / "whirl.rrd"
    summary = save(recording, path)
    return summary, Saved(path), path.stat().st_size


@pytest.mark.parametrize("plane", ["ring", "disk"])
def test_orbit_turns_clockwise_on_screen_for_a_backward_whirl(painted: Any, plane: str) -> None:
    _, saved, _ = painted
    strips = saved[f"/orbit/{plane}/trace", "LineStrips2D:strips"].values[-1]
    points = np.concatenate([np.array(strip) for strip in strips])
    turn = np.unwrap(np.arctan2(points[:, 1], points[:, 0]))
    # The 2-D view's y points down: a growing angle is clockwise.
    assert np.all(np.diff(turn) >= 0.0)
    assert 2.0 < (turn[-1] - turn[0]) / (2.0 * math.pi) < 5.0
    radius = RADIUS_MM * (1.0 if plane == "ring" else DISK_RATIO)
    np.testing.assert_allclose(np.hypot(points[:, 0], points[:, 1]), radius, rtol=5e-3)
    first, second = saved[f"/orbit/{plane}/reading", "Points2D:labels"].values[-1]
    assert first == "BACKWARD whirl -83.0 Hz"
    assert second.startswith("clockwise")


def test_orbit_of_the_free_run_is_forward(painted: Any, recording: Synthetic) -> None:
    _, saved, _ = painted
    readings = saved["/orbit/ring/reading", "Points2D:labels"]
    before = [
        text for time, text in zip(readings.times_s, readings.values, strict=True) if 0.35 < time < recording.hit_s
    ]
    assert before
    assert all(first.startswith("FORWARD") for first, _ in before)


def test_clearance_circles_are_static_and_have_their_size(painted: Any) -> None:
    _, saved, _ = painted
    for plane, radius in (("ring", CLEARANCE_MM), ("disk", CLEARANCE_MM * DISK_RATIO)):
        circle = saved[f"/orbit/{plane}/clearance", "LineStrips2D:strips"]
        assert np.isnan(circle.times_s).all()
        np.testing.assert_allclose(np.hypot(*np.array(circle.values[0][0]).T), radius, rtol=1e-5)


def test_frames_come_at_20_to_30_hertz(painted: Any, recording: Synthetic) -> None:
    _, saved, _ = painted
    for path, component in (
        ("/orbit/ring/trace", "LineStrips2D:strips"),
        ("/rig3d/rotor", "Transform3D:quaternion"),
        ("/rig3d/rotor/spin", "Transform3D:quaternion"),
    ):
        rate = len(saved[path, component].values) / recording.times_s[-1]
        assert 20.0 <= rate <= 30.0


def test_spectrum_peaks_at_minus_83_hertz(painted: Any) -> None:
    _, saved, _ = painted
    side = "/spectrum/now/backward"
    abscissa = np.array(saved[side, "BarChart:abscissa"].values[0][0]["buffer"])
    bars = np.array(saved[side, "BarChart:values"].values[-1][0]["buffer"])
    assert abscissa[np.argmax(bars)] == -83.0
    assert bars.max() == pytest.approx(RADIUS_MM, rel=1e-2)
    forward = np.array(saved["/spectrum/now/forward", "BarChart:values"].values[-1][0]["buffer"])
    assert forward.max() < 1e-2 * bars.max()
    assert abscissa.min() == -spectrum.LIMIT_HZ


def test_waterfall_is_one_image_of_bounded_height(painted: Any) -> None:
    _, saved, _ = painted
    level = saved["/spectrum/waterfall/level", "DepthImage:buffer"]
    assert len(level.values) == 1
    shape = saved["/spectrum/waterfall/level", "DepthImage:format"].values[0][0]
    image = np.array(level.values[0][0], dtype=np.uint8).reshape(shape["height"], shape["width"])
    assert image.shape == (spectrum.HEIGHT, 201)
    frequency = np.arange(-200, 201, 2)
    assert abs(frequency[np.argmax(image[0])] - -83) <= 2
    assert frequency[np.argmax(image[-1])] in (6, 8)


def test_curves_are_labelled_with_their_units(painted: Any) -> None:
    _, saved, _ = painted
    labels = {
        path: saved[path, "SeriesLines:names"].values[0] for path, name in saved.columns if name.endswith(":names")
    }
    assert labels["/sensors/probes/ring"] == ["ring_x [mm]", "ring_y [mm]"]
    assert labels["/sensors/forces/P"] == ["P_N [N]", "P_S [N]", "P_E [N]", "P_W [N]"]
    assert labels["/derived/reaction"] == ["x: P_E - P_W [N]", "y: P_N - P_S [N]"]
    assert labels["/sensors/drive/speed"] == ["speed [Hz]"]
    assert labels["/sensors/hammer/hammer"] == ["hammer [N]"]
    assert {"/sensors/accelerations/inner", "/sensors/accelerations/outer"} <= set(labels)


def test_curves_are_decimated_but_whole_around_the_hammer(painted: Any, recording: Synthetic) -> None:
    _, saved, _ = painted
    ring = saved["/sensors/probes/ring", "Scalars:scalars"]
    near = np.abs(ring.times_s - recording.hit_s) < 0.049
    assert near.sum() == pytest.approx(0.098 * RATE_HZ, rel=0.01)
    far = np.abs(ring.times_s - recording.hit_s) > 0.06
    assert far.sum() <= 2100 * recording.times_s[-1]
    x = np.array([row[0] for row in ring.values])
    late = ring.times_s > recording.hit_s + 0.1
    assert x[late].max() == pytest.approx(RADIUS_MM, abs=2e-3)
    assert x[late].min() == pytest.approx(-RADIUS_MM, abs=2e-3)
    reaction = np.array(saved["/derived/reaction", "Scalars:scalars"].values)
    assert np.abs(reaction).max() == pytest.approx(523.0, rel=0.02)


def test_contact_is_labelled_by_source(painted: Any, recording: Synthetic) -> None:
    summary, saved, _ = painted
    for path in ("/contact/sensed_by_ring_probes", "/contact/truth_of_the_model"):
        states = saved[path, "StateChange:state"]
        assert [value for (value,) in states.values] == ["free", "contact"]
        assert states.times_s[1] == pytest.approx(recording.hit_s, abs=1e-3)
    assert summary.last_contact_s == pytest.approx(recording.times_s[-1])


def test_events_are_a_log_with_levels(painted: Any) -> None:
    _, saved, _ = painted
    texts = [text for (text,) in saved["/events", "TextLog:text"].values]
    assert texts[1] == "hammer: force_n 100.0, duration_ms 5.0, direction x"
    assert [level for (level,) in saved["/events", "TextLog:level"].values] == ["INFO", "INFO", "WARN", "INFO"]


def test_all_entities_have_only_simulated_and_wall_time(painted: Any) -> None:
    _, saved, _ = painted
    assert saved.timelines == {SIMULATED, WALL}
    ring = saved["/sensors/probes/ring", "Scalars:scalars"]
    np.testing.assert_allclose(ring.walls_s - WALL_S, ring.times_s, atol=1e-5)


def test_rotor_tilts_towards_the_displacement(painted: Any, recording: Synthetic) -> None:
    _, saved, _ = painted
    tilt = saved["/rig3d/rotor", "Transform3D:quaternion"]
    ((x, y, z, w),) = tilt.values[-1]
    row = np.flatnonzero(recording.times_s <= tilt.times_s[-1] + 1e-9)[-1]
    # The image of +z under the quaternion.
    end = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x)])
    expected = np.array([recording.z[row].real, recording.z[row].imag])
    np.testing.assert_allclose(end / np.hypot(*end), expected / np.hypot(*expected), atol=2e-2)
    assert np.hypot(*end) > 5.0 * 1e-3 * RADIUS_MM / 0.197


def test_the_file_is_small(painted: Any, recording: Synthetic) -> None:
    _, _, size = painted
    stored = sum(values.size for values in recording.values.values()) * 4
    assert size < 1.02 * stored  # lanes and labels have the same size for any length
    for duration_s in (1.0, 60.0, 3600.0):
        assert file.rows_per_s(duration_s) * duration_s <= file.MAX_ROWS * (1.0 + 1e-9)
        assert file.rows_per_s(duration_s) <= 2000.0
        assert duration_s / file.frame_s(duration_s) <= file.MAX_FRAMES * (1.0 + 1e-9)


def test_missing_rows_interrupt_the_curves(tmp_path: Path) -> None:
    recording = Synthetic(duration_s=0.6)
    whole = recording.samples

    def gapped(group: str) -> Any:
        samples = whole(group)
        kept = (samples.index < 4000) | (samples.index >= 5000)
        if group == "probes":
            kept = np.concatenate((np.flatnonzero(kept), [7000, 7001]))  # two rows come twice, out of order
        return type(samples)(
            name=group,
            times_s=samples.times_s[kept],
            index=samples.index[kept],
            values=samples.values[kept],
            names=samples.names,
            units=samples.units,
            rate_hz=samples.rate_hz,
        )

    recording.samples = gapped  # type: ignore[method-assign]
    save(recording, tmp_path / "gap.rrd")
    ring = Saved(tmp_path / "gap.rrd")["/sensors/probes/ring", "Scalars:scalars"]
    broken = ring.times_s[[math.isnan(row[0]) for row in ring.values]]
    assert broken == pytest.approx([0.2])
    assert not ((ring.times_s > 0.2001) & (ring.times_s < 0.2499)).any()


def test_groups_and_parameters_may_be_missing(tmp_path: Path) -> None:
    recording = Synthetic(duration_s=0.4)
    recording.table = recording.table.select_groups(("probes",))
    recording.parameters = {"set": "unknown", "values": {}}
    recording.catalogue = {}
    save(recording, tmp_path / "probes.rrd")
    saved = Saved(tmp_path / "probes.rrd")
    assert "/sensors/probes/ring" in saved.paths
    assert "/derived/reaction" not in saved.paths
    texts = [text for (text,) in saved["/events", "TextLog:text"].values]
    assert any("ring.clearance" in text for text in texts)


def test_an_empty_recording_is_drawn_as_such(tmp_path: Path) -> None:
    recording = Synthetic(duration_s=0.1)
    whole = recording.samples

    def nothing(group: str) -> Any:
        samples = whole(group)
        return type(samples)(
            name=group,
            times_s=samples.times_s[:0],
            index=samples.index[:0],
            values=samples.values[:0],
            names=samples.names,
            units=samples.units,
            rate_hz=samples.rate_hz,
        )

    recording.samples = nothing  # type: ignore[method-assign]
    assert save(recording, tmp_path / "empty.rrd").points == 0


def test_event_texts_are_one_line() -> None:
    command = {"event": "command", "tick": 1, "time_s": 0.1, "id": 3, "command": "speed", "request": {"speed_hz": 5.2}}
    assert event_text(command)[1] == "command: id 3, command speed, speed_hz 5.2"
    assert event_text({"event": "end", "reason": "completed", "rows": {"a": 1}})[1] == "end: reason completed"


def test_other_channels_get_the_matching_views() -> None:
    table = default_table()
    assert list_missing_views(table) == []
    foreign = table.groups["forces"].model_copy(
        update={"name": "log", "channels": (table.channels["P_N"].model_copy(update={"name": "rpm"}),)}
    )
    other = ChannelTable(groups={"log": foreign})
    assert [text.split(" (no")[0] for text in list_missing_views(other)] == [
        "orbit, spectrum, contact",
        "reaction",
        "turning of the rotor",
    ]
    for given, whole in ((table, True), (other, False)):
        plan = blueprint.layout(given, Geometry(), live=False)
        found = {str(view.origin) for view in _views(plan.root_container)}
        assert "/events" in found
        assert {"/orbit/ring" in found, "/spectrum/now" in found, "/contact" in found} == {whole}


def _views(container: Any) -> list[Any]:
    if not hasattr(container, "contents") or hasattr(container, "origin"):
        return [container]
    return [view for inner in container.contents for view in _views(inner)]


def test_only_views_with_a_text_in_their_title_are_shown() -> None:
    plan = blueprint.layout(default_table(), Geometry(), live=False, only="ORBIT")
    assert [str(view.origin) for view in _views(plan.root_container)] == ["/orbit/ring", "/orbit/disk"]
    for text in ("", " ", "orbits"):
        with pytest.raises(InputError, match=r"^--only must be part of a title: Orbit at the ring"):
            blueprint.layout(default_table(), Geometry(), live=True, only=text)


def test_the_command_accepts_parts_and_shows_notes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written = list(generate_stream(BLOCKS))
    note = {"event": "note", "tick": 5000, "time_s": 0.005, "text": "bearing is warm", "tags": ["look"]}
    half = next(n for n, (key, _) in enumerate(written) if n > len(written) / 2 and key == wire.sensor_key("probes"))
    halves = [[*written[:half], (wire.EVENTS, wire.encode_document(note))], written[half:]]
    files = [write_recording(tmp_path / f"{n}.mcap", half) for n, half in enumerate(halves)]
    with pytest.raises(SystemExit) as end:
        main(["view", str(files[1]), str(files[0]), "--save", str(tmp_path / "both.rrd")])
    assert end.value.code == 0
    assert f"{BLOCKS * 0.01 - 5e-5:.3f} s" in capsys.readouterr().out
    saved = Saved(tmp_path / "both.rrd")
    assert "note: bearing is warm #look" in [text for (text,) in saved["/events", "TextLog:text"].values]


def test_a_picture_gets_its_name_only_when_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded, target = tmp_path / "run.mcap", tmp_path / "run.rrd"
    write_recording(recorded, list(generate_stream(20)))
    listings: list[list[str]] = []
    paint = file.paint

    def spied(*arguments: Any) -> file.Painted:
        listings.append(sorted(path.name for path in tmp_path.glob("run.rrd*")))
        return paint(*arguments)

    def fails(*arguments: Any) -> file.Painted:
        paint(*arguments)
        raise OSError(28, "No space left on device", "run.rrd")

    target.write_text("precious")
    for change, code in ((fails, 1), (spied, 0)):
        monkeypatch.setattr(file, "paint", change)
        with pytest.raises(SystemExit) as ended:
            main(["view", str(recorded), "--save", str(target), "--force"])
        assert (ended.value.code or 0) == code
        assert sorted(path.name for path in tmp_path.iterdir()) == ["run.mcap", "run.rrd"]
        assert (target.read_bytes() == b"precious") == bool(code)
    ((name, draft),) = listings
    assert name == "run.rrd"
    assert re.fullmatch(r"run\.rrd\.[0-9a-f]{16}\.part", draft)


def test_faults_and_commands_are_marks_from_begin_to_end(tmp_path: Path) -> None:
    faults = [
        {"at_s": 0.1, "channel": "P_E", "kind": "freeze", "for_s": 0.1},
        {"at_s": 0.15, "channel": "P_E", "kind": "hum", "amplitude_v": 0.1},
        {"at_s": 0.2, "channel": "probes", "kind": "dropout", "for_s": 0.05},
    ]
    hit = {"at_s": 0.05, "command": "hammer", "force_n": 80.0}
    scene = parse_scene({"duration_s": 0.3, "drive": {"speed_hz": 6.2}, "commands": [hit], "faults": faults})
    write_run(Simulation(scene), tmp_path / "faulty.mcap")
    save(Recording.open(tmp_path / "faulty.mcap"), tmp_path / "faulty.rrd")
    saved = Saved(tmp_path / "faulty.rrd")
    for lane, expected in (
        ("faults/P_E", [(0.1, "freeze"), (0.15, "freeze + hum"), (0.2, "hum")]),
        ("faults/probes", [(0.2, "dropout"), (0.25, "sound")]),
        ("commands", [(0.05, "hammer 80"), (0.1, "-")]),
    ):
        marks = saved[f"/marks/{lane}", "StateChange:state"]
        found = [(round(time_s, 6), state) for time_s, (state,) in zip(marks.times_s, marks.values, strict=True)]
        assert found == expected


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is always full")
@pytest.mark.parametrize("size", [10, 1 << 20])
def test_a_full_disk_does_not_stop_the_writer_of_a_pipe(size: int) -> None:
    full = Path("/dev/full").open("wb", buffering=0)  # noqa: SIM115
    with pytest.raises(OSError, match="No space"), full as file, piped(file) as pipe:
        pipe.write_bytes(bytes(size))


def test_a_pipe_passes_all_bytes_and_ends_unused(tmp_path: Path) -> None:
    data = np.random.default_rng(1).bytes(1 << 20)
    for sent in (data, None):
        with (tmp_path / "file").open("wb") as file, piped(file) as pipe:
            if sent is not None:
                pipe.write_bytes(sent)
        assert (tmp_path / "file").read_bytes() == (sent or b"")
