"""Where a session writes: one or several files, and the room that they may take."""
