"""Test equipment: bench, device under test, recorder, and their processes."""
