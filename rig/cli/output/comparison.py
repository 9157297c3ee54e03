"""How a command answers that compares a family of models: as tables or JSON, and as a picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rig.cli.output.tables import Form, echo, echo_json

if TYPE_CHECKING:
    from rich.console import Console

Subject = TypeVar("Subject")


def answer(
    subject: Subject,
    *,
    compare: Callable[[Subject], dict[str, Any]],
    draw: Callable[[Subject, Path], None],
    show: Callable[[dict[str, Any], Console], None],
    plot: Path | None,
    form: Form,
) -> None:
    """Compare, draw where that is wanted, and tell.

    Args:
        subject: Of what: a parameter set, a model.
        compare: Makes the document.
        draw: Makes the picture.
        show: Prints the document as tables.
        plot: File for the picture.
        form: As tables, or as the document itself.
    """
    if plot is not None:
        draw(subject, plot)
    document = compare(subject)
    if form.as_json:
        echo_json(document)
        return
    show(document, form.console())
    if plot is not None:
        echo(f"\npicture  {plot}")
