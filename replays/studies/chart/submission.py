"""Solvers outside the project: the problem file for an author, and the file of results.

`docs/charts.md` describes both files. The solver is not run here, so its processor time and its number of contacts are
taken from its file.
"""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from replays.studies.chart.measure import Budget, measure_point
from replays.studies.chart.methods import ADDED_FAMILY, Competitor
from replays.studies.chart.phases import PHASES, RUB, build_problem
from replays.studies.common.journal import prepare_folder
from replays.studies.peers import PEERS, Library, Peer, Setting
from replays.studies.peers.common.problem import ERROR_COLUMNS, Problem
from replays.studies.peers.common.reference import Reference
from replays.studies.peers.common.solution import Solution
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.files import build_read_error, read_file, write_file
from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import STATE

PANEL = "exact"
"""Panel of the problems: total error against exact Coulomb friction."""
_PHASES = tuple(name for name in PHASES if name != RUB)
"""Phases with an error at each instant; the chaotic rub has only statistics."""
_KEYS = ("solver", "phase", "setting", "cpu_s", "contacts")
_COLUMNS = ("time [s]", *(f"{STATE[column].name} [{STATE[column].unit}]" for column in ERROR_COLUMNS))
_MAX_BYTES = 1 << 24
"""Largest size of a file, many times the longest phase at full precision; the rest is not read."""
_INSTANT_TOLERANCE_S = 1e-9
"""Tolerance for rounded times, a thousandth of the model's tick."""
_MAX_VALUE = 1e9
"""Upper limit of states in SI units and of processor times [s]."""
_LABEL = re.compile(r"[A-Za-z0-9][ -#%-~]{0,39}")
"""Pattern of names that fit a legend, without dollar signs, which start a formula in matplotlib."""
_UNIT = re.compile(r"^    (\w+): \w+  # .*?\[(.+?)\]", re.MULTILINE)
"""Name and unit of a field of `rig.physics.kernels.constants`, whose comments hold the unit in brackets."""


def write_problem(phase: str, folder: Path) -> Path:
    """Write a problem without its solution to FOLDER/problem-PHASE.json, and return the path.

    Args:
        phase: One of `_PHASES`.
        folder: Output folder, created if missing.

    Raises:
        InputError: If the phase is another, or the folder cannot be created or written.
        DiskError: If the file cannot be written.
    """
    problem = _exact_problem(phase)
    constants = problem.constants
    groups = {name: getattr(constants, name) for name in ("shaft", "magnet", "contact", "house")}
    groups["inputs"] = problem.inputs
    document = {
        "phase": phase,
        "title": PHASES[phase].title,
        **{name: group._asdict() for name, group in groups.items()},
        "torque_gain": constants.torque_gain,
        "initial_state": {signal.name: float(value) for signal, value in zip(STATE, problem.y0, strict=True)},
        "corners_s": problem.corners,
        "instants_s": problem.times.tolist(),
        "scales": {signal.name: signal.scale for signal in STATE},
        "units": {name: dict(_UNIT.findall(inspect.getsource(type(group)))) for name, group in groups.items()}
        | {"initial_state": {signal.name: signal.unit for signal in STATE}, "torque_gain": "N m s"},
    }
    prepare_folder(folder)
    path = folder / f"problem-{phase}.json"
    write_file(path, json.dumps(document, indent=1) + "\n")
    return path


class Submission(NamedTuple):
    """A solver at one setting on one phase, with states, contacts and processor time from its file."""

    contender: Competitor
    phase: str
    problem: Problem
    solution: Solution

    def point(self, reference: Reference) -> dict[str, Any]:
        """Return the columns of the point, computed as for any peer.

        Args:
            reference: Reference of the problem.
        """
        name, settings = self.contender.name, self.contender.settings
        PEERS[name] = _RecordedPeer(name, name, Library(ADDED_FAMILY, ""), settings, {"solution": self.solution})
        try:
            return measure_point(self.contender, settings[0], self.problem, reference, Budget(np.inf, 1))
        finally:
            del PEERS[name]


class _RecordedPeer(Peer):
    """A peer whose solution comes from a file."""

    def solve(self, problem: Problem, setting: Setting | None = None, *, budget_s: float = 60.0) -> Solution:
        """Return the solution of the file."""
        return self.options["solution"]


def read_submission(path: Path) -> Submission:
    """Read a file of a solver's results.

    Args:
        path: File with comment lines `# KEY: VALUE`, a line of column names with units, and a row per instant.

    Raises:
        InputError: If the file cannot be read, or a key, a column or a row is missing or wrong.
    """
    try:
        lines = read_file(path, _MAX_BYTES).decode("utf-8-sig", "replace").splitlines()
    except OSError as error:
        raise build_read_error(path, error) from None
    comments = [line[1:].partition(":") for line in lines if line.startswith("#")]
    names = [name.strip() for name, _, _ in comments]
    for key in _KEYS:
        if names.count(key) != 1:
            raise InputError(
                key, f"in one line `# {key}: VALUE` of {path.name}", Words(f"{names.count(key)} such lines")
            )
    keys = dict(zip(names, (value.strip() for _, _, value in comments), strict=True))
    problem, solver, label = _exact_problem(keys["phase"]), keys["solver"], keys["setting"]
    for key in ("solver", "setting"):
        if not _LABEL.fullmatch(keys[key]) or keys[key] in {*ENGINES, *PEERS, "reference"}:
            must = "1 to 40 ASCII characters without $, a letter or digit first, and no name used in the chart"
            raise InputError(key, must, keys[key])
    solution = Solution(problem.times, np.inf)
    solution.cpu_s = _number("cpu_s", keys, 1e-9, _MAX_VALUE)
    if not re.fullmatch(r"\d{1,5}", keys["contacts"]):
        raise InputError("contacts", "a whole number from 0 to 99999", keys["contacts"])
    solution.onsets = [(np.nan, np.nan)] * int(keys["contacts"])
    solution.states[:] = 0.0
    solution.states[:, ERROR_COLUMNS] = _states(
        [line for line in lines if line.strip() and not line.startswith("#")], problem.times
    )
    tolerance = float(label) if re.fullmatch(r"\d+(\.\d+)?(e-?\d+)?", label) else 0.0
    setting = (Setting(label, tolerance),)
    return Submission(Competitor(solver, solver, ADDED_FAMILY, setting, setting), keys["phase"], problem, solution)


def _exact_problem(phase: str) -> Problem:
    if phase not in _PHASES:
        raise UnknownNameError("phase", f"one of {', '.join(_PHASES)}", phase, _PHASES)
    return build_problem(PANEL, phase, "")


def _number(key: str, texts: dict[str, str], least: float, most: float, place: str = "") -> float:
    try:
        value = float(texts.get(key, ""))
    except ValueError:
        value = np.nan
    if not least <= value <= most:
        raise InputError(key + place, f"a number from {least:g} to {most:g}", texts.get(key, Words("nothing")))
    return value


def _states(lines: list[str], times: np.ndarray) -> np.ndarray:
    """Return states by column names at the problem's instants, shape (n, 7)."""
    headings = [name.strip(' "') for name in lines[0].split(",")] if lines else []
    if any(headings.count(name) != 1 for name in _COLUMNS):
        raise InputError("columns", f"{', '.join(_COLUMNS)}, each once", Words(", ".join(headings)))
    if len(lines) != len(times) + 1:
        raise InputError("rows", f"{len(times)}, one at each instant of the problem", len(lines) - 1)
    values = np.empty((len(times), len(_COLUMNS)))
    for i, time_s in enumerate(times.tolist()):
        fields, place = dict(zip(headings, lines[i + 1].split(","), strict=False)), f" in row {i + 1}"
        values[i] = [_number(name, fields, -_MAX_VALUE, _MAX_VALUE, place) for name in _COLUMNS]
        if abs(values[i, 0] - time_s) > _INSTANT_TOLERANCE_S:
            raise InputError(_COLUMNS[0] + place, f"{time_s:.9g}, as in the problem", float(values[i, 0]))
    return values[:, 1:]
