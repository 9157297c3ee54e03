"""Output of a recording session: one or several files within a limit of disk space."""
