"""Result of a search with its evidence: a JSON document, and the pick as stored in a scene."""

from __future__ import annotations

import math
import platform
from typing import Any

from replays.studies.common import provenance
from replays.studies.ladder.measurement import Measurement
from replays.studies.ladder.quantity import QUANTITIES, Value
from replays.studies.ladder.search import Errors, Ladder
from rig.run.model_choice import Pick, PickedQuantity
from rig.run.scenes import pick_digests

_PACKAGES = ("numba", "numpy", "scipy")


def ladder_document(ladder: Ladder) -> dict[str, Any]:
    """Return the search as a JSON document; infinite or missing values are null."""
    scene = ladder.scene
    return {
        "scene": scene.name,
        "duration_s": scene.duration_s,
        "quantities": [
            {
                "name": name,
                "unit": QUANTITIES[name].unit,
                "phase": QUANTITIES[name].phase,
                "how": QUANTITIES[name].title,
                "tolerance": tolerance,
                "reference": _number(ladder.reference.values[name]),
                "unlike": _number(ladder.unlike.values[name]),
                "reference_error": _number(ladder.reference_errors[name]),
                "as_given": _number(ladder.given.values[name]),
                "as_given_error": _number(ladder.given_errors[name]),
            }
            for name, tolerance in ladder.tolerances.items()
        ],
        "reference": {
            "engine": ladder.reference.candidate.method,
            "unlike": ladder.unlike.candidate.method,
            "model": ladder.reference.candidate.model,
        },
        "outcome": ladder.reference.ending.outcome if ladder.reference.ending else None,
        "savings": {level: _digits(part) for level, part in ladder.savings.items()},
        "steps": [
            {
                "stage": step.stage,
                "label": step.label,
                **_run(step.measured, scene.duration_s),
                "cost": _run(step.cost, scene.duration_s) if step.cost else None,
                "errors": _errors(step.errors),
                "passes": step.passes,
                "note": step.note,
            }
            for step in ladder.steps
        ],
        "pick": make_pick(ladder).model_dump(mode="json"),
        "picked": _run(ladder.picked, scene.duration_s),
        "given": _run(ladder.given, scene.duration_s),
        "full": _run(ladder.full, scene.duration_s),
        "all_engines_tried": ladder.complete,
        "spent_s": ladder.spent_s,
        "versions": versions(),
    }


def make_pick(ladder: Ladder) -> Pick:
    """Return the pick as stored in a scene."""
    scene, picked, errors = ladder.scene, ladder.picked, ladder.picked_errors
    candidate = picked.candidate
    scene_digest, parameters_digest, code_digest = pick_digests(scene)
    environment = versions()
    return Pick(
        **candidate.levels.model_dump(),
        drive=candidate.drive,  # pyrefly: ignore[bad-argument-type]
        sensors=ladder.sensors,  # pyrefly: ignore[bad-argument-type]
        engine=candidate.engine,
        step_us=candidate.step_us,
        engine_tolerance=candidate.tolerance,
        companion=candidate.companion,
        quantities=tuple(
            PickedQuantity(
                quantity=name,
                unit=QUANTITIES[name].unit,
                tolerance=tolerance,
                value=_short(picked.values[name]),
                reference=_short(ladder.reference.values[name]),
                model_error=_digits(errors.model[name]),
                numerical_error=_digits(errors.numerical[name]),
                total_error=_digits(errors.total[name]),
                reference_error=_digits(ladder.reference_errors[name]),
            )
            for name, tolerance in ladder.tolerances.items()
        ),
        cpu_s=_digits(picked.cpu_s),
        cpu_given_s=_digits(ladder.given.cpu_s),
        cpu_full_s=_digits(ladder.full.cpu_s),
        reference_engine=ladder.reference.candidate.method,
        unlike_engine=ladder.unlike.candidate.method,
        date=environment["date"],
        rig=environment["rig"],
        commit=environment["commit"],
        machine=environment["machine"],
        seed=scene.seed,
        scene_digest=scene_digest,
        parameters_digest=parameters_digest,
        code_digest=code_digest,
    )


def versions() -> dict[str, str]:
    """Return date, machine, commit, and the versions that affect the numbers."""
    environment = provenance.versions(provenance.RIG, *_PACKAGES)
    return {
        "date": provenance.today(),
        "rig": environment.pop(provenance.RIG),
        "commit": provenance.commit(),
        "machine": provenance.machine(),
        "python": platform.python_version(),
        **environment,
    }


def _run(measured: Measurement, simulated_s: float) -> dict[str, Any]:
    return {
        "engine": measured.candidate.method,
        "model": measured.candidate.model,
        "values": {name: _number(value) for name, value in measured.values.items()},
        "outcome": measured.ending.outcome if measured.ending else None,
        "contact_share": measured.ending.contact_share if measured.ending else None,
        "cpu_s": _number(measured.cpu_s),
        "cpu_least_s": _number(measured.spread_s[0]),
        "cpu_most_s": _number(measured.spread_s[1]),
        "runs": measured.runs,
        "steps": measured.steps,
        "ns_a_step": _number(measured.step_ns(simulated_s)),
        "energy_residual_share": _number(measured.residual_share),
    }


def _errors(errors: Errors) -> dict[str, dict[str, Value | None]]:
    kinds = (("model", errors.model), ("numerical", errors.numerical), ("total", errors.total))
    return {kind: {name: _number(value) for name, value in values.items()} for kind, values in kinds}


def _number(value: Value) -> Value | None:
    return value if isinstance(value, str) or math.isfinite(value) else None


def _digits(value: float) -> float:
    # Later digits depend on the platform.
    return float(f"{value:.3g}")


def _short(value: Value) -> Value:
    return value if isinstance(value, str) else float(f"{value:.8g}")


def python_line() -> str:
    """Return the environment on one line, for the chart."""
    at = versions()
    packages = ", ".join(f"{name} {at[name]}" for name in _PACKAGES)
    commit = f", commit {at['commit']}" if at["commit"] else ""
    return f"rig {at['rig']}{commit}, {at['date']}; {at['machine']}; Python {at['python']}, {packages}"
