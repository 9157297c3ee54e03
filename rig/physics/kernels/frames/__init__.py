"""Frames: tilt of the shaft, its axis, and its position in the ring."""
