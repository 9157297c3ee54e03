"""What the terminal shows of a run or a replay that is served here, while it lasts."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer

from rig.cli.tables import echo, progress_bar

Status = Callable[[], dict[str, Any]]
Line = Callable[[dict[str, Any]], list[str]]


@contextmanager
def showing(status: Status, words: Line) -> Iterator[None]:
    """Show how it goes: on a terminal a live line, with a bar where the end is known, else a line every 5 s.

    Args:
        status: Gives the status document.
        words: What to show of it.
    """
    done = threading.Event()
    # A thread of its own, so that a terminal that is held up (Ctrl-S) holds up nothing else.
    show = _show_live if sys.stderr.isatty() else _show_lines
    thread = threading.Thread(target=show, args=(status, words, done), name="display", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join(timeout=1.0)


def _show_live(status: Status, words: Line, done: threading.Event) -> None:
    from rich.progress import BarColumn

    now = status()
    begin_s, end_s = now.get("replay", {}).get("from_s", 0.0), now["end_s"]
    columns = [] if end_s is None else [BarColumn(24)]
    with progress_bar(*columns, auto_refresh=False, transient=True) as bar:
        task = bar.add_task("", total=None if end_s is None else max(end_s - begin_s, 1e-9))
        while not done.wait(0.5):
            now = status()
            bar.update(task, completed=now["time_s"] - begin_s, description=_line(now, words), refresh=True)


def _show_lines(status: Status, words: Line, done: threading.Event) -> None:
    while not done.wait(5.0):
        echo(_line(status(), words), err=True)


def _line(status: dict[str, Any], words: Line) -> str:
    parts = [*words(status), f"clients {len(status['clients'])}"]
    if status["congestion"].get("stalled_links"):
        parts.append(f"stalled links {status['congestion']['stalled_links']:.0f}")
    return "  ".join(parts)


def end_with(troubles: list[str]) -> None:
    """Exit status 1 where something failed that did not end the run, told in a line each."""
    for text in troubles:
        echo(f"rig: {text}", err=True)
    if troubles:
        raise typer.Exit(1)


def lateness(status: dict[str, Any]) -> str:
    """How late it was so far, in a few words."""
    late = status["lateness_ms"]
    return f"late p99 {late['p99']:.2f} max {late['max']:.2f} ms"


def all_lateness(summary: dict[str, Any]) -> str:
    """How late it was in the end."""
    late = summary["lateness_ms"]
    return "lateness " + " ".join(f"{name} {late[name]:.3f}" for name in ("p50", "p99", "max", "last")) + " ms"
