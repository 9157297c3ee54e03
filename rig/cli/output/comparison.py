"""Output of commands that compare a family of models: tables or JSON, and a picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rig.base.files import check_new_file
from rig.cli.output.tables import Form, echo, echo_json

if TYPE_CHECKING:
    from rich.console import Console

Subject = TypeVar("Subject")


def print_comparison(
    subject: Subject,
    *,
    compare: Callable[[Subject], dict[str, Any]],
    draw: Callable[[Subject, Path], None],
    show: Callable[[dict[str, Any], Console], None],
    plot: Path | None,
    form: Form,
) -> None:
    """Compare, draw if requested, and print.

    Args:
        subject: The parameter set or model.
        compare: Returns the document.
        draw: Draws the picture.
        show: Prints the document as tables.
        plot: File for the picture.
        form: Output as tables or as JSON.
    """
    if plot is not None:
        check_new_file(plot, field="--plot", suffixes=(".png", ".svg"), force=True)
        draw(subject, plot)
    document = compare(subject)
    if form.as_json:
        echo_json(document)
        return
    show(document, form.console())
    if plot is not None:
        echo(f"\npicture  {plot}")
