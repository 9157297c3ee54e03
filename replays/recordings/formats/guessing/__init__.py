"""Guesses at the channels of a log's signals, and a mapping to start from."""
