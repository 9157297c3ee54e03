"""Drawing: figures without a window, atomic file writes, one style and one palette.

All figures have the width of a page, so that letters have the same size everywhere. Drawing functions are decorated
with `@house_style()`, which sets matplotlib's defaults while they run and restores the caller's own.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rig.base.errors import InputError
from rig.base.files import write_file
from rig.base.text import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image

# Okabe and Ito's palette, suitable for colour-blind readers.
BLACK, ORANGE, SKY, GREEN, BLUE, RED, PINK = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip

WIDTH = 10.0
"""Width of every figure [inch]; at 850 pixels, letters of 9.5 points are 11 pixels high."""
DPI = 140
"""Resolution of a PNG [dots/inch], sharp on a scaled-down page and on a high-resolution screen."""
_PALETTE_ROUNDS = 2
"""Rounds of k-means for the palette of a PNG; further rounds change no colour visibly."""
_RGB = 0xFFFFFF
"""Mask of the red, green and blue bits of a pixel, without opacity."""
_COMPRESSION = 7
"""Compression level of a PNG; level 9 needs five times the time and gives files that are 6 % smaller."""
_MIN_BAND_PERIODS, _MAX_SLICES = 80, 240
"""Periods from which a signal is drawn as a band, and the largest number of time slices in the band."""
_SALT = "rotor-stator-rig"
"""Salt of the identifiers in an SVG, so that they are reproducible."""
_NOT_IN_XML = re.compile("[^\t\n\r\x20-\u2029\u202f-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Control characters and marks of direction in names, which are not XML or change how a line is read."""
_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "figure.titlesize": 12.5,
    "figure.titleweight": "bold",
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 10,
    "axes.edgecolor": "0.45",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 9.5,
    "ytick.labelsize": 9.5,
    "xtick.color": "0.45",
    "ytick.color": "0.45",
    "xtick.labelcolor": "0.15",
    "ytick.labelcolor": "0.15",
    "legend.fontsize": 9.5,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.columnspacing": 1.4,
    "svg.fonttype": "none",
    "svg.hashsalt": _SALT,
}


@contextmanager
def house_style() -> Iterator[None]:
    """Apply matplotlib's defaults for every figure, as a context manager or as a decorator of a drawing function."""
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        yield


def new_figure(
    height: float | None = None, title: str = "", *, layout: Literal["constrained"] | None = "constrained"
) -> Figure:
    """Create a figure of the common width, without pyplot or a window.

    Args:
        height: Height [inch]; None if the drawing sets it later.
        title: Title above all panels.
        layout: None if the drawing places its panels itself.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=None if height is None else (WIDTH, height), layout=layout)
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, x=0.01, ha="left")
    return figure


def draw_signals(axes: Any, times: np.ndarray, *signals: tuple[np.ndarray, str, str]) -> None:
    """Draw signals of any length, as lines or as the mean within a band from minimum to maximum.

    A line with more periods than a panel can show would be a solid block. Bands are faint, so that a second one remains
    visible.

    Args:
        axes: Axes to draw on.
        times: Times, shape (n,).
        signals: Values, shape (n,), colour and name of each signal; with a name, the legend explains a band.
    """
    periods = max(np.count_nonzero(np.diff(values > values.mean())) // 2 for values, _, _ in signals)
    # Each slice holds two periods; otherwise the band would depend on the position of its limits.
    slices = min(_MAX_SLICES, periods // 2)
    whole = len(times) // max(1, slices) * slices
    for values, colour, label in signals:
        if periods < _MIN_BAND_PERIODS or len(times) < 4 * slices:
            axes.plot(times, values, color=colour, lw=1.0, label=label)
            continue
        folded, middle = values[:whole].reshape(slices, -1), times[:whole].reshape(slices, -1).mean(axis=1)
        low, high = folded.min(axis=1), folded.max(axis=1)
        band = "envelope" if label else ""
        axes.fill_between(middle, low, high, color=colour, alpha=0.13, lw=0, label=band)
        for edge in (low, high):
            axes.plot(middle, edge, color=colour, lw=0.7, alpha=0.8)
        axes.plot(middle, folded.mean(axis=1), color=colour, lw=1.4, label=label and f"{label}, mean")


def axis_label(name: str, unit: str) -> str:
    """Return the axis label of a channel."""
    return f"{name} [{unit.replace('^2', '²')}]"


def add_legend(figure: Figure, *panels: Any, columns: int = 4) -> None:
    """Draw one legend for some panels, or all, below the figure; each name occurs once."""
    handles = {}
    for axes in panels or figure.axes:
        handles |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)


def check_suffix(path: Path, *, field: str = "picture") -> None:
    """Check that a picture can be written to a file of this name, before it is drawn.

    Args:
        path: The file.
        field: Name of the option in errors.

    Raises:
        InputError: If it is neither .png nor .svg.
    """
    if path.suffix not in (".png", ".svg"):
        raise InputError(field, "a .png or .svg file", str(path))


def save(figure: Figure, *paths: Path, source: str = "") -> list[Path]:
    """Write a figure to files atomically; equal data give equal bytes.

    Args:
        figure: The figure.
        paths: Files that end in .png or .svg.
        source: Source of the data, for the files' metadata.

    Returns:
        The files.

    Raises:
        InputError: If a file is neither .png nor .svg.
        DiskError: If a file cannot be written; an existing file stays unchanged.
    """
    for path in paths:
        check_suffix(path)
    for path in paths:
        data = _svg(figure, source) if path.suffix == ".svg" else png(figure, source=source)
        write_file(path, data)
    return list(paths)


def png(figure: Figure, *, dpi: int = DPI, source: str = "") -> bytes:
    """Return a figure as PNG with a palette, which reduces a line drawing to a third of its size.

    Args:
        figure: The figure.
        dpi: Dots per inch.
        source: Source of the data, for the metadata field Source.
    """
    from PIL.PngImagePlugin import PngInfo

    _disable_mathtext(figure)
    about = PngInfo()
    if source:
        about.add_text("Source", source)
    buffer = io.BytesIO()
    image = _apply_palette(_render(figure, dpi))
    image.save(buffer, format="png", compress_level=_COMPRESSION, pnginfo=about)
    return buffer.getvalue()


def _render(figure: Figure, dpi: int) -> np.ndarray:
    """Return the pixels of a figure as red + 256 green + 65536 blue, shape (height, width).

    Unlike `Figure.savefig`, it draws once and encodes nothing. Canvas and resolution are restored.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas, former = figure.canvas, figure.dpi
    try:
        figure.dpi = dpi
        drawn = FigureCanvasAgg(figure)
        drawn.draw()
        return np.asarray(drawn.buffer_rgba()).view("<u4")[:, :, 0] & _RGB
    finally:
        figure.set_canvas(canvas)
        figure.dpi = former


def _disable_mathtext(figure: Figure) -> None:
    """Draw all texts as they are, as names and notes from outside may contain dollar signs; numbers at ticks are kept.

    Args:
        figure: The figure, complete.
    """
    from matplotlib.text import Text
    from matplotlib.ticker import LogFormatter

    numbers = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if isinstance(axis.get_major_formatter(), LogFormatter):  # powers of ten
                numbers.update(map(id, [*axis.get_ticklabels(), *axis.get_ticklabels(minor=True)]))
    for text in figure.findobj(Text):
        if id(text) not in numbers and isinstance(text, Text):
            text.set_parse_math(False)


def _apply_palette(pixels: np.ndarray) -> Image:
    """Return an image with a palette of at most 256 colours.

    This choice preserves faint tints, and steps of a colour scale stay invisible. It is the k-means of Pillow's
    `quantize(kmeans=...)`, applied to a few thousand colours instead of two million pixels.

    Args:
        pixels: Colours as of `_render`.
    """
    from PIL import Image

    flat = pixels.ravel()
    starts = np.flatnonzero(np.diff(flat, prepend=flat[0] ^ 1))  # of runs of one colour
    numbers, of_runs = np.unique(flat[starts], return_inverse=True)
    lengths = np.diff(starts, append=len(flat))
    counts, colours = np.bincount(of_runs, lengths), (numbers[:, None].astype(np.int64) >> np.array([0, 8, 16])) & 255
    first = Image.fromarray(colours[None].astype(np.uint8)).quantize(
        256, Image.Quantize.MAXCOVERAGE, kmeans=0, dither=Image.Dither.NONE
    )
    means = np.array(first.getpalette(), dtype=float).reshape(-1, 3)
    for _ in range(_PALETTE_ROUNDS):
        nearest = _nearest(colours, means)
        weights = np.bincount(nearest, counts, len(means))
        sums = np.stack([np.bincount(nearest, counts * part, len(means)) for part in colours.T], axis=1)
        means = np.where(weights[:, None] > 0.0, sums / np.maximum(weights, 1.0)[:, None], means)
    means = np.rint(means)
    indices = np.repeat(_nearest(colours, means).astype(np.uint8)[of_runs], lengths)
    paletted = Image.fromarray(indices.reshape(pixels.shape))
    paletted.putpalette(means.astype(np.uint8).tobytes())
    return paletted


def _nearest(colours: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Return the index of the nearest mean for each colour, shape (n,); both arguments have shape (n, 3)."""
    squares = np.sum(means**2, axis=1)
    parts = np.array_split(colours, len(colours) // 10_000 + 1)  # a picture with a colour scale has 100,000 colours
    return np.concatenate([(squares - 2.0 * part @ means.T).argmin(axis=1) for part in parts])


@house_style()
def _svg(figure: Figure, source: str) -> bytes:
    _disable_mathtext(figure)
    buffer = io.BytesIO()
    # Without a date and with fixed identifiers, equal data give an equal file.
    figure.savefig(buffer, format="svg", dpi=DPI, metadata={"Date": None, "Source": source or None})
    return _NOT_IN_XML.sub(lambda found: printable(found[0]), buffer.getvalue().decode()).encode()
