"""What was sent, what was recorded, and how the two are wired."""
