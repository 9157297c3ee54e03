"""WebSocket server for the Foxglove app and other programs with its protocol: plots, events, commands, play bar.

The plot messages are those of a recording, so one layout shows both. The server is a client of the rig, which checks
each command as from every other client.
"""

from __future__ import annotations

import json
import secrets
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from recorder.contents.views import Messages, View, Views
from recorder.files.schemas import JOINT_STATE, LOG, VIEW_EVENTS, Definition, encode_log, event_text
from rig.base import wire
from rig.base.checks import read_json
from rig.base.errors import InputError, RefusedError, require_package
from rig.base.files import Closing
from rig.base.text import printable
from rig.run.commands import SUMMARIES
from rig.run.commands.table import COMMANDS
from rig.serve.stream_check import BlockValidator, Catalogue, parse_event
from rig.serve.transport import Client
from rig.serve.transport.clients import Reporter
from rig.serve.waiting import BoundedQueue

if TYPE_CHECKING:
    from foxglove import Channel, Parameter, Schema, Service, ServiceRequest
    from foxglove.websocket import PlaybackControlRequest, PlaybackState


SERVICES = {**{name: line or "Clear a fault, or all" for name, line in SUMMARIES.items()}, "stop": "End the run"}
"""Commands that are offered as services, with a description each."""
REQUEST_BYTES = 1 << 16
"""Largest request of a service, as of the rig's other clients [bytes]."""
_NS = 1_000_000_000
_TICK_S = 0.02
"""Interval at which messages are sent [s]."""
_STATUS_S = 0.25
"""Interval at which the state of a replay and the link to the rig are checked [s]."""
_QUEUE_BYTES = 64 << 20
"""Size of the queue of received blocks: 20 s of the default streams [bytes]."""
_BACKLOG = 16_384
"""Messages that wait for one WebSocket client: 10 s of the default plots. With more, its oldest are dropped."""
_SHOWN_BLOCKS = 2
"""Blocks played after a seek of a paused replay: a block after a jump is accepted with the next one."""

Send = Callable[..., Any]
"""Sends a command, given its name and fields; returns the rig's acknowledgement, a dataclass."""


class FoxgloveServer(Closing):
    """Serves one rig or replay, also after its restart.

    Args:
        client: Transport to the rig; its owner closes it.
        address: Host and port to listen on; port 0: a free one.
        view_rate_hz: Rate of the plot messages [Hz of simulated time].
        send: Sends commands to the rig.
        allow_commands: Accept the services; otherwise they answer with an error.
        allow_playback: Accept the play bar of a replay.
        secret: Required as the field `secret` of the services' requests; None: they need none.

    Raises:
        InputError: The address is in use.
        ModuleNotFoundError: The package foxglove-sdk is not installed.
        NoReplyError: No rig replies.
    """

    def __init__(
        self,
        client: Client,
        address: tuple[str, int],
        *,
        view_rate_hz: float,
        send: Send,
        allow_commands: bool,
        allow_playback: bool,
        secret: str | None = None,
    ) -> None:
        sdk = require_package("foxglove", "foxglove")
        from foxglove.websocket import Capability

        self._client, self._send, self._view_rate_hz = client, send, view_rate_hz
        self._allow_commands, self._secret = allow_commands, secret
        self._inbox = BoundedQueue[tuple[str, bytes]](_QUEUE_BYTES, size=lambda item: len(item[1]))
        self._context = sdk.Context()
        self._channels: dict[str, Channel] = {}
        self._catalogue: dict[str, Any] = {}
        self._now_ns, self._sent_ns, self._checked_s, self.malformed = 0, -1, 0.0, 0
        self.messages = 0
        """Number of messages sent to the channels."""
        self._notices: deque[str] = deque(maxlen=100)
        self._alive, self._rig = True, client.rig
        self._reporter = Reporter(client, "foxglove")
        self._describe()
        status = wire.decode_document(client.request(wire.STATUS))
        replay = status.get("replay") if allow_playback else None
        self._is_replay = replay is not None
        self._played: tuple[Any, ...] = ()
        span = None if replay is None else (round(replay["from_s"] * _NS), round(replay["to_s"] * _NS))
        try:
            self._server = sdk.start_server(
                name=f"rig {status.get('scene')}",
                host=address[0],
                port=address[1],
                capabilities=[Capability.Time, Capability.Parameters, Capability.Services],
                supported_encodings=["json"],
                server_listener=self,
                services=[self._make_service(name) for name in SERVICES],
                context=self._context,
                playback_time_range=span,
                message_backlog_size=_BACKLOG,
            )
        except (OSError, RuntimeError) as error:
            raise InputError("--listen", f"a free address ({error})", f"{address[0]}:{address[1]}") from None
        self.port: int = self._server.port
        client.subscribe(f"{wire.SENSORS}/*", self._take)
        client.subscribe(wire.EVENTS, self._take, history=True)
        client.watch(wire.ALIVE, self._watch)

    @property
    def app_url(self) -> str:
        """Address that opens the app with this server as its source."""
        return str(self._server.app_url())

    def close(self) -> None:
        """Disconnect the WebSocket clients."""
        self._inbox.close()
        self._report(done=True)
        self._server.stop()

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve until `stop` returns True; it is called in each cycle."""
        while not stop():
            self.step()
            time.sleep(_TICK_S)

    def step(self) -> None:
        """Send what has arrived, and the state of a replay."""
        from foxglove import StatusLevel

        while (item := self._inbox.take(0.0)) is not None:
            try:
                self._take_event(item[1]) if item[0] == wire.EVENTS else self._take_blocks(*item)
            except ValueError:
                self.malformed += 1
        for view in self._views.all:
            self._log(view, view.take_complete())
        if self._now_ns != self._sent_ns:
            self._sent_ns = self._now_ns
            self._server.broadcast_time(self._now_ns)
        while self._notices:
            self._server.publish_status(self._notices.popleft(), StatusLevel.Warning)
        if time.monotonic() - self._checked_s >= _STATUS_S and self._alive:
            self._checked_s = time.monotonic()
            self._check_rig()

    # ---- on threads of the transport ----

    def _take(self, key: str, payload: bytes) -> None:
        self._inbox.push((key, payload))

    def _watch(self, alive: bool) -> None:
        if self._alive and not alive:
            self._notices.append("the rig was lost; waiting for it to start again")
        self._alive = alive

    # ---- streams ----

    def _check_rig(self) -> None:
        """Describe a rig that was started again, and publish the state of a replay."""
        try:
            if self._client.rig not in (None, self._rig):
                self._describe()
                self._rig = self._client.rig
                self._server.clear_session()
            self._report()
            if self._is_replay and (played := self._get_playback(None, sought=False)) is not None:
                state = (played.status, played.current_time, played.playback_speed)
                if state != self._played:
                    self._played = state
                    self._server.broadcast_playback_state(played)
        except (ConnectionError, ValueError):
            pass  # it has not started completely; checked again

    def _report(self, *, done: bool = False) -> None:
        beat = next(iter(self._groups), "")
        self._reporter.send(self._rows.next.get(beat), lost=self._rows.lost.get(beat, 0), done=done)

    def _describe(self) -> None:
        """Read the rig's documents; replace the channels if its channel table is another one."""
        document = wire.decode_document(self._client.request(wire.CATALOGUE))
        scene = wire.decode_document(self._client.request(wire.SCENE))
        catalogue = Catalogue.read(document)
        self._groups = {wire.sensor_key(name): group for name, group in catalogue.table.groups.items()}
        self._tick_rate_hz = round(catalogue.tick_rate_hz)
        self._validator, self._rows = BlockValidator(catalogue), wire.Continuity()
        self._scene = _flatten(scene.get("scene") if isinstance(scene.get("scene"), dict) else scene)
        self._views = Views(catalogue.table, rate_hz=self._view_rate_hz)
        if document != self._catalogue:
            self._catalogue = document
            for channel in self._channels.values():
                channel.close()
            self._channels = {view.topic: self._open_channel(view.topic, JOINT_STATE) for view in self._views.all}
            self._channels[VIEW_EVENTS] = self._open_channel(VIEW_EVENTS, LOG)

    def _open_channel(self, topic: str, form: Definition) -> Channel:
        from foxglove import Channel, Schema

        schema = Schema(name=form.name, encoding=form.language, data=form.text)
        return Channel(topic, schema=schema, message_encoding=form.encoding, context=self._context)

    def _take_blocks(self, key: str, payload: bytes) -> None:
        for _, block, *_ in self._validator.take(key, payload):
            if (group := self._groups.get(key)) is None:
                continue
            self._rows.follow(key, block.index, len(block.values))
            start_ns = block.tick * _NS // self._tick_rate_hz
            self._now_ns = start_ns + round((len(block.values) - 1) * _NS / block.rate_hz)
            if (plotted := self._views.add(group, block, start_ns)) is not None:
                self._log(*plotted)

    def _take_event(self, payload: bytes) -> None:
        event = parse_event(payload)
        tick = event.get("tick")
        time_ns = self._now_ns if tick is None else tick * _NS // self._tick_rate_hz
        level, text = event_text(event)
        self._publish(VIEW_EVENTS, encode_log(time_ns, level, wire.EVENTS, text), time_ns)

    def _log(self, view: View, messages: Messages) -> None:
        times_ns, data = messages
        for row, time_ns in zip(data, times_ns.tolist(), strict=True):
            self._publish(view.topic, row.tobytes(), time_ns)

    def _publish(self, topic: str, message: bytes, time_ns: int) -> None:
        self._channels[topic].log(message, log_time=max(0, time_ns))
        self.messages += 1

    def _ignore(self, *_: Any) -> None:
        """Ignore a subscription: channels without subscribers cost nothing."""

    on_subscribe = on_unsubscribe = on_parameters_subscribe = on_parameters_unsubscribe = _ignore

    # ---- commands, on threads of the WebSocket server ----

    def _make_service(self, name: str) -> Service:
        from foxglove import MessageSchema, Schema, Service, ServiceSchema

        def form(title: str, properties: Mapping[str, Any]) -> MessageSchema:
            described = {"title": title, "type": "object", "description": SERVICES[name], "properties": properties}
            schema: Schema = Schema(name=title, encoding="jsonschema", data=json.dumps(described).encode())
            return MessageSchema(encoding="json", schema=schema)

        reply = {"command": {"type": "string"}, "id": {"type": "integer"}, "tick": {"type": "integer"}}
        fields = describe_fields(name) | ({} if self._secret is None else {"secret": {"type": "string"}})
        given = ServiceSchema(name, request=form(name, fields), response=form(f"{name} reply", reply))
        return Service(name, schema=given, handler=self._call)

    def _call(self, request: ServiceRequest) -> bytes:
        """Send a command to the rig; the text of an error is the answer of the service."""
        name = request.service_name
        if not self._allow_commands:
            raise RefusedError(f"{name} is refused: this server was started without --allow-commands")
        fields = read_json(request.payload or b"{}", field=name, most_bytes=REQUEST_BYTES)
        if self._secret is not None:
            given = str(fields.pop("secret", "")).encode(errors="replace")
            if not secrets.compare_digest(given, self._secret.encode()):
                raise RefusedError(f"{name} is refused: the field secret must be that of `rig foxglove --secret FILE`")
        for own in {"from", "rig"} & fields.keys():
            raise InputError(f"{name}.{own}", "left out", fields[own])
        return json.dumps(asdict(self._send(name, **fields))).encode()

    # ---- parameters ----

    def on_get_parameters(self, client: Any, param_names: list[str], request_id: str | None = None) -> list[Parameter]:
        """Return the scene's values, all if no names are given."""
        from foxglove import Parameter

        scene = self._scene
        return [Parameter(name, value=scene[name]) for name in param_names or scene if name in scene]

    def on_set_parameters(
        self, client: Any, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        """Return the unchanged values: they are those of a scene that runs."""
        self._notices.append("the parameters are those of the running scene and cannot be set; use the services")
        return self.on_get_parameters(client, [each.name for each in parameters])

    # ---- play bar ----

    def on_playback_control_request(self, playback_control_request: PlaybackControlRequest) -> PlaybackState | None:
        """Play, pause, seek, or set the rate of the replay; return its state then."""
        from foxglove.websocket import PlaybackCommand

        asked, sought = playback_control_request, False
        try:
            play = self._request_playback()
            if asked.playback_speed != play["rate"]:
                self._send("rate", rate=float(np.clip(asked.playback_speed, 0.01, 1000.0)))
            if asked.playback_command == PlaybackCommand.Pause and not play["paused"]:
                self._send("pause")
            to_s = None if asked.seek_time is None else asked.seek_time / _NS
            if asked.playback_command == PlaybackCommand.Play and to_s is None and _has_ended(play):
                to_s = play["from_s"]
            if to_s is not None:
                last_s = play["to_s"] - _SHOWN_BLOCKS * play["block_s"]
                self._send("seek", time_s=max(play["from_s"], min(to_s, last_s)))
                sought = True
            if asked.playback_command == PlaybackCommand.Play:
                self._send("resume")
            elif sought:
                self._send("step", blocks=_SHOWN_BLOCKS)
            self._played = ()
        except (ConnectionError, RefusedError, ValueError) as error:
            self._notices.append(printable(str(error), 200))
        return self._get_playback(asked.request_id, sought=sought)

    def _request_playback(self) -> dict[str, Any]:
        """Return the state of the replay from the status document.

        Raises:
            NoReplyError: The replay does not reply.
            RefusedError: The rig is no replay.
        """
        status = wire.decode_document(self._client.request(wire.STATUS))
        if "replay" not in status:
            raise RefusedError("the rig is no replay")
        return {**status["replay"], "block_s": 1e-3 * (status["block_ms"] or 0.0), "state": status["state"]}

    def _get_playback(self, request_id: str | None, *, sought: bool) -> PlaybackState | None:
        from foxglove.websocket import PlaybackState, PlaybackStatus

        try:
            play = self._request_playback()
        except (ConnectionError, RefusedError, ValueError):
            return None
        status = PlaybackStatus.Paused if play["paused"] else PlaybackStatus.Playing
        if _has_ended(play):
            status = PlaybackStatus.Ended
        return PlaybackState(status, round(play["position_s"] * _NS), float(play["rate"] or 1.0), sought, request_id)


def _has_ended(play: Mapping[str, Any]) -> bool:
    at_end = play["paused"] and play["to_s"] - play["position_s"] < 1.5 * play["block_s"]
    return at_end or play["state"] == "ended"


def describe_fields(name: str) -> dict[str, Any]:
    """Return the JSON schema of a command's fields, by name."""
    if name == "fault":
        return {"channel": {"type": "string"}, "kind": {"type": "string"}, "for_s": {"type": "number"}}
    if name == "clear":
        return {"id": {"type": ["integer", "string"], "default": "all"}}
    fields = COMMANDS[name].quantities() if name in COMMANDS else {}
    return {
        field: {
            "type": ["number", "string"] if each.takes_text else "number",
            "description": f"{each.quantity.help} [{each.quantity.unit}]",
            **({} if each.required else {"default": each.default}),
        }
        for field, each in fields.items()
    }


def _flatten(value: Any, name: str = "scene") -> dict[str, Any]:
    """Return the values of nested tables by dotted name; a list is a JSON text, and an empty value is left out."""
    if isinstance(value, dict):
        return {key: leaf for field, each in value.items() for key, leaf in _flatten(each, f"{name}.{field}").items()}
    if isinstance(value, list):
        value = json.dumps(value)
    return {} if value is None else {name: value}
