"""A motor controller with tachometer and keyphasor: protocol, driver, twin."""
