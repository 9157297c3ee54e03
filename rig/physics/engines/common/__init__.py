"""Common parts of the engines: memory, events, and the march of one-step methods through events."""
