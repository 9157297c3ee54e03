"""Whole scenes: random ones by number, and the twelve of the chart."""
