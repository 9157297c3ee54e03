"""Equipment of a test: bench, device under test, recorder, and their processes."""
