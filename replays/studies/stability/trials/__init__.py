"""Trials of an engine on small systems, with the verdict that theory expects."""
