"""What a recording holds, checked: documents, channels, counts, and their agreement."""
