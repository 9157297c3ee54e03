"""Validation of the model by a recording: bit by bit, by declared criteria, and with explanations of failures."""

from __future__ import annotations

from replays.recordings.validation.comparison import validate
from replays.recordings.validation.criteria import Criteria, load_criteria
from replays.recordings.validation.outcome import Validation

__all__ = ["Criteria", "Validation", "load_criteria", "validate"]
