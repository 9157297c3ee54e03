"""Frames: the shaft's tilt, its axis, and its place in the ring."""
