"""Eddy-current proximity probe conditioner: protocol, driver, twin."""
