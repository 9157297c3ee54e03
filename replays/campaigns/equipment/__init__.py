"""What a test runs: a bench, a device under test, a recorder, and their processes."""
