"""Motor controller with tachometer and keyphasor: protocol, driver, twin."""
