"""Output of reports, by file suffix."""

from __future__ import annotations

from pathlib import Path

from replays.report.document import Report
from rig.base.errors import InputError
from rig.base.files import check_new_file, write_file

SUFFIXES = (".html", ".pdf")
TEXT_SUFFIXES = (*SUFFIXES, ".md")
"""Suffixes of a report without pictures."""


def write_report(report: Report, path: Path) -> None:
    """Write a report to a file atomically; equal reports give equal bytes.

    Raises:
        InputError: If the file is neither .html nor .pdf nor .md.
        DiskError: If the file cannot be written; an existing file stays unchanged.
    """
    if path.suffix == ".md":
        from replays.report.markdown import render
    elif check_suffix(path) == ".html":
        from replays.report.html import render
    else:
        from replays.report.pdf import render
    data = render(report)
    write_file(path, data)


def check_suffix(path: Path) -> str:
    """Check and return the suffix of a report file.

    Raises:
        InputError: If it is neither .html nor .pdf.
    """
    if path.suffix not in SUFFIXES:
        raise InputError("report", f"a file name that ends in {' or '.join(SUFFIXES)}", str(path))
    return path.suffix


def check_report(path: Path, *, force: bool, field: str = "report", suffixes: tuple[str, ...] = SUFFIXES) -> None:
    """Check that a report can be written to a file, before anything is computed.

    Raises:
        InputError: If the suffix is another, the folder is missing or read-only, or the file exists.
    """
    check_new_file(path, field=field, suffixes=suffixes, force=force)
