"""The README's picture of the imports is up to date."""

from __future__ import annotations

from tests.house.architecture import PICTURE, ROOT, draw_picture


def test_picture_is_up_to_date() -> None:
    assert PICTURE.read_text(encoding="utf-8") == draw_picture(), "regenerate it: python -m tests.house.architecture"


def test_readme_shows_the_picture() -> None:
    assert f"({PICTURE.relative_to(ROOT)})" in (ROOT / "README.md").read_text(encoding="utf-8")
