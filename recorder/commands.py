"""The commands that a file names as sent before it."""

from __future__ import annotations

from typing import Any

_MOST = 10_000
"""Latest commands that are named."""


class Commands:
    """The scene document, kept up to date: whoever has only a later file needs the commands that came before it."""

    def __init__(self, scene: dict[str, Any]) -> None:
        self._scene = scene
        self._taken = {entry.get("id"): entry for entry in scene.get("taken", [])}

    def follow(self, event: dict[str, Any] | None) -> None:
        """Take an event of the stream."""
        if event is not None and event.get("event") == "command":
            if len(self._taken) >= _MOST:
                self._taken.pop(next(iter(self._taken)))
            fields = ("id", "tick", "command", "request")
            self._taken.setdefault(event.get("id"), {name: event.get(name) for name in fields})

    @property
    def scene(self) -> dict[str, Any]:
        """The scene document with all commands so far."""
        if not self._taken and "taken" not in self._scene:
            return self._scene
        return {**self._scene, "taken": list(self._taken.values())}
