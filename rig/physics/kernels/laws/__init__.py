"""Force laws of single parts: contact, magnet, housing."""
