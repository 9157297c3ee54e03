"""Terminal display of a run or replay that this process serves."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer

from rig.cli.output.tables import echo, progress_bar

Status = Callable[[], dict[str, Any]]
Line = Callable[[dict[str, Any]], list[str]]


@contextmanager
def display_status(status: Status, words: Line) -> Iterator[None]:
    """Show the status during the block: a live line on a terminal, otherwise a line every 5 s.

    Args:
        status: Returns the status document.
        words: Returns the parts of the line.
    """
    done = threading.Event()
    # In its own thread, so that a suspended terminal (Ctrl-S) does not block the run.
    show = _show_live if sys.stderr.isatty() else _show_lines
    thread = threading.Thread(target=show, args=(status, words, done), name="display", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join(timeout=1.0)


def _show_live(status: Status, words: Line, done: threading.Event) -> None:
    with progress_bar(auto_refresh=False, transient=True) as bar:
        task = bar.add_task("")
        while not done.wait(0.5):
            bar.update(task, description=fit_width(_parts(status(), words), bar.console.width), refresh=True)


def _show_lines(status: Status, words: Line, done: threading.Event) -> None:
    while not done.wait(5.0):
        echo("  ".join(_parts(status(), words)), err=True)


def _parts(status: dict[str, Any], words: Line) -> list[str]:
    """Return the parts of the line, most important first; zero losses are left out."""
    counts = {
        "stalled links": status["congestion"].get("stalled_links", 0),
        "dropped": status["queue"]["dropped"],
    }
    counters = [f"{name} {count:.0f}" for name, count in counts.items() if count]
    overruns = [f"overruns {status['overruns']}"] if status["overruns"] else []
    return [*words(status), *counters, f"clients {len(status['clients'])}", *overruns]


def fit_width(parts: list[str], width: int, between: str = "  ") -> str:
    """Return the parts joined to one line, without trailing parts that exceed the width."""
    while len(between.join(parts)) > width and len(parts) > 1:
        parts = parts[:-1]
    return between.join(parts)


def exit_if_failed(troubles: list[str]) -> None:
    """Print the failures that did not end the run, and exit with status 1 if there are any."""
    for text in troubles:
        echo(f"rig: {text}", err=True)
    if troubles:
        raise typer.Exit(1)


def lateness_text(status: dict[str, Any]) -> str:
    """Return the lateness of a status in a few words."""
    late = status["lateness_ms"]
    p99, most = (f"{late[name]:.2f}" if late[name] < 10.0 else f"{late[name]:.0f}" for name in ("p99", "max"))
    return f"late p99 {p99} max {most} ms"


def lateness_summary(summary: dict[str, Any]) -> str:
    """Return the lateness of a summary."""
    late = summary["lateness_ms"]
    return "lateness " + " ".join(f"{name} {late[name]:.3f}" for name in ("p50", "p99", "max", "last")) + " ms"


def engine_text(engine: dict[str, Any]) -> str:
    """Return name and step of an engine, and the fraction of time in rolling by collocation."""
    share = engine.get("rolling_share")
    rolled = f", {share:.0%} of the time rolling by collocation" if isinstance(share, float) and share else ""
    return f"{engine.get('name', '?')}, {engine.get('step_us', '?')} us{rolled}"


def accuracy_text(accuracy: dict[str, Any]) -> str:
    """Return the error estimate of a status, each quantity in its unit; before version 0.2 it was a single number."""
    quantities = accuracy.get("quantities")
    if not isinstance(quantities, dict):
        return number_text(accuracy.get("estimate"), "(scaled)")
    parts = []
    for quantity in (quantity for quantity in quantities.values() if isinstance(quantity, dict)):
        limit = quantity.get("tolerance")
        within = f" (tolerance {limit:.2g})" if isinstance(limit, float | int) else ""
        parts.append(
            f"{quantity.get('label')} {number_text(quantity.get('error'), quantity.get('unit', ''), digits=2)}{within}"
        )
    return ", ".join(parts)


def motion_text(motion: dict[str, Any]) -> str:
    """Return the kind of the shaft's motion in words."""
    if (frequency_hz := motion.get("whirl_hz")) is not None:
        return f"{motion.get('kind')} at {abs(frequency_hz):.1f} Hz"
    if (impacts_hz := motion.get("impacts_hz")) is not None:
        return f"impacts, {impacts_hz:.0f} per second"
    return str(motion.get("kind"))


def number_text(value: float | None, unit: str, *, digits: int = 4) -> str:
    """Return a number of a status with its unit."""
    return f"{value:.{digits}g} {unit}" if isinstance(value, float | int) else "not finite"
