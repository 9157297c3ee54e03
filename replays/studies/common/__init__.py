"""Common parts of the studies: scenes, runs of engines, journals, provenance of results."""
