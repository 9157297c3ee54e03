"""A pendulum hammer with its force transducer: protocol, driver, twin."""
