"""Pictures on disk: whole or not there, the same bytes each time."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from replays.report.canvas import check_suffix, new_figure, save
from rig.errors import DiskError, InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def lines() -> Figure:
    figure = new_figure((3.0, 2.0), "a title")
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


def test_size_title_and_dots_are_as_asked(tmp_path: Path) -> None:
    from PIL import Image

    figure = new_figure((3.0, 2.0), "a title", title_size=9)
    assert figure.get_suptitle() == "a title"
    save(figure, tmp_path / "picture.png", dpi=50)
    with Image.open(tmp_path / "picture.png") as image:
        assert image.size == (150, 100)


def test_few_colours_make_a_palette_of_at_most_so_many(tmp_path: Path) -> None:
    from PIL import Image

    many, few = tmp_path / "many.png", tmp_path / "few.png"
    save(lines(), many)
    save(lines(), few, colours=16)
    with Image.open(few) as image:
        assert image.mode == "P"
        colours = image.getcolors()
        assert colours is not None
        assert 2 <= len(colours) <= 16
    with Image.open(many) as image:
        assert image.mode == "RGBA"
    assert few.stat().st_size < many.stat().st_size


def test_disk_that_fills_up_leaves_the_former_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
