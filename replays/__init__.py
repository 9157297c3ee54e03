"""What is made of runs and recordings: verdicts, figures, exports."""
