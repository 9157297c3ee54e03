"""Where pictures are drawn: figures without a window, files that are whole or not there, one style and one palette.

All figures are as wide as a page shows them, so that one size of letters reads the same in all. A drawing is a function
under `@house_style()`, which sets matplotlib's defaults while it runs and leaves the caller's own as they were.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rig.base.errors import InputError, whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image

# Okabe and Ito's colours, which colour-blind readers can tell apart.
BLACK, ORANGE, SKY, GREEN, BLUE, RED, PINK = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip

WIDTH = 10.0
"""Of every figure [inch]: where a page shows it at 850 pixels, letters of 9.5 points are 11 pixels high."""
DPI = 140
"""Dots an inch of a PNG: sharp where a page shows it smaller, or a screen has two dots a pixel."""
_PALETTE_ROUNDS = 2
"""Rounds of k-means for the palette of a PNG: with more, no colour moves by a step that is seen."""
_PLACES = np.array([1 << 16, 1 << 8, 1])
"""Of red, green and blue in the number of a colour."""
_PERIODS, _STRETCHES = 80, 240
"""A signal of so many periods is drawn as a band, which shows the extremes of at most so many stretches of time."""
_SALT = "rotor-stator-rig"
"""What the names inside an SVG are made of, beside what they name."""
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
    """Matplotlib's defaults for every figure, as a block or as a decorator of what draws."""
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        yield


def new_figure(
    height: float | None = None, title: str = "", *, layout: Literal["constrained"] | None = "constrained"
) -> Figure:
    """A figure of its own, without pyplot and its windows, as wide as all are.

    Args:
        height: [inch]; None where the drawing sets it later.
        title: Above all panels.
        layout: None where the drawing places its panels itself.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=None if height is None else (WIDTH, height), layout=layout)
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, x=0.01, ha="left")
    return figure


def draw_signals(axes: Any, times: np.ndarray, *signals: tuple[np.ndarray, str, str]) -> None:
    """Signals of any length: as lines, or each as its mean in the band from its least to its largest.

    A line with more periods than a panel has room for is a solid block, in which nothing is seen. Bands are faint, so
    that a second one shows through.

    Args:
        axes: Where to.
        times: Shape (n,).
        signals: Values, shape (n,), colour and name of each.
    """
    periods = max(np.count_nonzero(np.diff(values > values.mean())) // 2 for values, _, _ in signals)
    # A stretch holds two periods, else the band would show where they are cut.
    stretches = min(_STRETCHES, periods // 2)
    whole = len(times) // max(1, stretches) * stretches
    for values, colour, label in signals:
        if periods < _PERIODS or len(times) < 4 * stretches:
            axes.plot(times, values, color=colour, lw=1.0, label=label)
            continue
        folded, middle = values[:whole].reshape(stretches, -1), times[:whole].reshape(stretches, -1).mean(axis=1)
        low, high = folded.min(axis=1), folded.max(axis=1)
        axes.fill_between(middle, low, high, color=colour, alpha=0.13, lw=0)
        for edge in (low, high):
            axes.plot(middle, edge, color=colour, lw=0.7, alpha=0.8)
        axes.plot(middle, folded.mean(axis=1), color=colour, lw=1.4, label=label)


def label_of(name: str, unit: str) -> str:
    """What stands along the axis of a channel."""
    return f"{name} [{unit.replace('^2', '²')}]"


def legend_below(figure: Figure, *panels: Any, columns: int = 4) -> None:
    """One legend for some panels, or all, under the figure, where it hides no data; each name once."""
    found = {}
    for axes in panels or figure.axes:
        found |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=columns)


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


def save(figure: Figure, *paths: Path, source: str = "") -> list[Path]:
    """Write a figure to files that are whole or not there: the same numbers give the same bytes.

    Args:
        figure: The figure.
        paths: Each .png or .svg.
        source: What its numbers come from, for the files' metadata.

    Returns:
        The files.

    Raises:
        InputError: A file is neither .png nor .svg.
        DiskError: The disk refused; what stood in the file before stands there still.
    """
    for path in paths:
        check_suffix(path)
    for path in paths:
        data = _svg(figure, source) if path.suffix == ".svg" else png(figure, source=source)
        with whole_file(path) as draft:
            draft.write_bytes(data)
    return list(paths)


def png(figure: Figure, *, dpi: int = DPI, source: str = "") -> bytes:
    """A figure as PNG with a palette: a line drawing looks the same in a third of the size.

    Args:
        figure: The figure.
        dpi: Dots an inch.
        source: What its numbers come from, for the field Source of its metadata.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    about = PngInfo()
    if source:
        about.add_text("Source", source)

    buffer, small = io.BytesIO(), io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    with Image.open(buffer) as image:
        _with_palette(image.convert("RGB")).save(small, format="png", optimize=True, pnginfo=about)
    return small.getvalue()


def _with_palette(image: Image) -> Image:
    """Return an image with a palette of at most 256 colours.

    Chosen in this way, faint tints stay as they are, and the steps of a colour scale are too small to be seen. It is
    k-means as `quantize(kmeans=...)` of Pillow, but over the few thousand colours instead of two million pixels.

    Args:
        image: An RGB image.
    """
    from PIL import Image

    counted = image.getcolors(image.width * image.height)
    assert counted is not None
    counts, colours = np.array([n for n, _ in counted]), np.array([colour for _, colour in counted])
    first = image.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=0, dither=Image.Dither.NONE)
    means = np.array(first.getpalette(), dtype=float).reshape(-1, 3)
    for _ in range(_PALETTE_ROUNDS):
        nearest = _nearest(colours, means)
        weights = np.bincount(nearest, counts, len(means))
        sums = np.stack([np.bincount(nearest, counts * part, len(means)) for part in colours.T], axis=1)
        means = np.where(weights[:, None] > 0.0, sums / np.maximum(weights, 1.0)[:, None], means)
    means = np.rint(means)
    places = np.zeros(1 << 24, np.uint8)
    places[colours @ _PLACES] = _nearest(colours, means)
    found = Image.fromarray(places[np.asarray(image, dtype=np.int32) @ _PLACES])
    found.putpalette(means.astype(np.uint8).tobytes())
    return found


def _nearest(colours: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Return the place of the mean nearest to each colour, shape (n,); both shape (n, 3)."""
    squares = np.sum(means**2, axis=1)
    parts = np.array_split(colours, len(colours) // 10_000 + 1)  # a picture with a scale of colours has 100,000 of them
    return np.concatenate([(squares - 2.0 * part @ means.T).argmin(axis=1) for part in parts])


@house_style()
def _svg(figure: Figure, source: str) -> bytes:
    buffer = io.BytesIO()
    # Without a date and with fixed names, the same numbers give the same file.
    figure.savefig(buffer, format="svg", dpi=DPI, metadata={"Date": None, "Source": source or None})
    return buffer.getvalue()
