"""The cheapest sufficient model of twelve scenes for three questions, each result checked against `taylor`.

Run `python -m tests.physics.ladder_runs [SCENE ...]`; each search takes 20 to 60 s of processor time, about 25 minutes
in all. Rows of the table in docs/engines.md are printed as they are found. The last column is the error of the chosen
run against the full model by `taylor` at 1e-11, which the search does not use. A model with an error above twice the
limit is marked, and the status is 1.
"""

from __future__ import annotations

import math
import sys

from replays.studies.common.twelve_scenes import TWELVE_SCENES, StudyScene
from replays.studies.ladder.measurement import Candidate, measure
from replays.studies.ladder.quantity import QUANTITIES
from replays.studies.ladder.search import Ladder, search
from rig.base.errors import InputError

QUESTIONS = ("whirl_frequency", "reaction_amplitude", "time_to_roll")
TOLERANCE, BUDGET_S = 0.01, 300.0


def exact(found: Ladder) -> Candidate:
    """Return the full model by `taylor`."""
    return found.reference.candidate.with_engine("taylor", 25, 1e-11)


def row(study: StudyScene, name: str) -> tuple[str, bool]:
    """Return a row of the table, and whether the model meets the limit."""
    scene = study.load().model_copy(update={"duration_s": study.window_s})
    try:
        found = search(scene, {name: TOLERANCE}, budget_s=BUDGET_S)
    except InputError as error:
        return f"| {study.title} | {name} | none: {error} | | | | |", True
    picked, full = found.picked, found.full
    checked = measure(scene, exact(found), (name,), runs=1)
    error = QUANTITIES[name].error(picked.values[name], checked.values[name])
    left_out = ", ".join(f"{level} {part:.0%}" for level, part in found.savings.items()) or "nothing"
    holds = math.isfinite(error) and error <= 2.0 * TOLERANCE
    given = picked.cpu_s / found.given.cpu_s
    cells = study.title, name, picked.candidate.label, left_out, f"{given:.2f}", f"{picked.cpu_s / full.cpu_s:.2f}"
    return f"| {' | '.join(cells)} | {error:.1e}{'' if holds else ' MISSED'} |", holds


def main() -> int:
    """Print the table; return 1 if a model exceeds twice the limit, 2 if a scene is unknown."""
    names = sys.argv[1:] or list(TWELVE_SCENES)
    if unknown := [name for name in names if name not in TWELVE_SCENES]:
        print(f"SCENE must be one or more of {', '.join(TWELVE_SCENES)}; received {unknown[0]!r}", file=sys.stderr)
        return 2
    print(
        "| scene | question | pick | saved | of the scene as given | of the full model | error |\n" + "|---" * 7 + "|"
    )
    every = True
    for name in names:
        for question in QUESTIONS:
            text, holds = row(TWELVE_SCENES[name], question)
            every = every and holds
            print(text, flush=True)
    return 0 if every else 1


if __name__ == "__main__":
    raise SystemExit(main())
