"""Reports to files, by the suffix."""

from __future__ import annotations

from pathlib import Path

from replays.report.document import Report
from rig.base.errors import InputError, check_new_file, whole_file

SUFFIXES = (".html", ".pdf")


def write_report(report: Report, path: Path) -> None:
    """Write a report to a file that is whole or not there; the same report gives the same bytes.

    Raises:
        InputError: The file is neither .html nor .pdf.
        DiskError: The disk refused; what stood in the file before stands there still.
    """
    check_suffix(path)
    if path.suffix == ".html":
        from replays.report.html import render
    else:
        from replays.report.pdf import render
    data = render(report)
    with whole_file(path) as draft:
        draft.write_bytes(data)


def check_suffix(path: Path) -> None:
    """Refuse a file that no report is written to.

    Raises:
        InputError: It is neither .html nor .pdf.
    """
    if path.suffix not in SUFFIXES:
        raise InputError("report", f"a file name that ends in {' or '.join(SUFFIXES)}", str(path))


def check_report(path: Path, *, force: bool, field: str = "report") -> None:
    """Refuse a file that no report can be written to, before anything is computed.

    Raises:
        InputError: Another suffix, a folder that is missing or read-only, or an existing file.
    """
    check_new_file(path, field=field, suffixes=SUFFIXES, force=force)
