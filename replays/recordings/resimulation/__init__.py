"""Re-simulation of a recorded experiment, and sensitivity of its signals to any of its numbers."""
