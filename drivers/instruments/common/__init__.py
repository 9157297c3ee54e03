"""What the instruments share: their protocol, the driver's side and the twin's side of it."""
