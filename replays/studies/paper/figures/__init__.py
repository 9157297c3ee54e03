"""Pictures and tables of the report."""
