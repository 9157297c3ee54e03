"""The ends of a connection to a rig, and its node on a CAN bus."""
