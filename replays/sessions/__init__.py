"""Reference sessions: short recordings that later versions are validated against, and what makes them anew."""

from __future__ import annotations

from replays.sessions.session import FOLDER, SESSIONS, ReferenceSession, make, open_session

__all__ = ["FOLDER", "SESSIONS", "ReferenceSession", "make", "open_session"]
