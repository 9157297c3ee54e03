"""Terminal output: tables, progress, compiling, provenance of reports."""
