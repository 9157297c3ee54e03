"""Fits of known signals, and what they are worth."""
