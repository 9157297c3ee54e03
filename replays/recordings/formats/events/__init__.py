"""Events of an imported log: commands, impacts, motion."""
