"""An MCAP file: its records and chunks, while it is made and once it is whole."""
