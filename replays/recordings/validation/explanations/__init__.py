"""What explains a difference between recording and model."""
