"""Experiment of a recording, for simulation: scene, parameters and commands with their times.

On the same build the same experiment gives the same payloads, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from recorder.reader import Recording
from rig.base.checks import get_table
from rig.base.errors import InputError, Words
from rig.base.wire import EDGES, sensor_key, truth_key
from rig.channels.faults import find_channels
from rig.physics.parameters import DEFAULT_SET, load_parameters, set_names
from rig.run.commands.table import COMMANDS, MECHANICAL, FaultCommand, check_command
from rig.run.motion import MotionStart
from rig.run.offline import Run, SentCommand, frames, simulate
from rig.run.scenes import Scene, change_scene, parse_scene
from rig.run.simulation import TICK_RATE_HZ, Frame, Simulation

PICKUP_S = 0.5
"""Time before the hammer pulse at which a log from a running rig is picked up [s]: a few turns show the state of the
shaft."""
GRID_S = 0.1
"""Time step that is a whole number of samples of every rate [s]."""


@dataclass(frozen=True)
class Experiment:
    """Scene with the commands that were sent to it.

    Attributes:
        scene: The scene with the recorded parameters; it ends with the recording.
        commands: Commands sent in addition to those of the scene.
        first_s: Simulated time at which the recording begins [s].
        begin: Initial state of a log from a running rig; None: the scene's own start at time 0.
        unsure: Standard deviation of values without their own channel, by key, in their unit.
        angle: Angle of the shaft in addition to `begin`, included in the scene's `shaft.unbalance_phase` [rad].
        mark: Known value of `angle` from the mark of the keyphasor, and its standard deviation [rad], or None.
        imported: Whether it is that of a log of another system.
        mapped: Channels of such a log, in the order of its mapping.
    """

    scene: Scene
    commands: tuple[SentCommand, ...] = ()
    first_s: float = 0.0
    begin: MotionStart | None = None
    unsure: Mapping[str, float] = field(default_factory=dict)
    angle: float = 0.0
    mark: tuple[float, float] | None = None
    imported: bool = False
    mapped: tuple[str, ...] = ()

    @classmethod
    def from_recording(cls, recording: Recording) -> Self:
        """Return the experiment of a recording of this rig.

        Raises:
            InputError: The recording is not from this rig, or this version does not know its scene or parameters.
        """
        document = recording.scene.get("scene")
        streams = [stream for stream in recording.streams.values() if stream.rows]
        if "import" in recording.scene and not isinstance(document, dict):
            must = "a recording with the scene it ran: add [experiment] to the mapping, and import it again"
            raise InputError("file", must, Words(f"{recording.path}, imported without one"))
        if not isinstance(document, dict) or not streams:
            raise InputError("file", "a recording of this rig, with the scene it ran and samples", str(recording.path))
        duration_s = max(_end_s(recording), 1.0 / TICK_RATE_HZ)
        scene = parse_scene({**recorded_scene(recording.parameters, document), "duration_s": duration_s})
        sent = [
            SentCommand(one["tick"], one["command"], dict(one["request"]))
            for one in recording.commands
            if one["command"] in COMMANDS
        ]
        first_s = min(float(stream.first_time_s) for stream in streams)
        begin = _initial_state(recording, scene, first_s) if starts_while_running(recording) else None
        document = recording.scene.get("import", {})
        mark = document.get("mark_deg") if begin is not None and len(_find_first_edges(recording, scene)) > 1 else None
        return cls(scene=scene, commands=tuple(sent), first_s=first_s, begin=begin, unsure=document.get("unsure", {}),
                   mark=mark and (math.radians(mark[0]), math.radians(mark[1])),
                   imported=is_imported(recording),
                   mapped=tuple(document.get("mapping", {}).get("channels", ())))  # fmt: skip

    def with_changes(self, changes: dict[str, Any]) -> Experiment:
        """Return the experiment with other values of scene or parameters, by dotted key, each in its own unit.

        Raises:
            InputError: An unknown key or an invalid value.
        """
        return replace(self, scene=change_scene(self.scene, changes))

    def without_faults(self) -> Experiment:
        """Return the experiment without sensor faults."""
        kept = tuple(one for one in self.scene.commands if one.request.MECHANICAL)
        sent = tuple(one for one in self.commands if one.name in MECHANICAL)
        return replace(self, scene=self.scene.model_copy(update={"commands": kept}), commands=sent)

    @property
    def faulty_channels(self) -> set[str]:
        """Channels that have a fault at some time."""
        timed = [one.request for one in self.scene.commands] + [
            check_command(one.name, dict(one.request)) for one in self.commands if one.name == "fault"
        ]
        table, sensors = self.scene.table, self.scene.sensors
        sent = [one for one in timed if isinstance(one, FaultCommand)]
        ideal = sensors.chain == "ideal"
        return {
            name for f in sent for name in find_channels(f.what, f.channel, table, ideal=ideal, noisy=sensors.noise)
        }

    def simulation(self) -> Simulation:
        """Return a simulation of the scene at its start; `frames` sends it the commands."""
        return Simulation(self.scene, begin=self.begin)

    def frames(self, simulation: Simulation, *, chunk_s: float = 0.1) -> Iterator[Frame]:
        """Run the experiment on a simulation, chunk by chunk."""
        return frames(simulation, chunk_s=chunk_s, commands=self.commands)

    def run(self, *, duration_s: float | None = None, progress: Callable[[float], None] | None = None) -> Run:
        """Run the experiment, and keep everything.

        Args:
            duration_s: End at another time [s].
            progress: Callback for the completed fraction, 0 to 1.
        """
        return simulate(self.scene, duration_s=duration_s, commands=self.commands, progress=progress)


def is_imported(recording: Recording) -> bool:
    """Return whether a recording is a log of another system."""
    return "import" in recording.scene


def starts_while_running(recording: Recording) -> bool:
    """Return whether the rig of a log was already running, so that only samples show the shaft's state."""
    mapped = recording.scene.get("import", {}).get("mapping", {}).get("experiment", {})
    return mapped.get("commands", "scene") != "scene" and "lead_s" not in mapped


def _initial_state(recording: Recording, scene: Scene, first_s: float) -> MotionStart:
    """Return the initial state of such a log: shortly before the hammer pulse, at the angle of the edges."""
    hammer_s = min((timed.at_s for timed in scene.commands), default=first_s)
    begin_s = math.floor(round(max(first_s, hammer_s - PICKUP_S) / GRID_S, 6)) * GRID_S
    edges_s = _find_first_edges(recording, scene)
    if len(edges_s) < 2:
        turns = (begin_s - edges_s.sum()) * scene.drive.speed_hz if len(edges_s) else 0.0
        return MotionStart(round(begin_s * TICK_RATE_HZ), angle=2.0 * math.pi * (turns % 1.0))
    near = max(0, min(int(np.searchsorted(edges_s, begin_s)) - 1, len(edges_s) - 2))
    turns = (begin_s - edges_s[near]) / (edges_s[near + 1] - edges_s[near])
    return MotionStart(round(begin_s * TICK_RATE_HZ), angle=2.0 * math.pi * (turns % 1.0))


def _find_first_edges(recording: Recording, scene: Scene) -> np.ndarray:
    """Return the edges before the first command, after which the shaft slows down, shape (n,) [s]."""
    edges_s = recording.edges()
    return edges_s[edges_s < min((timed.at_s for timed in scene.commands), default=math.inf)]


def _end_s(recording: Recording) -> float:
    """Return the simulated time after the last row of any stream [s].

    Raises:
        InputError: The times of a stream contradict its row numbers.
    """
    rates = {sensor_key(name): group.rate_hz for name, group in recording.table.groups.items()}
    rates |= {truth_key(name): table["rate_hz"] for name, table in recording.catalogue.get("truth", {}).items()}
    ends = [0.0]
    for key, stream in recording.streams.items():
        if key != EDGES and stream.rows > 1:  # edges come once per turn, not at a rate
            steps = stream.rows + stream.lost - 1
            period_s = (stream.last_time_s - stream.first_time_s) / steps
            if key in rates and not 0.5 < period_s * rates[key] < 2.0:
                raise InputError(
                    "file", "a recording whose times fit its row numbers", Words(f"{recording.path}, {key}")
                )
            ends.append(stream.last_time_s + period_s)
    return math.floor(max(ends) * TICK_RATE_HZ + 0.5) / TICK_RATE_HZ


def recorded_scene(parameters: dict[str, Any], document: dict[str, Any]) -> dict[str, Any]:
    """Return the document of the scene that made a recording, with the recorded parameters.

    An engine without `rolling` is of a version in which it integrated rolling contact by series.

    Raises:
        InputError: This version does not know a parameter, or `engine` is not a table.
    """
    engine = {"rolling": "series", **get_table(document, "engine")}
    return {**document, **_recorded_parameters(parameters, document), "engine": engine, "fidelity": "given"}


def _recorded_parameters(parameters: dict[str, Any], document: dict[str, Any]) -> dict[str, Any]:
    """Return the scene's fields that give the recorded parameters, independent of the files they came from.

    Raises:
        InputError: This version does not know one of them.
    """
    recorded = {key: entry["value"] for key, entry in parameters["values"].items()}
    name, changes = document.get("parameters", DEFAULT_SET), document.get("set", {})
    if name in set_names():
        now = load_parameters(name).override(changes) if changes else load_parameters(name)
        if {key: entry.value for key, entry in now.entries.items()} == recorded:
            return {"parameters": name, "set": changes}
    base = load_parameters().entries
    unknown = sorted(set(recorded) - set(base))
    if unknown:
        raise InputError("file", "a recording whose parameters this version knows", ", ".join(unknown))
    different = {key: value for key, value in recorded.items() if base[key].value != value}
    return {"parameters": DEFAULT_SET, "set": different}
