"""Connections of a command to a rig, and the rig's node on a CAN bus."""
