"""How a command answers that compares a family of models: as tables or JSON, and as a picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from rig.cli.tables import echo, echo_json

Subject = TypeVar("Subject")


def answer(
    subject: Subject,
    *,
    compare: Callable[[Subject], dict[str, Any]],
    draw: Callable[[Subject, Path], None],
    show: Callable[[dict[str, Any]], None],
    plot: Path | None,
    as_json: bool,
) -> None:
    """Compare, draw where that is wanted, and tell.

    Args:
        subject: Of what: a parameter set, a model.
        compare: Makes the document.
        draw: Makes the picture.
        show: Prints the document as tables.
        plot: File for the picture.
        as_json: The document itself instead of tables.
    """
    if plot is not None:
        draw(subject, plot)
    document = compare(subject)
    if as_json:
        echo_json(document)
        return
    show(document)
    if plot is not None:
        echo(f"\npicture  {plot}")
