"""A window cut out of a scene, as a problem for our engines and other people's solvers."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Literal

import numpy as np

from replays.studies.peers import scipy_solvers
from replays.studies.peers.problem import Problem
from replays.studies.peers.right_hand_side import contact_at, pack
from replays.studies.peers.solution import Setting
from rig.commands import HammerCommand, ReleaseCommand, SpeedCommand
from rig.errors import InputError
from rig.kernels.constants import Constants, Inputs
from rig.kernels.contact import BACKWARD, FLIGHT, FORWARD, TOUCHING
from rig.kernels.signals import N_STATE
from rig.levels import FRICTION_LAWS
from rig.model import Model, build_model
from rig.motion import initial_state
from rig.scenes import Scene

TICK_S = 1e-6
"""Length of a tick [s]."""
_BEFORE = Setting("1e-9", 1e-9)
"""How DOP853 solves what lies before the window."""


def cut_window(
    scene: Scene,
    *,
    start_s: float = 0.0,
    end_s: float | None = None,
    sample_s: float = 1e-4,
    friction: Literal["none", "smoothed", "exact"] | None = None,
    smoothing_speed: float | None = None,
    memory: bool = True,
) -> Problem:
    """Cut a window out of a scene.

    Commands take effect at the tick nearest to their time. (A simulation moves them up to the next observed row, which
    is the same for times of a whole 25 µs.) What lies before the window is integrated by DOP853 with events, at a
    tolerance of 1e-9, under the same contact law.

    Args:
        scene: The scene.
        start_s: Start of the window [s].
        end_s: Its end [s]; None for the scene's end.
        sample_s: States are wanted this often [s], and at the end.
        friction: Friction law instead of the scene's.
        smoothing_speed: v_s of the smoothed law instead of the scene's [m/s].
        memory: False takes the damping term with its impact speed out of the contact law.

    Raises:
        InputError: The window is empty, or drive, magnets or a second pulse change inside it.
    """
    model = build_model(scene.load_parameters(), scene.model)
    constants = _under_law(model.constants, friction, smoothing_speed, memory)
    end_s = scene.duration_s if end_s is None else end_s
    start_tick, end_tick = round(start_s / TICK_S), round(end_s / TICK_S)
    if not 0 <= start_tick < end_tick:
        raise InputError("end_s", f"above start_s = {start_s:g} s, which is 0 or more", end_s)
    until = _inputs(scene, model, start_tick)[1]
    if end_tick > until:
        raise InputError("end_s", f"at most {until * TICK_S:g} s, where the scene changes its inputs", end_s)

    def piece(first: int, end: int, every_s: float) -> Problem:
        stride = max(1, round(every_s / TICK_S))
        ticks = np.unique(np.append(np.arange(0, end - first, stride), end - first))
        return Problem(
            name=scene.name,
            constants=constants,
            inputs=_inputs(scene, model, first)[0],
            start_tick=first,
            y0=np.array(state, dtype=float),
            phase=phase,
            onset_speed=onset_speed,
            times=ticks * TICK_S,
        )

    # Every piece of constant inputs up to the window is solved in turn.
    state = initial_state(model, scene.initial, None, spin=_inputs(scene, model, 0)[0].speed)[:N_STATE]
    phase, onset_speed, now = FLIGHT, constants.contact.speed_floor, 0
    phase = _phase(piece(0, end_tick, sample_s))
    while now < start_tick:
        end = min(start_tick, _inputs(scene, model, now)[1])
        with np.errstate(all="ignore"):  # trial steps that overflow are the solver's own affair
            solution = scipy_solvers.solve(piece(now, end, 1.0), setting=_BEFORE, budget_s=600.0, method="DOP853")
        if solution.failure is not None:
            raise InputError("start_s", "an instant that DOP853 reaches", solution.failure)
        now, state, phase, onset_speed = end, solution.states[-1], solution.phase, solution.onset_speed
    return piece(start_tick, end_tick, sample_s)


def _under_law(constants: Constants, friction: str | None, smoothing_speed: float | None, memory: bool) -> Constants:
    """The model under another contact law; None keeps what it has."""
    contact, levels = constants.contact, constants.levels
    if friction is not None:
        levels = levels._replace(friction=FRICTION_LAWS[friction])
    if smoothing_speed is not None:
        contact = contact._replace(smoothing_speed=smoothing_speed)
    if not memory:
        contact = contact._replace(damping_factor=0.0)
    return constants._replace(contact=contact, levels=levels)


def _phase(problem: Problem) -> int:
    """Phase of the contact that the state at the start alone tells; one that rolls is taken for one that slides."""
    penetration, _, sliding, _, _ = contact_at(0.0, problem.y0, pack(problem)[0], FLIGHT)
    if penetration <= 0.0:
        return FLIGHT
    if not problem.exact_friction:
        return TOUCHING
    return FORWARD if sliding > 0.0 else BACKWARD


def _inputs(scene: Scene, model: Model, tick: int) -> tuple[Inputs, int]:
    """Inputs in force from a tick on, and the tick at which they change.

    Raises:
        InputError: A command of speed lies before that tick: where a ramp then begins depends on the run before it.
    """
    timed = sorted(((round(one.at_s / TICK_S), one.request) for one in scene.commands), key=lambda pair: pair[0])
    drive = scene.drive
    points = [(round(time / TICK_S), 2.0 * math.pi * hz) for time, hz in (drive.profile or ((0.0, drive.speed_hz),))]
    segments = [(t0, w0, (w1 - w0) / ((t1 - t0) * TICK_S)) for (t0, w0), (t1, w1) in pairwise(points)]
    segments.append((*points[-1], 0.0))
    pulses = [(at, command) for at, command in timed if isinstance(command, HammerCommand)]
    if any(isinstance(command, SpeedCommand) and at <= tick for at, command in timed):
        raise InputError("start_s", "before the scene's first command of speed", tick * TICK_S)

    begun = [pulse for pulse in pulses if pulse[0] <= tick] or pulses[:1]
    force, (dx, dy), begin, end = 0.0, (1.0, 0.0), 0, 0
    if begun:
        begin, command = begun[-1]
        force, (dx, dy) = float(command.force_n), command.cosines
        end = begin + max(1, round(command.duration_ms * 1e-3 / TICK_S))
    changes = [at for at, _, _ in segments]
    changes += [at for at, command in timed if isinstance(command, ReleaseCommand | SpeedCommand)]
    changes += [at for at, _ in pulses if at != begin]
    segment = max(one for one in segments if one[0] <= tick)
    inputs = Inputs(
        tick_s=TICK_S,
        hammer_force=force,
        hammer_x=dx,
        hammer_y=dy,
        hammer_start=begin,
        hammer_end=end,
        speed=segment[1],
        speed_slope=segment[2],
        speed_tick=segment[0],
        ideal_drive=drive.mode == "ideal",
        magnet_engaged=scene.initial.magnets
        and not any(isinstance(command, ReleaseCommand) and at <= tick for at, command in timed),
    )
    return inputs, min((at for at in changes if at > tick), default=2**62)
