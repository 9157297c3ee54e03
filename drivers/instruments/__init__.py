"""The rig's instruments: a folder each, and what they share."""
