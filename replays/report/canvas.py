"""Where pictures are drawn: figures without a window, files that are whole or not there, one palette."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rig.errors import InputError, whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which colour-blind readers can tell apart.
BLACK, ORANGE, SKY, GREEN, BLUE, RED, PINK = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip

_SALT = "rotor-stator-rig"
"""What the names inside an SVG are made of, beside what they name."""


def new_figure(
    size: tuple[float, float] | None = None,
    title: str = "",
    *,
    title_size: float = 14,
    layout: Literal["constrained"] | None = "constrained",
) -> Figure:
    """A figure of its own, without pyplot and its windows.

    Args:
        size: Width and height [inch]; None where the drawing sets them later.
        title: Above all panels.
        title_size: Of its letters [pt].
        layout: None where the drawing places its panels itself.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout=layout)
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=title_size)
    return figure


def draw_grid(*panels: Any) -> None:
    """Thin grey lines behind all that is drawn."""
    for axes in panels:
        axes.grid(visible=True, color="0.9", lw=0.6)
        axes.set_axisbelow(True)


def check_suffix(path: Path, *, field: str = "picture") -> None:
    """Refuse a file that no picture is written to, before it is drawn.

    Args:
        path: The file.
        field: What the user knows it by.

    Raises:
        InputError: It is neither .png nor .svg.
    """
    if path.suffix not in (".png", ".svg"):
        raise InputError(field, "a .png or .svg file", str(path))


def save(figure: Figure, *paths: Path, dpi: int = 110, colours: int | None = None) -> list[Path]:
    """Write a figure to files that are whole or not there: the same numbers give the same bytes.

    Args:
        figure: The figure.
        paths: Each .png or .svg.
        dpi: Dots an inch of a PNG, and of pixels inside an SVG.
        colours: Colours of a PNG, at most 256; None for all. With 256 a line drawing looks the same in a third of the
            size.

    Returns:
        The files.

    Raises:
        InputError: A file is neither .png nor .svg.
        DiskError: The disk refused; what stood in the file before stands there still.
    """
    for path in paths:
        check_suffix(path)
    for path in paths:
        _write(path, _svg(figure, dpi) if path.suffix == ".svg" else _png(figure, dpi, colours))
    return list(paths)


def _svg(figure: Figure, dpi: int) -> bytes:
    import matplotlib

    buffer = io.BytesIO()
    # Without a date and with fixed names, the same numbers give the same file.
    with matplotlib.rc_context({"svg.hashsalt": _SALT}):
        figure.savefig(buffer, format="svg", dpi=dpi, metadata={"Date": None})
    return buffer.getvalue()


def _png(figure: Figure, dpi: int, colours: int | None) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    if colours is None:
        return buffer.getvalue()
    from PIL import Image

    small = io.BytesIO()
    with Image.open(buffer) as image:
        image.convert("RGB").quantize(colours, dither=Image.Dither.NONE).save(small, format="png", optimize=True)
    return small.getvalue()


def _write(path: Path, data: bytes) -> None:
    with whole_file(path) as draft:
        draft.write_bytes(data)
