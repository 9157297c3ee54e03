"""The bus itself: its frames, the model of who sends when, the hub that lets it run, doors for other programs."""
