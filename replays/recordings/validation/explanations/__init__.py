"""Explanations of a difference between recording and model."""
