"""Reports: headings, paragraphs, tables and pictures in one self-contained HTML or PDF file."""

from __future__ import annotations

from replays.report.document import OUTCOME_MARKS, Mark, Report, Row
from replays.report.writing import TEXT_SUFFIXES, check_report, write_report

__all__ = ["OUTCOME_MARKS", "TEXT_SUFFIXES", "Mark", "Report", "Row", "check_report", "write_report"]
