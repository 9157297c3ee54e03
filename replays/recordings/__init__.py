"""What is made of recordings: validation, identification, other formats, exports, verdicts."""
