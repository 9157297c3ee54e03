"""Common parts of the peers: the problem, its right-hand side, the solution."""
