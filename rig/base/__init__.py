"""Common parts of the rig: units, errors, text, checks of input, messages, samples."""
