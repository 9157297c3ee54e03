"""File formats of other systems, one module each."""
