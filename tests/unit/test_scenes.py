"""Scenes: shipped ones, valid fields, overrides by dotted key, and the document that runs again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.base.errors import InputError
from rig.channels.orbit import synchronous
from rig.channels.table import default_table
from rig.physics.parameters import load_parameters
from rig.run.commands.table import COMMANDS, HammerCommand, ReleaseCommand, SpeedCommand, check_command
from rig.run.offline import simulate
from rig.run.scenes import Scene, load_scene, parse_scene, read_value, scene_document, scene_names

PERIODS = [n for n in range(1, 10_001) if 1_000_000 % n == 0]
"""Periods of whole ticks whose rates are whole as well [us]."""


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


hammers = st.fixed_dictionaries(
    {"command": st.just("hammer")},
    optional={
        "force_n": numbers(1.0, 1000.0),
        "duration_ms": numbers(0.5, 50.0),
        "direction": st.sampled_from(["x", "y", "-x", "-y"]) | numbers(-360.0, 360.0),
    },
)
speeds = st.fixed_dictionaries({"command": st.just("speed"), "speed_hz": numbers(0.0, 15.0)})
requests = hammers | speeds | st.just({"command": "release"})
# At most one impact per half second, and one release of the magnets.
timed = st.lists(requests, max_size=4, unique_by=lambda request: request["command"] == "release" or id(request)).map(
    lambda found: [{"at_s": 0.5 * n, **request} for n, request in enumerate(found)]
)
profiles = st.lists(st.tuples(numbers(0.01, 10.0), numbers(0.0, 15.0)), min_size=1, max_size=5).map(
    lambda steps: [[sum(step for step, _ in steps[1 : n + 1]), speed] for n, (_, speed) in enumerate(steps)]
)


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, Any]:
    """Draw a valid scene, as TOML would give it."""
    step = draw(st.sampled_from([1, 5, 10, 25, 50]))
    rates = [1_000_000 // period for period in PERIODS if period % step == 0]
    drive = {"mode": draw(st.sampled_from(["torque", "ideal"]))}
    drive |= {"profile": draw(profiles)} if draw(st.booleans()) else {"speed_hz": draw(numbers(0.0, 15.0))}
    return {
        "title": draw(st.text(max_size=10)),
        "parameters": draw(st.sampled_from(["corrected", "as-printed", "dtu-2019"])),
        "set": draw(st.dictionaries(st.just("contact.friction"), numbers(0.0, 2.0), max_size=1)),
        "duration_s": draw(numbers(1e-3, 86_400.0)),
        "seed": draw(st.integers(0, 2**63 - 1)),
        "drive": drive,
        "commands": draw(timed.flatmap(st.permutations)),
        "engine": {"name": draw(st.sampled_from(["split", "rk4", "rk8", "tsit5", "taylor"])), "step_us": step},
        "sensors": {
            "groups": draw(st.permutations(list(default_table().groups)).map(lambda names: names[:3])),
            "rate_hz": draw(st.sampled_from([rate for rate in rates if rate >= 100])),
            "truth_rate_hz": draw(st.sampled_from([rate for rate in rates if rate >= 10])),
            "noise": draw(st.booleans()),
        },
    }


@given(data=scenes())
@settings(max_examples=60, deadline=None)
def test_document_of_a_scene_is_the_scene(data: dict[str, Any]) -> None:
    scene = parse_scene(data)
    document = json.loads(json.dumps(scene_document(scene), allow_nan=False))
    assert parse_scene(document) == scene
    for command, given_command in zip(scene.commands, data["commands"], strict=True):
        assert command.at_s == given_command["at_s"]
        fields = {key: value for key, value in given_command.items() if key != "at_s"}
        assert command.request == COMMANDS[fields["command"]](**fields)


@pytest.mark.parametrize("name", scene_names())
def test_shipped_scenes_load_and_have_a_description(name: str) -> None:
    scene = load_scene(name)
    assert scene.name == name
    assert scene.title
    assert scene.parameters == "corrected"
    assert scene.engine.name == "split"
    assert parse_scene(scene_document(scene)) == scene


def test_hammer_scene_is_the_papers() -> None:
    scene = load_scene("hammer")
    (impact,) = scene.commands
    assert scene.drive.speed_hz == 6.2
    assert impact.request == HammerCommand(force_n=100.0, duration_ms=5.0, direction="x")


def test_a_scene_file_has_a_name_and_flat_commands(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('[[commands]]\nat_s = 0.5\ncommand = "speed"\nspeed_hz = 3\n[set]\n"contact.friction" = 0.3\n')
    scene = load_scene(path)
    assert scene.name == "mine"
    assert scene.commands[0].request == SpeedCommand(speed_hz=3.0)
    assert scene.load_parameters()["contact.friction"] == 0.3
    assert scene.load_parameters().entries["contact.friction"].source == "scene mine"


@given(rate=st.integers(100, 1_000_000), step=st.integers(1, 1000), truth=st.sampled_from([10, 1000, 2000, 40_000]))
def test_rates_with_few_sample_positions_between_rows_are_accepted(rate: int, step: int, truth: int) -> None:
    data = {"engine": {"step_us": step}, "sensors": {"rate_hz": rate, "truth_rate_hz": truth}}
    try:
        scene = parse_scene(data)
    except InputError as refused:
        error = refused
    else:
        error = None
    if error is not None:
        assert error.field == "sensors.rate_hz"
        for word in error.must.split("such as ")[1].split(" or "):
            assert abs(int(word) - rate) < 2_000
            parse_scene({**data, "sensors": {**data["sensors"], "rate_hz": int(word)}})
        return
    rows = 1_000_000 // scene.row_ticks
    assert 1_000_000 % scene.row_ticks == 0
    assert (1_000_000 // truth) % scene.row_ticks == 0
    assert rate // math.gcd(rate, rows) <= 4096
    assert rows >= 7.5 * max(channel.bandwidth_hz for channel in scene.table.channels.values())


def test_common_laboratory_rates_are_accepted_with_any_step() -> None:
    for rate in (1_000, 1_024, 8_192, 25_600, 44_100, 48_000, 51_200, 65_536, 96_000, 102_400, 131_072, 204_800):
        for step in (1, 7, 25, 50, 1000):
            parse_scene({"engine": {"step_us": step}, "sensors": {"rate_hz": rate}})


def test_truth_is_sampled_on_whole_microseconds() -> None:
    with pytest.raises(InputError, match=r"^sensors\.truth_rate_hz must be a rate whose period is a whole number"):
        parse_scene({"sensors": {"truth_rate_hz": 3_000}})


@pytest.mark.parametrize(
    "profile",
    [
        [[1.0, 1.0]],
        [[0.0, 1.0], [0.0, 2.0]],
        [[0.0, 1.0], [0.009, 2.0]],
        [[0.0, 1.0], [2.0, 1.0], [1.0, 1.0]],
        [[0.0, -1.0]],
    ],
)
def test_profile_ascends_from_zero_and_never_turns_backward(profile: list[list[float]]) -> None:
    with pytest.raises(InputError, match=r"^drive\.profile must be points of "):
        parse_scene({"drive": {"profile": profile}})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("5.2", 5.2),
        ("3", 3),
        ("true", True),
        ("[1, 2]", [1, 2]),
        ('"a b"', "a b"),
        ("internal-sphere", "internal-sphere"),
        ("", ""),
        ("2026-01-01x", "2026-01-01x"),
    ],
)
def test_values_on_the_command_line_are_toml_or_plain_text(text: str, value: object) -> None:
    read = read_value(text)
    assert read == value
    assert type(read) is type(value)


def test_overrides_reach_scene_and_parameters() -> None:
    scene = load_scene(
        "hammer",
        {
            "drive.speed_hz": "5.2",
            "contact.friction": 0.3,
            "contact.stiffness": "external-sphere",
            "sensors.noise": "false",
            "duration_s": 0.5,
            "sensors.groups": '["probes", "drive"]',
        },
    )
    assert scene.drive.speed_hz == 5.2
    assert scene.set == {"contact.friction": 0.3, "contact.stiffness": "external-sphere"}
    assert scene.load_parameters()["contact.friction"] == 0.3
    assert (scene.sensors.noise, scene.duration_s, scene.sensors.groups) == (False, 0.5, ("probes", "drive"))
    assert scene.sensors.truth_rate_hz == 2_000, "other fields keep their values"
    assert load_scene("hammer").set == {}, "the shipped scene stays as it is"


def test_points_of_a_profile_may_have_the_minimum_distance() -> None:
    profile = [[0.01 * n, 1.0] for n in range(100)]
    assert len(parse_scene({"drive": {"profile": profile}}).drive.profile) == 100


IMPACT = {"command": "hammer", "duration_ms": 5.0}
RELEASE = {"command": "release"}


@pytest.mark.parametrize(
    ("commands", "field"),
    [
        ([{"at_s": 0.1, **IMPACT}, {"at_s": 0.1, **IMPACT}], "hammer"),
        ([{"at_s": 0.104, **IMPACT}, {"at_s": 0.1, **IMPACT}], "hammer"),
        ([{"at_s": 0.1, **RELEASE}, {"at_s": 0.2, **RELEASE}], "release"),
    ],
)
def test_contradicting_commands_are_refused(commands: list[dict[str, Any]], field: str) -> None:
    with pytest.raises(InputError, match=f"^{field} must be "):
        parse_scene({"commands": commands})
    apart = [{**command, "at_s": 0.3 * n} for n, command in enumerate(commands)]
    if field == "hammer":
        assert len(parse_scene({"commands": apart}).commands) == 2


def test_released_magnets_cannot_be_released_again() -> None:
    with pytest.raises(InputError, match=r"^release must be given once, while the magnets hold"):
        parse_scene({"initial": {"magnets": False}, "commands": [{"at_s": 0.1, **RELEASE}]})


def test_a_speed_from_outside_replaces_the_profile() -> None:
    scene = load_scene("run-up", {"drive.speed_hz": 4.0})
    assert (scene.drive.profile, scene.drive.speed_hz) == ((), 4.0)


def test_overrides_do_not_change_a_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("[drive]\nspeed_hz = 3.0\n")
    assert load_scene(path, {"drive.speed_hz": 4.0}).drive.speed_hz == 4.0
    assert load_scene(path).drive.speed_hz == 3.0


@pytest.mark.parametrize("key", ["drive.speed", "contact.frictoin", "sensors", "nothing", "drive.speed_hz.x", "", "."])
def test_unknown_or_whole_key_is_refused(key: str) -> None:
    value: Any = 3
    with pytest.raises(InputError) as caught:
        load_scene("hammer", {key: value})
    assert str(caught.value).startswith(f"{key} must be ")


def test_unknown_key_names_its_neighbours() -> None:
    with pytest.raises(InputError, match=r"drive\.speed_hz"):
        load_scene("hammer", {"drive.sped_hz": 3})


@pytest.mark.parametrize("text", ["drive = 3\n", 'drive = "fast"\n'])
def test_override_inside_a_value_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match="drive must be"):
        load_scene(path, {"drive.speed_hz": 1.0})


def test_override_with_a_wrong_set_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("set = 4\n")
    with pytest.raises(InputError, match="set must be"):
        load_scene(path, {"contact.friction": 0.1})


@pytest.mark.parametrize(
    "overrides",
    [
        {"drive.speed_hz": 15.1},
        {"drive.speed_hz": 5.0, "drive.top_speed": 4.9},
        {"drive.profile": "[[0.0, 1.0], [1.0, 16.0]]"},
        {"commands": '[{ at_s = 0.1, command = "speed", speed_hz = 15.5 }]'},
    ],
)
def test_no_speed_of_a_scene_is_above_the_drives(overrides: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"must be at most drive\.top_speed = "):
        load_scene("stable-run", overrides)


def test_the_drives_limit_is_a_valid_speed() -> None:
    assert load_scene("stable-run", {"drive.speed_hz": 15.0}).drive.speed_hz == 15.0


@given(direction=st.sampled_from(["x", "y", "-x", "-y"]) | numbers(-360.0, 360.0))
def test_direction_of_an_impact_is_a_unit_vector(direction: str | float) -> None:
    assert math.hypot(*HammerCommand(direction=direction).cosines) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize(
    ("direction", "cosines"),
    [
        ("x", (1, 0)),
        ("y", (0, 1)),
        ("-x", (-1, 0)),
        ("-y", (0, -1)),
        (90.0, (0, 1)),
        (-90.0, (0, -1)),
        (30.0, (math.sqrt(0.75), 0.5)),
    ],
)
def test_direction_turns_from_x_toward_y(direction: Any, cosines: tuple[float, float]) -> None:
    assert HammerCommand(direction=direction).cosines == pytest.approx(cosines, abs=1e-15)


@pytest.mark.parametrize(
    ("name", "request_", "command"),
    [
        ("hammer", {}, HammerCommand()),
        (
            "hammer",
            {"force_n": 1.0, "duration_ms": 50.0, "direction": 360},
            HammerCommand(force_n=1.0, duration_ms=50.0, direction=360.0),
        ),
        ("speed", {"speed_hz": 0}, SpeedCommand(speed_hz=0.0)),
        ("release", {}, ReleaseCommand()),
    ],
)
def test_valid_commands(name: str, request_: dict[str, Any], command: object) -> None:
    assert check_command(name, request_) == command


def test_a_request_cannot_become_another_command() -> None:
    with pytest.raises(InputError, match=r"speed\.command must be 'speed'; received 'release'"):
        check_command("speed", {"speed_hz": 1.0, "command": "release"})


def test_scenes_are_frozen() -> None:
    scene = load_scene("hammer")
    with pytest.raises(ValueError, match="frozen"):
        scene.seed = 2
    assert Scene() == Scene()


def test_the_scenes_of_the_critical_speed_pass_it_without_contact() -> None:
    # Slower than 5 Hz and faster than 13 Hz the shaft moves little: the middle of each run has the resonance.
    for name, start_s, end_s in (("critical-speed", 0.0, 20.0), ("coast-down", 10.0, 30.0)):
        scene = load_scene(name)
        assert {round(speed_hz) for _, speed_hz in scene.drive.profile} == {1, 15}
        profile = dict(scene.drive.profile)
        middle = [[0.0, np.interp(start_s, [*profile], [*profile.values()])]]
        middle += [[end_s - start_s, np.interp(end_s, [*profile], [*profile.values()])]]
        changes = {"drive.profile": middle, "duration_s": end_s - start_s, "sensors.rate_hz": 1000}
        run = simulate(name, changes, signals=["normal_force"])
        speed_hz, vector = synchronous(run.samples["disk_x"], run.samples.times_s, run.edges_s)
        assert run["normal_force"].max() == 0.0
        assert 0.4 < abs(vector).max() < 0.65  # [mm]; at rest e / (2 zeta) = 0.62 mm
        assert 9.1 < speed_hz[abs(vector).argmax()] < 10.1  # mode at 9.57 Hz; later the faster the speed changes


def test_slow_roll_shows_the_run_out_of_its_table() -> None:
    run = simulate("slow-roll", duration_s=6.0, signals=[])
    for channel, phase in (("disk_x", 0.9), ("disk_y", 0.9 - math.pi / 2)):
        _, vector = synchronous(run.samples[channel], run.samples.times_s, run.edges_s)
        expected = 0.025 * np.exp(1j * phase)
        assert abs(vector[1:-1].mean() - expected) < 0.0015  # and a little of the unbalance


def test_the_hammer_test_at_rest_stays_free_and_shows_both_modes() -> None:
    run = simulate("hammer-shaft", signals=["normal_force", "disk_x", "disk_y"])
    assert run["normal_force"].max() == 0.0
    for channel in ("disk_x", "disk_y"):
        spectrum = abs(np.fft.rfft(run[channel]))
        assert 9.0 < spectrum[1:].argmax() / 48.0 < 11.0
    assert [event["event"] for event in run.events] == ["hammer"] * 6


def test_the_hammer_test_of_the_houses_rings_at_the_mode_of_both_on_the_transducers() -> None:
    run = simulate("hammer-house", signals=["normal_force"])
    parameters = load_parameters()
    inner, outer = parameters["house.inner_mass"], parameters["house.outer_mass"]
    both_hz = math.sqrt(parameters["house.pair_stiffness_vertical"] * (1 / inner + 1 / outer)) / (2 * math.pi)
    late = run.times_s > 1.5
    spectrum = abs(np.fft.rfft(run.samples["inner_y"][late]))
    found_hz = spectrum[1:].argmax() / 0.5
    assert both_hz < found_hz < 1.06 * both_hz  # stiffer by the beams and the contact with the shaft
