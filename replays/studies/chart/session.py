"""Creation of a chart: missing points are measured one by one, then everything is drawn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from replays.studies.chart import profile
from replays.studies.chart.measure import Budget, measure_point, measure_statistics, run_engine
from replays.studies.chart.methods import RIG_FAMILY, Competitor, competitors, missing_peers
from replays.studies.chart.phases import (
    PANELS,
    PHASES,
    RUB,
    SCENE_TARGETS,
    SMOOTHED_SPEEDS,
    SMOOTHING,
    Mode,
    Task,
    build_problem,
    friction_law,
    plan_points,
    scene_problem,
    select,
)
from replays.studies.chart.store import Row, Store, read_table
from replays.studies.chart.submission import PANEL, read_submission
from replays.studies.common.twelve_scenes import TWELVE_SCENES
from replays.studies.peers import PEERS, Setting
from replays.studies.peers.common.problem import Problem, scaled_error
from replays.studies.peers.common.reference import Reference, find_reference
from rig.base.errors import InputError, SimulationError, UnknownNameError

TOTAL_S = {"quick": 95.0, "full": 3300.0}
"""Wall time for all points without compilation [s]; remaining points are left to the next run."""
BUDGETS = {"quick": Budget(2.0, 3, 0.4), "full": Budget(20.0, 3)}
_WALK_SHARE = 0.3
"""Largest share of the time for the profile, and for the twelve scenes, if other panels are made as well."""
_RUB_S = {"quick": 12.0, "full": 60.0}
"""Simulated time of the chaotic rub [s]."""
_RUB_BUDGET_S = {"quick": 4.0, "full": 120.0}


@dataclass
class ChartProgress:
    """Receiver of progress reports, displayed by the command line."""

    begin: Callable[[int], None] = lambda _total: None
    step: Callable[[str], None] = lambda _text: None


@dataclass
class ChartOutcome:
    """Result of a chart run."""

    files: list[Path] = field(default_factory=list)
    measured: int = 0
    resumed: int = 0
    outdated: int = 0
    left: int = 0
    """Points that were not measured for lack of time."""
    failures: int = 0
    added: list[str] = field(default_factory=list)
    """Line about each added file."""
    missing: list[str] = field(default_factory=list)
    """Libraries of peers that are not installed."""
    interrupted: bool = False


def make_chart(
    folder: Path,
    *,
    mode: Mode = "quick",
    only: str | None = None,
    panels: list[str] | None = None,
    peers: bool = True,
    fresh: bool = False,
    end_s: float | None = None,
    methods: list[str] | None = None,
    command: str = "rig chart",
    progress: ChartProgress | None = None,
) -> ChartOutcome:
    """Measure missing points and draw the chart.

    Args:
        folder: Folder for pictures and data.
        mode: Extent of the chart.
        only: A single phase or, on the panel of the scenes, a single scene.
        panels: Panels; None for all.
        peers: Whether to include the peers.
        fresh: Delete earlier points.
        end_s: Upper limit of every window [s] (for tests).
        methods: Methods; None for all.
        command: Command named in the figures.
        progress: Receiver of progress reports.

    Raises:
        InputError: If a choice is invalid, or the folder cannot be written.
    """
    chosen, only, scene = select_points(only, panels)
    progress = progress or ChartProgress()
    store = Store(folder, fresh=fresh)
    contenders = competitors(peers=peers)
    if methods is not None:
        contenders = {name: contenders[name] for name in methods}
    outcome = ChartOutcome(outdated=store.outdated, missing=missing_peers() if peers else [])
    work = _Work(store, contenders, mode, end_s, scene)
    try:
        _measure(work, chosen, only, outcome, progress)
    except KeyboardInterrupt:
        outcome.interrupted = True
    rows = store.rows(mode)
    outcome.failures = sum(bool(row["failure"]) for row in rows)
    if rows:
        from replays.studies.chart.drawing.figure import draw

        note = ""
        if not peers:
            note = "peers left out on request"
        elif outcome.missing:
            note = f"not installed, so not drawn: {', '.join(outcome.missing)} (extra: peers)"
        if outcome.left:
            note += f"{'; ' if note else ''}{outcome.left} points not measured for want of time: run again to add them"
        outcome.files = store.write(mode) + draw(rows, folder, chosen, command=command, note=note)
    return outcome


def select_points(only: str | None, panels: list[str] | None) -> tuple[list[str], str | None, str | None]:
    """Check a selection; return the panels, the phase, and the scene.

    Raises:
        InputError: Unknown phase, scene or panel, or no selected panel has the phase.
    """
    if only in TWELVE_SCENES and (panels == ["scenes"] or (panels is None and only not in PHASES)):
        return ["scenes"], None, only
    if only is not None and panels == ["scenes"]:
        raise UnknownNameError("only", f"one of {', '.join(TWELVE_SCENES)}", only, TWELVE_SCENES)
    return *select(only, panels), None


def draw_again(folder: Path, *, only: str | None = None, panels: list[str] | None = None) -> ChartOutcome:
    """Draw the table of an earlier chart again without measuring.

    Raises:
        InputError: If a choice is invalid, or the folder has no such table.
    """
    from replays.studies.chart.drawing.figure import draw

    chosen, _, scene = select_points(only, panels)
    rows = [row for row in read_table(folder) if scene in (None, row["phase"])]
    if not rows:
        raise InputError("output", "a folder with points in chart.csv", str(folder))
    files = draw(rows, folder, chosen, command=_command(rows[0]["mode"]))
    return ChartOutcome(files=files, resumed=len(rows), failures=sum(bool(row["failure"]) for row in rows))


def add_solvers(folder: Path, paths: list[Path], *, progress: ChartProgress | None = None) -> ChartOutcome:
    """Add solvers outside the project to a chart by their results, and draw it without measuring other points.

    Args:
        folder: Folder of the chart; a new one gets a chart of these solvers only.
        paths: Files of results, one per solver, setting and phase; they replace earlier ones of the same three.
        progress: Receiver of progress reports.

    Raises:
        InputError: If a file is invalid, or the chart was measured by other code.
        SimulationError: If no two codes solved the problem, so that there is no reference.
    """
    from replays.studies.chart.drawing.figure import choose_main_phase, draw

    progress = progress or ChartProgress()
    added = [read_submission(path) for path in paths]
    charted = read_table(folder) if (folder / "chart.csv").exists() else []
    store = Store(folder)
    if not all(store.has(row) for row in charted):
        raise InputError("output", "a folder with a chart by this code, with its journal, or a new one", str(folder))
    mode: Mode = "full" if charted and charted[0]["mode"] == "full" else "quick"
    work = _Work(store, {}, mode, None)
    points: list[Row] = []
    progress.begin(2 * len(added))
    for each in added:
        progress.step(f"reference of {each.phase}")
        _references(work, PANEL, each.phase, "")
        reference = work.reference(PANEL, each.phase, "")
        if reference is None:
            raise SimulationError(f"no two codes solved {each.phase}, so it has no reference")
        progress.step(f"{each.phase}: {each.contender.title}")
        base = work.base(PANEL, each.phase, "", each.contender, each.contender.settings[0])
        points.append({**base, "friction": "exact", **each.point(reference)})
        work.keep(points[-1], {})
    rows = store.rows(mode)
    files = store.write(mode) + draw(rows, folder, list(PANELS), command=_command(mode))
    main_phase = choose_main_phase(rows)
    lines = [
        f"{row['title']}, {row['rung']}, {row['phase']}: {_describe_point(row)}; drawn in "
        f"{'chart.png and ' if row['phase'] == main_phase else ''}chart-exact.png"
        for row in points
    ]
    failures = sum(bool(row["failure"]) for row in rows)
    return ChartOutcome(files=files, measured=len(added), failures=failures, added=lines)


def _describe_point(row: Row) -> str:
    """Return error, speed, contacts and failure of a point in words."""
    error = f"error {row['error']:.1e}" if row["error"] is not None else "no error"
    failed = f", failed: {row['message']}" if row["failure"] else ""
    contacts = f"{row['contacts']} of {row['contacts_reference']} contacts"
    return f"{error}, {row['speed']:.2g} times real time, {contacts}{failed}"


def _command(mode: str) -> str:
    return "rig chart --full" if mode == "full" else "rig chart"


def own_reference(problem: Problem) -> Reference | None:
    """Return a reference without a second peer, from scipy's DOP853 and our rk8, which share only the equations."""
    first = PEERS["scipy-dop853"].solve(problem, Setting("1e-13", 1e-13), budget_s=300.0)
    second = run_engine("rk8", Setting("1e-12", 1e-12, step_us=25), problem, Budget(300.0, 1)).solution
    if first.failure is not None or second.failure is not None:
        return None
    error = scaled_error(first.states, second.states)
    return Reference(first, ("scipy-dop853", "rk8"), error, (first.compile_s, second.compile_s), independent=False)


@dataclass
class _Work:
    """Common state of the points of one chart run."""

    store: Store
    contenders: dict[str, Competitor]
    mode: Mode
    end_s: float | None
    scene: str | None = None
    """The only one of the scenes to measure."""
    problems: dict[tuple[Any, ...], Problem] = field(default_factory=dict)
    references: dict[tuple[Any, ...], Reference | None] = field(default_factory=dict)
    compiled: dict[str, float] = field(default_factory=dict)

    @property
    def compile_s(self) -> float:
        """Compile time until now [s], which is not charged to any budget."""
        return sum(self.compiled.values())

    def compiling(self, what: str, seconds: float, *, again: bool) -> None:
        """Note a compile time; a library reports the same time with every solve, our engines a new one each."""
        before = self.compiled.get(what, 0.0)
        self.compiled[what] = before + seconds if again else max(before, seconds)

    def problem(self, panel: str, phase: str, case: str, smoothing_speed: float = SMOOTHING) -> Problem:
        key = (panel, phase, case, smoothing_speed)
        if key not in self.problems:
            end = _RUB_S[self.mode] if phase == RUB else PHASES[phase].end_s
            end = end if self.end_s is None else min(end, self.end_s)
            self.problems[key] = build_problem(panel, phase, case, smoothing_speed=smoothing_speed, end_s=end)
        return self.problems[key]

    def reference(self, panel: str, phase: str, case: str) -> Reference | None:
        # A smoothed law on the exact panel is compared with exact Coulomb.
        case = "" if panel == "exact" else case
        key = (panel, phase, case)
        if key not in self.references:
            self.references[key] = self.solve(self.problem(panel, phase, case))
        return self.references[key]

    def solve(self, problem: Problem) -> Reference | None:
        reference = find_reference(problem, quick=self.mode == "quick") or own_reference(problem)
        if reference is not None:
            for name, seconds in zip(reference.names, reference.compile_s, strict=True):
                self.compiling(PEERS[name].family if name in PEERS else RIG_FAMILY, seconds, again=False)
        return reference

    def keep(self, row: Row, columns: Row) -> None:
        self.store.add(row | columns)
        self.compiling(row["family"], float(columns.get("compile_s") or 0.0), again=row["family"] == RIG_FAMILY)

    def base(self, panel: str, phase: str, case: str, contender: Competitor, setting: Setting | None) -> Row:
        return {
            "mode": self.mode,
            "panel": panel,
            "phase": phase,
            "case": case,
            "method": contender.name,
            "rung": "" if setting is None else setting.label,
            "title": contender.title,
            "family": contender.family,
            "known_failure": contender.known_failure,
            "step_us": setting.step_us or None if setting is not None else None,
            "tolerance": None if setting is None else setting.tolerance,
        }


def _measure(work: _Work, panels: list[str], only: str | None, outcome: ChartOutcome, progress: ChartProgress) -> None:
    tasks = plan_points(work.contenders, mode=work.mode, panels=panels, only=only)
    walks = {} if only else {panel: len(walk[0]) for panel, walk in _walks(work).items() if panel in panels}
    windows = {(task.panel, task.phase, task.case) for task in tasks if task.panel != RUB}
    progress.begin(len(tasks) + len(windows) + sum(walks.values()))
    total = TOTAL_S[work.mode]
    # The profile and the twelve scenes have their share of the time after the main picture, before other peers.
    main = ("exact", "whirl")
    early = [task for task in tasks if work.contenders[task.method].ours or (task.panel, task.phase) == main]
    late = [task for task in tasks if task not in early]
    for panel, phase, case in sorted(windows):
        if case != "smoothed":
            progress.step(f"reference of {panel}, {phase}")
            _references(work, panel, phase, case)
    clock = time.perf_counter() - work.compile_s
    for task in early:
        _point(work, task, outcome, progress, clock + total)
    for panel in walks:
        share = total * (_WALK_SHARE if tasks else 1.0 / len(walks))
        _walk_ladders(work, panel, outcome, progress, time.perf_counter() - work.compile_s + share)
    for task in late:
        _point(work, task, outcome, progress, clock + total)


def _references(work: _Work, panel: str, phase: str, case: str) -> None:
    """Add the reference and, on the exact panel, the distances of the smoothed laws."""
    own = {"mode": work.mode, "panel": panel, "phase": phase, "case": case or "exact", "family": "reference"}
    own |= {"method": "reference", "rung": ""}
    if work.store.has(own):
        return
    reference = work.reference(panel, phase, case)
    if reference is None:
        return
    columns = {
        "title": " / ".join(reference.names),
        "reference": " / ".join(reference.names),
        "reference_error": reference.error,
        "contacts": reference.solution.contacts,
        "simulated_s": reference.solution.times[-1],
    }
    for speed in SMOOTHED_SPEEDS if panel == "exact" and phase != "drop" else ():
        smooth = work.solve(work.problem(panel, phase, "smoothed", speed))
        if smooth is not None:
            distance = scaled_error(smooth.solution.states, reference.solution.states)
            work.store.add(
                {**own, "case": "floor", "method": "floor", "rung": f"v_s = {speed * 1e3:g} mm/s", "error": distance,
                 "smoothing_speed": speed, "reference_error": smooth.error}
            )  # fmt: skip
    work.store.add(own | columns)


def _point(work: _Work, task: Task, outcome: ChartOutcome, progress: ChartProgress, deadline: float) -> None:
    contender = work.contenders[task.method]
    progress.step(f"{task.panel}, {task.phase}: {contender.title}, {task.setting.label}")
    row = work.base(task.panel, task.phase, task.case, contender, task.setting)
    if work.store.has(row):
        outcome.resumed += 1
        return
    if time.perf_counter() > deadline + work.compile_s:
        outcome.left += 1
        return
    budget = BUDGETS[work.mode]
    row["friction"] = friction_law(task.panel, task.case)
    row["smoothing_speed"] = task.smoothing_speed if row["friction"] == "smoothed" else None
    problem = work.problem(task.panel, task.phase, task.case, task.smoothing_speed)
    if task.panel == RUB:
        budget = budget._replace(solve_s=_RUB_BUDGET_S[work.mode])
        settle = min(1.0, 0.25 * problem.duration_s)
        columns = measure_statistics(contender, task.setting, problem, budget, settle_s=settle)
    else:
        reference = work.reference(task.panel, task.phase, task.case)
        if reference is None:
            outcome.left += 1
            return
        columns = measure_point(contender, task.setting, problem, reference, budget)
    work.keep(row, columns)
    outcome.measured += 1


def _walks(work: _Work) -> dict[str, tuple[dict[str, Callable[[], Problem]], tuple[float, ...]]]:
    """Return problems by phase, and targets, of each panel whose methods search their ladders."""
    draws = {f"scene-{seed:03d}": partial(profile.draw_problem, seed) for seed in range(profile.SCENES[work.mode])}
    scenes = {
        name: partial(scene_problem, name, end_s=work.end_s) for name in TWELVE_SCENES if work.scene in (None, name)
    }
    return {"profile": (draws, (profile.TARGET,)), "scenes": (scenes, SCENE_TARGETS)}


def _walk_ladders(work: _Work, panel: str, outcome: ChartOutcome, progress: ChartProgress, deadline: float) -> None:
    problems, targets = _walks(work)[panel]
    rivals = [one for one in work.contenders.values() if not one.known_failure]
    if panel == "profile":
        rivals = [one for one in rivals if one.takes("exact")]
    if work.mode == "quick":
        # A quick chart has no time for scipy's steps in Python over a whole scene.
        slow = ("scipy-radau", "scipy-bdf") if panel == "profile" else ("scipy",)
        rivals = [one for one in rivals if one.quick and one.name not in slow and one.family not in slow]
    budget = BUDGETS[work.mode]._replace(solve_s=1.0 if work.mode == "quick" else 5.0)
    for phase, make in problems.items():
        progress.step(f"{panel}, {TWELVE_SCENES[phase].title if phase in TWELVE_SCENES else phase}")
        # The setting found is not part of the key: one point per scene, target and method.
        cases = {"" if panel == "profile" else f"{target:g}": target for target in targets}
        rows = [(one, case, work.base(panel, phase, case, one, None)) for one in rivals for case in cases]
        waiting = [(one, case, row) for one, case, row in rows if not work.store.has(row | {"rung": "cheapest"})]
        outcome.resumed += len(rows) - len(waiting)
        if not waiting:
            continue
        if time.perf_counter() > deadline + work.compile_s:
            outcome.left += len(waiting)
            continue
        problem = make()
        reference, reached = work.solve(problem), dict[str, str]()
        for one, case, row in waiting:
            columns = profile.find_cheapest(one, problem, reference, budget, cases[case], reached.get(one.name, ""))
            reached[one.name] = columns.get("rung", "")
            message = columns.get("message") or f"cheapest setting {columns.get('rung', '')}"
            work.keep(row, {**columns, "rung": "cheapest", "message": message})
            outcome.measured += 1
