"""Pictures on disk: complete or absent, with the same bytes each time."""

from __future__ import annotations

import errno
import io
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import pytest

from replays.report.canvas import DPI, WIDTH, add_legend, check_suffix, draw_signals, house_style, new_figure, png, save
from rig.base.errors import DiskError, InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@house_style()
def lines() -> Figure:
    figure = new_figure(2.0, "a title")
    figure.subplots().plot([0.0, 1.0], [0.0, 1.0], label="straight")
    figure.axes[0].legend()
    return figure


@pytest.mark.parametrize(("suffix", "head"), [(".png", b"\x89PNG"), (".svg", b"<?xml")])
def test_same_drawing_gives_same_bytes(tmp_path: Path, suffix: str, head: bytes) -> None:
    files = [tmp_path / f"{name}{suffix}" for name in ("first", "second")]
    for file in files:
        assert save(lines(), file) == [file]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert files[0].read_bytes().startswith(head)
    assert b"dc:date" not in files[0].read_bytes()


@pytest.mark.filterwarnings("ignore:Glyph")
def test_names_with_control_characters_are_readable_xml(tmp_path: Path) -> None:
    figure = new_figure(2.0, "\x1b[2J\x07 \u202e<script>")
    (file,) = save(figure, tmp_path / "a.svg")
    texts = "".join(ElementTree.parse(file).getroot().itertext())
    assert "\\x1b[2J\\x07 \\u202e<script>" in texts


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_texts_from_outside_are_drawn_as_they_are_and_powers_of_ten_as_powers(tmp_path: Path, suffix: str) -> None:
    outside = r"$\frac{$ and $x$"
    figure = new_figure(4.0, outside)
    axes, named = figure.subplots(2)
    axes.loglog([1.0, 1e4], [1.0, 1e4], label=outside)
    axes.set(title=outside, xlabel=outside)
    axes.text(1.0, 1.0, outside)
    axes.annotate(outside, (1.0, 1.0))
    named.set_yticks([0.0, 1.0], ["a", outside])
    add_legend(figure)
    (file,) = save(figure, tmp_path / f"picture{suffix}")
    if suffix == ".svg":
        drawn = re.sub(r"<!--.*?-->", "", file.read_text(encoding="utf-8"), flags=re.DOTALL)
        assert drawn.count(rf">{outside}</text>") == 7
        assert "mathdefault" not in drawn


def test_pictures_are_as_wide_as_all_with_a_palette(tmp_path: Path) -> None:
    from PIL import Image

    figure = lines()
    assert figure.get_suptitle() == "a title"
    save(figure, tmp_path / "picture.png")
    with Image.open(tmp_path / "picture.png") as image:
        assert image.size == (WIDTH * DPI, 2 * DPI)
        assert image.mode == "P"
        colours = image.getcolors()
        assert colours is not None
        assert 2 <= len(colours) <= 256


def test_a_palette_keeps_tints_and_steps_of_a_scale() -> None:
    from PIL import Image

    figure = new_figure(2.0, "tints")
    axes = figure.subplots()
    axes.imshow(np.linspace(0.0, 1.0, 600).reshape(20, 30), cmap="viridis")
    axes.axvspan(10.0, 20.0, color="#FFF7E6")
    canvas, dpi = figure.canvas, figure.dpi
    whole, few = io.BytesIO(), io.BytesIO(png(figure, dpi=60))
    assert (figure.canvas, figure.dpi) == (canvas, dpi)
    figure.savefig(whole, format="png", dpi=60)
    with Image.open(whole) as right, Image.open(few) as found:
        assert len(found.getcolors() or []) <= 256
        apart = np.asarray(found.convert("RGB"), int) - np.asarray(right.convert("RGB"), int)
    assert np.abs(apart).max() <= 24
    assert np.abs(apart).mean() < 0.5
    tint = np.all(np.asarray(right.convert("RGB")) == (0xFF, 0xF7, 0xE6), axis=2)
    assert tint.sum() > 1000
    assert not apart[tint].any()


def test_a_picture_does_not_change_the_global_style() -> None:
    import matplotlib

    before = matplotlib.rcParams["axes.grid"]
    with house_style():
        assert matplotlib.rcParams["axes.grid"] is not before
    assert matplotlib.rcParams["axes.grid"] is before


def test_a_signal_of_many_periods_is_its_mean_in_a_band() -> None:
    times = np.linspace(0.0, 1.0, 20_001)
    few, many = (0.5 + np.sin(2.0 * np.pi * hz * times) for hz in (10.0, 500.0))
    axes = new_figure(2.0).subplots()
    draw_signals(axes, times, (few, "k", "few"))
    assert len(axes.lines) == 1
    assert len(axes.collections) == 0
    axes = new_figure(2.0).subplots()
    draw_signals(axes, times, (few, "k", "few"), (many, "r", "many"))
    assert len(axes.collections) == 2, "of two that share a panel none hides the other"
    low, high, mean = (np.asarray(line.get_ydata()) for line in axes.lines[3:])
    assert low == pytest.approx(-0.5, abs=0.02)
    assert high == pytest.approx(1.5, abs=0.02)
    assert mean == pytest.approx(0.5, abs=0.05)
    assert sorted(axes.get_legend_handles_labels()[1]) == ["envelope", "envelope", "few, mean", "many, mean"]


def test_a_full_disk_keeps_the_former_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "picture.png"
    path.write_bytes(b"former")
    write = Path.write_bytes

    def half(self: Path, data: bytes) -> int:
        write(self, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self))

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(DiskError, match="could not be written: No space left on device"):
        save(lines(), path)
    assert path.read_bytes() == b"former"
    assert list(tmp_path.iterdir()) == [path]


def test_other_kinds_of_file_are_refused_before_any_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"picture must be a \.png or \.svg file"):
        save(lines(), tmp_path / "picture.png", tmp_path / "picture.pdf")
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="--plot must be"):
        check_suffix(Path("picture"), field="--plot")
