"""Identification of the rig's parameters from a recording, with confidence intervals."""

from __future__ import annotations

from replays.recordings.identification.fit import PRECISION, SPREAD, Identification, identify
from replays.recordings.identification.judgement import Finding, Judgement
from replays.recordings.identification.request import Question, Unknown, ask

__all__ = ["PRECISION", "SPREAD", "Finding", "Identification", "Judgement", "Question", "Unknown", "ask", "identify"]
