"""A bench: a rig of one test's own, in a process and at a port of its own; or a recording, or the rig at a URL."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from replays.campaigns.equipment.process import Program
from rig.base import wire
from rig.base.closeable import Closing
from rig.base.errors import InputError, RefusedError, Words
from rig.base.outcome import InconclusiveError
from rig.channels.sampling import TICKS_HZ
from rig.serve.transport.endpoint import free_port
from rig.serve.waiting import Deadline

if TYPE_CHECKING:
    from drivers.client import Rig
    from drivers.console import AcceptedStep
    from rig.run.commands.table import TimedCommand

START_S = 300.0
"""Longest that a rig takes to be there, where nothing is compiled yet [s]."""
JOIN_S = 30.0
"""Longest that a device takes to join a rig in lockstep [s]."""
_LIVE_S = 86_400.0
"""Length of a run in real time, which the test ends [s]."""
_ROUND_TRIPS = 20
Pace = Literal["lockstep", "real-time"]


class BenchError(RuntimeError):
    """The bench or the device under test failed, which is no verdict on a measurement; one line."""


class BehindError(BenchError, InconclusiveError):
    """The rig did not keep real time: what is not as it must be may be of this machine, and not of the device."""


class NotThereError(RuntimeError):
    """What a test needs cannot be done on this bench; the message says why."""


@dataclass(frozen=True)
class Target:
    """On what tests run, if not on rigs of their own.

    Attributes:
        url: The rig there.
        replay: A recording.
    """

    url: str | None = None
    replay: Path | None = None

    @property
    def own(self) -> bool:
        """Each test has a rig of its own."""
        return self.url is None and self.replay is None


@dataclass(frozen=True)
class BenchSettings:
    """What a test needs of its bench.

    Attributes:
        scene: A scene, by name or path; None: any.
        pace: What decides when a block runs.
        block_ms: Length of a block [ms]: in lockstep what a device's reaction is exact to.
        set: Changes of the scene or its parameters, by dotted key.
        channels: Channels that `connect` reads unless it is told.
        commands: Commands and faults at times of the scene, as `[[commands]]` there; beside its own.
        duration_s: Length of the run [s]; None: the scene's, or without an end in real time.
        table: A channel table of the user's own.
        can: Whether it is a node of a CAN bus, too.
    """

    scene: str | None = None
    pace: Pace = "lockstep"
    block_ms: float = 10.0
    set: Mapping[str, Any] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    commands: tuple[TimedCommand, ...] = ()
    duration_s: float | None = None
    table: Path | None = None
    can: bool = False

    def document(self) -> dict[str, Any]:
        """As a document for JSON."""
        commands = [each.model_dump(mode="json", exclude_none=True) for each in self.commands]
        return {
            "scene": self.scene, "pace": self.pace, "block_ms": self.block_ms, "set": dict(self.set),
            "commands": commands, "duration_s": self.duration_s, "can": self.can,
        }  # fmt: skip


def check_replay(path: Path) -> None:
    """Refuse what no campaign is run on, before anything runs.

    Raises:
        InputError: It is no recording, or was cut off: what is not in it would be taken for what did not happen.
    """
    from recorder.reader import Recording

    if not Recording.open(path).complete:
        raise InputError("--replay", "a recording that was finished", Words(f"{path}, which was cut off"))


class Bench(Closing):
    """A bench that is there; close it, or use it as a context manager.

    Args:
        settings: What it has to be.
        folder: Where its output goes.
        target: What it is, if no rig of its own.

    Raises:
        BenchError: The rig did not start.
        NotThereError: The target is not what the settings ask for.
    """

    def __init__(self, settings: BenchSettings, folder: Path, target: Target = Target()) -> None:
        self.settings, self.target = settings, target
        self.name = f"bench-{os.getpid()}-{next(_NUMBERS)}"
        self._program: Program | None = None
        self._clients: list[Rig] = []
        self._late = self._late_before = 0
        self.can_url: str | None = None
        """Where the rig is on a CAN bus, for `rig.connect` and `Daq.open`; None without one."""
        if target.url is not None:
            self.url = target.url
        else:
            self._program = Program(self._command(), folder / "rig.log")
            line = self._program.wait_for("listening on", START_S)
            if line is None:
                said = self._program.last_line
                self._program.end()
                raise BenchError(f"the rig did not start: {said}")
            self.url = f"zenoh:{line.partition('listening on ')[2].split()[0].rstrip(';')}"
        try:
            self._console = self.connect(name="campaign", channels=())
            self.pace: str = self._console.pace
            if not target.own:
                self._check_alike()
        except BaseException:
            self.close()
            raise

    def _command(self) -> list[str]:
        settings, rig = self.settings, [sys.executable, "-m", "rig"]
        listen = ["--listen", "127.0.0.1:0", "--name", self.name]
        if self.target.replay is not None:
            return [*rig, "replay", str(self.target.replay), "--pause", *listen]
        if settings.can:
            bus = f"zenoh:can0?endpoint=127.0.0.1:{free_port()}"
            self.can_url = f"can:{bus}"
            listen += ["--can", bus]
        changes = dict(settings.set)
        if settings.duration_s is not None or settings.pace == "real-time":
            changes["duration_s"] = settings.duration_s or _LIVE_S
        if settings.commands:
            from rig.run.scenes import load_scene

            own = load_scene(settings.scene or DEFAULT_SCENE, dict(settings.set)).commands
            changes["commands"] = [each.model_dump(exclude_none=True) for each in (*own, *settings.commands)]
        sets = [word for key, value in changes.items() for word in ("--set", f"{key}={toml_value(value)}")]
        table = [] if settings.table is None else ["--channels", str(settings.table)]
        pace = ["--pace", settings.pace, "--block-ms", f"{settings.block_ms:g}"]
        return [*rig, "run", settings.scene or DEFAULT_SCENE, *pace, *listen, *sets, *table]

    def begin(self) -> float:
        """Let a recording play; returns when, in simulated time of the run, the test begins [s]."""
        if self.target.replay is not None:
            self._console.resume()
            return 0.0
        if self.target.own and self.pace == "lockstep":
            return 0.0
        status = self.status()
        self._late_before = status["overruns"]
        return float(status["time_s"])

    def late_blocks(self) -> int:
        """Blocks of a rig in real time that were not ready when they were due, since the test began."""
        if self.target.own and self.pace == "real-time":
            with contextlib.suppress(RefusedError, ConnectionError):  # it has ended: as many as were seen last
                self._late = self.status()["overruns"] - self._late_before
        return self._late

    # ---- what tests use ----

    def connect(self, *, name: str | None = None, wait_s: float = 30.0, **settings: Any) -> Rig:
        """A client of the rig, as `rig.connect`; closed with the bench.

        Args:
            name: Who asks.
            wait_s: How long to wait for it to be there [s].
            settings: `channels` (those of the bench unless given), `rate_hz`, `truth`, ...
        """
        from drivers.client import connect

        client = connect(self.url, wait_s=wait_s, name=name, **{"channels": self.settings.channels, **settings})
        self._clients.append(client)
        return client

    def status(self) -> dict[str, Any]:
        """The rig's status document."""
        return self._console.status()

    @property
    def links(self) -> int:
        """How many links clients have to the rig."""
        return int(self.status()["congestion"].get("links", 0))

    @property
    def joined(self) -> list[str]:
        """Devices that take part in lockstep, by what the rig calls them."""
        return [row["name"] for row in self.status().get("devices", []) if row["state"] == "joined"]

    def wait_for(self, device: str, *, timeout_s: float = JOIN_S) -> None:
        """Wait until a device under test takes part in lockstep, whoever has started it.

        Raises:
            BenchError: It does not in time.
        """
        self.first_joined(lambda name: name == device, device, timeout_s=timeout_s)

    def first_joined(
        self, fits: Callable[[str], bool], device: str, *, timeout_s: float = JOIN_S,
        look: Callable[[], object] = lambda: None,
    ) -> str:  # fmt: skip
        """Wait until a device that fits takes part in lockstep; returns what the rig calls it.

        Args:
            fits: Whether one of that name is it.
            device: What it is called in errors.
            timeout_s: How long [s].
            look: Called meanwhile.

        Raises:
            BenchError: None does in time.
        """
        now: list[str] = []
        for _ in Deadline(timeout_s).polls():
            now = self.joined
            if found := next(filter(fits, now), None):
                return found
            look()
        others = ", ".join(now) or "nobody"
        raise BenchError(f"device {device} did not join in {timeout_s:g} s; what has: {others}")

    def advance_to(self, time_s: float) -> None:
        """Let the rig go on to a time [s] or to its end: step it in lockstep, to whole blocks, or wait.

        Raises:
            BenchError: It does not go on.
        """
        client = self._console
        if self.pace != "lockstep":
            deadline = Deadline(10.0 + 2.0 * max(0.0, time_s - client.status()["time_s"]))
            while (left := time_s - (status := client.status())["time_s"]) > 0.0 and status["state"] != "ended":
                if deadline.passed:
                    raise BenchError(f"the rig did not reach {time_s:g} s")
                time.sleep(min(0.2, max(0.002, left)))
            return
        status = client.status()
        tick, block, end_s = status["tick"], _ticks(1e-3 * status["block_ms"]), status["end_s"]
        end = math.inf if end_s is None else _ticks(end_s)
        last = min(_ticks(time_s), end)
        while tick < last:
            ticks = min(-(-min(last - tick, _PIECE) // block) * block, end - tick)
            try:
                reply = self._step(int(ticks))
            except RefusedError as error:
                if f"{wire.ENDED}: stopped" in str(error):
                    return  # as a device may
                raise BenchError(f"the rig does not go on: {error}") from None
            tick = reply.tick

    def _step(self, ticks: int) -> AcceptedStep:
        """Step the rig.

        Raises:
            BenchError: It has died, or waits for a device for too long.
            RefusedError: It refuses to.
        """
        try:
            return self._console.step(ticks, timeout_s=_STEP_S)
        except ConnectionError as error:
            if self._program is not None and (status := self._program.wait(_DIES_S)) is not None:
                raise BenchError(f"the rig has died (status {status}): {self._program.last_line}") from None
            raise BenchError(f"the rig does not go on: {error}") from None

    def floor_ms(self) -> tuple[float, float]:
        """Round trips of a request to the rig: median and longest [ms], what a command's latency cannot be below."""
        took = []
        for _ in range(_ROUND_TRIPS):
            begun = time.perf_counter()
            self._console.status()
            took.append(1e3 * (time.perf_counter() - begun))
        return statistics.median(took), max(took)

    @property
    def resolution(self) -> str:
        """What a device's reaction is exact to, in words; the same for each run in lockstep."""
        block = f"{self.settings.block_ms:g} ms blocks" if self.target.own else "the blocks of the rig that is there"
        return f"{block}, in lockstep" if self.pace == "lockstep" else f"{block}, and the measured floor"

    def close(self) -> None:
        """Close the clients, and end the rig if it is the bench's own."""
        for client in self._clients:
            client.close()
        self._clients.clear()
        if self._program is not None:
            self._program.end()

    # ---- on a rig that is there ----

    def _check_alike(self) -> None:
        """Refuse a rig that is there, and is another one than the test is about.

        Raises:
            NotThereError: Scene or values differ; the message tells the first that does.
        """
        what = "the recording" if self.target.replay else "the rig there"
        scene = self.scene_document()
        settings = self.settings
        if settings.scene is not None and Path(settings.scene).stem != scene.get("name"):
            raise NotThereError(f"{what} has scene {scene.get('name')}, not {settings.scene}")
        for key, wanted in settings.set.items():
            place: Any = scene
            for part in key.split("."):
                place = place.get(part) if isinstance(place, Mapping) else None
            place = scene.get("set", {}).get(key) if place is None else place
            if json.dumps(place) != json.dumps(wanted) and place != wanted:
                raise NotThereError(f"{what} has {key} = {place}, not {wanted}")
        end_s = self.status()["end_s"]
        if (
            self.target.replay is not None
            and settings.duration_s is not None
            and end_s < settings.duration_s - _SHORT_S
        ):
            raise NotThereError(f"{what} ends at {end_s:g} s, before the test at {settings.duration_s:g} s")
        if settings.can:
            raise NotThereError(f"whether {what} is on a CAN bus, and where, is not told")
        if self.target.replay is not None:
            done = {_key(each) for each in scene.get("commands", ())}
            for each in settings.commands:
                if _key(each.model_dump(mode="json")) not in done:
                    what = f"{each.request.command} at {each.at_s:g} s"
                    raise NotThereError(f"a recording takes no commands, and this one has no {what}")

    def scene_document(self) -> dict[str, Any]:
        """The scene of the rig that is there, with its name."""
        from rig.serve.transport.zenoh import client_of

        with client_of(self.url, wait_s=30.0) as client:
            document = wire.decode_document(client.request(wire.SCENE))
        return {**document.get("scene", {}), "name": document.get("name")}


DEFAULT_SCENE = "stable-run"
_NUMBERS = itertools.count(1)
_SHORT_S = 0.01
"""A recording may lack this of a run [s]: the rows behind its last one."""
_PIECE = 1_000_000
"""Ticks that are stepped at a time."""
_STEP_S = 600.0
"""Longest that a step takes, where it waits for devices that are patient [s]."""
_DIES_S = 2.0
"""How soon a rig whose link has gone has ended, if it has [s]."""


def _ticks(time_s: float) -> int:
    return round(time_s * TICKS_HZ)


def _key(command: Mapping[str, Any]) -> str:
    return json.dumps({"at_s": command.get("at_s"), **command.get("request", {})}, sort_keys=True)


def toml_value(value: Any) -> str:
    """A value as TOML on one line."""
    if isinstance(value, Mapping):
        inner = ", ".join(f"{json.dumps(str(key))} = {toml_value(each)}" for key, each in value.items())
        return f"{{ {inner} }}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(toml_value, value))}]"
    if value is None or not isinstance(value, str | bool | int | float):
        raise InputError("set", "of numbers, texts, lists and tables", Words(type(value).__name__))
    return json.dumps(value)
