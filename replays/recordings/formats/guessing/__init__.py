"""What a log's signals may be, and a mapping to start from."""
