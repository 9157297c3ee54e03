"""The device: names, scales, outputs and errors."""
