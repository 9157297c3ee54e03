"""What happened in an imported log: commands, impacts, motion."""
