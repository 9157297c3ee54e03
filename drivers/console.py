"""Operator console of a running rig: hammer, speed, magnet release, stop, lockstep, status."""

from __future__ import annotations

import contextlib
import math
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partialmethod
from typing import Any, Self

from rig.base import wire
from rig.base.errors import InputError, RefusedError
from rig.base.files import Closing
from rig.run.commands import SUMMARIES
from rig.serve.devices import describe_waits
from rig.serve.transport import DEFAULT_ENDPOINT, Client, NoReplyError, RigLostError


@dataclass(frozen=True, slots=True)
class Accepted:
    """Acknowledgement of a command.

    Attributes:
        command: Name of the command.
        id: Number of the command in this run; the event `command` of the stream carries it too.
        tick: Effective tick; for a step, the tick at its end.
        time_s: The same as simulated time [s].
    """

    command: str
    id: int
    tick: int
    time_s: float


@dataclass(frozen=True, slots=True)
class AcceptedFault(Accepted):
    """Acknowledgement of a fault.

    Attributes:
        fault: Number of the fault, for `clear`.
        channels: Channels that it affects.
        first_row: Number of the first affected sample, by channel group.
    """

    fault: int
    channels: tuple[str, ...]
    first_row: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class AcceptedStep(Accepted):
    """Acknowledgement of a step.

    Attributes:
        lost: Devices under test that the rig removed during the step, with the reason.
    """

    lost: Mapping[str, str]


class Console(Closing):
    """Sends commands to one rig, and returns its acknowledgements.

    Args:
        client: Transport to the rig; `close` closes it too.
        name: Name of this console in the stream's events; by default it contains the process id.
        timeout_s: Longest wait for a reply [s].
        any_rig: Send commands to whichever rig runs, also to one that was started later.

    Example:
        With a rig that runs: `with Console.open("zenoh:127.0.0.1:7460") as console`. Here with a stand-in that accepts
        every command:

        >>> class Rig:
        ...     rig = None
        ...     def request(self, key, payload=b"", *, timeout_s):
        ...         return b'{"accepted": true, "id": 1, "tick": 2500, "time_s": 0.0025}'
        >>> console = Console(Rig())
        >>> console.hammer(force_n=100.0, duration_ms=5.0, direction="x")
        Accepted(command='hammer', id=1, tick=2500, time_s=0.0025)
        >>> console.speed(float("nan"))
        Traceback (most recent call last):
        rig.base.errors.InputError: speed_hz must be a finite number; received nan
    """

    def __init__(
        self, client: Client, *, name: str | None = None, timeout_s: float = 5.0, any_rig: bool = False
    ) -> None:
        self._client = client
        self._name = name or f"console pid {os.getpid()}"
        self._timeout_s = timeout_s
        self._rig = None if any_rig else client.rig
        """Identity of the rig; None if any will do, or over CAN."""
        self._secret = secrets.token_hex(16)
        """Secret of the devices that this console joins: no other client can end their blocks or remove them."""

    @classmethod
    def open(cls, url: str = "zenoh:" + DEFAULT_ENDPOINT, *, name: str | None = None, wait_s: float = 3.0) -> Self:
        """Connect to the rig at a URL, as `Daq.open` does; close the console, or use it as a context manager.

        Args:
            url: `zenoh:HOST:PORT`, or the name of a rig on this computer.
            name: Name of this console in the stream's events.
            wait_s: Longest wait for a rig to reply [s].

        Raises:
            InputError: The URL is malformed.
            ConnectionError: No rig replies.
        """
        from rig.serve.transport.zenoh import connect_url

        return cls(connect_url(url, wait_s=wait_s), name=name)

    def close(self) -> None:
        """Disconnect; the rig continues."""
        self._client.close()

    def send(self, command: str, timeout_s: float | None = None, /, **fields: Any) -> Accepted:
        """Send a command by name, with its fields as listed in rig/KEYS.md.

        Args:
            command: Name of the command.
            timeout_s: Longest wait for the reply [s]; by default that of the console.
            fields: Fields of the command.

        Raises:
            InputError: A field is not a finite number.
            NoReplyError: The rig did not reply in time.
            RigLostError: Another rig runs there now.
            RefusedError: The rig refused the command, for the reason in the message.
        """
        reply = self._request(command, timeout_s, **fields)
        return Accepted(command=command, id=reply["id"], tick=reply["tick"], time_s=reply["time_s"])

    def hammer(self, *, force_n: float = 100.0, duration_ms: float = 5.0, direction: str | float = "x") -> Accepted:
        """Apply an impact to the shaft at the disk with the hammer.

        Args:
            force_n: Peak force [N], above 0.
            duration_ms: Length of the half-sine pulse [ms], above 0.
            direction: "x", "y", "-x", "-y", or the angle from x towards y [degrees].

        Raises:
            RefusedError: The rig refused the command, for the reason in the message.
        """
        return self.send("hammer", force_n=force_n, duration_ms=duration_ms, direction=direction)

    def speed(self, hz: float) -> Accepted:
        """Set the speed set point of the drive.

        Args:
            hz: Shaft speed [Hz].

        Raises:
            RefusedError: The rig refused the command, for the reason in the message.
        """
        return self.send("speed", speed_hz=hz)

    def release(self) -> Accepted:
        """Release the magnet that holds the shaft.

        Raises:
            RefusedError: The rig refused the command, for the reason in the message.
        """
        return self.send("release")

    def fault(self, channel: str, kind: str, *, for_s: float | None = None, **numbers: Any) -> AcceptedFault:
        """Inject a fault into a channel; `rig fault --list` lists the kinds and their fields.

        Args:
            channel: Name of a channel, or of a channel group for all of its channels.
            kind: Kind of fault, such as `gain`.
            for_s: Duration [s]; by default until it is cleared.
            numbers: Fields of the kind, such as `factor=1.05` of `gain`.

        Returns:
            The acknowledgement, with the number of the fault for `clear`.

        Raises:
            RefusedError: The rig refused the command, for the reason in the message.
        """
        duration = {} if for_s is None else {"for_s": for_s}
        reply = self._request("fault", channel=channel, kind=kind, **duration, **numbers)
        values = {name: reply[name] for name in ("id", "tick", "time_s", "fault", "first_row")}
        return AcceptedFault(command="fault", channels=tuple(reply["channels"]), **values)

    def clear(self, number: int | str = "all") -> Accepted:
        """Clear one fault, or all.

        Args:
            number: Number of the fault, or "all".

        Raises:
            RefusedError: The fault does not exist.
        """
        return self.send("clear", id=number)

    def stop(self) -> Accepted:
        """End the run.

        Raises:
            RefusedError: The rig refused the command, for the reason in the message.
        """
        return self.send("stop")

    def step(self, ticks: int, *, timeout_s: float = 600.0) -> AcceptedStep:
        """Step a rig in lockstep; return when the ticks are published and all devices have processed them.

        Args:
            ticks: Length of the step [ticks], a whole multiple of the simulation's block.
            timeout_s: Longest wait for the end of the step [s].

        Raises:
            RefusedError: The rig is not in lockstep, or the number is not a whole multiple of the block.
        """
        reply = self._request("step", timeout_s, ticks=ticks)
        values = {name: reply[name] for name in ("id", "tick", "time_s")}
        return AcceptedStep(command="step", lost=reply.get("lost", {}), **values)

    def join(self, device: str | None = None, *, patience_s: float = 10.0) -> Accepted:
        """Register a device under test, for which a rig in lockstep then waits after each block (see `done`).

        Args:
            device: Name of the device; by default that of this console.
            patience_s: Longest time for a block [s of wall time]. A device that needs longer is removed, and the rig
                continues without it.

        Raises:
            RefusedError: The rig is not in lockstep, or a device of this name has joined.
        """
        return self.send("join", device=device or self._name, patience_s=float(patience_s), secret=self._secret)

    def done(self, tick: int, device: str | None = None) -> Accepted:
        """Report that a device has processed all blocks up to a tick.

        Args:
            tick: End of the last processed block [ticks].
            device: Name of the device; by default that of this console.

        Raises:
            RefusedError: The device was removed, or no block ends at this tick and the device is removed now.
        """
        return self.send("done", device=device or self._name, tick=tick, secret=self._secret)

    def leave(self, device: str | None = None) -> Accepted:
        """Unregister a device: the rig no longer waits for it.

        Args:
            device: Name of the device; by default that of this console.

        Raises:
            RefusedError: The device has not joined.
        """
        return self.send("leave", device=device or self._name, secret=self._secret)

    def step_blocks(self, blocks: int, *, timeout_s: float = 600.0) -> Accepted:
        """Play a number of blocks of a paused replay; return when they are published.

        Args:
            blocks: Number of blocks, at least 1.
            timeout_s: Longest wait for the last block [s].

        Raises:
            RefusedError: No replay is paused, or the number is below 1.
        """
        return self.send("step", timeout_s, blocks=blocks)

    def pause(self) -> Accepted:
        """Pause the replay of a recording.

        Raises:
            RefusedError: This is a rig, not a replay.
        """
        return self.send("pause")

    def resume(self) -> Accepted:
        """Resume the replay of a recording.

        Raises:
            RefusedError: This is a rig, not a replay.
        """
        return self.send("resume")

    def seek(self, time_s: float) -> Accepted:
        """Move the replay of a recording to another position.

        Args:
            time_s: Position [s of the recording's simulated time].

        Raises:
            RefusedError: This is a rig, not a replay, or the recording has no such position.
        """
        return self.send("seek", time_s=time_s)

    def rate(self, rate: float) -> Accepted:
        """Set the speed of a replay.

        Args:
            rate: Recorded seconds per second.

        Raises:
            RefusedError: The replay has no rate, or the rate is out of range.
        """
        return self.send("rate", rate=rate)

    def note(self, text: str, *, tags: list[str] | None = None) -> Accepted:
        """Add a note to the stream's events, and so to every recording of the stream.

        Args:
            text: The note.
            tags: Words to search for it by.

        Raises:
            RefusedError: The rig refused the command, for the reason in the message.
        """
        return self.send("note", text=text, tags=tags or [])

    def status(self) -> dict[str, Any]:
        """Return the rig's status document, which is also published twice a second."""
        self._check_rig()
        return wire.decode_document(self._client.request(wire.STATUS, timeout_s=self._timeout_s))

    @property
    def connection(self) -> str | None:
        """Certificates by which rig and console have authenticated each other; None without TLS."""
        return getattr(self._client, "connection", None)

    def _check_rig(self) -> None:
        """Raise an error if the linked rig is another one than at the start."""
        if self._rig is not None and self._client.rig not in (None, self._rig):
            raise RigLostError("the rig was lost, and another runs there now: connect again")

    def _describe_wait(self) -> str:
        """Return the devices that the rig waits for, as the end of an error message."""
        with contextlib.suppress(NoReplyError):
            rows = self.status().get("devices", ()) if self._client.rig is not None else ()
            if waits := describe_waits(rows):
                return f"; {waits}"
        return ""

    def _request(self, command: str, timeout_s: float | None = None, /, **fields: Any) -> dict[str, Any]:
        for name, value in fields.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(name, "a finite number", value)
        self._check_rig()
        rig = {} if self._rig is None else {"rig": self._rig}
        request = wire.encode_document({"from": self._name, **rig, **fields})
        try:
            payload = self._client.request(wire.command_key(command), request, timeout_s=timeout_s or self._timeout_s)
        except NoReplyError as error:
            raise NoReplyError(f"{error}{self._describe_wait()}") from None
        reply = wire.decode_document(payload)
        if not reply.get("accepted"):
            self._check_rig()
            raise RefusedError(str(reply.get("error", f"the rig refused {command} without a reason")))
        return reply


for _name in SUMMARIES.keys() - vars(Console).keys():
    setattr(Console, _name, partialmethod(Console.send, _name))
