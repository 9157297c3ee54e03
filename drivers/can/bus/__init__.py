"""The bus itself: its frames, the model of arbitration and timing, the hub that runs it, and text protocols."""
