"""Experiment of an imported log: scene, commands and speed, from the mapping and the log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from replays.recordings.formats.events.motion import ChannelMotion, Impact, detect_impact, estimate_speed
from rig.base.errors import InputError, Words
from rig.channels.table import ChannelTable, default_table
from rig.run.commands.table import HAMMER_BOUNDS

if TYPE_CHECKING:
    from replays.recordings.formats.events.pulses import HammerPulse
    from replays.recordings.formats.mapping import ExperimentMapping
    from rig.run.scenes import Scene

_SPEED_DEVIATION, _DEFAULT_SPEED_DEVIATION = 0.01, 0.2
"""Relative standard deviation of a speed that is given or measured, and of the scene's default."""
_EDGE_ERROR = 1e-3
"""Relative error of the speed from two keyphasor edges."""
_PROBES = "the motion of the probes"
_MIN_ANGLE_DEG = 5.0
"""Smallest angle of an impact that counts as a separate direction; hammers hit along x [degrees]."""
_UNRECORDED_PULSE_DEVIATION = {"hammer.1.duration_ms": 0.1, "clock.offset_s": 1e-3}
"""Standard deviations for a hammer pulse that no channel recorded: of its length (relative) and of its time [s]."""
_MAX_COMMAND_DELAY_S = 0.02
"""Largest delay of a command after the sudden motion that it explains [s]."""


class Speed(NamedTuple):
    """Speed found in a log, with its standard deviation [Hz] and its source."""

    hz: float
    deviation_hz: float
    by: str

    @property
    def text(self) -> str:
        """The speed in words."""
        within = f" ±{2.0 * self.deviation_hz:.1g}" if self.by == _PROBES else ""
        return f"{self.hz:.4g}{within} Hz by {self.by}"


def measure_speeds(motions: Sequence[ChannelMotion], edges: np.ndarray, until_s: float) -> list[Speed]:
    """Return mean speeds up to some time, or of the whole log: from the channel `speed`, from edges, else from probes.

    Args:
        motions: Channels, in the time of the recording.
        edges: Keyphasor edges [ticks], shape (turns,).
        until_s: Time up to which only the drive acts [s].
    """
    speeds = []
    if (speed_channel := next((one for one in motions if one.name == "speed"), None)) is not None:
        rows = max(1, round((min(until_s, 1e6) - speed_channel.axis.first_s) * speed_channel.axis.rate_hz))
        hz = float(np.nanmean(speed_channel.values[:rows]))
        speeds.append(Speed(hz, _SPEED_DEVIATION * abs(hz), "the channel `speed`"))
    times = edges[edges < until_s * 1e6]
    times = times if len(times) > 1 else edges
    if len(times) > 1:
        hz = (len(times) - 1) * 1e6 / float(times[-1] - times[0])
        speeds.append(Speed(hz, 0.0, "the keyphasor"))
    if not speeds and (speed_hz := estimate_speed(motions, until_s=until_s)) is not None:
        speeds.append(Speed(*speed_hz, _PROBES))
    return speeds


class ExperimentDocuments(NamedTuple):
    """Documents of an experiment in a recording."""

    name: str
    parameters: dict[str, Any]
    scene: dict[str, Any]
    commands: list[dict[str, Any]]
    """The scene's commands, each with at_s."""
    unsure: dict[str, float]
    """Standard deviation of values without their own channel, by key, in their unit."""


def build_experiment(
    wanted: ExperimentMapping,
    pulses: Sequence[HammerPulse],
    *,
    duration_s: float,
    motions: Sequence[ChannelMotion],
    edges: np.ndarray,
    table: ChannelTable,
    remarks: list[str],
) -> ExperimentDocuments:
    """Build the documents of a recording from the scene in a mapping and the findings in the log.

    Args:
        wanted: The table [experiment] of the mapping.
        pulses: Detected hammer pulses.
        duration_s: Length of the recording [s].
        motions: Channels, in the time of the recording.
        edges: Keyphasor edges [ticks], shape (turns,).
        table: Channel table of the recording.
        remarks: Extended by processing steps and by contradictions between log and mapping.

    Raises:
        InputError: The scene is not valid.
    """
    from rig.run.scenes import load_scene, parse_scene
    from rig.run.simulation import Simulation

    scene = load_scene(wanted.scene, dict(wanted.set))
    data = scene.model_dump()
    if wanted.commands == "detected":
        others = [timed for timed in data["commands"] if timed["request"]["command"] != "hammer"]
        data["commands"] = [*others, *(pulse.command() for pulse in pulses)]
    elif wanted.commands != "scene":
        data["commands"] = list(wanted.commands)
    data |= {"duration_s": duration_s, "fidelity": "given"}
    own = default_table().groups
    groups = tuple(name for name in table.groups if name in own)
    if groups:
        data["sensors"] = {**data["sensors"], "groups": () if set(groups) == set(own) else groups}
    rates = {table.groups[name].rate_hz for name in groups}
    try:
        rate = rates.pop() if len(rates) == 1 else data["sensors"]["rate_hz"]
        rate = 0 if all(rate == group.rate_hz for group in own.values()) else rate
        scene = parse_scene({**data, "sensors": {**data["sensors"], "rate_hz": rate}})
    except InputError as error:
        if not error.field.startswith("sensors"):
            raise
        scene = parse_scene(data)
        remarks.append("the scene uses the rig's own sample rates, as the log's rates are not possible")
    remarks.append(f"scene {scene.name}: experiment from the mapping, with assumed parameters until identified")
    hits = [timed for timed in scene.commands if timed.request.command == "hammer"]
    first_s = min((timed.at_s for timed in hits), default=math.inf)
    unsure = dict[str, float]()
    if wanted.commands != "scene":
        hit = detect_impact(motions)
        if hit is not None and all(timed.at_s > hit.at_s + _MAX_COMMAND_DELAY_S for timed in scene.commands):
            remarks.append(
                f"from {hit.at_s:.3f} s on {', '.join(hit.names)} move suddenly, as after an impact, without a "
                f"command: predictions from there are wrong; set [experiment] commands = [{format_command(hit)}]"
            )
            first_s = hit.at_s
        if hits and all(one.name != "hammer" for one in motions):
            unsure |= _UNRECORDED_PULSE_DEVIATION
            unsure["hammer.1.duration_ms"] *= hits[0].request.model_dump()["duration_ms"]
    scene, deviation_hz = _apply_speed(scene, wanted, measure_speeds(motions, edges, first_s), edges, remarks)
    if deviation_hz:
        unsure["drive.speed_hz"] = deviation_hz
    simulation = Simulation(scene)
    commands = [{"at_s": timed.at_s, **timed.request.model_dump()} for timed in scene.commands]
    return ExperimentDocuments(
        scene.name, simulation.parameters_document(), simulation.scene_document(), commands, unsure
    )


def format_command(hit: Impact) -> str:
    """Return an impact as a command in TOML, from the motion of the probes."""
    at_s, force_n, duration_ms, degrees = hit.pulse or (hit.at_s, 100.0, 5.0, 0.0)
    way = f", direction = {round(degrees)}" if abs(degrees) > _MIN_ANGLE_DEG else ""
    force, length = (
        min(max(value, low), high)
        for value, (low, high) in zip((force_n, duration_ms), HAMMER_BOUNDS.values(), strict=True)
    )
    return f'{{ at_s = {at_s:.5f}, command = "hammer", force_n = {force:.3g}, duration_ms = {length:.3g}{way} }}'


def _apply_speed(
    scene: Scene, wanted: ExperimentMapping, speeds: Sequence[Speed], edges: np.ndarray, remarks: list[str]
) -> tuple[Scene, float]:
    """Return the scene at the given or measured speed, and the speed's standard deviation [Hz]; 0 if it is known.

    Raises:
        InputError: The speed is to be measured, and cannot be.
    """
    from rig.run.scenes import parse_scene

    measured = wanted.speed_hz == "measured"
    if measured and not speeds:
        must = "a number, or a log with a channel `speed`, a keyphasor or probes that show the rotation"
        raise InputError("experiment.speed_hz", must, Words("measured"))
    number = wanted.set.get("drive.speed_hz") if wanted.speed_hz is None else None if measured else wanted.speed_hz
    if measured:
        chosen = speeds[0]
    elif number is not None:
        chosen = Speed(float(number), _SPEED_DEVIATION * abs(float(number)), "the mapping")
    elif wanted.commands == "scene" or scene.drive.profile:
        return scene, 0.0
    else:
        chosen = Speed(scene.drive.speed_hz, 0.0, f"the scene {scene.name}, as experiment.speed_hz is omitted")
    apart = [
        one for one in speeds
        if abs(one.hz - chosen.hz) > 2.0 * math.hypot(one.deviation_hz, chosen.deviation_hz, _EDGE_ERROR * chosen.hz)
    ]  # fmt: skip
    shown = any(one.by != _PROBES for one in speeds)
    if apart or not (shown or number is not None):
        others = f", but {' and '.join(one.text for one in apart)}" * bool(apart)
        remarks.append(f"speed: {chosen.text}{others}" + ("" if shown else "; `rig validate` fits it"))
    if wanted.speed_hz is not None:
        data = scene.model_dump()
        scene = parse_scene({**data, "drive": {**data["drive"], "speed_hz": max(0.0, chosen.hz), "profile": ()}})
    if len(edges) > 2 or (measured and shown):
        return scene, 0.0
    return scene, chosen.deviation_hz or _DEFAULT_SPEED_DEVIATION * chosen.hz
