"""Bench of a test: a rig in its own process on its own port, a played recording, or an existing rig at a URL."""

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
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, FiniteFloat

from replays.campaigns.equipment.cleanup import END_S
from replays.campaigns.equipment.process import Program
from rig.base import wire
from rig.base.checks import Written
from rig.base.errors import InputError, RefusedError, Words
from rig.base.files import Closing
from rig.base.outcome import InconclusiveError
from rig.channels.sampling import TICKS_HZ
from rig.serve.transport.endpoint import free_port
from rig.serve.waiting import Deadline

if TYPE_CHECKING:
    from drivers.client import Rig
    from drivers.console import AcceptedStep
    from rig.run.commands.table import TimedCommand

_LIVE_S = 86_400.0
"""Nominal length of a run in real time; the test ends it earlier [s]."""
_ROUND_TRIPS = 20
Pace = Literal["lockstep", "real-time"]


_Wait = Annotated[FiniteFloat, Field(gt=0.0, le=86_400.0)]


class Waits(Written):
    """Limits of wall-clock time [s]."""

    start_s: _Wait = 300.0
    """Start of a rig, including a first compilation of the kernels."""
    join_s: _Wait = 30.0
    """Time for a device to join a rig in lockstep."""
    patience_s: _Wait = 600.0
    """Duration of a step of the rig by up to 1 s, during which it may wait for slow devices."""
    end_s: _Wait = END_S
    """Time for a device to end after the run, and again after a SIGTERM."""


class BenchError(RuntimeError):
    """Failure of the bench or of the device under test rather than of a measurement; the message is one line."""


class LateRigError(BenchError, InconclusiveError):
    """Error of a rig that fell behind real time: a failed limit may be due to this machine instead of the device."""


class UnsupportedError(RuntimeError):
    """Error of a bench that cannot do what a test needs; the test is skipped with this message."""


@dataclass(frozen=True)
class Target:
    """The rig or recording that tests run on, unless each test starts its own rig.

    Attributes:
        url: URL of an existing rig.
        replay: Recording to play.
    """

    url: str | None = None
    replay: Path | None = None

    @property
    def owns_rig(self) -> bool:
        """True if each test starts its own rig."""
        return self.url is None and self.replay is None


@dataclass(frozen=True)
class BenchSettings:
    """Requirements of a test on its bench.

    Attributes:
        scene: Scene, by name or path; None accepts any.
        pace: Clock of the run: lockstep or real time.
        block_ms: Length of a block [ms], which in lockstep is the resolution of a device's reaction time.
        set: Changes to the scene or its parameters, by dotted key.
        channels: Channels that `connect` reads by default.
        commands: Commands and faults at scene times, added to `[[commands]]` of the scene.
        duration_s: Length of the run [s]; None: as in the scene, or unlimited in real time.
        table: The user's own channel table.
        can: Whether the rig is also a node on a CAN bus.
        wait: Limits of wall-clock time.
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
    wait: Waits = field(default_factory=Waits)

    def document(self) -> dict[str, Any]:
        """Return the settings as a JSON document."""
        commands = [each.model_dump(mode="json", exclude_none=True) for each in self.commands]
        return {
            "scene": self.scene, "pace": self.pace, "block_ms": self.block_ms, "set": dict(self.set),
            "commands": commands, "duration_s": self.duration_s, "can": self.can,
            "wait": self.wait.model_dump(),
        }  # fmt: skip


def validate_replay(path: Path) -> None:
    """Raise an error unless a file is a complete recording, before any test runs.

    Raises:
        InputError: If it is not a recording or was cut off; events missing from it would count as not having occurred.
    """
    from recorder.reader import Recording

    if not Recording.open(path).complete:
        raise InputError("--replay", "a complete recording", Words(f"{path}, which was cut off"))


class Bench(Closing):
    """A running bench; close it, or use it as a context manager.

    Args:
        settings: Requirements of the test.
        folder: Folder for the output of the rig.
        target: Existing rig or recording to use; by default the bench starts its own rig.

    Raises:
        BenchError: If the rig does not start.
        UnsupportedError: If the target does not meet the settings.
    """

    def __init__(self, settings: BenchSettings, folder: Path, target: Target = Target()) -> None:
        self.settings, self.target = settings, target
        self.name = f"bench-{os.getpid()}-{next(_NUMBERS)}"
        self._program: Program | None = None
        self._daqmx: Program | None = None
        self._daqmx_port = ""
        self._folder = folder
        self._clients: list[Rig] = []
        self.client_names: set[str] = set()
        """Names of the clients of the test."""
        self.late = self._late_before = 0
        """Late blocks of a rig in real time during the test, as counted last."""
        self._is_counting = False
        self.can_url: str | None = None
        """Address of the rig on a CAN bus, for `rig.connect` and `Daq.open`; None without a bus."""
        self.socketcand_url: str | None = None
        """HOST:PORT at which the bus is served by socketcand, under the name can0; None without a bus."""
        self.slcan_path: str | None = None
        """Path of a pseudo-terminal that acts as an SLCAN adapter on the bus; None without a bus."""
        if target.url is not None:
            self.url = target.url
        else:
            self._program = Program(self._command(), folder / "rig.log")
            line = self._program.wait_for("listening on", settings.wait.start_s)
            if line is None:
                last_line = self._program.last_line
                within = f" within start_s = {settings.wait.start_s:g} s" if self._program.status is None else ""
                self._program.end()
                raise BenchError(f"the rig did not start{within}: {last_line}")
            self.url = f"zenoh:{line.partition('listening on ')[2].split()[0].rstrip(';')}"
            if settings.can and (line := self._program.wait_for(_SLCAN, settings.wait.start_s)) is not None:
                self.slcan_path = line.partition(_SLCAN)[2]
        try:
            self._console = self.connect(name="campaign", channels=())
            self.pace: str = self._console.pace
            if not target.owns_rig:
                self._check_target()
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
            self.socketcand_url = f"127.0.0.1:{free_port()}"
            listen += ["--can", bus, "--can-socketcand", self.socketcand_url, "--can-slcan"]
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

    def serve_daqmx(self) -> str:
        """Return the port of a NI-DAQmx server of the rig, which the first call starts.

        Raises:
            BenchError: If it does not start.
        """
        if self._daqmx is None:
            command = [sys.executable, "-m", "rig", "daqmx", "--connect", self.url, "--allow-commands"]
            self._daqmx = Program([*command, "--listen", "127.0.0.1:0"], self._folder / "daqmx.log")
            if (line := self._daqmx.wait_for(_DAQMX, self.settings.wait.start_s)) is None:
                raise BenchError(f"rig daqmx did not start: {self._daqmx.last_line}")
            self._daqmx_port = line.partition(_DAQMX)[2].partition(";")[0]
        return self._daqmx_port

    @property
    def daqmx_runs(self) -> bool | None:
        """Return whether a task of the NI-DAQmx server has run; None without a server."""
        return None if self._daqmx is None else self._daqmx.wait_for("rig: a task started", 0.0) is not None

    def begin(self) -> float:
        """Start a recording, if one is played, and return the simulated time at which the test begins [s]."""
        if self.target.replay is not None:
            self._console.resume()
            return 0.0
        if self.target.owns_rig and self.pace == "lockstep":
            return 0.0
        status = self.status()
        self._late_before, self._is_counting = status["overruns"], self.pace == "real-time"
        return float(status["time_s"])

    def late_blocks(self) -> int:
        """Return the number of blocks of the rig that missed their deadline in real time during the test."""
        if self._is_counting:
            with contextlib.suppress(RefusedError, ConnectionError):  # the rig has ended; the last count remains
                self.late = max(0, self.status()["overruns"] - self._late_before)
        return self.late

    # ---- what tests use ----

    def connect(self, *, name: str | None = None, wait_s: float = 30.0, **settings: Any) -> Rig:
        """Return a client of the rig, as `rig.connect` does; it is closed with the bench.

        Args:
            name: Name of the client; None: a new one.
            wait_s: Longest wait for the rig [s].
            settings: `channels` (default: those of the bench), `rate_hz`, `truth`, ...
        """
        from drivers.client import connect

        name = name or f"test-{len(self._clients)}"
        self.client_names.add(name)
        client = connect(self.url, wait_s=wait_s, name=name, **{"channels": self.settings.channels, **settings})
        self._clients.append(client)
        return client

    def status(self) -> dict[str, Any]:
        """Return the rig's status document."""
        return self._console.status()

    @property
    def links(self) -> int:
        """Number of client connections to the rig."""
        return int(self.status()["congestion"].get("links", 0))

    @property
    def joined(self) -> list[str]:
        """Names, as the rig knows them, of the devices that take part in lockstep."""
        return [row["name"] for row in self.status().get("devices", []) if row["state"] == "joined"]

    @property
    def lost(self) -> dict[str, str]:
        """Devices that the rig lists as lost, with the reasons; empty if it does not respond."""
        with contextlib.suppress(RefusedError, ConnectionError):
            return {row["name"]: row["reason"] for row in self.status().get("devices", []) if row["state"] == "lost"}
        return {}

    def stop(self) -> None:
        """End the run of the bench's own rig.

        Raises:
            BenchError: If the rig had ended with an error, or another process took its place.
        """
        self.late_blocks()  # while the rig still responds, and before the evaluation loads the machine
        self._is_counting = False
        if not self.target.owns_rig:
            return
        assert self._program is not None
        if (status := self._program.status) not in (None, 0):
            raise BenchError(f"the rig exited with status {status}: {self._program.last_line}")
        with contextlib.suppress(RefusedError, ConnectionError):  # the run has ended
            self._console.stop()

    def wait_for(self, device: str, *, timeout_s: float | None = None) -> None:
        """Wait until a device under test takes part in lockstep, even if another program started it.

        Raises:
            BenchError: If it does not join in time.
        """
        self.wait_for_joined(lambda name: name == device, device, timeout_s=timeout_s)

    def wait_for_joined(
        self, fits: Callable[[str], bool], device: str, *, timeout_s: float | None = None,
        look: Callable[[], object] = lambda: None,
    ) -> str:  # fmt: skip
        """Wait until a matching device takes part in lockstep, and return the rig's name for it.

        Args:
            fits: Predicate on the name of a device.
            device: Name of the device in error messages.
            timeout_s: Longest wait [s]; None: `join_s` of the settings.
            look: Function called while waiting, for example to check that the device still runs.

        Raises:
            BenchError: If no such device joins in time.
        """
        now: list[str] = []
        within_s = self.settings.wait.join_s if timeout_s is None else timeout_s
        for _ in Deadline(within_s).polls():
            now = self.joined
            if device_name := next(filter(fits, now), None):
                return device_name
            look()
        others = ", ".join(now) or "none"
        limit = f"{'join_s = ' if timeout_s is None else ''}{within_s:g} s"
        raise BenchError(f"device {device} did not join within {limit}; joined devices: {others}")

    def advance_to(self, time_s: float) -> None:
        """Advance the rig to a time [s] or to its end: step it by whole blocks in lockstep, or wait in real time.

        Raises:
            BenchError: If the rig does not advance.
        """
        client = self._console
        if self.pace != "lockstep":
            deadline = Deadline(10.0 + 2.0 * max(0.0, time_s - client.status()["time_s"]))
            while (remaining_s := time_s - (status := client.status())["time_s"]) > 0.0 and status["state"] != "ended":
                if deadline.passed:
                    raise BenchError(f"the rig did not reach {time_s:g} s")
                time.sleep(min(0.2, max(0.002, remaining_s)))
            return
        status = client.status()
        tick, block, end_s = status["tick"], _to_ticks(1e-3 * status["block_ms"]), status["end_s"]
        end = math.inf if end_s is None else _to_ticks(end_s)
        last = min(_to_ticks(time_s), end)
        while tick < last:
            ticks = min(-(-min(last - tick, _TICKS_PER_STEP) // block) * block, end - tick)
            try:
                reply = self._step(int(ticks))
            except RefusedError as error:
                if f"{wire.ENDED}: stopped" in str(error):
                    return  # a device may stop the rig
                raise BenchError(f"the rig does not advance: {error}") from None
            tick = reply.tick

    def _step(self, ticks: int) -> AcceptedStep:
        """Step the rig.

        Raises:
            BenchError: If the rig has ended, or waits too long for a device.
            RefusedError: If the rig refuses to step.
        """
        try:
            return self._console.step(ticks, timeout_s=self.settings.wait.patience_s)
        except ConnectionError as error:
            if self._program is not None and (status := self._program.wait(_EXIT_S)) is not None:
                raise BenchError(f"the rig exited with status {status}: {self._program.last_line}") from None
            limit = f"patience_s = {self.settings.wait.patience_s:g} s"
            raise BenchError(f"the rig did not complete a step within {limit}: {error}") from None

    def floor_ms(self) -> tuple[float, float]:
        """Return the median and maximum round-trip time of a request [ms], the lower limit of any command latency."""
        round_trips_ms = []
        for _ in range(_ROUND_TRIPS):
            start_s = time.perf_counter()
            self._console.status()
            round_trips_ms.append(1e3 * (time.perf_counter() - start_s))
        return statistics.median(round_trips_ms), max(round_trips_ms)

    @property
    def resolution(self) -> str:
        """Resolution of a device's reaction time in words; the same for every run in lockstep."""
        block = f"{self.settings.block_ms:g} ms blocks" if self.target.owns_rig else "blocks of the existing rig"
        return f"{block}, in lockstep" if self.pace == "lockstep" else f"{block}, and the measured round trip"

    def close(self) -> None:
        """Close the clients, and stop the rig if the bench started it."""
        for client in self._clients:
            client.close()
        self._clients.clear()
        if self._daqmx is not None:
            self._daqmx.end()
        if self._program is not None:
            self._program.end()

    # ---- on an existing rig or a recording ----

    def _check_target(self) -> None:
        """Check that an existing rig or recording is the one that the test needs.

        Raises:
            UnsupportedError: If the scene or a value differs; the message names the first difference.
        """
        what = "the recording" if self.target.replay else "the existing rig"
        scene = self.scene_document()
        settings = self.settings
        if settings.scene is not None and Path(settings.scene).stem != scene.get("name"):
            raise UnsupportedError(f"{what} has scene {scene.get('name')}, not {settings.scene}")
        for key, wanted in settings.set.items():
            place: Any = scene
            for part in key.split("."):
                place = place.get(part) if isinstance(place, Mapping) else None
            place = scene.get("set", {}).get(key) if place is None else place
            if json.dumps(place) != json.dumps(wanted) and place != wanted:
                raise UnsupportedError(f"{what} has {key} = {place}, not {wanted}")
        end_s = self.status()["end_s"]
        if (
            self.target.replay is not None
            and settings.duration_s is not None
            and end_s < settings.duration_s - _MAX_MISSING_S
        ):
            raise UnsupportedError(f"{what} ends at {end_s:g} s, before the test at {settings.duration_s:g} s")
        if settings.can:
            raise UnsupportedError(f"the CAN bus address of {what} is not available")
        if self.target.replay is not None:
            done = {_command_key(each) for each in scene.get("commands", ())}
            for each in settings.commands:
                if _command_key(each.model_dump(mode="json")) not in done:
                    what = f"{each.request.command} at {each.at_s:g} s"
                    raise UnsupportedError(f"a recording accepts no commands, and this one has no {what}")

    def scene_document(self) -> dict[str, Any]:
        """Return the scene of an existing rig or recording, with its name."""
        from rig.serve.transport.zenoh import connect_url

        with connect_url(self.url, wait_s=30.0) as client:
            document = wire.decode_document(client.request(wire.SCENE))
        return {**document.get("scene", {}), "name": document.get("name")}


DEFAULT_SCENE = "stable-run"
_DAQMX = "NI-DAQmx device rig at 127.0.0.1:"
_SLCAN = "SLCAN adapter on "
"""Words of the rig before the path of its pseudo-terminal."""
_NUMBERS = itertools.count(1)
_MAX_MISSING_S = 0.01
"""Longest part of a run that a recording may lack, as it ends at its last sample [s]."""
_TICKS_PER_STEP = 1_000_000
_EXIT_S = 2.0
"""Longest time between the loss of the connection and the exit of the rig's process [s]."""


def _to_ticks(time_s: float) -> int:
    return round(time_s * TICKS_HZ)


def _command_key(command: Mapping[str, Any]) -> str:
    return json.dumps({"at_s": command.get("at_s"), **command.get("request", {})}, sort_keys=True)


def toml_value(value: Any) -> str:
    """Return a value as TOML on one line."""
    if isinstance(value, Mapping):
        inner = ", ".join(f"{json.dumps(str(key))} = {toml_value(each)}" for key, each in value.items())
        return f"{{ {inner} }}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(toml_value, value))}]"
    if value is None or not isinstance(value, str | bool | int | float):
        raise InputError("set", "numbers, texts, lists and tables", Words(type(value).__name__))
    return json.dumps(value)
