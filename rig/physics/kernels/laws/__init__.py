"""Forces of single parts as laws: contact, magnet, bearing house."""
