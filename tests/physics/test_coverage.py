"""Coverage of intervals: each value alone, and five together with the factor for simultaneous intervals.

Many fits, half a minute per seed: set `RIG_COVERAGE_SEEDS` to the number of seeds to run it. It prints a table
(`pytest -s`).

| what | must agree with | why |
|---|---|---|
| share of recordings in which an interval contains the true value | 95 % | the meaning of an interval |
| the same of all five at once, by the wider intervals | 95 % | the meaning of `together` |
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from recorder.reader import Recording
from replays.recordings.export import write_run
from replays.recordings.identification import ask, identify
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.sensitivity import get_value
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

SEEDS = int(os.environ.get("RIG_COVERAGE_SEEDS", "0"))
KEYS = (
    "contact.friction", "contact.restitution", "magnet.stiffness", "house.pair_stiffness_vertical",
    "shaft.unbalance_eccentricity",
)  # fmt: skip
_START_FACTOR = 1.02
"""Start of the search relative to the truth."""
_CONFIDENCE = 0.999
"""An interval is too narrow if the probability of so low a share by chance is below 1 minus this."""


def check_intervals(recording: Recording, keys: tuple[str, ...]) -> tuple[dict[str, bool], bool | None]:
    """Return which intervals contain the true value, and whether all wider ones do at once.

    Without an interval there is no entry, and None.
    """
    experiment = Experiment.from_recording(recording)
    truth = {key: get_value(experiment, key) for key in keys}
    found = identify(
        ask(recording, experiment, keys, start={key: _START_FACTOR * value for key, value in truth.items()})
    )
    given = [one for one in found.judgement.findings if one.standing == "identified"]
    off = {one.unknown.key: abs(one.value - truth[one.unknown.key]) / one.half_width for one in given}
    together = bool(max(off.values()) < found.judgement.together) if len(off) == len(keys) else None
    return {key: bool(each < 1.0) for key, each in off.items()}, together


@pytest.mark.skipif(not SEEDS, reason="RIG_COVERAGE_SEEDS says how many seeds; half a minute each")
@pytest.mark.timeout(0)
def test_intervals_have_their_nominal_coverage(tmp_path: Path) -> None:
    from scipy.stats import binomtest

    counts: dict[str, list[bool | None]] = {}
    for seed in range(100, 100 + SEEDS):
        path = tmp_path / "h.mcap"
        scene = load_scene("hammer", {"duration_s": 0.08, "sensors.rate_hz": 5000, "seed": seed})
        write_run(Simulation(scene), path, force=True)
        recording = Recording.open(path)
        for key in KEYS:
            counts.setdefault(f"{key}, alone", []).append(check_intervals(recording, (key,))[0].get(key))
        each, together = check_intervals(recording, KEYS)
        for key in KEYS:
            counts.setdefault(f"{key}, of five", []).append(each.get(key))
        counts.setdefault("all five at once", []).append(together)
        print(json.dumps({"seed": seed, **{name: found[-1] for name, found in counts.items()}}), flush=True)
    low = []
    for name, every in counts.items():
        found = [inside for inside in every if inside is not None]
        assert len(found) > 0.9 * SEEDS, name
        shares = binomtest(sum(found), len(found), 0.95, alternative="less")
        ci = binomtest(sum(found), len(found)).proportion_ci(method="wilson")
        print(f"{name}: {sum(found)} of {len(found)}, Wilson {ci.low:.3f} to {ci.high:.3f}")
        if shares.pvalue < 1.0 - _CONFIDENCE:
            low.append(name)
    assert not low
