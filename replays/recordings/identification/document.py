"""A fit as a parameter set that a run takes, and as a JSON document."""

from __future__ import annotations

import json
import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from replays.recordings.identification.fit import Identification
from rig.base.files import check_new_file, write_file
from rig.physics.parameters import DEFAULT_SET, Parameter, load_parameters, set_names


def format_set(result: Identification, *, recording: str) -> str:
    """Return the parameter set as TOML: the set of the experiment with the identified values replaced.

    Values that are not seen keep their start. Values that are only seen together are all written as fitted, with a
    note.
    """
    scene = result.question.experiment.scene
    base = scene.parameters if scene.parameters in set_names() else DEFAULT_SET
    span = f"{result.from_s:.4f} to {result.window.end_s:.4f} s"
    lines = [
        f"# Made by `rig identify`; the model's verdict: {result.judgement.verdict}.",
        f"title = {_quoted(f'Fitted to {recording}, {span}')}",
        f"base = {_quoted(base)}",
    ]
    before = load_parameters(base).entries
    fitted = {finding.unknown.key: finding for finding in result.judgement.findings}
    for key, entry in scene.load_parameters().entries.items():
        finding = fitted.get(key)
        if finding is None:
            if entry != before[key]:
                lines += _entry(key, entry)
            continue
        if finding.standing == "not seen":
            if finding.unknown.rule is None and finding.unknown.start != before[key].value:
                source = f"not seen in {recording}, {span}: start value"
                lines += _entry(key, entry, value=finding.unknown.start, kind="assumed", source=source)
            continue
        unit = "" if entry.unit == "1" else f" {entry.unit}"
        interval = f"95 % interval +-{finding.half_width:.3g}{unit}" if math.isfinite(finding.half_width) else ""
        interval = interval or f"no separate interval, {finding.words}"
        source = f"rig identify, {recording}, {span}: {interval}"
        lines += _entry(key, entry, value=finding.value, kind="fitted", source=source)
    other = [finding for key, finding in fitted.items() if key not in before]
    if other:
        lines += ["", "# Not parameters, and therefore not part of the set:"]
        lines += [f"# {one.unknown.key} = {one.value:.8g} {one.unknown.unit}: {one.words}" for one in other]
    return "\n".join(lines) + "\n"


def check_set(path: Path, *, force: bool) -> None:
    """Check that a set can be written to a file, before anything is computed.

    Raises:
        InputError: Another suffix, a missing folder, or an existing file.
    """
    check_new_file(path, field="output", suffixes=(".toml",), force=force)


def write_set(text: str, path: Path) -> None:
    """Write a set to a file atomically, after a test that it can be loaded."""
    with TemporaryDirectory() as folder:  # a draft has not the ending by which a set is known
        named = Path(folder) / path.name
        named.write_text(text, encoding="utf-8")
        load_parameters(str(named))
    write_file(path, text)


def identification_document(result: Identification, *, recording: str) -> dict[str, Any]:
    """Return all results as a JSON document; non-finite numbers are null."""
    judgement = result.judgement
    return {
        "recording": recording,
        "window_s": [result.from_s, result.window.end_s],
        "window_ends_because": result.why,
        "verdict": judgement.verdict,
        "fits": judgement.fits,
        "white": judgement.white,
        "chi2_per_degree_of_freedom": judgement.chi2,
        "degrees_of_freedom": judgement.dof,
        "simultaneous_over_single_intervals": judgement.together,
        "interval_inflation": judgement.inflation,
        "values": {
            finding.unknown.key: {
                "standing": finding.standing,
                "value": finding.value if finding.standing == "identified" else None,
                "half_width_95": finding.half_width if math.isfinite(finding.half_width) else None,
                "unit": finding.unknown.unit,
                "start": finding.unknown.start,
                "words": finding.words,
            }
            for finding in judgement.findings
        },
        "correlation": [[None if math.isnan(c) else float(c) for c in row] for row in judgement.correlation],
        "singular_values": judgement.singular_values.tolist(),
        "channels": [vars(channel) for channel in judgement.channels],
        "stages": [
            {
                "end_s": stage.end_s,
                "why": stage.why,
                "values": stage.values.tolist(),
                "half_widths_95": stage.half_widths.tolist(),
                "chi2": stage.chi2,
                "chi2_of_new_samples": stage.fresh,
            }
            for stage in result.stages
        ],
        "simulations": result.runs,
        "spread_made_smaller": result.narrowed,
    }


def _entry(key: str, entry: Parameter, **changes: Any) -> list[str]:
    value, kind, source = (changes.get(name, getattr(entry, name)) for name in ("value", "kind", "source"))
    shown = _quoted(value) if isinstance(value, str) else repr(float(value))
    return ["", f"[{key}]", f"value = {shown}", f"kind = {_quoted(kind)}", f"source = {_quoted(source)}"]


def _quoted(text: str) -> str:
    # A JSON string without escapes beyond ASCII is a basic string of TOML.
    return json.dumps(text, ensure_ascii=False)
