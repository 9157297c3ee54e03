"""An eddy-current proximity probe conditioner: protocol, driver, twin."""
