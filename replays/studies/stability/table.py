"""Table of trials: one cell per case and engine, followed by known errors of other solvers."""

from __future__ import annotations

from collections.abc import Iterator

from replays.studies.stability.peers import peer_cells
from replays.studies.stability.trials.cell import Cell
from replays.studies.stability.trials.trials import TRIALS
from rig.base.errors import InputError
from rig.physics.engines import ENGINES


def select_trials(only: str | None) -> list[str]:
    """Return the trials of a comma-separated list; None selects all.

    Raises:
        InputError: If a trial does not exist.
    """
    return choose_names("--only", only, list(TRIALS))


def select_engines(names: str | None) -> list[str]:
    """Return the engines of a comma-separated list; None selects all.

    Raises:
        InputError: If an engine does not exist.
    """
    return choose_names("--engines", names, list(ENGINES))


def run_trials(trials: list[str], engines: list[str], *, quick: bool) -> Iterator[Cell]:
    """Yield the cells trial by trial: first the engines, then the peers."""
    for trial in trials:
        for engine in engines:
            yield from TRIALS[trial].run(engine, quick)
        yield from peer_cells(trial)


def choose_names(field: str, names: str | None, choices: list[str]) -> list[str]:
    """Return the known names of a comma-separated list, in their own order; None selects all.

    Raises:
        InputError: If a name does not exist, or the list is empty.
    """
    if names is None:
        return choices
    requested = [name.strip() for name in names.split(",") if name.strip()]
    by_lower = {name.lower(): name for name in choices}
    for name in requested:
        if name.lower() not in by_lower:
            raise InputError(field, f"one or more of {', '.join(choices)}", name)
    wanted = {by_lower[name.lower()] for name in requested}
    if not wanted:
        raise InputError(field, f"one or more of {', '.join(choices)}", names)
    return [name for name in choices if name in wanted]
