"""Names of drawn faults in logs of another rig: a journal of what is named, and bounds of what may be wrong."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replays.recordings.validation import validate
from tests import faulty_logs, second_rig
from tests.unit.test_nuisance import import_all_channels

BEFORE_S, AFTER_S = 0.3, 0.12
"""Recorded time before and after the hammer pulse."""
COMPARED_ROWS = 1000
"""Rows that are compared up to some contacts, at 20 kHz."""


def judge_drawn(seed: int, motion: second_rig.Motion, folder: Path) -> dict[str, Any]:
    """Return the journal's line of a drawn fault."""
    rng = np.random.default_rng(9000 + seed)
    kind = faulty_logs.KINDS[seed % len(faulty_logs.KINDS)]
    drawn = faulty_logs.draw_fault(kind, rng, motion, COMPARED_ROWS, BEFORE_S)
    found = validate(import_all_channels(folder, motion, seed=500 + seed, case=drawn.case))
    judgement, names, sound = faulty_logs.judge_names(drawn, found)
    return {
        "seed": seed, "fault": kind, "size": drawn.size, "over": round(drawn.over_noise, 3), "judgement": judgement,
        "named": names, "sound": sound, "text": found.explained.conclusion[:300] if found.explained else "",
    }  # fmt: skip


@pytest.mark.skipif("RIG_FAULTY_LOGS" not in os.environ, reason="RIG_FAULTY_LOGS=34: a minute for each drawn fault")
@pytest.mark.timeout(0)
def test_drawn_faults_have_their_names(tmp_path: Path) -> None:
    """RIG_FAULTY_LOGS is the number of faults; RIG_FAULT_JOURNAL a file to which each is appended."""
    motion = second_rig.simulate_pulse(turned=2.1, before_s=BEFORE_S, after_s=AFTER_S, settled_s=1.5)
    journal, lines = Path(os.environ.get("RIG_FAULT_JOURNAL", tmp_path / "journal.jsonl")), list[dict[str, Any]]()
    for seed in range(max(len(faulty_logs.KINDS), int(os.environ["RIG_FAULTY_LOGS"]))):
        (folder := tmp_path / str(seed)).mkdir()
        lines.append(judge_drawn(seed, motion, folder))
        with journal.open("a", encoding="utf-8") as file:
            file.write(json.dumps(lines[-1]) + "\n")
    assert not [one for one in lines if one["judgement"] == "wrong"]
    assert not [one for one in lines if one["sound"]]
    due = [one for one in lines if one["over"] > 1.0]
    assert sum(one["judgement"] in ("right", "class") for one in due) >= 0.9 * len(due)
    large = [one for one in lines if one["over"] > 10.0 / 3.0]
    assert sum(one["judgement"] == "cannot tell" for one in large) <= 0.1 * len(large)
