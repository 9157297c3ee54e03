"""Studies of the force laws of contact and magnets."""
