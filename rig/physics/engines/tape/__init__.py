"""Generator of the Taylor series' code: the equations of motion as a tape. Not used during a run."""
