"""Channels: their table, formulas, generators, faults and sensors."""
