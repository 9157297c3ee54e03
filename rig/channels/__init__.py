"""Channels: table, formulas, generators, faults and sensors."""
