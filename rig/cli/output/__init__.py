"""What the terminal shows: tables, progress, compiling, reports' origin."""
