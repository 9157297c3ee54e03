"""Guessing of the rig's channels among the signals of a log, and a mapping to start from."""
