"""What studies share: scenes, runs of engines, journals, and where numbers come from."""
