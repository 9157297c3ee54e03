"""Trials of an engine on small systems, compared with theory."""
