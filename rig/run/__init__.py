"""A run of a scene: scene in, frames out, commands on the way."""
