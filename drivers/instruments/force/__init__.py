"""A force transducer's charge amplifier: protocol, driver, twin."""
