"""A run that is served, be it of a simulation or of a recording: its documents, commands, status, and its end."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

from rig.base import wire
from rig.base.errors import InputError
from rig.base.text import finite
from rig.serve.pacing import Clock, StepTimeoutError, short_collections
from rig.serve.request_handler import Desk, Pending, one_line
from rig.serve.transport import Server

_SUMMED_UP = (
    "scene", "pace", "tick", "time_s", "real_time_factor", "lateness_ms", "overruns", "queue", "congestion",
    "samples_published", "commands", "replay",
)  # fmt: skip
"""Figures of the last status that are in the summary."""


class ServedRun(ABC):
    """Serves one run from its start to its end; what runs, and how it is published, its kinds say.

    Args:
        server: Transport; stays open when the run ends.
        clock: Pace.
        scene: Scene document.
        tick_rate_hz: Ticks per simulated second [Hz].
        linger_s: At the end of a run, wait at most this long [s] until clients have recovered what they missed.
        desk: What commands are taken, as for `Desk`.
    """

    def __init__(
        self,
        server: Server,
        clock: Clock,
        *,
        scene: Mapping[str, Any],
        tick_rate_hz: int,
        linger_s: float,
        **desk: Any,
    ) -> None:
        self._server = server
        self._clock = clock
        self._scene = scene
        self._rate = tick_rate_hz
        self._linger_s = linger_s
        self._state = "running"
        self._prepared = False
        self._stop_requested = False
        self._accepted = 0
        self._desk = Desk(server, wake=self._wake, tell=self._warn, **desk)

    # ---- what a kind of run provides ----

    @abstractmethod
    def status(self) -> dict[str, Any]:
        """The status document (see rig/KEYS.md); from any thread."""

    @property
    @abstractmethod
    def published(self) -> int:
        """Row after the last one published, of the stream that clients report on."""

    @abstractmethod
    def _get_ready(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Do what takes its time before anybody is answered; returns the catalogue and the parameters."""

    @abstractmethod
    def _scene_now(self) -> dict[str, Any]:
        """The scene document with the commands that were taken so far."""

    @abstractmethod
    def _go(self) -> str:
        """Run; returns why it ended."""

    @abstractmethod
    def _end(self, reason: str) -> dict[str, Any]:
        """Close the desk and end the stream; returns what the summary has beyond the figures of the status."""

    @abstractmethod
    def _carry_out(self, pending: Pending) -> dict[str, Any] | None:
        """Do what a command asks for, and answer it now or later; returns the event that tells of it.

        Raises:
            InputError: It cannot be done.
        """

    def _arrived(self) -> Iterator[Pending]:
        """The commands that have come, in the order in which they are taken."""
        return self._desk.taken()

    @abstractmethod
    def _warn(self, text: str) -> None:
        """Put a warning into the stream; from any thread."""

    # ---- from any thread ----

    def stop(self) -> None:
        """End the run at the next block boundary; from any thread or signal handler."""
        self._stop_requested = True
        self._wake()

    def _wake(self) -> None:
        """Make the thread that runs look around."""
        self._clock.wake()

    def _status(
        self,
        *,
        tick: int,
        end_s: float | None,
        pace: str,
        block_ms: float,
        queue: dict[str, int],
        rate_hz: float,
        health: dict[str, Any],
        warnings: list[str],
    ) -> dict[str, Any]:
        """What every status has, of what its kind knows (units and meaning: rig/KEYS.md)."""
        return finite(
            {
                "scene": self._scene.get("name"),
                "tick": tick,
                "time_s": tick / self._rate,
                "end_s": end_s,
                "wall_s": time.time(),
                "state": self._state,
                "pace": pace,
                "block_ms": block_ms,
                **self._clock.statistics(),
                "queue": queue,
                "congestion": self._server.congestion(),
                "clients": self._desk.clients.rows(self.published, rate_hz),
                "spin_hz": health.get("spin_hz"),
                "energy": health.get("energy", {}),
                "engine": health.get("engine", {}),
                "accuracy": health.get("accuracy"),
                "warnings": warnings + self._desk.warnings(),
                "samples_published": self.published,
                "commands": self._accepted,
            }
        )

    def _event(self, name: str, tick: int, **fields: Any) -> dict[str, Any]:
        return {"event": name, "tick": tick, "time_s": tick / self._rate, "wall_s": time.time(), **fields}

    # ---- on the thread that runs ----

    def prepare(self) -> None:
        """Get ready, answer requests and show the rig's token; `run` does it where it was not done before."""
        if self._prepared:
            return
        catalogue, parameters = self._get_ready()
        self._desk.open(
            {
                wire.CATALOGUE: lambda: catalogue,
                wire.PARAMETERS: lambda: parameters,
                wire.SCENE: self._scene_now,
                wire.STATUS: self.status,
            }
        )
        self._prepared = True

    def run(self) -> dict[str, Any]:
        """Run to the end, to a stop, or to a failure, which is raised after the stream has been ended.

        Returns:
            Summary: reason, wall_s, the figures of the last status, what is counted, and troubles.
        """
        self.prepare()
        reason = "failed"
        began_s = time.monotonic()
        try:
            with short_collections():
                began_s = time.monotonic()
                reason = self._go()
        except KeyboardInterrupt:
            reason = "stopped"
            raise
        except BaseException as error:
            kind = "" if isinstance(error, InputError | StepTimeoutError) else f"{type(error).__name__}: "
            reason = f"failed: {kind}{one_line(error)}"
            raise
        finally:
            wall_s = time.monotonic() - began_s
            self._state = "ended"
            counts = self._end(reason)
            # The cache is kept until everybody who is connected has everything.
            self._desk.clients.settle(self._server, self.published, patience_s=self._linger_s)
        status = self.status()
        figures = {name: status[name] for name in _SUMMED_UP if name in status}
        return {"reason": reason, "wall_s": wall_s, **figures, **counts, "troubles": self._desk.troubles}

    def _take_commands(self) -> list[dict[str, Any]]:
        """Carry out all commands that have arrived; returns the events that tell of them."""
        events = []
        for pending in self._arrived():
            try:
                event = self._carry_out(pending)
                if event is not None:
                    events.append(event)
            except InputError as error:
                pending.refuse(error)
            except Exception as error:
                # A request that all checks let through must not end the run.
                pending.refuse(InputError(pending.command, "readable", one_line(error)))
                self._desk.trouble(pending.command, error)
        return events

    def _accept(self, pending: Pending, tick: int) -> dict[str, Any]:
        """Count a command; returns its answer.

        Args:
            pending: The command.
            tick: When it takes effect, or is done [ticks].
        """
        self._accepted += 1
        reply = {"accepted": True, "id": self._accepted, "command": pending.command}
        return {**reply, "tick": tick, "time_s": tick / self._rate}
