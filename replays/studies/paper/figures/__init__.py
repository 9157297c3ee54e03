"""The report's pictures and tables."""
