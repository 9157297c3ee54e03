"""Magnet that holds the shaft until it is released: protocol, driver, twin."""
