"""Pendulum hammer with its force transducer: protocol, driver, twin."""
