"""Export of recordings for other tools."""
