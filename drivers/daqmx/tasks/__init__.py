"""Tasks of programs: configuration, acquisition and counters."""
