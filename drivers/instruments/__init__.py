"""The rig's six instruments: a folder each, and what they share."""
