"""The operator's console of a running rig: hammer, speed, magnet release, stop, lockstep, status."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partialmethod
from typing import Any, Self

from rig.base import wire
from rig.base.closeable import Closing
from rig.base.errors import InputError, RefusedError
from rig.run.commands import SUMMARIES
from rig.serve.transport import DEFAULT_ENDPOINT, Client, NoReplyError


@dataclass(frozen=True, slots=True)
class Accepted:
    """The rig's reply to a command that it took.

    Attributes:
        command: Name of the command.
        id: Number of the command in this run; the stream's event `command` carries it too.
        tick: Simulated time at which it takes effect [ticks]; for a step, at which it was done.
        time_s: The same [s].
    """

    command: str
    id: int
    tick: int
    time_s: float


@dataclass(frozen=True, slots=True)
class AcceptedFault(Accepted):
    """The reply to a fault.

    Attributes:
        fault: Its number.
        channels: Its channels.
        first_row: Number of the first row that it changes, by group.
    """

    fault: int
    channels: tuple[str, ...]
    first_row: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class AcceptedStep(Accepted):
    """The reply to a step.

    Attributes:
        lost: Devices under test that were put out meanwhile, with the reason.
    """

    lost: Mapping[str, str]


class Console(Closing):
    """Sends commands to one rig.

    Args:
        client: Transport to the rig.
        name: Who asks; appears in the stream's events.
        timeout_s: How long to wait for a reply [s].

    Example:
        Of a rig that runs: `with Console.open("zenoh:127.0.0.1:7460") as console`. Here of one that takes everything:

        >>> class Rig:
        ...     def request(self, key, payload=b"", *, timeout_s):
        ...         return b'{"accepted": true, "id": 1, "tick": 2500, "time_s": 0.0025}'
        >>> console = Console(Rig())
        >>> console.hammer(force_n=100.0, duration_ms=5.0, direction="x")
        Accepted(command='hammer', id=1, tick=2500, time_s=0.0025)
        >>> console.speed(float("nan"))
        Traceback (most recent call last):
        rig.base.errors.InputError: speed_hz must be a finite number; instead received nan
    """

    def __init__(self, client: Client, *, name: str | None = None, timeout_s: float = 5.0) -> None:
        self._client = client
        self._name = name or f"console pid {os.getpid()}"
        self._timeout_s = timeout_s

    @classmethod
    def open(cls, url: str = "zenoh:" + DEFAULT_ENDPOINT, *, name: str | None = None, wait_s: float = 3.0) -> Self:
        """A console of the rig at a URL, as for `Daq.open`; close it, or use it as a context manager.

        Raises:
            InputError: The URL is malformed.
            ConnectionError: Nothing is there.
        """
        from rig.serve.transport.zenoh import client_of

        return cls(client_of(url, wait_s=wait_s), name=name)

    def close(self) -> None:
        """Close the client."""
        self._client.close()

    def send(self, command: str, timeout_s: float | None = None, /, **fields: Any) -> Accepted:
        """Send a command by its name, with its fields as rig/KEYS.md lists them.

        Args:
            command: Name of the command.
            timeout_s: How long to wait for the reply [s]; that of the console unless given.
            fields: Fields of the command.

        Raises:
            RefusedError: The rig refused, for the reason in the message.
        """
        reply = self._reply(command, timeout_s, **fields)
        return Accepted(command=command, id=reply["id"], tick=reply["tick"], time_s=reply["time_s"])

    def hammer(self, *, force_n: float = 100.0, duration_ms: float = 5.0, direction: str | float = "x") -> Accepted:
        """Hit the shaft at the disk.

        Args:
            force_n: Peak force [N].
            duration_ms: Length of the half sine [ms].
            direction: "x", "y", "-x", "-y" or an angle from x towards y [degrees].

        Raises:
            RefusedError: The rig refused, for the reason in the message.
        """
        return self.send("hammer", force_n=force_n, duration_ms=duration_ms, direction=direction)

    def speed(self, hz: float) -> Accepted:
        """Set the speed that the drive holds [Hz].

        Raises:
            RefusedError: The rig refused, for the reason in the message.
        """
        return self.send("speed", speed_hz=hz)

    def release(self) -> Accepted:
        """Release the magnet that holds the shaft.

        Raises:
            RefusedError: The rig refused, for the reason in the message.
        """
        return self.send("release")

    def fault(self, channel: str, kind: str, *, for_s: float | None = None, **numbers: Any) -> AcceptedFault:
        """Make a channel misbehave; `rig fault --list` has the kinds and their numbers.

        Args:
            channel: A channel, or a group for all of its channels.
            kind: What it does.
            for_s: How long [s]; until it is cleared unless given.
            numbers: Of the kind, such as `factor=1.05` of a gain.

        Raises:
            RefusedError: The rig refused, for the reason in the message.
        """
        given = {} if for_s is None else {"for_s": for_s}
        reply = self._reply("fault", channel=channel, kind=kind, **given, **numbers)
        told = {name: reply[name] for name in ("id", "tick", "time_s", "fault", "first_row")}
        return AcceptedFault(command="fault", channels=tuple(reply["channels"]), **told)

    def clear(self, number: int | str = "all") -> Accepted:
        """End a fault by its number, or all.

        Raises:
            RefusedError: There is no such fault.
        """
        return self.send("clear", id=number)

    def stop(self) -> Accepted:
        """End the run.

        Raises:
            RefusedError: The rig refused, for the reason in the message.
        """
        return self.send("stop")

    def step(self, ticks: int, *, timeout_s: float = 600.0) -> AcceptedStep:
        """Let a rig in lockstep run this many ticks; returns when they were published and all devices are done.

        Args:
            ticks: A whole multiple of the simulation's block.
            timeout_s: How long to wait for that [s].

        Raises:
            RefusedError: The rig refused, for the reason in the message.
        """
        reply = self._reply("step", timeout_s, ticks=ticks)
        told = {name: reply[name] for name in ("id", "tick", "time_s")}
        return AcceptedStep(command="step", lost=reply.get("lost", {}), **told)

    def join(self, device: str | None = None, *, patience_s: float = 10.0) -> Accepted:
        """Make a rig in lockstep wait, after each block from now on, until a device under test is `done` with it.

        Args:
            device: Its name; that of this console unless given.
            patience_s: How long it may take over a block, wall time [s]; then it is put out, and the rig goes on.

        Raises:
            RefusedError: The rig is not in lockstep, or such a device has joined.
        """
        return self.send("join", device=device or self._name, patience_s=float(patience_s))

    def done(self, tick: int, device: str | None = None) -> Accepted:
        """Say that a device has dealt with everything up to the end of a block [ticks].

        Raises:
            RefusedError: The device was put out, or is by this: there is no such block.
        """
        return self.send("done", device=device or self._name, tick=tick)

    def leave(self, device: str | None = None) -> Accepted:
        """Make the rig wait for a device no longer.

        Raises:
            RefusedError: It has not joined.
        """
        return self.send("leave", device=device or self._name)

    def step_blocks(self, blocks: int, *, timeout_s: float = 600.0) -> Accepted:
        """Let a recording whose replay is paused go on by so many blocks; returns when they have been published.

        Raises:
            RefusedError: It is no replay that is paused, or the number is none.
        """
        return self.send("step", timeout_s, blocks=blocks)

    def pause(self) -> Accepted:
        """Hold the replay of a recording.

        Raises:
            RefusedError: A rig cannot be held.
        """
        return self.send("pause")

    def resume(self) -> Accepted:
        """Let the replay of a recording go on.

        Raises:
            RefusedError: It is no replay.
        """
        return self.send("resume")

    def seek(self, time_s: float) -> Accepted:
        """Let the replay of a recording go on from another position [s of its simulated time].

        Raises:
            RefusedError: It is no replay, or it has no such position.
        """
        return self.send("seek", time_s=time_s)

    def rate(self, rate: float) -> Accepted:
        """Set how many recorded seconds a replay plays a second.

        Raises:
            RefusedError: It is no replay with a rate, or there is no such rate.
        """
        return self.send("rate", rate=rate)

    def note(self, text: str, *, tags: list[str] | None = None) -> Accepted:
        """Put a note into the stream's events, and so into every recording of it.

        Raises:
            RefusedError: The rig refused, for the reason in the message.
        """
        return self.send("note", text=text, tags=tags or [])

    def status(self) -> dict[str, Any]:
        """The rig's status document, as published twice a second."""
        return wire.decode_document(self._client.request(wire.STATUS, timeout_s=self._timeout_s))

    @property
    def connection(self) -> str | None:
        """By which certificates the rig and this console know each other; None without TLS."""
        return getattr(self._client, "connection", None)

    def _waited_for(self) -> str:
        """Devices that a rig which is there waits for, in words."""
        with contextlib.suppress(NoReplyError):
            rows = self.status().get("devices", ()) if self._client.rig is not None else ()
            if late := [f"{row['name']} ({row['behind_s']:.0f} s)" for row in rows if row.get("behind_s")]:
                return f"; it waits for {', '.join(late)}"
        return ""

    def _reply(self, command: str, timeout_s: float | None = None, /, **fields: Any) -> dict[str, Any]:
        for name, value in fields.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(name, "a finite number", value)
        request = wire.encode_document({"from": self._name, **fields})
        try:
            payload = self._client.request(wire.command_key(command), request, timeout_s=timeout_s or self._timeout_s)
        except NoReplyError as error:
            raise NoReplyError(f"{error}{self._waited_for()}") from None
        reply = wire.decode_document(payload)
        if not reply.get("accepted"):
            raise RefusedError(str(reply.get("error", f"the rig refused {command} without a reason")))
        return reply


for _name in SUMMARIES.keys() - vars(Console).keys():
    setattr(Console, _name, partialmethod(Console.send, _name))
