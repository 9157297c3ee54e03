"""IEPE accelerometer conditioner: protocol, driver, twin."""
