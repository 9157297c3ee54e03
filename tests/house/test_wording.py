"""Prose is plain technical English: patterns are rare, docstrings of functions begin with a verb."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.house.wording import BASIC, COLLECTED, ROOT, check_forms, files, match_patterns

CODE = [ROOT / name for name in ("rig", "drivers", "recorder", "replays")]
PAGES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "rig/KEYS.md")), ROOT / "docs"]
LIMIT = 0.01
"""Largest share of lines that match: a pattern is at times the right word."""


@pytest.mark.parametrize("patterns", [BASIC, COLLECTED], ids=["basic", "collected"])
@pytest.mark.parametrize("paths", [CODE, PAGES], ids=["code", "pages"])
def test_few_lines_match_a_pattern(paths: list[Path], patterns: dict[str, str]) -> None:
    found, lines = match_patterns(files(*paths), patterns)
    assert lines > 500
    assert len(found) < LIMIT * lines, "\n".join(map(str, [f"{len(found)} of {lines} lines:", *found[:40]]))


def test_docstrings_of_functions_begin_with_a_verb_and_constants_are_nouns() -> None:
    found = check_forms(path for path in files(*CODE, ROOT / "tests") if path.suffix == ".py")
    assert not found, "\n".join(map(str, found[:40]))


@pytest.mark.parametrize(
    ("patterns", "line"),
    [
        (BASIC, "What has happened: open channels and dropped frames."),
        (BASIC, "It is written beside it, then renamed."),
        (COLLECTED, "A name that is none raises an error."),
        (COLLECTED, "The recording is held against the model."),
        (COLLECTED, "At most 512 rows a message."),
    ],
)
def test_a_pattern_is_found_in_docstrings_comments_and_pages(
    patterns: dict[str, str], line: str, tmp_path: Path
) -> None:
    texts = {"a.py": f'"""Title.\n\n{line}\n"""\n', "b.py": f"X = 1  # {line}\n", "c.md": f"{line}\n"}
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
        found, _ = match_patterns([tmp_path / name], patterns)
        assert [each.text for each in found] == [line]


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ('def rows():\n    """Return the rows."""\n', 0),
        ('def rows():\n    """The rows."""\n', 1),
        ('@property\ndef rows():\n    """Rows."""\n', 0),
        ("_LATE_S = 3.0\n", 1),
        ("_MAX_LATENESS_S = 3.0\n", 0),
    ],
)
def test_forms(text: str, count: int, tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text(text, encoding="utf-8")
    assert len(check_forms([tmp_path / "a.py"])) == count
