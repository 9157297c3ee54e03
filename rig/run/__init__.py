"""Simulation of a scene: commands, faults, frames."""
