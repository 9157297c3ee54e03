"""Parts of a validation: criteria, phases, spectra, bits, and causes of a difference."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording, join
from recorder.rewrite import cut
from recorder.writer import RecordingWriter
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import Measured, Prediction, predict, read_measured, simplify
from replays.recordings.validation import load_criteria, outcome, validate
from replays.recordings.validation.bits import Bits
from replays.recordings.validation.criteria import DEFAULT, Criteria
from replays.recordings.validation.explanations.attribution import Explained, Explanation, attribute, conclude
from replays.recordings.validation.explanations.signals import SignalFault
from replays.recordings.validation.phases import Phase, View, find_phases, quantities, spectrum_distance
from rig.base.errors import InputError
from rig.base.outcome import Outcome
from rig.base.wire import EDGES, EVENTS, encode_block, encode_document, sensor_key, truth_key
from rig.run.offline import frames
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation
from tests.commands import run_captured

RUN_CHANGES = {"sensors.rate_hz": 2000, "sensors.truth_rate_hz": 100, "duration_s": 0.06}


def record_scene(
    path: Path, scene: str = "hammer", *, truth: bool = True, leave_out: tuple[int, ...] = (), **changes: object
) -> Recording:
    """Record a scene; the frames of 0.01 s in `leave_out` are missing."""
    simulation = Simulation(
        load_scene(scene, {**RUN_CHANGES, **{key.replace("__", "."): v for key, v in changes.items()}})
    )
    with RecordingWriter(
        path, catalogue=simulation.catalogue(), parameters=simulation.parameters_document(),
        scene=simulation.scene_document(), view_rate_hz=0.0, force=True,
    ) as writer:  # fmt: skip
        for number, frame in enumerate(frames(simulation, chunk_s=0.01)):
            for event in frame.events:
                writer.write(EVENTS, encode_document(event), 0)
            blocks = {sensor_key(name): block for name, block in frame.samples.items()}
            blocks |= {truth_key(name): block for name, block in frame.truth.items()} if truth else {}
            if frame.edges is not None:
                blocks[EDGES] = frame.edges
            for key, block in blocks.items():
                if number not in leave_out:
                    writer.write(key, encode_block(block), frame.tick * 1000)
        writer.finish("closed")
    return Recording.open(path)


@pytest.fixture(scope="module")
def hammer(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record_scene(tmp_path_factory.mktemp("validation") / "hammer.mcap")


def make_criteria(*names: str) -> Criteria:
    """Return the default criteria with these parameters as the only candidates for a cause."""
    criteria = load_criteria()
    few = tuple(one for one in criteria.attribution.candidates if one.name in names)
    return criteria.model_copy(update={"attribution": criteria.attribution.model_copy(update={"candidates": few})})


# Criteria.


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("longest_s = 30.0", "longest_s = 0.0", "window.longest_s"),
        ("longest_s = 30.0", "", "window.longest_s"),
        ('"ring.clearance", "shaft.mass"', '"ring.clearence"', "ring.clearence"),
        ('quantities = ["contact_fraction"]', 'quantities = ["contact_part"]', "contact_fraction"),
        ("rms = 1.01", "rms = 1.01\nrsm = 2.0", "rsm"),
        ('reason = "True values have no noise, so only rounding errors may remain."', 'reason = ""', "truth.reason"),
        ("title =", "title", "a TOML file"),
    ],
)
def test_wrong_criteria_are_refused_with_their_field(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = DEFAULT.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "own.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        load_criteria(path)


def test_the_first_matching_criterion_applies() -> None:
    criteria = load_criteria()
    keyphasor, probe = criteria.find_trajectory("keyphasor"), criteria.find_trajectory("disk_x")
    assert keyphasor is not None
    assert probe is not None
    assert keyphasor.peak > probe.peak
    spin, force = criteria.find_statistic("whirl", "spin"), criteria.find_statistic("impacts", "spin")
    assert spin is not None
    assert force is not None
    assert spin.relative < force.relative


def test_missing_data_are_reported_as_missing(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text("[window]\nlongest_s = 1.0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"^own\.toml\.title must be given; received nothing$"):
        load_criteria(path)


# Spectra and phases, against closed forms.


def test_distance_of_spectra() -> None:
    turn = np.exp(2j * np.pi * 50.0 * np.arange(4096) / 4096.0)
    assert spectrum_distance(turn, turn) == 0.0
    assert spectrum_distance(turn, turn * np.exp(0.7j)) == pytest.approx(0.0, abs=1e-12)  # phase does not count
    assert spectrum_distance(turn, turn.conj()) == pytest.approx(1.0, abs=1e-6)  # the opposite sense
    assert spectrum_distance(turn, 1.1 * turn) == pytest.approx(0.1 / math.sqrt(1.0 + 1.1**2))


def test_phases_are_found_at_their_times() -> None:
    times = np.arange(0.0, 2.0, 1e-3)
    radius = np.select([times < 0.3, times < 0.6, times < 1.5], [0.1, 0.5 + 0.6 * (np.sin(40 * times) > 0), 1.01], 0.1)
    angle = np.where(times >= 0.6, -2 * np.pi * 30.0 * times, 0.3)
    values = {"ring_x": radius * np.cos(angle), "ring_y": radius * np.sin(angle)}
    view = View(times_s=dict.fromkeys(values, times), values=values, base={}, touches=1.0)
    phases = find_phases(view, floor_n=1.0)
    assert [phase.name for phase in phases] == ["free run", "impacts", "whirl", "decay"]
    starts = [phase.from_s for phase in phases]
    assert starts[1] == pytest.approx(0.3, abs=0.1)
    assert starts[2] == pytest.approx(0.6, abs=0.051)
    assert starts[3] == pytest.approx(1.5, abs=0.051)
    kept = (times >= 0.7) & (times < 1.4)
    whirl = View(
        times_s=dict.fromkeys(values, times[kept]), values={k: v[kept] for k, v in values.items()}, base={}, touches=1.0
    )
    read = quantities(whirl, "whirl")
    assert read["whirl_frequency"] == pytest.approx(-30.0, rel=1e-6)
    assert read["sense"] == -1.0
    assert read["contact_fraction"] == 1.0


# Bits.


def test_the_same_build_gives_the_same_bits(hammer: Recording) -> None:
    found = validate(hammer)
    assert found.bit_exact
    assert found.good
    assert len(found.bits) == 9  # five groups, four truth tables; no edge in so short a time
    assert sum(stream.rows for stream in found.bits.values()) == 5 * 120 + 4 * 6


def test_a_pass_needs_judged_rows_or_criteria(hammer: Recording) -> None:
    found = validate(hammer)
    rows = sum(one.rows for one in found.bits.values())
    nothing = {key: replace(one, rows=0) for key, one in found.bits.items()}
    outcomes = {
        Outcome.PASS: [found, replace(found, skipped=rows // 100)],
        Outcome.INCONCLUSIVE: [
            replace(found, skipped=rows // 50), replace(found, bits=nothing),
            replace(found, bit_exact=False, residuals=(), statistics=(), truth=()),
        ],
        Outcome.FAIL: [replace(found, skipped=rows // 50, doubts=("it contradicts itself",))],
    }  # fmt: skip
    for expected, cases in outcomes.items():
        assert [each.outcome for each in cases] == [expected] * len(cases)
    assert outcomes[Outcome.INCONCLUSIVE][0].verdict_line.startswith(f"inconclusive: {rows // 50} of ")


def test_a_truncated_recording_is_inconclusive(hammer: Recording, tmp_path: Path) -> None:
    """Every count present is right, and the number of missing ones is unknown."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(hammer.path.read_bytes()[:-100])  # all samples are there, because it is short
    found = validate(Recording.open(cut))
    assert found.bit_exact
    assert found.outcome is Outcome.INCONCLUSIVE
    assert found.verdict_line.startswith("inconclusive: the recording is not complete")
    wrong = validate(Recording.open(cut), criteria=make_criteria(), changes={"contact.friction": 0.2})
    assert wrong.outcome is Outcome.FAIL


def test_one_changed_count_is_found_with_its_time(hammer: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = Recording.blocks

    def off(self: Recording, key: str):
        for block in blocks(self, key):
            if key.endswith("/probes") and block.index == 80:
                values = block.values.copy()
                values[3, 1] += 1
                block = replace(block, values=values)
            yield block

    monkeypatch.setattr(Recording, "blocks", off)
    found = validate(hammer)
    assert not found.bit_exact
    (stream,) = [one for one in found.bits.values() if not one.equal]
    assert (stream.first_s, stream.first_column, stream.largest) == (83 / 2000, 1, 1.0)


@pytest.mark.parametrize("names", [("disk_x", "disk_y", "P_N"), ("ring_y", "disk_x", "speed")])
def test_of_some_channels_the_bits_are_compared_by_name(
    hammer: Recording, tmp_path: Path, names: tuple[str, ...]
) -> None:
    small = tmp_path / "small.mcap"
    cut(hammer, small, from_s=0.02, to_s=0.05, only="sensors", channels=names)
    found = validate(Recording.open(small))
    assert found.bit_exact
    assert sum(one.rows for one in found.bits.values()) == 2 * 60
    assert "probes 2 of 4" in found.bits_line
    # ... and not by place: another channel's counts under a name are that channel's.
    recording = Recording.open(small)
    group = recording.table.groups["probes"]
    turned = group.model_copy(update={"channels": group.channels[::-1]})
    recording.table.groups["probes"] = turned
    experiment = Experiment.from_recording(recording)
    bits = Bits(recording, experiment.simulation().table)
    predict(experiment, read_measured(recording, experiment.scene), follow=bits.follow)
    assert [key for key, stream in bits.finish().items() if not stream.equal] == [sensor_key("probes")]


def test_gaps_and_a_late_begin_are_passed_over(tmp_path: Path) -> None:
    found = validate(record_scene(tmp_path / "gap.mcap", leave_out=(0, 3)), declared=True)
    assert found.bit_exact
    assert found.good
    assert found.bits[sensor_key("probes")].rows == 80
    assert found.bits[sensor_key("probes")].skipped == 20
    assert found.skipped == 5 * 20 + 4


def test_parts_of_one_run_are_one_recording(hammer: Recording, tmp_path: Path) -> None:
    ends = (0.0, 0.03, 0.06)
    paths = [tmp_path / f"part{k}.mcap" for k in range(2)]
    for path, begin, end in zip(paths, ends, ends[1:], strict=False):
        cut(hammer, path, from_s=begin, to_s=end)
    found = validate(join(paths[::-1]))
    assert found.bit_exact
    assert found.skipped == 0
    assert sum(one.rows for one in found.bits.values()) == 5 * 120 + 4 * 6
    assert found.title == "part0.mcap and 1 more"


def test_another_seed_changes_sensors_and_not_the_motion(hammer: Recording) -> None:
    found = validate(hammer, changes={"seed": 9})
    assert {key.split("/")[1] for key, one in found.bits.items() if not one.equal} == {"sensors"}
    assert found.good
    assert "truth is equal to the bit" in found.bits_line


def test_json_of_an_imported_log_has_earlier_words_and_names_of_defects(hammer: Recording) -> None:
    found = validate(hammer)
    law = Explanation.of(np.zeros(1), kind="sensor", name="P_N freeze", change="", value=0.0, explained=1.0, to_s=1.0)
    faults = [
        SignalFault("P_N", what, 0.0, 1.0, "") for what in ("freeze", "clip", "miss-pulses", "lost samples", "hum")
    ]
    explained = Explained(0.0, 1.0, (law,), "", (law.name,))
    log = replace(found, bits={}, faults=tuple(faults), explained=explained).document()
    assert [one["what"] for one in log["faults"]] == ["stuck", "clipped", "pulses", "rows", "hum"]
    assert [one["defects"] for one in log["faults"]] == [[one.what] for one in faults]
    (ranked,) = log["explained"]["ranked"]
    assert (ranked["name"], ranked["defects"], log["explained"]["best"]) == ("P_N stuck", ["freeze"], ["P_N stuck"])
    own = replace(found, faults=tuple(faults), explained=explained).document()
    assert [one["what"] for one in own["faults"]] == [one.what for one in faults]


def test_few_channels_and_no_truth_are_enough(tmp_path: Path) -> None:
    recording = record_scene(tmp_path / "few.mcap", truth=False, sensors__groups=["accelerations"])
    found = validate(recording, declared=True)
    assert found.good
    assert [phase.name for phase in found.phases] == ["free run"]
    assert not found.truth
    wrong = validate(recording, changes={"contact.friction": 0.2})
    assert not wrong.good
    assert wrong.explained is not None
    assert wrong.explained.best == ("contact.friction",)
    assert wrong.verdict_line.startswith(f"fail, {len(wrong.failures)} of ")
    assert len(wrong.verdict_line) < 200
    assert all(one.limit and one.line for one in wrong.failures)


def test_rows_of_another_clock_are_between_the_models(
    hammer: Recording, measured: tuple[dict[str, Measured], Prediction]
) -> None:
    """A recorder at 1/3 of a millisecond past every row: no row of the model coincides."""
    from scipy.interpolate import CubicSpline

    parts, nominal = measured
    part = parts["probes"]
    late = replace(part, times_s=part.times_s[:40] + 1e-3 / 3.0, index=part.index[:40], values=part.values[:40])
    between = predict(simplify(Experiment.from_recording(hammer)), {"probes": late}).values["probes"]
    assert between == pytest.approx(CubicSpline(part.times_s, nominal.values["probes"])(late.times_s), abs=2e-5)


# Causes of a difference: faults applied to the channels themselves.


def explained(recording: Recording, parts: dict[str, Measured], nominal: Prediction) -> Explained:
    experiment = simplify(Experiment.from_recording(recording))
    rules = load_criteria().attribution
    few = [one for one in rules.candidates if one.name in ("contact.friction", "house.preload", "magnet.stiffness")]
    return attribute(experiment, parts, nominal, rules.model_copy(update={"candidates": tuple(few)}), from_s=0.0)


@pytest.fixture(scope="module")
def measured(hammer: Recording) -> tuple[dict[str, Measured], Prediction]:
    experiment = Experiment.from_recording(hammer)
    parts = read_measured(hammer, experiment.scene, longest_s=1.0)
    return parts, predict(simplify(experiment), parts)


def with_fault(parts: dict[str, Measured], group: str, matrix: np.ndarray, shift: float = 0.0) -> dict[str, Measured]:
    values = parts[group].values @ matrix
    values[:, 0] += shift
    return {**parts, group: replace(parts[group], values=values)}


@pytest.mark.parametrize(
    ("matrix", "shift", "name", "change"),
    [
        (np.diag([1.01, 1.0, 1.0, 1.0]), 0.0, "disk_x gain", "+1 %"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), 0.0, "disk_x polarity", "inverted"),
        (np.eye(4), 0.002, "disk_x offset", "+0.002 mm"),
        (np.eye(4)[[1, 0, 2, 3]], 0.0, "disk_x and disk_y", "swapped"),
    ],
)
def test_a_sensor_fault_is_classified_as_one(
    hammer: Recording,
    measured: tuple[dict[str, Measured], Prediction],
    matrix: np.ndarray,
    shift: float,
    name: str,
    change: str,
) -> None:
    parts, nominal = measured
    found = explained(hammer, with_fault(parts, "probes", matrix, shift), nominal)
    assert found.best == (name,)
    assert found.conclusion.startswith("sensor: ")
    one = next(one for one in found.ranked if one.name == name)
    assert one.change.replace("+0.99", "+1").startswith(change[:5]) or one.change == change


def test_a_late_clock_is_called_time(hammer: Recording, measured: tuple[dict[str, Measured], Prediction]) -> None:
    from scipy.interpolate import CubicSpline

    parts, nominal = measured
    late = {}
    for name, part in parts.items():
        noise = part.values - nominal.values[name]
        late[name] = replace(part, values=CubicSpline(part.times_s, nominal.values[name])(part.times_s - 2e-4) + noise)
    found = explained(hammer, late, nominal)
    assert found.best == ("time offset",)
    assert found.ranked[0].value == pytest.approx(2e-4, abs=2e-6)


def test_two_equal_explanations_are_both_named(tmp_path: Path) -> None:
    """Transducers at rest show the preload alone, or an offset of the same size."""
    recording = record_scene(tmp_path / "rest.mcap", "stable-run", sensors__groups=["forces"])
    found = validate(recording, changes={"house.preload": 2990.0})
    assert not found.good
    assert found.explained is not None
    assert "house.preload" in found.explained.best
    assert any(name.startswith("P_") for name in [one.name for one in found.explained.ranked])


def test_a_second_cause_is_named_with_the_first(tmp_path: Path) -> None:
    """Damping is identified before the impacts, friction only in them."""
    both = {"shaft__damping_ratio_x": 0.03, "contact__friction": 0.24}
    recording = record_scene(tmp_path / "two.mcap", sensors__rate_hz=20_000, duration_s=0.045, **both)
    criteria = make_criteria("contact.friction", "shaft.damping_ratio_x")
    right = {"shaft.damping_ratio_x": 0.016, "contact.friction": 0.25}
    found = validate(recording, criteria=criteria, changes=right).explained
    assert found is not None
    assert found.best[0] == "shaft.damping_ratio_x"
    assert re.search(r"of the difference to 0\.02\d s", found.conclusion)
    match = re.search(r"second cause, contact.friction (\S+) % with shaft.damping_ratio_x (\S+) %", found.conclusion)
    assert match is not None
    assert float(match[1]) == pytest.approx(-4.0, abs=0.1)
    assert float(match[2]) == pytest.approx(87.5, abs=1.0)
    assert found.to_s == pytest.approx(0.05, abs=2e-3)


@pytest.mark.parametrize(("left", "nearest"), [(1.0, False), (31.0, True)])
def test_the_best_candidate_is_no_explanation_if_more_than_noise_remains(left: float, nearest: bool) -> None:
    one = Explanation("model", "ring.clearance", "+2 %", 0.02, "", 0.97, left, 1e4 * left**2, 10_000, 0.3)
    conclusion, names = conclude([one], [], load_criteria().attribution, end_s=0.3)
    assert conclusion.startswith("no candidate alone explains it") == nearest
    assert names == ("ring.clearance",)


def test_a_document_is_json_throughout(hammer: Recording) -> None:
    import json

    criteria = make_criteria("contact.restitution", "contact.friction")
    found = validate(hammer, criteria=criteria, changes={"contact.restitution": 0.85}, declared=True)
    document = json.loads(json.dumps(found.document(), allow_nan=False))
    assert document["good"] is False
    assert document["explained"]["best"] == ["contact.restitution"]
    assert outcome.Validation is type(found)


# Numbers that float.


def test_floated_numbers_are_fitted_to_a_recording_of_the_rig_and_not_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record_scene(tmp_path / "other.mcap", duration_s=0.15, sensors__rate_hz=10_000, contact__friction=0.22).path
    arguments = ("validate", str(path), "--set", "contact.friction=0.25", "--float", "contact.friction", "--json")
    code, out, _ = run_captured(capsys, *arguments)
    floated = json.loads(out)["floated"]["contact.friction"]
    assert code == 0
    assert abs(floated["value"] - 0.22) < floated["half_width"] < 1e-3
    code, _, text = run_captured(capsys, *arguments[:-2], "contact.frictoin")
    assert (code, "contact.friction" in text, text.startswith("rig: --float must be the name of a parameter")) == (
        2,
        True,
        True,
    )


def test_a_number_that_a_recording_does_not_determine_is_no_pass(tmp_path: Path) -> None:
    free = record_scene(tmp_path / "free.mcap", duration_s=0.02)
    found = validate(free, criteria=make_criteria().with_floating(["contact.restitution"]))
    assert found.outcome is Outcome.INCONCLUSIVE
    assert "does not determine contact.restitution" in found.verdict_line


def test_a_log_without_phases_passes_only_if_its_samples_were_compared_to_the_end(tmp_path: Path) -> None:
    found = validate(record_scene(tmp_path / "free.mcap", duration_s=0.02))
    end_s = found.window_s[1]
    for last_s, verdict in ((end_s, Outcome.PASS), (1.5 * end_s, Outcome.INCONCLUSIVE)):
        phases = (Phase("free run", 0.0, last_s),)
        log = replace(found, bits={}, bit_exact=False, statistics=(), phases=phases)
        assert log.outcome is verdict, log.verdict_line
    assert f"the {0.5 * end_s:.3g} s after them were not compared" in log.verdict_line


def test_a_floated_number_is_no_candidate_for_a_cause() -> None:
    rules = load_criteria().with_floating(["house.pair_stiffness_vertical"])
    names = {one.name for one in rules.attribution.candidates}
    assert not names & {"house.pair_stiffness", "house.pair_stiffness_vertical"}
    assert "house.pair_stiffness_horizontal" in names


def test_a_budget_needs_a_log_and_a_known_suffix(hammer: Recording, capsys: pytest.CaptureFixture[str]) -> None:
    out = hammer.path.with_name("budget")
    code, _, text = run_captured(capsys, "validate", str(hammer.path), "--budget", f"{out}.md")
    assert (code, "--budget must be used with a log of another system" in text) == (2, True), text
    code, _, text = run_captured(capsys, "validate", str(hammer.path), "--budget", f"{out}.txt")
    assert (code, "ends in .html, .pdf or .md" in text) == (2, True), text
    assert not out.with_suffix(".md").exists()
    both = ("--budget", f"{out}.html", "--report", f"{out.parent}/./{out.name}.html")
    code, _, text = run_captured(capsys, "validate", str(hammer.path), *both)
    assert (code, "--budget must be another file than --report" in text) == (2, True), text
