"""Alignment of a record's rows with the session."""
