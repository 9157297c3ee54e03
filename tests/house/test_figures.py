"""Pictures of speed and accuracy belong to the present engines."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from replays.studies.chart import store
from replays.studies.chart.store import code_digest, read_table
from replays.studies.common.provenance import digest

FIGURES = Path(store.__file__).parents[2] / "figures"
MODULE = '''"""About it."""

from rig.engines.old import advance

LIMIT = 3e-4
"""A reason."""


def step(y):
    """Take a step."""
    return advance(y) + LIMIT  # why
'''


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("Take a step.", "Take one.", True), ("# why", "# because", True), ("A reason.", "Another.", True),
        ("rig.engines.old", "rig.engines.new", True), ("3e-4", "3.1e-4", False), ("+ LIMIT", "- LIMIT", False),
        ("import advance", "import retreat as advance", False),
    ],
)  # fmt: skip
def test_a_digest_depends_only_on_behaviour(old: str, new: str, same: bool, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    paths = [tmp_path / "a.py", tmp_path / "folder/b.py"]
    assert old in MODULE
    for path, text in zip(paths, (MODULE, MODULE.replace(old, new)), strict=True):
        path.write_text(text, encoding="utf-8")
    assert (digest(paths[:1]) == digest(paths[1:])) is same


def test_the_chart_is_of_these_engines() -> None:
    cure = (
        "`rig chart --full -o FOLDER` (55 minutes, goes on where it was stopped) makes them: copy chart.csv, chart*.png"
    )
    code = code_digest()
    assert {row["code"] for row in read_table(FIGURES)} == {code}, f"chart.csv is of other engines or peers: {cure}"
    for path in sorted(FIGURES.glob("chart*.png")):
        with Image.open(path) as image:
            assert image.info.get("Source") == f"code {code}", f"{path.name} is of another table: {cure}"


def test_the_atlas_is_of_these_engines() -> None:
    cure = "`rig stability --scenes -o FOLDER` (twelve minutes) makes it: copy stability-scenes.png"
    with Image.open(FIGURES / "stability-scenes.png") as image:
        assert image.info.get("Source") == f"code {code_digest()}", f"it is of other engines or peers: {cure}"
