"""Scans over pulses, conditions and assumed values."""
