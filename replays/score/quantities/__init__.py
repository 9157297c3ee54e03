"""Quantities of the analogue path, a module each."""
