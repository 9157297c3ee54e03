"""Estimation: least squares, 95 % intervals, lines through two clocks, spectra and sines, each defined once.

Functions of arrays, below everything else in `replays`: nothing here reads a recording, a scene or a file.
"""
