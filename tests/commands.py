"""Run commands of `rig` in this process; each printed table is also checked on a terminal and in a pipe."""

from __future__ import annotations

import io
import re
from typing import Any

import pytest
from rich.cells import cell_len

from rig.cli.main import main
from rig.cli.output.tables import Table, table_console

TERMINAL = 80


def render_lines(table: Table, *, width: int | None = TERMINAL) -> list[str]:
    """Return the lines of a table on a terminal of this width, or in a pipe."""
    console = table_console(wide=True)
    console.file, console.width = io.StringIO(), width or console.width
    console.print(table)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def check_legible(table: Table, *, width: int = TERMINAL) -> None:
    """Check that no cell is cut, that hidden columns are announced, and that a row in a pipe is one line with all its
    cells.
    """
    lines = render_lines(table, width=width)
    assert max(map(cell_len, lines), default=0) <= width, lines
    text = "\n".join(lines)
    note = re.search(r"^columns left out: (.*)\s\(shown\swith\s--wide\)\Z", text, re.MULTILINE | re.DOTALL)
    hidden_columns = set(" ".join(note[1].split()).split(", ")) if note else set()
    assert hidden_columns <= {table.headings[at] for at in table.spare}
    for at, heading in enumerate(table.headings):
        cells = [cells[at].plain for cells, _ in table.rows if len(cells) == len(table.headings)]
        if heading in hidden_columns:
            continue
        for word in re.split(r"[ -]+", heading):
            assert word in text, f"{heading} is not there"
        for cell in cells:
            for part in cell.split() if at in table.wrapped else [cell]:
                folded = cell_len(part) > width // (table.keys + 1) - 2
                assert folded or part in text, f"{part!r} of {heading} is not whole"
    headed, title = any(table.headings), bool(table.title)
    rows = render_lines(table, width=None)[title:]
    assert len(rows) == headed + len(table.rows)
    for row, (cells, _) in zip(rows[headed:], table.rows, strict=True):
        whole = [cell.plain.strip() or "-" for cell in cells]
        assert row.split() == " ".join(whole).split()
        assert re.split(r"\s{2,}", row.strip()) == whole or any("  " in cell for cell in whole)


def run(*arguments: object) -> int:
    """Run a command and return its exit status."""
    shown, tables = Table.__rich_console__, []

    def kept(table: Table, *about: Any) -> Any:
        tables.append(table)
        return shown(table, *about)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Table, "__rich_console__", kept)
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
    for table in tables:
        check_legible(table)
    return int(ended.value.code or 0)


def run_captured(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Run a command and return its exit status, output and error output."""
    status = run(*arguments)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def run_for_output(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must succeed and return its output."""
    status, output, complaints = run_captured(capsys, *arguments)
    assert status == 0, complaints
    return output
