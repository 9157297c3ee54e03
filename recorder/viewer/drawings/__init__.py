"""What the viewer shows, a module each, and what they share."""
