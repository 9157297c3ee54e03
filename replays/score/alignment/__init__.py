"""Where a record's rows are in the session."""
