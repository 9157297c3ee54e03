"""A user's own channels: result of the file, formulas, and one line for every wrong table."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import rig
from drivers.can.dbc import database
from drivers.can.signals import default_messages, messages_for
from replays.studies.bench.engines import CASES
from rig.base.errors import InputError
from rig.base.wire import row_tick
from rig.channels.channel_file import read_channels
from rig.channels.formula import Formulas
from rig.channels.sensors.filters import channel_poles
from rig.channels.table import default_table
from rig.physics.kernels.signals import COLUMN, N_ROW
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

MINE = """
drop = ["accelerations", "hammer"]

[channels.disk_x]
sensitivity_v = 7.87

[groups.probes]
rate_hz = 51200

[groups.bearing]
title = "Probes at the bearing"
rate_hz = 51200
defaults = { unit = "mm", si = 1e-3, sensitivity_v = 3.94, bias_v = -10.0, range_v = [-18.0, -2.0], adc_v = 20.0 }
channels = [
    { name = "bearing_u", signal = "along(shaft_x(0.35), shaft_y(0.35), 45) + runout(theta)" },
    { name = "bearing_v", signal = "along(shaft_x(0.35), shaft_y(0.35), 135)", noise_v = 1e-3 },
]

[groups.forces]
channels = [{ name = "beam", signal = "house.inner_beam_stiffness * (x_ih - x_oh)", range_v = [-5, 5] }]

[groups.slow]
rate_hz = 1000
channels = [
    { name = "strain", unit = "um/m", si = 1e-6, sensitivity_v = 0.01, signal = "6 * 0.004 / 0.25 ** 2 * x_ih" },
]

[curves]
runout = "runout.csv"
"""


def written(folder: Path, text: str = MINE) -> Path:
    angles = np.arange(0.0, 360.0, 5.0)
    np.savetxt(folder / "runout.csv", np.c_[angles, 5e-6 * np.cos(np.radians(angles))], delimiter=",")
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_the_file_changes_only_its_listed_settings(tmp_path: Path) -> None:
    table, own = read_channels(written(tmp_path)), default_table().channels
    assert {name: group.names for name, group in table.groups.items()} == {
        "probes": ("disk_x", "disk_y", "ring_x", "ring_y"),
        "forces": ("P_N", "P_S", "P_E", "P_W", "beam"),
        "drive": ("speed", "keyphasor"),
        "bearing": ("bearing_u", "bearing_v"),
        "slow": ("strain",),
    }
    assert [group.rate_hz for group in table.groups.values()] == [51_200, 20_000, 20_000, 51_200, 1_000]
    found = table.channels
    assert found["disk_x"] == own["disk_x"].model_copy(
        update={"sensitivity_v": 7.87, "rate_hz": 51_200, "kind": "user"}
    )
    assert found["P_N"] == own["P_N"]
    # Settings that a new channel omits are its group's if all channels there agree, otherwise the defaults.
    assert (found["beam"].unit, found["beam"].sensitivity_v, found["beam"].range_v) == ("N", 1e-3, (-5.0, 5.0))
    assert (found["strain"].bandwidth_hz, found["strain"].adc_bits, found["strain"].noise_v) == (250.0, 24, 0.0)
    assert (found["bearing_u"].kind, found["bearing_u"].label) == ("user", "bearing_u")


def test_a_slower_group_lowers_the_default_corner(tmp_path: Path) -> None:
    slow = "[groups.probes]\nrate_hz = 1000\n[channels.disk_y]\nbandwidth_hz = 900.0"
    table = read_channels(written(tmp_path, slow))
    assert (table.channels["disk_x"].bandwidth_hz, table.channels["disk_y"].bandwidth_hz) == (250.0, 900.0)


def test_a_table_can_start_empty(tmp_path: Path) -> None:
    table = read_channels(written(tmp_path, 'base = "none"\n' + channel('signal = "pivot_x"')))
    assert list(table.channels) == ["a"]
    frame = Simulation(load_scene("stable-run", {"channels": str(tmp_path / "mine.toml")})).advance(10_000)
    assert (frame.samples["g"].values.shape, frame.edges) == ((200, 1), None)


def test_channels_follow_their_formulas(tmp_path: Path) -> None:
    changes = {"channels": str(written(tmp_path)), "sensors.chain": "ideal", "sensors.rate_hz": 20_000}
    run = rig.simulate("hammer", changes, duration_s=0.1)
    model = run.simulation.model.constants
    x, y = 0.35 / model.shaft.arm_disk * run["disk_x"], 0.35 / model.shaft.arm_disk * run["disk_y"]
    runout = np.interp(
        np.degrees(run["theta"]) % 360, np.arange(0.0, 365.0, 5.0), 5e-6 * np.cos(np.radians(np.arange(0, 365, 5)))
    )
    expected = {
        "bearing_u": ((x + y) * math.sqrt(0.5) + runout) * 1e3,
        "bearing_v": (y - x) * math.sqrt(0.5) * 1e3,
        "beam": model.house.inner_beam_stiffness * (run["x_ih"] - run["x_oh"]),
        "strain": 6 * 0.004 / 0.25**2 * run["x_ih"] * 1e6,
    }
    channels = run.table.channels
    for name, values in expected.items():
        np.testing.assert_allclose(
            run.samples[name], values, rtol=0, atol=0.51 * abs(channels[name].scale), err_msg=name
        )


def test_formulas_are_evaluated_as_written() -> None:
    rows = np.random.default_rng(1).normal(size=(50, N_ROW))
    x, y, angle = (rows[:, COLUMN[name]] for name in ("disk_x", "disk_y", "theta"))
    formulas = Formulas({"ring.clearance": 0.5}, {"cam": ((0.0, 0.0), (90.0, 1.0), (270.0, -1.0))})
    cases = {
        "-disk_x + 2 * disk_y ** 2": -x + 2 * y**2,
        "max(min(disk_x, 0.2), -ring.clearance)": np.clip(x, -0.5, 0.2),
        "abs(disk_x) / hypot(disk_x, disk_y)": np.abs(x) / np.hypot(x, y),
        "atan2(disk_y, disk_x) + sign(disk_y) * pi": np.arctan2(y, x) + np.sign(y) * math.pi,
        "exp(-disk_x) * cos(theta) - sin(theta)": np.exp(-x) * np.cos(angle) - np.sin(angle),
        "cam(theta)": np.interp(np.degrees(angle) % 360, [-90, 0, 90, 270, 360], [-1, 0, 1, -1, 0]),
        "sqrt(disk_x)": np.where(x >= 0, np.sqrt(np.abs(x)), 0.0),
        "1 / 0": np.zeros(50),
    }
    columns = [formulas.column("c", text) for text in cases]
    assert columns == list(range(N_ROW, N_ROW + len(cases)))
    for made, expected in zip(formulas.values(rows).T, cases.values(), strict=True):
        np.testing.assert_allclose(made, expected, rtol=1e-12, atol=1e-15)


def test_formulas_have_the_bits_of_numpy_wherever_their_numbers_are_computed() -> None:
    rows = np.random.default_rng(2).normal(size=(40, N_ROW)) * 10
    x, y, angle = (rows[:, COLUMN[name]] for name in ("disk_x", "disk_y", "theta"))
    curves = {"late": ((400.0, 1.0), (30.0, 2.0), (-90.0, -4.0)), "one": ((5.0, 2.0),)}
    cosine, sine = np.cos(np.radians(30.0)), np.sin(np.radians(30.0))
    cases = {
        "along(disk_x, disk_y, 15 * 2)": x * cosine + y * sine,
        "along(disk_x, disk_y, theta)": x * np.cos(np.radians(angle)) + y * np.sin(np.radians(angle)),
        "along(1, 2, 30) + 0 * disk_x": np.full(40, 1.0 * cosine + 2.0 * sine) + 0.0 * x,
        "late(theta - pi / 4)": np.interp(np.degrees(angle - math.pi / 4), [400, 30, -90], [1, 2, -4], period=360.0),
        "one(theta) * late(-pi)": 2.0 * np.interp(np.full(40, -180.0), [400, 30, -90], [1, 2, -4], period=360.0),
        "shaft_x(0.1 + 0.05) - 1 / 8": (0.1 + 0.05) / 0.36 * x - 0.125,
    }
    formulas = Formulas({"shaft.arm_disk": 0.36}, curves)
    for name, signal in enumerate(cases):
        formulas.column(str(name), signal)
    for signal, computed in zip(cases, formulas.values(rows).T, strict=True):
        assert computed.tobytes() == cases[signal].tobytes(), signal


def test_the_bench_times_a_laboratory_of_24_channels() -> None:
    case = next(case for case in CASES if case.name.startswith("24 channels"))
    table, shipped = (
        load_scene(case.scene, case.changes).table,
        read_channels(Path(__file__).parents[2] / "docs/daq24.toml"),
    )
    kinds = [sorted(each.signal not in COLUMN for each in one.channels.values()) for one in (table, shipped)]
    assert kinds[0] == kinds[1], "as many formulas"
    assert (len(table.channels), {each.rate_hz for each in table.channels.values()}) == (24, {51_200})


def test_messages_follow_the_table(tmp_path: Path) -> None:
    assert messages_for(default_table()) is default_messages()
    assert messages_for(default_table().select_groups(("forces",), 5_000)) is default_messages()
    table = messages_for(read_channels(written(tmp_path)))
    assert table.layout != default_messages().layout
    sampled = [channel.name for row in table.fd if row.samples for channel in row.samples.channels]
    assert sampled == list(read_channels(tmp_path / "mine.toml").channels)
    names = {signal.name for message in database(table).messages for signal in message.signals}
    assert {"bearing_u", "strain", "beam_0"} <= names
    many = ", ".join(f'{{ name = "c{n}", signal = "P_N" }}' for n in range(60))
    wide = messages_for(read_channels(written(tmp_path, f"[groups.forces]\nchannels = [{many}]")))
    assert sum(len(row.samples.channels) for row in wide.fd if row.samples) == 75
    database(wide)


def test_a_scene_names_its_channel_file_and_stores_the_contents(tmp_path: Path) -> None:
    written(tmp_path)
    (tmp_path / "scene.toml").write_text('channels = "mine.toml"\n')
    scene = load_scene(tmp_path / "scene.toml")
    assert scene.channels == read_channels(tmp_path / "mine.toml")
    document = Simulation(scene).scene_document()["scene"]
    (tmp_path / "mine.toml").unlink()
    assert rig.Scene.model_validate(document) == scene


def channel(row: str) -> str:
    good = {"name": '"a"', "signal": '"P_N"', "unit": '"N"', "si": "1.0", "sensitivity_v": "1e-3"}
    for part in row.split("; "):
        name, _, value = part.partition(" = ")
        good[name] = value
    inside = ", ".join(f"{name} = {value}" for name, value in good.items() if value)
    return f"[groups.g]\nchannels = [{{ {inside} }}]"


WRONG = {
    "no sensitivity": (channel("sensitivity_v = "), "channel a.sensitivity_v must be given"),
    "no unit": (channel("unit = "), "channel a.unit must be given"),
    "no scale": (channel("si = "), "channel a.si must be given"),
    "no name": (channel("name = "), "groups.g.channels.0.name must be given"),
    "no signal": (channel("signal = "), "channel a.signal must be given"),
    "sensitivity of nothing": (channel("sensitivity_v = 0"), "channel a.sensitivity_v must be non-zero"),
    "negative unit": (channel("si = -1"), "channel a.si must be greater than 0"),
    "unknown signal": (channel('signal = "disk_z"'), "channel a.signal must be one of the model's"),
    "unknown in a formula": (channel('signal = "2 * disk_z"'), "such as disk_y"),
    "unknown parameter": (channel('signal = "shaft.arm * P_N"'), "such as shaft.arm_ring, shaft.arm_disk"),
    "law as a number": (channel('signal = "contact.exponent * P_N"'), "a formula with numeric parameters"),
    "millimetres": (channel('signal = "shaft_x(349)"'), "shaft_x of a distance from the pivot within 0.628 m"),
    "unknown function": (channel('signal = "sine(theta)"'), "a formula with the functions, such as sin"),
    "too many arguments": (channel('signal = "sin(theta, 1)"'), "sin of 1 argument; received 2"),
    "no formula": (channel('signal = "P_N +"'), "or a formula of them; received 'P_N +'"),
    "code": (channel('''signal = "__import__('os').system('true')"'''), "channel a.signal must be"),
    "an attribute of a number": (channel('signal = "(1).real"'), "channel a.signal must be"),
    "a comprehension": (channel('signal = "[x for x in P_N]"'), "a formula with numbers, signals, parameters"),
    "a comparison": (channel('signal = "P_N > 3"'), "a formula with numbers, signals, parameters"),
    "text in a formula": (channel('signal = "P_N + True"'), "a formula with numbers, signals, parameters"),
    "a deep formula": (channel(f'signal = "{"-" * 40}P_N"'), "nested at most 30 deep"),
    "a long formula": (channel(f'signal = "{"P_N + " * 100}P_N"'), "a formula of at most 500 characters"),
    "range that falls": (channel("range_v = [5, -5]"), "channel a.range_v must be two ascending values inside"),
    "range beyond the converter": (
        channel("range_v = [-20, 20]"),
        "channel a.range_v must be two ascending values inside",
    ),
    "no bits": (channel("adc_bits = 4"), "channel a.adc_bits must be greater than or equal to 8"),
    "many poles": (
        channel("filter_order = 12"),
        "channel a.filter_order must be from 1 to 8 for the filter butterworth",
    ),
    "unknown filter": (channel('filter = "elliptic"'), "channel a.filter must be 'butterworth', 'bessel', "),
    "short filter": (
        channel('filter = "fir", filter_order = 4'),
        "a.filter_order must be from 8 to 1024 for the filter",
    ),
    "delay of poles": (
        channel("group_delay_us = 80"),
        "a.group_delay_us must be left out, as the filter butterworth is",
    ),
    "compensated, live": (channel('filter = "sinc", group_delay_us = 0'), "a.group_delay_us must be at least "),
    "no ripple": (channel("ripple_db = 0"), "channel a.ripple_db must be greater than 0"),
    "noise below zero": (channel("noise_v = -1"), "channel a.noise_v must be greater than or equal to 0"),
    "bandwidth beyond any row": (channel("bandwidth_hz = 1e6"), "channel a.bandwidth_hz must be at most 130000"),
    "unknown field": (channel("sensitivty_v = 1"), "channel a.sensitivty_v must be a known field"),
    "name with a blank": (channel('name = "a b"'), "a name of at most 28 letters"),
    "name twice": (channel('name = "P_N"'), "channel P_N must be in the table once"),
    "rate of zero": ("[groups.probes]\nrate_hz = 0", "groups.probes.rate_hz must be greater than or equal to 1"),
    "rate of too many places": ("[groups.probes]\nrate_hz = 19997", "groups.probes.rate_hz must be a rate with"),
    "a rate a channel": (channel("rate_hz = 100"), "channel a.rate_hz must be left out"),
    "unknown channel": ("[channels.disk_z]\nnoise_v = 0", "channels.disk_z must be the name of a channel"),
    "another name": ('[channels.disk_x]\nname = "x"', "channels.disk_x.name must be left out"),
    "drop of nothing": ('drop = ["disk_z"]', "drop must be names of groups or channels, such as disk_y"),
    "nothing left": ('drop = ["probes", "forces", "accelerations", "drive", "hammer"]', "such that a channel is left"),
    "a group of nothing": ("[groups.g]\nrate_hz = 1000", "groups.g.channels must be given"),
    "unknown table": ("[group.g]\nrate_hz = 1000", "group must be a known field, such as groups"),
    "unknown base": ('base = "mine"', "base must be"),
    "no curve": ('[curves]\nc = "none.csv"', "curves.c must be a file that can be read"),
    "a curve back and forth": (
        "[curves]\nc = [[0, 1], [0, 2]]",
        "curves.c must be 2 to 10000 points of ascending angle",
    ),
    "a curve of more than a turn": ("[curves]\nc = [[0, 1], [400, 2]]", "curves.c must be points from 0 to below 360"),
    "a curve that is a function": ("[curves]\nsin = [[0, 1], [90, 2]]", "curves.sin must be of a name that no signal"),
    "a curve that is a folder": ('[curves]\nc = "."', "curves.c must be a file that can be read"),
    "minus upon minus": (channel(f'signal = "{"-" * 400}P_N"'), "channel a.signal must be nested at most 30 deep"),
    "a text for a number": (channel('noise_v = "0"'), "channel a.noise_v must be a number"),
    "truth for a number": (channel("adc_bits = true"), "channel a.adc_bits must be a number"),
    "an odd unit": (channel('unit = "m\\nm"'), "channel a.unit must be printable"),
    "a unit of nothing": (channel("si = 1e-320"), "channel a.sensitivity_v must be"),
    "a high-pass beyond any row": (channel("highpass_hz = 1e308"), "channel a.highpass_hz must be at most 130000"),
    "no TOML": ("groups = {", "a TOML file"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_table_is_refused_with_channel_and_field(what: str, tmp_path: Path) -> None:
    text, line = WRONG[what]
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_scene("hammer", {"channels": str(path)})
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 400
    assert line in message, message
    assert "mine.toml" in message or what == "rate of too many places"  # that limit belongs to the whole scene


INLINE = {
    "group.name": ({"groups": {"g/../*": {"name": "g/../*"}}}, "a name of at most 28 letters"),
    "rate": ({"groups": {"g": {"rate_hz": 10**9}}}, "groups.g.rate_hz must be from 1 to 1000000"),
    "channel rate": ({"groups": {"g": {"channels": {"rate_hz": 2000}}}}, "channel a.rate_hz must be that of its group"),
    "bandwidth": ({"groups": {"g": {"channels": {"bandwidth_hz": 1e9}}}}, "channel a.bandwidth_hz must be at most"),
    "curve": ({"curves": {"c": [[3.0, 1.0], [2.0, 1.0]]}}, "curves.c must be 2 to 10000 points of ascending angle"),
    "nothing": ({"groups": None}, "groups must be of 1 to 512 channels"),
}


@pytest.mark.parametrize("what", INLINE)
def test_a_table_inside_a_scene_has_the_same_checks(what: str, tmp_path: Path) -> None:
    # Equal to recordings: a value is accepted by this path exactly if it is accepted by the other.
    text = 'base = "none"\n' + channel('signal = "P_N"')
    document = read_channels(written(tmp_path, text)).model_dump(mode="json")
    changes, line = INLINE[what]
    for name, group in (changes.get("groups") or {}).items():
        whole = document["groups"].pop("g") | {key: value for key, value in group.items() if key != "channels"}
        whole["channels"][0] |= {"group": whole["name"]} | group.get("channels", {})
        document["groups"][name] = whole
    if changes.get("groups", 0) is None:
        document["groups"] = {}
    document |= {key: value for key, value in changes.items() if key == "curves"}
    with pytest.raises(InputError) as caught:
        load_scene("hammer", {"channels": document})
    assert line in str(caught.value)


def test_a_high_pass_at_the_corner_of_the_low_pass_is_no_double_pole() -> None:
    from scipy.signal import butter, freqs

    base = default_table().channels["inner_x"]
    for order in (1, 3, 5, 7):
        for near in (0.0, 1e-13, 1e-7, 1e-4, 2e-3):
            held = 50.0 * (1.0 - near)
            poles, residues, direct = channel_poles(
                base.model_copy(update={"filter_order": order, "bandwidth_hz": 50.0, "highpass_hz": held})
            )
            for frequency_hz in (5.0, 50.0, 500.0):
                at = 2.0 * math.pi * frequency_hz
                parts = [
                    0.5 * (r / (1j * at - p) + r.conjugate() / (1j * at - p.conjugate()))
                    if abs(p.imag) > 1e-6 else r / (1j * at - p)
                    for p, r in zip(poles, residues, strict=True)
                ]  # fmt: skip
                low = freqs(*butter(order, 2.0 * math.pi * 50.0, analog=True), [at])[1][0]
                high = freqs(*butter(1, 2.0 * math.pi * held, "highpass", analog=True), [at])[1][0]
                assert abs(direct + sum(parts) - low * high) < 1e-3, (order, near, frequency_hz)


def test_a_slow_group_does_not_change_blocks_and_durations(tmp_path: Path) -> None:
    text = 'base = "none"\n[groups.s]\nrate_hz = 64\n' + channel('signal = "P_N"').partition("\n")[2]
    scene = load_scene("stable-run", {"channels": str(written(tmp_path, text)), "duration_s": 0.1})
    simulation = Simulation(scene)
    frames = [simulation.advance(10_000) for _ in range(10)]
    assert simulation.end_tick == 100_000
    assert [len(frame.samples["s"].values) for frame in frames] == [1, 1, 0, 1, 1, 0, 1, 1, 0, 1]
    assert all(len(block.values) for frame in frames for _, block in frame.blocks())
    run = rig.simulate(scene)
    assert run.groups["s"].times_s.tolist() == [n / 64 for n in range(7)]
    np.testing.assert_array_equal(run.times_s, run.groups["s"].times_s)


def test_rates_of_a_sound_card_get_suitable_rows(tmp_path: Path) -> None:
    for rate in (44_100, 131_072, 262_144):
        text = 'base = "none"\n' + channel('signal = "P_N"').replace("[groups.g]", f"[groups.g]\nrate_hz = {rate}")
        assert load_scene("hammer", {"channels": str(written(tmp_path, text))}).table.groups["g"].rate_hz == rate


def test_a_dbc_holds_any_unit_and_label(tmp_path: Path) -> None:
    text = channel(r"""unit = "in\"" ; label = "a \"b\" µ \\ €" """.replace(" ;", ";").strip())
    messages = messages_for(read_channels(written(tmp_path, text)))
    signal = next(s for m in database(messages).messages for s in m.signals if s.name in ("a", "a_0"))
    assert signal.unit == "in'"
    inches = messages_for(read_channels(written(tmp_path, text.replace('in\\"', "mm"))))
    assert inches.layout != messages.layout, "another unit is another layout"


def test_a_channel_of_another_unit_has_separate_messages() -> None:
    group = default_table().groups["forces"]
    other = group.channels[0].model_copy(update={"unit": "lbf", "si": 4.448})
    table = default_table().model_copy(update={"groups": {"forces": group.model_copy(update={"channels": (other,)})}})
    assert messages_for(table).layout != default_messages().layout


def test_the_tick_of_a_row_is_rounded_once() -> None:
    for first in range(0, 200_000, 777):
        for row in (0, 1, 17, 512):
            tick = row_tick(round(first * 1e6 / 51_200), 51_200.0, 1e6, row)
            assert tick == round((first + row) * 1e6 / 51_200)
