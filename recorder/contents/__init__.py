"""Documents, channels and counts of a recording, checked against each other."""
