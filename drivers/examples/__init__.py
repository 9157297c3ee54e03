"""Programs of about ten lines that use drivers and DAQ client; each runs as `python -m drivers.examples.NAME`."""
