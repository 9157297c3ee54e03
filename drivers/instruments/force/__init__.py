"""Charge amplifier of the force transducers: protocol, driver, twin."""
