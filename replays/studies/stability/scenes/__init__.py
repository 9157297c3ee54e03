"""Whole scenes: random ones by number, and the twelve scenes of the chart."""
