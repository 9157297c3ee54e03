"""Channels: their table, formulas, generators and the sensors' chain."""
