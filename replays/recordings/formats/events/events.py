"""What happened in an imported log: the experiment that a mapping tells of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from replays.recordings.formats.events.motion import Impact, Motion, impact, turning
from rig.base.errors import InputError, Words
from rig.channels.table import ChannelTable, default_table
from rig.run.commands.table import HAMMER_BOUNDS

if TYPE_CHECKING:
    from replays.recordings.formats.events.pulses import HammerPulse
    from replays.recordings.formats.mapping import ExperimentMapping
    from rig.run.scenes import Scene

_BY_HAND, _UNTOLD = 0.01, 0.2
"""Standard deviation of a speed that is given or that a channel shows, and of one that is the scene's, as a part."""
_BY_EDGES = 1e-3
"""Part by which the speed of two edges may be off."""
_PROBES = "the motion of the probes"
_ALONG_DEG = 5.0
"""Hammers hit along x; an angle that is seen with less is no other direction [degrees]."""
_BY_EYE = {"hammer.1.duration_ms": 0.1, "clock.offset_s": 1e-3}
"""Of a hammer pulse that no channel shows: of its length, as a part of it, and of its time [s]."""
_FORETOLD_S = 0.02
"""So long behind what is sudden in a log the command may stand that explains it [s]."""


class Speed(NamedTuple):
    """A speed that a log tells, its standard deviation [Hz], and what tells it."""

    hz: float
    deviation_hz: float
    by: str

    @property
    def text(self) -> str:
        """In words."""
        within = f" ±{2.0 * self.deviation_hz:.1g}" if self.by == _PROBES else ""
        return f"{self.hz:.4g}{within} Hz by {self.by}"


def speeds_before(motions: Sequence[Motion], edges: np.ndarray, until_s: float) -> list[Speed]:
    """Mean speeds up to some time, else of the whole: of the channel `speed`, of the edges, else of the probes' motion.

    Args:
        motions: Channels, in the time of the recording.
        edges: Of the keyphasor [ticks], shape (turns,).
        until_s: Up to here the drive alone acts [s].
    """
    found = []
    if (own := next((one for one in motions if one.name == "speed"), None)) is not None:
        rows = max(1, round((min(until_s, 1e6) - own.axis.first_s) * own.axis.rate_hz))
        hz = float(np.nanmean(own.values[:rows]))
        found.append(Speed(hz, _BY_HAND * abs(hz), "the channel `speed`"))
    times = edges[edges < until_s * 1e6]
    times = times if len(times) > 1 else edges
    if len(times) > 1:
        hz = (len(times) - 1) * 1e6 / float(times[-1] - times[0])
        found.append(Speed(hz, 0.0, "the keyphasor"))
    if not found and (turned := turning(motions, until_s=until_s)) is not None:
        found.append(Speed(*turned, _PROBES))
    return found


class ExperimentDocuments(NamedTuple):
    """What a recording holds of an experiment."""

    name: str
    parameters: dict[str, Any]
    scene: dict[str, Any]
    commands: list[dict[str, Any]]
    """The scene's commands, each with at_s."""
    unsure: dict[str, float]
    """Standard deviation of what the log tells less surely than by a channel of its own, by key, in its unit."""


def build_experiment(
    wanted: ExperimentMapping,
    pulses: Sequence[HammerPulse],
    *,
    duration_s: float,
    motions: Sequence[Motion],
    edges: np.ndarray,
    table: ChannelTable,
    remarks: list[str],
) -> ExperimentDocuments:
    """The scene that a mapping tells, with what was found in the log, as the documents of a recording.

    Args:
        wanted: What the mapping tells.
        pulses: Hammer pulses that were found.
        duration_s: Of the recording [s].
        motions: Channels, in the time of the recording.
        edges: Of the keyphasor [ticks], shape (turns,).
        table: Channel table of the recording.
        remarks: Grows by what was done, and by what of the log is at odds with what is told.

    Raises:
        InputError: The scene cannot be so.
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
        remarks.append("the scene samples at the rig's own rates, as it cannot at the log's")
    remarks.append(f"scene {scene.name}: what was done as the mapping tells it, on assumed parameters until identified")
    hits = [timed for timed in scene.commands if timed.request.command == "hammer"]
    first_s = min((timed.at_s for timed in hits), default=math.inf)
    unsure = dict[str, float]()
    if wanted.commands != "scene":
        hit = impact(motions)
        if hit is not None and all(timed.at_s > hit.at_s + _FORETOLD_S for timed in scene.commands):
            remarks.append(
                f"from {hit.at_s:.3f} s on {', '.join(hit.names)} move as never before, as behind an impact, and no "
                f"command comes by then: what follows is predicted wrongly; [experiment] commands = [{told_as(hit)}]"
            )
            first_s = hit.at_s
        if hits and all(one.name != "hammer" for one in motions):
            unsure |= _BY_EYE
            unsure["hammer.1.duration_ms"] *= hits[0].request.model_dump()["duration_ms"]
    scene, deviation_hz = _driven(scene, wanted, speeds_before(motions, edges, first_s), edges, remarks)
    if deviation_hz:
        unsure["drive.speed_hz"] = deviation_hz
    simulation = Simulation(scene)
    commands = [{"at_s": timed.at_s, **timed.request.model_dump()} for timed in scene.commands]
    return ExperimentDocuments(
        scene.name, simulation.parameters_document(), simulation.scene_document(), commands, unsure
    )


def told_as(hit: Impact) -> str:
    """An impact as a command in TOML, as far as the probes tell it."""
    at_s, force_n, duration_ms, degrees = hit.pulse or (hit.at_s, 100.0, 5.0, 0.0)
    way = f", direction = {round(degrees)}" if abs(degrees) > _ALONG_DEG else ""
    force, length = (
        min(max(value, low), high)
        for value, (low, high) in zip((force_n, duration_ms), HAMMER_BOUNDS.values(), strict=True)
    )
    return f'{{ at_s = {at_s:.5f}, command = "hammer", force_n = {force:.3g}, duration_ms = {length:.3g}{way} }}'


def _driven(
    scene: Scene, wanted: ExperimentMapping, speeds: Sequence[Speed], edges: np.ndarray, remarks: list[str]
) -> tuple[Scene, float]:
    """The scene at the speed that is told, and its standard deviation where the log does not show it [Hz], else 0.

    Raises:
        InputError: It is to be measured, and cannot be.
    """
    from rig.run.scenes import parse_scene

    measured = wanted.speed_hz == "measured"
    if measured and not speeds:
        must = "a number, or measured by a channel `speed`, a keyphasor or probes that turn"
        raise InputError("experiment.speed_hz", must, Words("measured"))
    number = wanted.set.get("drive.speed_hz") if wanted.speed_hz is None else None if measured else wanted.speed_hz
    if measured:
        told = speeds[0]
    elif number is not None:
        told = Speed(float(number), _BY_HAND * abs(float(number)), "the mapping")
    elif wanted.commands == "scene" or scene.drive.profile:
        return scene, 0.0
    else:
        told = Speed(scene.drive.speed_hz, 0.0, f"the scene {scene.name}, as experiment.speed_hz is left out")
    apart = [
        one for one in speeds
        if abs(one.hz - told.hz) > 2.0 * math.hypot(one.deviation_hz, told.deviation_hz, _BY_EDGES * told.hz)
    ]  # fmt: skip
    shown = any(one.by != _PROBES for one in speeds)
    if apart or not (shown or number is not None):
        others = f", but {' and '.join(one.text for one in apart)}" * bool(apart)
        remarks.append(f"speed: {told.text}{others}" + ("" if shown else "; `rig validate` fits it"))
    if wanted.speed_hz is not None:
        data = scene.model_dump()
        scene = parse_scene({**data, "drive": {**data["drive"], "speed_hz": max(0.0, told.hz), "profile": ()}})
    if len(edges) > 2 or (measured and shown):
        return scene, 0.0
    return scene, told.deviation_hz or _UNTOLD * told.hz
