"""Undeclared faults of channels, detected and named in recordings of this rig: each kind, and random ones."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder import rewrite
from recorder.files.payload import Payload
from recorder.reader import Recording
from recorder.rewrite import cut
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import predict, read_measured
from replays.recordings.validation import validate
from replays.recordings.validation.bits import Bits
from replays.recordings.validation.explanations.explanation import Explanation
from replays.recordings.validation.explanations.single_channels import own_faults
from rig.base.errors import InputError
from rig.base.wire import EDGES, encode_block, sensor_key, truth_key
from rig.channels.faults import KINDS
from rig.channels.faults.defects import DEFECTS, alternatives, unit_of
from rig.channels.table import default_table
from tests.fault_cases import BLIND_SIZES, BLOCKS, DEFECT_OF, size_of
from tests.physics.test_identification import recorded

CHANNEL_KINDS = [name for name, kind in KINDS.items() if not kind.of_blocks]
"""Faults of blocks keep the counts, and are detected by the rows that are present."""
PROBES_KEY = sensor_key("probes")
PROBES, FORCES = ("disk_x", "disk_y", "ring_x", "ring_y"), ("P_N", "P_S", "P_E", "P_W")
ACCELERATIONS = ("inner_x", "inner_y", "outer_x", "outer_y")
FULL = {"disk": 0.25, "ring": 0.127, "P": 1000.0, "inner": 980.0, "outer": 980.0}
"""Units per volt of a channel."""
REACH = {"disk": 1.5, "ring": 1.0, "P": 3500.0, "inner": 50.0, "outer": 50.0}
"""Approximate range of a channel."""
RANDOM = ("intermittent", "spikes")
"""Kinds with random times."""


def find_faults(recording: Recording) -> tuple[list[Explanation], set[str]]:
    """Return the findings of a blind validation, and the channels that differ."""
    experiment = Experiment.from_recording(recording).without_faults()
    parts, bits = read_measured(recording, experiment.scene), Bits(recording, experiment.simulation().table)
    nominal = predict(experiment, parts, follow=bits.follow)
    bits.finish()
    explanations = own_faults(
        parts, nominal, bits.differences, recording.edges(), bits.edges_s(), lambda other: predict(experiment, other)
    )
    return explanations, {name for part in parts for name in bits.channels_off(part)}


def is_named_right(explanations: list[Explanation], channel: str, kind: str) -> bool:
    """Return whether there is one certain finding, on the channel, with a name of the kind."""
    if len(explanations) != 1 or not explanations[0].sure:
        return False
    names, what = explanations[0].channels_and_defect
    looks_alike = DEFECTS[DEFECT_OF[kind]].validation or [DEFECT_OF[kind]]
    return channel in names.split() and not {*alternatives(what or explanations[0].change)}.isdisjoint(looks_alike)


@pytest.mark.parametrize(("kind", "numbers"), [(kind, n) for kind, (_, sizes) in BLIND_SIZES.items() for n in sizes])
def test_a_fault_has_its_name(kind: str, numbers: dict[str, Any], tmp_path: Path) -> None:
    channel = BLIND_SIZES[kind][0]
    pulse = {"at_s": 0.02, "command": "hammer", "force_n": 120.0, "duration_ms": 5.0, "direction": "x"}
    # There is one pulse per turn, and one spike in 25 ms.
    lasts_s, duration_s = (0.4, 0.6) if channel == "keyphasor" else (0.2, 0.3) if kind == "spikes" else (0.1, 0.18)
    fault = {"at_s": 0.05, "command": "fault", "channel": channel, "kind": kind, "for_s": lasts_s, **numbers}
    recording = recorded(
        tmp_path / "a.mcap", "hammer", duration_s=duration_s, drive__speed_hz=12.0, commands=[pulse, fault]
    )
    explanations, differ = find_faults(recording)
    assert is_named_right(explanations, channel, kind), [(one.name, one.change, one.left) for one in explanations]
    assert differ == {channel, *([numbers["other"]] if kind == "swap" else [])}
    size, defect, what = size_of(kind, numbers, channel), DEFECT_OF[kind], explanations[0].channels_and_defect[1]
    # Another number of a law, such as the end of a drift, has another unit; there are few pulses in 0.4 s.
    unit = unit_of(defect, default_table().channels[channel].unit)
    if size is not None and (what, explanations[0].unit) == (defect, unit) and channel != "keyphasor":
        assert explanations[0].value == pytest.approx(size, rel=0.5 if kind in RANDOM else 0.05)
    assert explanations[0].from_s == pytest.approx(0.05, abs=0.2 if channel == "keyphasor" or kind in RANDOM else 0.03)


@pytest.mark.parametrize("kind", [kind for kind in BLOCKS if DEFECTS[DEFECT_OF[kind]].doubts])
def test_a_fault_of_blocks_is_a_doubt(kind: str, tmp_path: Path) -> None:
    fault = {"at_s": 0.05, "command": "fault", "channel": "probes", "kind": kind, "for_s": 0.1, **BLOCKS[kind]}
    recording = recorded(tmp_path / "a.mcap", "hammer", duration_s=0.2, commands=[fault])
    doubts = " ".join(validate(recording, blind=True).doubts)
    assert DEFECTS[DEFECT_OF[kind]].doubts in doubts


def test_a_blind_validation_names_the_fault(tmp_path: Path) -> None:
    commands = [
        {"at_s": 0.05, "command": "fault", "channel": "ring_x", "kind": "hum", "amplitude_v": 0.01},
        {"at_s": 0.1, "command": "fault", "channel": "P_W", "kind": "drift", "rate": 50.0, "for_s": 0.2},
    ]
    found = validate(recorded(tmp_path / "a.mcap", "hammer", duration_s=0.4, commands=commands), blind=True)
    assert not found.good
    lines = [one.line for one in found.faults]
    assert lines[0].startswith("ring_x hum: 50 Hz, 0.001271 mm, from 0.0500 to ")
    assert lines[1].startswith("P_W drift: +50 N/s, from 0.1")
    assert found.explained is not None
    assert found.explained.best == ("ring_x hum", "P_W drift")


def test_a_recording_of_a_part_of_a_run_passes(tmp_path: Path) -> None:
    """The missing history before its start is not a fault."""
    whole = recorded(tmp_path / "a.mcap", "stable-run", duration_s=0.6, drive__speed_hz=12.0)
    cut(whole, tmp_path / "part.mcap", from_s=0.25, to_s=0.5)
    for blind in (False, True):
        assert validate(Recording.open(tmp_path / "part.mcap"), blind=blind).good
    fault = {"at_s": 0.3, "command": "fault", "channel": "disk_x", "kind": "offset", "value": 0.01}
    faulty = recorded(tmp_path / "b.mcap", "stable-run", duration_s=0.6, drive__speed_hz=12.0, commands=[fault])
    cut(faulty, tmp_path / "late.mcap", from_s=0.25, to_s=0.5)
    found = validate(Recording.open(tmp_path / "late.mcap"), blind=True)
    assert [one.line.partition(",")[0] for one in found.faults] == ["disk_x offset: +0.01 mm"]


Change = Callable[[str, np.ndarray, np.ndarray], np.ndarray]


def rewrite_values(source: Recording, output: Path, change: Change) -> Recording:
    """Write a recording whose values are changed by a function of key, row numbers and values."""

    def rewrite_block(payload: Payload) -> Payload:
        if (block := payload.block) is None or payload.key == EDGES:
            return payload
        values = change(payload.key, block.index + np.arange(len(block.values)), block.values)
        block = replace(block, values=values.astype(block.values.dtype))
        return replace(payload, data=encode_block(block), block=block)

    write = rewrite._write  # noqa: SLF001 (no public function changes values)
    nothing = InputError("file", "a recording with rows", str(source.path))
    write(source, output, metadata={}, reason="cut", force=True, change=rewrite_block, empty=nothing, on_progress=None)
    return Recording.open(output)


def splice(other: Recording, from_s: float, to_s: float = 9.0, by_s: float = 0.0, key: str = "") -> Change:
    """Return a change that replaces rows of a time by those of a recording that are later by `by_s`."""

    def change(name: str, index: np.ndarray, values: np.ndarray) -> np.ndarray:
        if key and name != key:
            return values
        blocks = list(other.blocks(name))
        there, rate_hz = np.concatenate([one.values for one in blocks]), float(blocks[0].rate_hz)
        rows = np.clip(index - blocks[0].index + round(by_s * rate_hz), 0, len(there) - 1)
        inside = (index >= from_s * rate_hz) & (index < to_s * rate_hz)
        return np.where(inside[:, None], there[rows], values)

    return change


@pytest.mark.parametrize("key", ["", PROBES_KEY])
def test_copied_rows_are_found_with_their_times(key: str, tmp_path: Path) -> None:
    sound = recorded(tmp_path / "a.mcap", "hammer", duration_s=0.2)
    found = validate(rewrite_values(sound, tmp_path / "b.mcap", splice(sound, 0.1, 0.12, by_s=0.05, key=key)))
    copies = [one.line for one in found.faults if one.what == "doubled samples"]
    assert "rows of probes from 0.1500 to 0.1699 s are equal bit for bit to those from 0.1000 s" in copies[0]
    assert not any("delay" in one.line or "wander" in one.line for one in found.faults)
    if not key:
        assert "differ at once from 0.100" in found.faults[-1].line


@pytest.mark.parametrize("other", [{"seed": 99}, {"drive__speed_hz": 6.0}])
def test_a_splice_of_two_runs_is_found_with_its_time(other: dict[str, Any], tmp_path: Path) -> None:
    sound = recorded(tmp_path / "a.mcap", "hammer", duration_s=0.2)
    later = recorded(tmp_path / "b.mcap", "hammer", duration_s=0.2, **other)
    found = validate(rewrite_values(sound, tmp_path / "c.mcap", splice(later, 0.14)))
    (fault,) = found.faults
    assert (fault.channel, fault.what, fault.from_s) == ("time", "other run", pytest.approx(0.14, abs=1e-4))
    for changed in ({"contact.friction": 0.24}, {"seed": 5}) * ("seed" in other):  # no splice
        assert not [one for one in validate(sound, changes=changed).faults if one.what == "other run"]


def test_truth_that_contradicts_the_state_is_a_doubt(tmp_path: Path) -> None:
    sound = recorded(tmp_path / "a.mcap", "hammer", duration_s=0.05)
    contact = truth_key("contact")
    changed = rewrite_values(
        sound, tmp_path / "b.mcap", lambda key, _, values: values * (1.02 if key == contact else 1.0)
    )
    found = validate(changed)
    assert not found.good
    assert "truth/contact contradicts truth/state" in found.doubts[0]


def some_fault(rng: random.Random) -> dict[str, Any]:
    """Return a fault of random kind, size, channel and time."""

    def between(low: float, high: float) -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    kind = rng.choice(CHANNEL_KINDS)
    channel = "keyphasor" if KINDS[kind].channel_only else rng.choice(PROBES + FORCES + ACCELERATIONS)
    full, sign = FULL.get(channel.partition("_")[0], 1.0), rng.choice((-1.0, 1.0))
    other = rng.choice([name for name in PROBES + FORCES + ACCELERATIONS if name != channel])
    numbers: dict[str, Any] = {
        "gain": {"factor": 1.0 + sign * between(0.002, 0.8)}, "offset": {"value": sign * full * between(0.003, 1.0)},
        "drift": {"rate": sign * full * between(0.05, 5.0), "tau_s": rng.choice((None, between(0.03, 0.3)))},
        "nonlinear": {"end": REACH.get(channel.partition("_")[0], 1.0) * between(1.0, 8.0)},
        "resonance": {"frequency_hz": between(30.0, 3000.0), "quality": between(1.0, 100.0)},
        "open": {"level_v": rng.uniform(-9.0, 9.0)},
        "intermittent": {"part": rng.uniform(0.05, 0.7), "slot_s": between(0.002, 0.05)},
        "hum": {"amplitude_v": between(0.003, 0.5), "frequency_hz": between(10.0, 400.0)},
        "crosstalk": {"source": other, "db": rng.uniform(-60.0, -10.0)}, "swap": {"other": other},
        "saturation": {"part": rng.uniform(0.02, 0.5)}, "bandwidth": {"corner_hz": between(50.0, 4000.0)},
        "late": {"late_us": between(5.0, 3500.0)}, "clock": {"ppm": sign * between(100.0, 20000.0)},
        "jitter": {"rms_us": between(3.0, 200.0)}, "noise": {"factor": between(1.2, 30.0)},
        "wander": {"amplitude_us": between(5.0, 1000.0), "period_s": between(0.05, 0.5)},
        "spikes": {"rate_hz": between(10.0, 500.0), "size_v": between(0.01, 2.0)}, "bits": {"lost": rng.randint(2, 16)},
        "stuck-bit": {"bit": rng.randint(2, 18), "value": rng.choice((0, 1))}, "clip": {"part": rng.uniform(0.02, 0.4)},
        "miss-pulses": {"part": 0.3}, "extra-pulses": {"part": 0.3}, "edge-jitter": {"rms_us": between(20.0, 300.0)},
    }.get(kind, {})  # fmt: skip
    return {
        "at_s": round(rng.uniform(0.0, 0.4), 6), "command": "fault", "channel": channel, "kind": kind,
        **{key: value for key, value in numbers.items() if value is not None},
        **({"for_s": round(rng.uniform(0.1, 0.5), 6)} if rng.random() < 0.7 else {}),
    }  # fmt: skip


@pytest.mark.skipif("RIG_BLIND_FAULTS" not in os.environ, reason="RIG_BLIND_FAULTS=250: four minutes")
def test_random_faults_have_their_names(tmp_path: Path) -> None:
    """95 of 100 faults that change a count have the right name, and at most one a wrong one."""
    rng = random.Random(int(os.environ.get("RIG_BLIND_SEED", "2030")))
    total, wrong, unnamed = 0, list[str](), list[str]()
    for n in range(int(os.environ["RIG_BLIND_FAULTS"])):
        pulse = {"at_s": 0.02, "command": "hammer", "force_n": rng.uniform(1.0, 150.0), "duration_ms": 5.0}
        fault, speed = some_fault(rng), rng.choice((6.2, rng.uniform(4.0, 14.9)))
        recording = recorded(
            tmp_path / f"{n}.mcap", "hammer", duration_s=0.8, drive__speed_hz=speed, commands=[pulse, fault]
        )
        explanations, differ = find_faults(recording)
        (tmp_path / f"{n}.mcap").unlink()
        if not differ:
            continue
        total += 1
        if not is_named_right(explanations, fault["channel"], fault["kind"]):
            line = (
                f"{n}: {speed:.4g} Hz, {pulse['force_n']:.4g} N, {fault}: {[(o.name, o.change) for o in explanations]}"
            )
            (wrong if any(one.sure for one in explanations) else unnamed).append(line)
    print(f"{total} faults: {len(wrong)} wrong, {len(unnamed)} unnamed", *wrong, *unnamed, sep="\n")
    assert len(wrong) <= 0.01 * total
    assert len(unnamed) <= 0.05 * total


def test_a_common_fault_and_one_without_truth_are_reported(tmp_path: Path) -> None:
    """If all channels of a kind are late, they are reported as late and the others not as early; a single channel is
    reported without the truth as well.
    """
    late = {"at_s": 0.05, "command": "fault", "channel": "forces", "kind": "late", "late_us": 200.0}
    gain = {"at_s": 0.05, "command": "fault", "channel": "disk_x", "kind": "gain", "factor": 1.1}
    pulse = {"at_s": 0.02, "command": "hammer", "force_n": 120.0, "duration_ms": 5.0, "direction": "x"}
    alike = recorded(tmp_path / "a.mcap", "hammer", duration_s=0.2, commands=[pulse, late, gain])
    lines = [one.line.partition(", from")[0] for one in validate(alike, blind=True).faults]
    assert sorted(lines) == ["P_N, P_S, P_E, P_W delay: +200 µs", "disk_x gain: +10 %"]
    one = recorded(tmp_path / "b.mcap", "hammer", duration_s=0.2, commands=[pulse, gain])
    cut(one, tmp_path / "c.mcap", only="sensors")
    found = validate(Recording.open(tmp_path / "c.mcap"), blind=True)
    assert not found.good
    assert "disk_x gain" in (found.explained.conclusion if found.explained else "")


def test_a_fault_that_changes_is_not_named_by_its_start(tmp_path: Path) -> None:
    faults = [
        {"at_s": 0.05, "command": "fault", "channel": "P_N", "kind": "gain", "factor": 1.05, "for_s": 2.0},
        {"at_s": 2.05, "command": "fault", "channel": "P_N", "kind": "polarity"},
    ]
    recording = recorded(tmp_path / "a.mcap", "stable-run", duration_s=2.5, commands=faults)
    (explanation,), _ = find_faults(recording)
    assert not explanation.sure
    assert "and at its end" in explanation.change
