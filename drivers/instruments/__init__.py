"""Instruments of the rig: one folder each, and `common` for the code that they share."""
