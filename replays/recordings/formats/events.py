"""What happened in an imported log: hammer pulses found in it, and the experiment that a mapping tells of."""

from __future__ import annotations

import math
from collections.abc import Mapping as Mapped
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rig.channels import ChannelTable, default_table
from rig.errors import InputError, Words

if TYPE_CHECKING:
    from replays.recordings.formats.clock import Axis
    from replays.recordings.formats.group import PlacedGroup
    from replays.recordings.formats.mapping import ExperimentMapping, HammerMapping

_FOOT = 0.05
"""A pulse is summed out to this part of its peak on either side."""


@dataclass(frozen=True)
class HammerPulse:
    """A hammer pulse as the half sine of the same peak and impulse, centred where it is: how a scene tells it.

    Attributes:
        at_s: Start [s].
        force_n: Peak [N].
        duration_ms: Length, pi/2 times impulse over peak [ms].
        direction: As in a scene.
    """

    at_s: float
    force_n: float
    duration_ms: float
    direction: str | float

    def command(self) -> dict[str, Any]:
        """As a scene's command."""
        return {
            "at_s": self.at_s, "command": "hammer", "force_n": self.force_n, "duration_ms": self.duration_ms,
            "direction": self.direction,
        }  # fmt: skip


def find_pulses(force_n: np.ndarray, axis: Axis, wanted: HammerMapping) -> list[HammerPulse]:
    """Hammer pulses in a force: stretches above the threshold, at least the dead time apart.

    Args:
        force_n: Force of the hammer [N], shape (n,).
        axis: Its time axis.
        wanted: Threshold, dead time, direction.
    """
    times_s = axis.instants()
    force = np.nan_to_num(force_n)
    above = force >= wanted.threshold_n
    starts = np.flatnonzero(above & ~np.concatenate([[False], above[:-1]]))
    found: list[HammerPulse] = []
    free_s = -math.inf
    for start in starts.tolist():
        if times_s[start] < free_s:
            continue
        free_s = float(times_s[start]) + wanted.dead_s
        end = start
        while end < len(force) and force[end] >= wanted.threshold_n:
            end += 1
        foot = _FOOT * float(force[start:end].max())
        low, high = start, end
        while low > 0 and force[low - 1] > foot:
            low -= 1
        while high < len(force) and force[high] > foot:
            high += 1
        pulse, when = force[low:high], times_s[low:high]
        peak, impulse = float(pulse.max()), float(pulse.sum()) / axis.rate_hz
        duration = 0.5 * math.pi * impulse / peak
        centre = float(pulse @ when) / float(pulse.sum())
        start_s = centre - 0.5 * duration - wanted.delay_us * 1e-6
        found.append(HammerPulse(start_s, peak, duration * 1e3, wanted.direction))
    return found


def speed_before(
    groups: Mapped[str, PlacedGroup], edges: np.ndarray, pulses: Sequence[HammerPulse], *, zero_s: float
) -> float | None:
    """Mean speed before the first hammer pulse, else of the whole [Hz]: of the channel `speed`, else of the edges."""
    drive = next((group for group in groups.values() if "speed" in group.channels), None)
    until_s = pulses[0].at_s if pulses else math.inf
    if drive is not None:
        values = drive.channels["speed"].values[
            : max(1, round((min(until_s, 1e6) + zero_s - drive.start_s) * drive.rate_hz))
        ]
        return float(np.nanmean(values))
    times = edges[edges < until_s * 1e6]
    times = times if len(times) > 1 else edges
    return (len(times) - 1) * 1e6 / float(times[-1] - times[0]) if len(times) > 1 else None


class ExperimentDocuments(NamedTuple):
    """What a recording holds of an experiment."""

    name: str
    parameters: dict[str, Any]
    scene: dict[str, Any]
    commands: list[dict[str, Any]]
    """The scene's commands, each with at_s."""


def build_experiment(
    wanted: ExperimentMapping,
    pulses: Sequence[HammerPulse],
    *,
    duration_s: float,
    speed_hz: float | None,
    table: ChannelTable,
    remarks: list[str],
) -> ExperimentDocuments:
    """The scene that a mapping tells, with what was found in the log, as the documents of a recording.

    Raises:
        InputError: The scene cannot be so.
    """
    from rig.scenes import load_scene, parse_scene
    from rig.simulation import Simulation

    scene = load_scene(wanted.scene, dict(wanted.set))
    data = scene.model_dump()
    if wanted.speed_hz is not None:
        speed = speed_hz if wanted.speed_hz == "measured" else wanted.speed_hz
        if speed is None:
            raise InputError(
                "experiment.speed_hz", "a number, or measured by a channel `speed` or a keyphasor", Words("measured")
            )
        data["drive"] = {**data["drive"], "speed_hz": max(0.0, speed), "profile": ()}
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
    simulation = Simulation(scene)
    commands = [{"at_s": timed.at_s, **timed.request.model_dump()} for timed in scene.commands]
    return ExperimentDocuments(scene.name, simulation.parameters_document(), simulation.scene_document(), commands)
