"""Python-can interface of the virtual CAN: `can.Bus(interface="zenoh", channel="can0")` in any local process.

`ZenohBus` connects to a hub in another process, `HubBus` to one in this process.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import can  # noqa: TID253 - loaded by python-can itself
import numpy as np

from drivers.can.bus import codec
from drivers.can.bus.node import NodeBus
from rig.base.checks import read_json
from rig.base.errors import InputError, RefusedError
from rig.serve.transport.endpoint import parse_loopback

if TYPE_CHECKING:
    from can.typechecking import AutoDetectedConfig

    from drivers.can.bus.hub import Hub

_REQUEST_TIMEOUT_S = 2.0


class ZenohBus(NodeBus):
    """A node of a virtual CAN bus whose hub runs in another process of this computer.

    Args:
        channel: Name of the bus.
        endpoint: HOST:PORT of the hub, on 127.0.0.1; use `ssh -L` for a hub on another computer.
        connect_s: Longest wait for the hub [s].
        **settings: Settings of `NodeBus`: can_filters, receive_own_messages, fd, listen_only, rx_queue_size, bitrate,
            data_bitrate, timing; `in_order` is True by default.

    Raises:
        CanInitializationError: No hub of that channel replies, or its bus has other settings.
    """

    def __init__(
        self,
        channel: Any = "can0",
        *,
        endpoint: str = codec.DEFAULT_ENDPOINT,
        connect_s: float = 1.0,
        **settings: Any,
    ) -> None:
        self._address, self._connect_s = str(endpoint), connect_s
        super().__init__(channel, in_order=settings.pop("in_order", True), **settings)
        # Last, so that rejoining a restarted hub cannot coincide with the first join.
        self.client.watch(codec.alive_key(self.channel), self._watch)
        self.channel_info = f"zenoh {self.channel} at {self._address}"

    def _connect(self) -> None:
        from rig.serve.transport import NoReplyError
        from rig.serve.transport.zenoh import ZenohClient

        try:
            parse_loopback(self._address, field="endpoint")
            if not codec.is_name(self.channel):
                raise InputError("channel", "letters, digits, - and _, such as can0", self.channel)
        except InputError as error:
            raise can.CanInitializationError(str(error)) from None
        try:
            self.client = ZenohClient(self._address, wait_s=self._connect_s)
        except NoReplyError:
            raise can.CanInitializationError(self._describe_missing_hub()) from None
        self.client.await_token(codec.ALIVE)
        self.client.announce(codec.node_key(self.channel, self.name))
        self.client.subscribe(
            codec.bus_key(self.channel),
            lambda _, payload: self._receive(payload),
            on_miss=lambda _, count: self._count_missed(count),
        )

    def _describe_missing_hub(self) -> str:
        return (
            f"no hub for CAN channel {self.channel} replies at {self._address}; give its address "
            f"(endpoint=HOST:PORT), or start one with: rig can hub {self.channel} (or with the rig: rig run --can "
            f"zenoh:{self.channel})"
        )

    def _where(self) -> str:
        return f"the hub of CAN channel {self.channel} at {self._address}"

    def _ask(self, name: str, document: dict[str, Any]) -> dict[str, Any]:
        from rig.serve.transport import NoReplyError

        payload = json.dumps({"endpoint": self.name, **document}).encode()
        try:
            answer = self.client.request(codec.request_key(self.channel, name), payload, timeout_s=_REQUEST_TIMEOUT_S)
        except NoReplyError as error:
            if name != "join":
                raise can.CanOperationError(f"{self._where()} does not reply: {error}") from None
            others = [key.split("/")[2] for key in self.client.tokens(codec.ALIVE)]
            known_channels = f" (channels there: {', '.join(others)})" if others else ""
            raise can.CanInitializationError(self._describe_missing_hub() + known_channels) from None
        document = read_json(answer, field="hub")
        if "error" in document:
            raise RefusedError(str(document["error"]))
        return document

    def _offer(self, secret: str, records: np.ndarray) -> None:
        payload = bytes.fromhex(secret) + codec.encode(records)
        self.client.report(codec.offer_key(self.channel, self.name), payload)

    def _receive(self, payload: bytes) -> None:
        """Process a message of the hub, on the thread of the connection."""
        try:
            message = codec.decode(payload)
        except codec.CodecError:
            self.malformed += 1
        else:
            self.receive(message)

    def _watch(self, there: bool) -> None:
        """Handle the hub's token: the hub has stopped or restarted."""
        if not there:
            self._on_hub_lost()
        elif not self._there and not self._is_shutdown:
            try:
                self._join()
            except can.CanError:
                # Another kind of hub, or stopped again: the bus stays without one, as its state and `send` report.
                self._on_hub_lost()

    def _leave(self) -> None:
        self.client.close()

    @staticmethod
    def _detect_available_configs() -> Sequence[AutoDetectedConfig]:
        """Return the channels of the hub at the default endpoint; none without a hub."""
        from rig.serve.transport import NoReplyError
        from rig.serve.transport.zenoh import ZenohClient

        try:
            with ZenohClient(codec.DEFAULT_ENDPOINT, wait_s=0.2) as client:
                channels = [key.split("/")[2] for key in client.tokens(codec.ALIVE)]
        except NoReplyError:
            return []
        return [{"interface": "zenoh", "channel": channel} for channel in channels]


class HubBus(NodeBus):
    """A node of a virtual CAN bus whose hub runs in this process.

    Args:
        hub: The hub.
        **settings: As for `ZenohBus`.
    """

    def __init__(self, hub: Hub, **settings: Any) -> None:
        self._hub = hub
        super().__init__(hub.channel, **settings)
        self.channel_info = f"{hub.channel} of this process"

    def _connect(self) -> None:
        self.secret = self._hub.connect(self.name, self.receive, self._on_hub_lost)

    def _where(self) -> str:
        return f"the hub of CAN channel {self.channel} in this process"

    def _ask(self, name: str, document: dict[str, Any]) -> dict[str, Any]:
        return self._hub.answer(name, {"endpoint": self.name, **document})

    def _offer(self, secret: str, records: np.ndarray, due_ns: np.ndarray | None = None) -> None:
        self._hub.offer_records(self.name, secret, records, due_ns)

    def schedule_records(self, records: np.ndarray, due_ns: np.ndarray, timeout: float | None = None) -> None:
        """Pass frames to the hub before they are due, so that no thread has to wake for each frame.

        Args:
            records: As for `send_records`, at most as many as a transmit queue holds.
            due_ns: Time at which the controller receives each frame [ns of the hub's clock, usually
                `time.monotonic_ns`], shape of `records`; a time in the past means now.
            timeout: Longest wait for room in the transmit queue [s]; frames that are not due take room as well.

        Raises:
            CanOperationError: As for `send_records`.
        """
        self._check_open()
        self._reserve(len(records), timeout)
        self._offer(self.secret or "", records, due_ns)

    def _leave(self) -> None:
        self._hub.disconnect(self.name)
