"""Quantities of the analogue path, one module each."""
