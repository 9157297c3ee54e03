"""Errors that a user meets: wrong input, a refusal by the rig, a run that failed."""

from __future__ import annotations


class InputError(ValueError):
    """A field has a value it must not have.

    The message always reads `FIELD must be MUST; instead received RECEIVED`, so that every command, service reply and
    notebook shows the same three facts. The command line turns it into one line and exit status 2.
    """

    def __init__(self, field: str, must: str, received: object) -> None:
        """Name the field, what it must be, and what it was."""
        self.field = field
        self.must = must
        self.received = received
        super().__init__(f"{field} must be {must}; instead received {received!r}")


class RefusedError(InputError):
    """The rig refused a request: carries the rig's own line, which is complete as it stands."""

    def __init__(self, line: str) -> None:
        """Keep the whole line."""
        self.field, self.must, self.received = "request", "one that the rig accepts", None
        ValueError.__init__(self, line)


class SimulationError(RuntimeError):
    """The numbers have gone wrong: the state is no longer finite, and the run ends."""
