"""Drawings of the viewer, one module each, with common geometry and history."""
