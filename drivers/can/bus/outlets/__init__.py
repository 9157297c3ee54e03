"""Text protocols for access to the bus by other programs: socketcand and SLCAN."""
