"""The gallery shows pictures of its own commands."""

from __future__ import annotations

import re

from replays.plots.methods import KINDS
from tests.house.gallery import FIGURES, PAGE, list_pictures


def test_each_picture_of_the_gallery_comes_from_one_of_its_commands() -> None:
    shown = re.findall(r"!\[[^\]]+\]\(\.\./replays/figures/([^)]+)\)", PAGE.read_text(encoding="utf-8"))
    assert shown == [name for name, _ in list_pictures()]
    assert {name for name in shown if not (FIGURES / name).is_file()} == set()
    assert {path.name for path in FIGURES.glob("gallery-*")} == set(shown)
    assert {kind for kind in KINDS if not any(kind in name for name in shown)} == set()
