"""A recording held against the model: bit by bit, then by declared criteria, and where they fail, what explains it."""

from __future__ import annotations

from replays.recordings.validation.comparison import validate
from replays.recordings.validation.criteria import Criteria, load_criteria
from replays.recordings.validation.outcome import Validation

__all__ = ["Criteria", "Validation", "load_criteria", "validate"]
