"""Faults of channels on command: each kind by its equation, on its rows, and no effect elsewhere."""

from __future__ import annotations

import inspect
import math
from typing import Any

import numpy as np
import pytest

from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.validation import validate
from rig.base.errors import InputError
from rig.channels.faults import KINDS
from rig.channels.faults.kind import Draws
from rig.cli.commands import fault as command
from rig.run.commands.table import check_command
from rig.run.scenes import load_scene, parse_scene, scene_document
from rig.run.simulation import Simulation
from tests.commands import run_captured
from tests.fault_cases import EXAMPLES
from tests.physics.test_identification import recorded

SCENE = load_scene("hammer", {"duration_s": 0.4, "drive.speed_hz": 15.0})
FROM, TO = 0.1, 0.3
CHANNELS = tuple(SCENE.table.channels)


def run(*faults: dict[str, Any], cut: int = 50_000, scene: Any = SCENE) -> tuple[dict[str, np.ndarray], list[Any]]:
    """Return the counts of every channel by name, edges under "edges" [ticks], and events."""
    simulation, found, edges, events = Simulation(scene), dict[str, list[np.ndarray]](), [np.empty(0)], []
    for fault in faults:
        while simulation.tick < round(1e6 * fault.get("at_s", FROM)):
            step(simulation, cut, found, edges, events)
        simulation.submit("fault", {key: value for key, value in fault.items() if key != "at_s"})
    while simulation.tick < simulation.end_tick:
        step(simulation, cut, found, edges, events)
    return {name: np.concatenate(parts) for name, parts in found.items()} | {"edges": np.concatenate(edges)}, events


def step(simulation: Simulation, cut: int, found: Any, edges: Any, events: Any) -> None:
    frame = simulation.advance(cut)
    for group, block in frame.samples.items():
        for c, name in enumerate(simulation.table.groups[group].names):
            found.setdefault(name, []).append(block.values[:, c])
    if frame.edges is not None:
        edges.append(frame.edges.values[:, 0] + frame.edges.tick)
    events += frame.events


def find_differences(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> dict[str, tuple[int, int]]:
    """Return the first and last rows that differ, by channel."""
    rows = {name: np.flatnonzero(one[name] != other[name]) for name in one if name != "edges"}
    return {name: (int(each[0]), int(each[-1])) for name, each in rows.items() if len(each)}


@pytest.fixture(scope="module")
def sound() -> dict[str, np.ndarray]:
    return run()[0]


def example(kind: str, channel: str) -> dict[str, Any]:
    return {"channel": channel, "kind": kind, "for_s": TO - FROM, **EXAMPLES[kind]}


def test_every_number_of_a_kind_is_an_option() -> None:
    numbers = {field for kind in KINDS.values() for field in kind.model_fields if field != "kind"}
    own = {"channel", "kind", "for_s", "clear", "listed", "connection", "form"}
    assert set(inspect.signature(command.fault).parameters) == numbers | own


@pytest.mark.parametrize("kind", KINDS)
def test_an_unknown_parameter_is_refused_with_the_known_ones(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The rig, and the command without a rig, refuse it; the line names the number, or option, and the kind."""
    takes = [name for name in KINDS[kind].model_fields if name != "kind"]
    words = f"must be left out: {kind} takes {', '.join(takes) or 'no numbers'}; received "
    others = {field for each in KINDS.values() for field in each.model_fields} - {*takes, "kind"}
    for name in others:
        with pytest.raises(InputError) as caught:
            check_command("fault", {"channel": "disk_x", "kind": kind, name: 1})
        assert str(caught.value) == f"fault.{kind}.{name} {words}1"
    option = f"--{min(others).replace('_', '-')}"
    status, _, line = run_captured(capsys, "fault", "disk_x", kind, option, "1")
    assert (status, line.startswith(f"rig: {option} of {kind} {words}")) == (2, True), line


@pytest.mark.parametrize("kind", EXAMPLES)
def test_a_fault_is_on_its_channels_and_rows_alone(kind: str, sound: dict[str, np.ndarray]) -> None:
    """Independent of the cuts; after its end, every count is the original."""
    channel = "keyphasor" if KINDS[kind].channel_only else "disk_x"
    there, events = run(example(kind, channel))
    found = find_differences(there, sound)
    (begun,) = (event for event in events if event["event"] == "fault")
    assert set(found) == set(begun["channels"])
    (rate_hz,) = {SCENE.table.channels[name].rate_hz for name in found}
    for first, last in found.values():
        assert begun["first_row"][SCENE.table.channels[channel].group] == FROM * rate_hz
        assert FROM * rate_hz <= first <= last < TO * rate_hz
        # Random faults, or those once per turn, may come later; the others appear within the filter's first samples.
        assert first <= FROM * rate_hz + 4 or kind in (
            "intermittent",
            "spikes",
            "miss-pulses",
            "extra-pulses",
            "edge-jitter",
        )
    finely, _ = run(example(kind, channel), cut=1_000)
    assert not find_differences(there, finely)
    np.testing.assert_array_equal(there["edges"], finely["edges"])


@pytest.mark.parametrize("kind", EXAMPLES)
def test_every_kind_has_an_effect_on_every_channel_or_is_refused(kind: str, sound: dict[str, np.ndarray]) -> None:
    other = {"swap": "other", "crosstalk": "source"}.get(kind)
    faults, refusing = list[dict[str, Any]](), Simulation(SCENE)
    for channel in CHANNELS:
        numbers = EXAMPLES[kind] | ({other: "P_N" if channel != "P_N" else "disk_x"} if other else {})
        fault = {"channel": channel, "kind": kind, **numbers}
        try:
            refusing.submit("fault", fault)
        except InputError:
            assert kind == "noise" or KINDS[kind].channel_only
        else:
            faults.append(fault)
    assert len(faults) == 1 if KINDS[kind].channel_only else len(faults) >= len(CHANNELS) - 2
    # On all channels at once, except for kinds that make one channel show another.
    for together in [[fault] for fault in faults] if other else [faults]:
        found = find_differences(run(*together)[0], sound)
        for channel in (fault["channel"] for fault in together):
            # A hammer at rest and a nearly constant spin show no fault that acts on their motion.
            still = channel in ("hammer", "speed") and kind in (
                "gain", "polarity", "stuck", "nonlinear", "no-filter", "bandwidth", "saturation", "short", "clip",
                "intermittent", "resonance",
            )  # fmt: skip
            assert channel in found or still or channel == "keyphasor", channel


def engineering(counts: dict[str, np.ndarray], name: str) -> np.ndarray:
    channel = SCENE.table.channels[name]
    return counts[name][round(0.12 * channel.rate_hz) : round(0.29 * channel.rate_hz)] * channel.scale + channel.offset


@pytest.mark.parametrize(("channel", "kind", "number", "value"), [
    ("P_E", "gain", "factor", 1.07), ("ring_y", "gain", "factor", 0.4), ("P_W", "offset", "value", 30.0),
    ("ring_x", "offset", "value", 0.03), ("P_N", "drift", "rate", 400.0), ("disk_y", "hum", "amplitude_v", 0.2),
    ("P_S", "noise", "factor", 5.0), ("inner_x", "noise", "factor", 2.5), ("disk_x", "late", "late_us", 730.0),
    ("P_E", "late", "late_us", 90.0),
])  # fmt: skip
def test_the_size_of_a_fault_is_recovered_from_the_counts(
    channel: str, kind: str, number: str, value: float, sound: dict[str, np.ndarray]
) -> None:
    """Within 1 %, or three standard deviations of the estimate's noise."""
    there, _ = run({"channel": channel, "kind": kind, "for_s": TO - FROM, number: value})
    y, x = engineering(there, channel), engineering(sound, channel)
    about = SCENE.table.channels[channel]
    t = (np.arange(len(x)) + round(0.12 * about.rate_hz)) / about.rate_hz - FROM
    noise = about.noise_v / abs(about.sensitivity_v)
    if kind == "gain":
        found, slack = float(x @ y / (x @ x)), 3.0 * noise / math.sqrt(float(x @ x))
    elif kind == "offset":
        found, slack = float(np.mean(y - x)), 0.0
    elif kind == "drift":
        found, slack = float(t @ (y - x) / (t @ t)), 0.0
    elif kind == "hum":
        turn = np.exp(-2j * math.pi * 50.0 * t)
        # The channel's filter passes 50 Hz unchanged.
        found, slack = abs(2.0 * np.mean((y - x) * turn)) * abs(about.sensitivity_v), 0.0
    elif kind == "noise":
        found = math.sqrt(float(np.var(y - x)) / noise**2 + 1.0)
        slack = 3.0 * found / math.sqrt(2.0 * len(x))
    else:
        steps = np.linspace(0.8, 1.2, 401) * value
        at = np.arange(len(x)) / about.rate_hz
        costs = [float(np.sum((y - np.interp(at - 1e-6 * late, at, x))[50:] ** 2)) for late in steps]
        found, slack = float(steps[int(np.argmin(costs))]), 2.0
    assert abs(found - value) < max(0.01 * value, slack)


def test_edges_follow_missing_and_extra_pulses(sound: dict[str, np.ndarray]) -> None:
    inside = [edge for edge in sound["edges"] if FROM <= edge * 1e-6 < TO]
    missing, extra, late = (
        run(example(kind, "keyphasor"))[0]["edges"] for kind in ("miss-pulses", "extra-pulses", "edge-jitter")
    )
    assert len(sound["edges"]) - len(missing) == len(inside) > 2
    assert len(extra) - len(sound["edges"]) == len(inside)
    moved = late[~np.isin(late, sound["edges"])] - np.array(inside)
    assert len(moved) == len(inside)
    assert ((moved > 0.0) & (moved < 8 * 300.0)).all()


@pytest.mark.parametrize("cut", [1_000, 7_000, 400_000])
@pytest.mark.parametrize(("from_s", "for_s"), [(0.081, 0.2), (0.115, 0.21), (0.15, 0.001), (0.09, 0.011)])
def test_edges_agree_with_the_signal(from_s: float, for_s: float, cut: int) -> None:
    """A fault may begin and end within a turn, whose other pulses are in both runs, or in none."""
    fault = {"channel": "keyphasor", "kind": "extra-pulses", "part": 1.0, "at_s": from_s, "for_s": for_s}
    found, channel = run(fault, cut=cut)[0], SCENE.table.channels["keyphasor"]
    high = found["keyphasor"] * channel.scale > 0.5
    rising_s = (np.flatnonzero(high[1:] & ~high[:-1]) + 1) / channel.rate_hz
    # The run begins in a pulse; the pulse half a turn later follows from the speed of the last one.
    np.testing.assert_allclose(rising_s[1:], found["edges"] * 1e-6, atol=5e-4)


def test_one_of_several_faults_on_a_group_can_be_cleared(sound: dict[str, np.ndarray]) -> None:
    hum = {"channel": "probes", "kind": "hum", "amplitude_v": 0.2}
    there, _ = run(hum, {"channel": "disk_x", "kind": "noise", "factor": 4.0, "at_s": 0.15, "for_s": 0.05})
    alone, _ = run(hum)
    assert set(find_differences(there, sound)) == {"disk_x", "disk_y", "ring_x", "ring_y"}
    first, last = find_differences(there, alone)["disk_x"]
    assert 3000 <= first <= last < 4000
    scales = {name: abs(SCENE.table.channels[name].lsb_v) for name in ("disk_x", "ring_y")}
    one, other = (scales[name] * (alone[name] - sound[name]) for name in scales)
    np.testing.assert_allclose(one, other, atol=5e-6)  # the same hum in all of them


def test_a_snapshot_contains_the_faults(sound: dict[str, np.ndarray]) -> None:
    simulation = Simulation(SCENE)
    simulation.submit("fault", {"channel": "P_E", "kind": "late", "late_us": 500.0})
    simulation.advance(50_000)
    snapshot = simulation.snapshot()
    first = simulation.advance(50_000).samples["forces"].values
    simulation.restore(snapshot)
    np.testing.assert_array_equal(simulation.advance(50_000).samples["forces"].values, first)


def test_faults_of_a_scene_are_recorded_and_repeated_bit_by_bit(tmp_path: Any) -> None:
    text = {
        "duration_s": 0.3, "drive": {"speed_hz": 6.2},
        "faults": [{"at_s": 0.1, "channel": "P_E", "kind": "gain", "factor": 1.05},
                   {"at_s": 0.12, "channel": "ring_x", "kind": "hum", "amplitude_v": 0.1, "for_s": 0.1}],
    }  # fmt: skip
    scene = parse_scene(text)
    assert [timed.request.command for timed in scene.commands] == ["fault", "fault"]
    assert parse_scene(scene_document(scene)) == scene
    commands = scene_document(scene)["commands"]
    recording = recorded(tmp_path / "f.mcap", "stable-run", duration_s=0.3, commands=commands)
    assert validate(recording).bit_exact
    assert Experiment.from_recording(recording).faulty_channels == {"P_E", "ring_x"}
    blind = validate(recording, blind=True)
    assert not blind.good
    assert blind.explained is not None
    # On a constant preload, several kinds have the same effect.
    found = {one.name: one.change for one in blind.explained.ranked}
    assert found["P_E offset or gain or open or saturation"] == "+150 N"
    assert found["ring_x hum"] == "50 Hz, 0.01271 mm"


@pytest.mark.parametrize(("request_", "says"), [
    ({"channel": "disk_z", "kind": "open"}, "fault.channel must be one of the channels"),
    ({"channel": "disk_x", "kind": "opn"}, "kind must be one of the kinds, such as open"),
    ({"channel": "disk_x"}, "kind must be one of the kinds"),
    ({"channel": "disk_x", "kind": "gain"}, "factor must be given"),
    ({"channel": "disk_x", "kind": "gain", "factor": 1.0}, "factor must be other than 1"),
    ({"channel": "disk_x", "kind": "gain", "factor": "2"}, "factor must be"),
    ({"channel": "disk_x", "kind": "gain", "factor": 2.0, "size": 1}, "left out: gain takes factor, ramp_s"),
    ({"channel": "disk_x", "kind": "offset", "value": math.inf}, "value must be"),
    ({"channel": "disk_x", "kind": "swap", "other": "disk_x"}, "fault.swap must be with another channel"),
    ({"channel": "probes", "kind": "swap", "other": "P_N"}, "fault.channel must be one channel for swap"),
    ({"channel": "disk_x", "kind": "miss-pulses"}, "fault.channel must be keyphasor for miss-pulses"),
    ({"channel": "speed", "kind": "bandwidth", "corner_hz": 3000.0}, "corner_hz must be below its bandwidth"),
    ({"channel": "disk_x", "kind": "bits", "lost": 24}, "lost must be below the converter's"),
    ({"channel": "disk_x", "kind": "late", "late_us": -3.0}, "late_us must be greater than 0"),
    ({"channel": "disk_x", "kind": "open", "for_s": 0.0}, "for_s must be greater than 0"),
])  # fmt: skip
def test_impossible_faults_are_refused_in_one_line(request_: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError) as caught:
        Simulation(SCENE).submit("fault", request_)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_only_an_active_fault_can_be_cleared() -> None:
    simulation = Simulation(SCENE)
    simulation.submit("fault", {"channel": "P_E", "kind": "open"})
    assert simulation.command_result == {"fault": 1, "channels": ["P_E"], "first_row": {"forces": 0}}
    with pytest.raises(InputError, match=r"clear\.id must be the number of an active fault"):
        simulation.submit("clear", {"id": 2})
    simulation.submit("clear", {"id": 1})
    assert {"id": "all"}
    assert simulation.submit("clear", {}) == 0


@pytest.mark.parametrize("kind", ["late", "jitter", "wander", "clock"])
def test_a_clock_fault_of_a_group_leaves_each_channel_its_own_noise(kind: str) -> None:
    """Third differences leave mainly the converters' noise: it is as independent as in channels without a fault."""
    still = load_scene("stable-run", {"duration_s": 0.3, "sensors.groups": ["forces", "probes"]})
    late = {"channel": "forces", "kind": kind, "at_s": 0.1, **EXAMPLES[kind]}
    alone = {"channel": "disk_x", "kind": kind, "at_s": 0.1, **EXAMPLES[kind]}
    there, _ = run(late, alone, scene=still)
    names = ("P_N", "P_S", "P_E", "P_W", "disk_x")
    rough = np.array([np.diff(there[name][2400:].astype(float), 3) for name in names])
    if kind != "jitter":  # jitter makes noise from motion, the same in all channels of the group
        off = np.corrcoef(rough) - np.eye(len(names))
        assert np.abs(off).max() < 0.1
    # White noise of one standard deviation has third differences of sqrt(20).
    loud = np.array([still.table.channels[name].noise_v / still.table.channels[name].lsb_v for name in names])
    assert (rough[:4].std(axis=1) / loud[:4] / math.sqrt(20.0) < 1.2).all()


def measure_forces_v(scene: Any, *faults: dict[str, Any]) -> dict[str, float]:
    """Return the mean force signals after 0.2 s [V], of inputs of 1.1, 2.2, 3.3, 4.4 V at P_N, P_S, P_E, P_W."""
    found, _ = run(*faults, scene=scene)
    table = scene.table.channels
    return {
        name: round(float(found[name][4000:].mean()) * table[name].lsb_v, 2) for name in ("P_N", "P_S", "P_E", "P_W")
    }


@pytest.mark.parametrize(("swaps", "shown"), [
    ([("P_N", "P_S"), ("P_S", "P_E")], (2.0, 3.0, 1.0, 4.0)),
    ([("P_S", "P_E"), ("P_N", "P_S")], (3.0, 1.0, 2.0, 4.0)),
    ([("P_N", "P_S"), ("P_S", "P_N")], (1.0, 2.0, 3.0, 4.0)),
    ([("P_N", "P_S"), ("P_S", "P_E"), ("P_E", "P_N")], (1.0, 3.0, 2.0, 4.0)),
    ([("P_N", "P_S"), ("P_E", "P_W"), ("P_S", "P_E")], (2.0, 4.0, 1.0, 3.0)),
])  # fmt: skip
@pytest.mark.parametrize("physics", [True, False])
def test_swaps_with_a_common_channel_are_applied_in_order(
    swaps: list[tuple[str, str]], shown: tuple[float, ...], physics: bool
) -> None:
    """With any swaps, each signal appears on one channel; offsets of transducers follow the cables."""
    names, volts = ("P_N", "P_S", "P_E", "P_W"), (1.1, 2.2, 3.3, 4.4)
    if physics:
        scene = load_scene("stable-run", {"duration_s": 0.22, "sensors.groups": ["forces"]})
        still = measure_forces_v(scene)
    else:
        scene = load_scene(
            "test-sine", {"duration_s": 0.22, "sensors.groups": ["forces"], "generator.amplitude_v": 1e-3}
        )
        still = dict.fromkeys(names, 0.0)
    sensitivity = scene.table.channels["P_N"].sensitivity_v
    offsets = [
        {"channel": name, "kind": "offset", "value": (v - still[name]) / sensitivity, "at_s": 0.1}
        for name, v in zip(names, volts, strict=True)
    ]
    changed = [{"channel": a, "kind": "swap", "other": b, "at_s": 0.15} for a, b in swaps]
    found = measure_forces_v(scene, *offsets, *changed)
    assert tuple(found.values()) == pytest.approx([1.1 * volts for volts in shown], abs=0.02)


def test_the_end_of_a_swap_restores_the_other_swaps() -> None:
    scene = load_scene("stable-run", {"duration_s": 0.25, "sensors.groups": ["forces", "probes"]})
    pairs = [("P_N", "P_S"), ("P_S", "disk_x"), ("disk_x", "P_E")]
    swaps = [{"channel": a, "kind": "swap", "other": b, "at_s": 0.1} for a, b in pairs]
    ended, _ = run(swaps[0], {**swaps[1], "for_s": 0.05}, swaps[2], scene=scene)
    never, _ = run(swaps[0], swaps[2], scene=scene)
    all_, _ = run(*swaps, scene=scene)
    # The filters of channels that remain swapped retain it for some samples.
    assert all(first >= 2000 and last < 3100 for first, last in find_differences(ended, never).values())
    assert all(first >= 3000 for first, _ in find_differences(ended, all_).values())


def test_the_numbers_of_a_random_fault_are_functions_of_its_place() -> None:
    """Later versions repeat a recording's faults from its seed, so the numbers themselves are fixed."""
    places = np.arange(20_000)
    uniform, normal = Draws(7, 1, 0).uniform(places), Draws(7, 1, 0).normal(places)
    assert uniform[:2].ravel() == pytest.approx(
        [0.9930834, 0.9588878, 0.3036319, 0.1622353, 0.5951127, 0.5783910, 0.0525338, 0.7885474], abs=1e-7
    )
    radius, turns = np.sqrt(-2.0 * np.log(uniform[:, 0])), uniform[:, 1]
    np.testing.assert_allclose(normal, radius * np.cos(2.0 * np.pi * turns), rtol=1e-12)
    draws = Draws(7, 1, 0)
    for part in (places[:100], places[100:150], places[120:130], places[0:0], places[[500, 502, 503]], places[:3]):
        np.testing.assert_array_equal(draws.uniform(part), uniform[part])
    four_sigmas = 4.0 / math.sqrt(len(places))
    assert abs(normal.mean()) < four_sigmas
    assert normal.std() == pytest.approx(1.0, abs=four_sigmas / math.sqrt(2.0))
    others = [Draws(7, 1, 1), Draws(7, 2, 0), Draws(8, 1, 0)]
    columns = [*uniform.T, normal[np.r_[1 : len(places), 0]], *(other.normal(places) for other in others)]
    assert np.abs(np.corrcoef(columns) - np.eye(len(columns))).max() < four_sigmas


@pytest.mark.parametrize("quiet", [{"sensors.noise": False}, {"sensors.chain": "ideal"}], ids=["no noise", "ideal"])
def test_a_delay_of_one_sample_shows_the_previous_row(quiet: dict[str, Any]) -> None:
    """Probes are around -10 V of 20 V, and their volts extend to both sides of half of the converter's range."""
    still = load_scene("stable-run", {"duration_s": 0.05, "sensors.groups": ["probes"], **quiet})
    sound, _ = run(scene=still)
    there, _ = run({"channel": "probes", "kind": "late", "late_us": 50.0, "at_s": 0.0}, scene=still)
    for name, counts in sound.items():
        if name != "edges":
            np.testing.assert_allclose(there[name][20:], counts[19:-1], atol=3.0, err_msg=name)
            assert np.ptp(counts) > 10_000
