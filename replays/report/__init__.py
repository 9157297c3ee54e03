"""Reports: headings, paragraphs, tables and pictures in one file, as HTML that needs nothing beside it, or as PDF."""

from __future__ import annotations

from replays.report.document import OUTCOME_MARKS, Mark, Report, Row
from replays.report.writing import check_report, write_report

__all__ = ["OUTCOME_MARKS", "Mark", "Report", "Row", "check_report", "write_report"]
