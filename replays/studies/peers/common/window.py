"""Window of a scene from its start, as a problem for our engines and other authors' solvers."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.right_hand_side import contact_at, pack
from rig.base.errors import InputError
from rig.physics.kernels.constants import Inputs
from rig.physics.kernels.laws.contact import BACKWARD, FLIGHT, FORWARD, TOUCHING
from rig.physics.kernels.signals import N_STATE
from rig.physics.levels import FRICTION_LAWS
from rig.physics.model import build_model
from rig.run.commands.table import HammerCommand, ReleaseCommand, SpeedCommand
from rig.run.motion import initial_state
from rig.run.scenes import Scene

TICK_S = 1e-6
"""Length of a tick [s]."""


def cut_window(
    scene: Scene,
    *,
    end_s: float | None = None,
    sample_s: float = 1e-4,
    friction: Literal["none", "smoothed", "exact"] | None = None,
    **contact: float,
) -> Problem:
    """Return a window of a scene as a problem.

    Commands take effect at the nearest tick. (A simulation moves them to the next observed row, which is the same for
    multiples of 25 µs.)

    Args:
        scene: Scene.
        end_s: End of the window [s]; None for the scene's end.
        sample_s: Interval of the required states [s]; the end is added.
        friction: Friction law; None for the scene's.
        contact: Changed contact constants by field, such as `smoothing_speed`; a `damping_factor` of 0 excludes the
            damping term with its memory of the impact speed.

    Raises:
        InputError: The window is empty, or drive, magnets or a second pulse change within it.
    """
    model = build_model(scene.load_parameters(), scene.model)
    constants = model.constants._replace(contact=model.constants.contact._replace(**contact))
    if friction is not None:
        constants = constants._replace(levels=constants.levels._replace(friction=FRICTION_LAWS[friction]))
    end_s = scene.duration_s if end_s is None else end_s
    end_tick = round(end_s / TICK_S)
    inputs, until = _inputs(scene)
    if not 0 < end_tick <= until:
        raise InputError(
            "end_s", f"above 0 and at most {until * TICK_S:g} s, where the scene changes its inputs", end_s
        )
    ticks = np.append(np.arange(0, end_tick, max(1, round(sample_s / TICK_S))), end_tick)
    problem = Problem(
        name=scene.name,
        constants=constants,
        inputs=inputs,
        y0=initial_state(model, scene.initial, None, spin=inputs.speed)[:N_STATE],
        phase=FLIGHT,
        onset_speed=constants.contact.speed_floor,
        times=ticks * TICK_S,
    )
    return replace(problem, phase=_phase(problem))


def _phase(problem: Problem) -> int:
    """Return the contact phase of the initial state; rolling counts as sliding."""
    penetration, _, sliding, _, _ = contact_at(0.0, problem.y0, pack(problem)[0], FLIGHT)
    if penetration <= 0.0:
        return FLIGHT
    if not problem.exact_friction:
        return TOUCHING
    return FORWARD if sliding > 0.0 else BACKWARD


def _inputs(scene: Scene) -> tuple[Inputs, int]:
    """Return the inputs at the start, with the first pulse, and the tick at which they change."""
    timed = sorted(((round(one.at_s / TICK_S), one.request) for one in scene.commands), key=lambda pair: pair[0])
    drive = scene.drive
    points = [(round(time / TICK_S), 2.0 * math.pi * hz) for time, hz in (drive.profile or ((0.0, drive.speed_hz),))]
    (first, speed), *later = points
    pulses = [(at, command) for at, command in timed if isinstance(command, HammerCommand)]
    force, (dx, dy), begin, end = 0.0, (1.0, 0.0), 0, 0
    for begin, command in pulses[:1]:
        force, (dx, dy) = float(command.force_n), command.cosines
        end = begin + max(1, round(command.duration_ms * 1e-3 / TICK_S))
    released = [at for at, command in timed if isinstance(command, ReleaseCommand)]
    changes = [at for at, _ in (*later, *pulses[1:])] + [at for at in released if at > 0]
    changes += [at for at, command in timed if isinstance(command, SpeedCommand)]
    inputs = Inputs(
        tick_s=TICK_S,
        hammer_force=force,
        hammer_x=dx,
        hammer_y=dy,
        hammer_start=begin,
        hammer_end=end,
        speed=speed,
        speed_slope=(later[0][1] - speed) / ((later[0][0] - first) * TICK_S) if later else 0.0,
        speed_tick=first,
        ideal_drive=drive.mode == "ideal",
        magnet_engaged=scene.initial.magnets and 0 not in released,
    )
    return inputs, min(changes, default=2**62)
