"""MCAP files: records, chunks, and the file while it is being written."""
