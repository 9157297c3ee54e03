"""Recording analysis: validation, identification, import, export and verdicts."""
