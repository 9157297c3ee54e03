"""Common parts of the peers: problem, right-hand side, solution."""
