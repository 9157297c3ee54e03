"""Code that the instruments share: protocol, driver and twin."""
