"""Base of served runs, for a simulation or a recording: documents, commands, status and end."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

from rig.base import wire
from rig.base.errors import InputError
from rig.base.text import replace_nonfinite
from rig.serve.pacing import Clock, StepTimeoutError, freeze_start_objects
from rig.serve.request_handler import PendingCommand, RequestHandler, one_line
from rig.serve.transport import Server

_SUMMARY_FIGURES = (
    "scene", "pace", "tick", "time_s", "motion", "real_time_factor", "lateness_ms", "overruns", "queue", "congestion",
    "samples_published", "commands", "replay",
)  # fmt: skip
"""Values of the last status that the summary contains."""
_MAX_AHEAD_S = 30.0
_MAX_AHEAD_BLOCKS = 2000
"""Lead of a run without a clock over the slowest client that acknowledges: below the depth of the transport per key
(3000 blocks) and the buffer of a recorder (90 s of the default streams)."""
_MIN_WAIT_REPORTED_S = 5.0


class ServedRun(ABC):
    """Serves one run from its start to its end; subclasses define what runs and how it is published.

    Args:
        server: Transport; stays open when the run ends.
        clock: Pace.
        scene: Scene document.
        tick_rate_hz: Ticks per simulated second [Hz].
        linger_s: Longest wait at the end of a run until clients have recovered missed messages [s].
        handler_settings: Settings of the request handler.
    """

    def __init__(
        self,
        server: Server,
        clock: Clock,
        *,
        scene: Mapping[str, Any],
        tick_rate_hz: int,
        linger_s: float,
        **handler_settings: Any,
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
        self._held: tuple[str, float] | None = None
        """Client that limits the pace, and the time since when it does [s, monotonic]."""
        self._handler = RequestHandler(server, wake=self._wake, on_warning=self._warn, **handler_settings)

    # ---- to be implemented by subclasses ----

    @abstractmethod
    def status(self) -> dict[str, Any]:
        """Return the status document (see rig/KEYS.md); from any thread."""

    @property
    @abstractmethod
    def published(self) -> int:
        """Index after the last published row, of the stream that clients report on."""

    @abstractmethod
    def _prepare_documents(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Do slow preparations before requests are answered; return the catalogue and the parameters."""

    @abstractmethod
    def _scene_document(self) -> dict[str, Any]:
        """Return the scene document with the accepted commands."""

    @abstractmethod
    def _run_to_end(self) -> str:
        """Run; return the reason for the end."""

    @abstractmethod
    def _end(self, reason: str) -> dict[str, Any]:
        """Close the request handler and end the stream; return further entries of the summary."""

    @abstractmethod
    def _execute(self, pending: PendingCommand) -> dict[str, Any] | None:
        """Execute a command, and answer it now or later; return its event.

        Raises:
            InputError: The command cannot be executed.
        """

    def _received_commands(self) -> Iterator[PendingCommand]:
        """Yield the received commands, in the order of execution."""
        return self._handler.take_commands()

    @abstractmethod
    def _warn(self, text: str) -> None:
        """Publish a warning event; from any thread."""

    # ---- from any thread ----

    def stop(self) -> None:
        """End the run at the next block boundary; from any thread."""
        self._stop_requested = True
        self._wake()

    def _wake(self) -> None:
        """Make the run's thread check for commands."""
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
        """Return the common part of every status (units and meaning: rig/KEYS.md)."""
        return replace_nonfinite(
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
                "clients": self._handler.clients.rows(self.published, rate_hz),
                "spin_hz": health.get("spin_hz"),
                "motion": health.get("motion"),
                "energy": health.get("energy", {}),
                "engine": health.get("engine", {}),
                "accuracy": health.get("accuracy"),
                "warnings": [*warnings, *self._describe_wait(), *self._handler.warnings()],
                "remarks": health.get("remarks", []),
                "samples_published": self.published,
                "commands": self._accepted,
            }
        )

    def _event(self, name: str, tick: int, **fields: Any) -> dict[str, Any]:
        return {"event": name, "tick": tick, "time_s": tick / self._rate, "wall_s": time.time(), **fields}

    def _describe_wait(self) -> list[str]:
        if (held := self._held) is None or (held_s := time.monotonic() - held[1]) <= _MIN_WAIT_REPORTED_S:
            return []
        return [f"has waited {held_s:.0f} s for client {held[0]} to receive the data"]

    # ---- on the run's thread ----

    def _is_client_behind(self, produced: int, rate_hz: float, block_rows: float) -> bool:
        """Return whether the rows produced exceed those that a client has acknowledged by too much."""
        rows = min(_MAX_AHEAD_S * rate_hz, _MAX_AHEAD_BLOCKS * block_rows)
        name = self._handler.clients.find_lagging(produced, round(rows)) if rows > 0 else None
        if name is None:
            self._held = None
        elif self._held is None or self._held[0] != name:
            self._held = name, time.monotonic()
        return name is not None

    def prepare(self) -> None:
        """Prepare, start to answer requests and publish the rig's token; `run` calls it if it was not called before."""
        if self._prepared:
            return
        catalogue, parameters = self._prepare_documents()
        self._handler.open(
            {
                wire.CATALOGUE: lambda: catalogue,
                wire.PARAMETERS: lambda: parameters,
                wire.SCENE: self._scene_document,
                wire.STATUS: self.status,
            }
        )
        self._prepared = True

    def run(self) -> dict[str, Any]:
        """Run until the end, a stop, or a failure, which is raised after the stream has ended.

        Returns:
            Summary: reason, wall_s, values of the last status, counts, and troubles.
        """
        self.prepare()
        reason = "failed"
        began_s = time.monotonic()
        try:
            with freeze_start_objects():
                began_s = time.monotonic()
                reason = self._run_to_end()
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
            # Keep the cache until all connected clients have received everything.
            self._handler.clients.settle(self._server, self.published, patience_s=self._linger_s)
        status = self.status()
        figures = {name: status[name] for name in _SUMMARY_FIGURES if name in status}
        return {"reason": reason, "wall_s": wall_s, **figures, **counts, "troubles": self._handler.failures}

    def _take_commands(self) -> list[dict[str, Any]]:
        """Execute all received commands; return their events."""
        events = []
        for pending in self._received_commands():
            try:
                event = self._execute(pending)
                if event is not None:
                    events.append(event)
            except InputError as error:
                pending.refuse(error)
            except Exception as error:
                # A request that passes all checks must not end the run.
                pending.refuse(InputError(pending.command, "readable", one_line(error)))
                self._handler.record_failure(pending.command, error)
        return events

    def _accept(self, pending: PendingCommand, tick: int) -> dict[str, Any]:
        """Count an accepted command; return its reply.

        Args:
            pending: The command.
            tick: When it takes effect, or is complete [ticks].
        """
        self._accepted += 1
        reply = {"accepted": True, "id": self._accepted, "command": pending.command}
        return {**reply, "tick": tick, "time_s": tick / self._rate}
