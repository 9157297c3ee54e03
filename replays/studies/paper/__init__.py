"""Reproduction of the paper: its figures, tables and claims, computed by the rig and compared by number."""
