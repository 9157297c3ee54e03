"""MCAP files: records, chunks, and files being written."""
