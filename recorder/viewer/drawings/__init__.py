"""Drawings of the viewer, one per module, with shared geometry and history."""
