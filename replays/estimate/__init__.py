"""Estimation: least squares, 95 % intervals, lines through two clocks, spectra and sines, each defined once.

Functions of arrays, independent of the other packages: they read no recording, scene or file.
"""
