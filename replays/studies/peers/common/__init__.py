"""What peers share: the problem, its right-hand side, the solution."""
