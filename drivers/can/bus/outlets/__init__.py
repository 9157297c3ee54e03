"""Access to the bus for programs with text protocols: socketcand and SLCAN."""
