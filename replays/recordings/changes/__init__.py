"""Changes between two recordings, without a model."""

from replays.recordings.changes.comparison import Change, Comparison, compare

__all__ = ["Change", "Comparison", "compare"]
