"""Reports: headings, paragraphs, tables and pictures in one file, as HTML that needs nothing beside it, or as PDF."""

from __future__ import annotations

from replays.report.document import Mark, Report, Row, check_report

__all__ = ["Mark", "Report", "Row", "check_report"]
