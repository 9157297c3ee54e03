"""A run that is served: pace, commands, devices, transport."""
