"""Ways to the bus for programs that speak in text."""
