"""Benchmarks of the engines and of ensembles on this machine, beside solvers of other authors."""
