"""Sent and recorded rows, and the wiring between them."""
