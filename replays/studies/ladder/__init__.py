"""Ladder of model levels: error and cost of each level, and the cheapest sufficient combination.

`measurement` runs one candidate, `quantity` evaluates a run, `search` tests combinations, `chart` draws the result, and
`pick` writes it into a scene file.
"""
