"""A problem that our engines and other people's solvers are both given: one window of a scene, and nothing else.

It holds the kernels' own numbers (`Constants`, `Inputs`), so that there is one model and only the method differs. Time
runs from 0 at the window's start; `start_tick` is that instant in the scene's ticks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from rig.commands import HammerCommand, ReleaseCommand, SpeedCommand
from rig.errors import InputError
from rig.kernels.constants import Constants, Inputs
from rig.kernels.contact import BACKWARD, EXACT, FLIGHT, FORWARD, TOUCHING
from rig.kernels.signals import N_STATE, STATE_SCALE
from rig.levels import FRICTION_LAWS
from rig.model import Model, build_model
from rig.scenes import Scene

TICK_S = 1e-6
"""Length of a tick [s]."""
ERROR_COLUMNS = (0, 1, 3, 4, 7, 8, 9)
"""States that an error is made of: both tilts, the inner house, the rates of the tilts and the spin."""
ERROR_SCALE = STATE_SCALE[list(ERROR_COLUMNS)]
"""Their scales [rad, rad, m, m, rad/s, rad/s, rad/s]."""


@dataclass(frozen=True)
class Problem:
    """One window of a scene.

    Attributes:
        name: Name of the scene.
        constants: The model; `levels.friction` is the friction law, `contact.damping_factor` 0 leaves the memory out.
        inputs: Hammer, drive and magnets, the same over the whole window.
        start_tick: Where the window begins, in the scene's ticks.
        y0: State at the start, shape (14,).
        phase: Phase of the contact at the start (`rig.kernels.contact`).
        onset_speed: v0 of a contact that is running at the start [m/s].
        times: Instants at which states are wanted, from the window's start [s], ascending from 0, shape (n,); the last
            is the window's end.
    """

    name: str
    constants: Constants
    inputs: Inputs
    start_tick: int
    y0: np.ndarray
    phase: int
    onset_speed: float
    times: np.ndarray

    @property
    def duration_s(self) -> float:
        """Length of the window [s]."""
        return float(self.times[-1])

    @property
    def exact_friction(self) -> bool:
        """Coulomb's set-valued law; else a law that the state alone decides."""
        return self.constants.levels.friction == EXACT

    @property
    def pulse(self) -> tuple[float, float] | None:
        """Start and end of the hammer's pulse, from the window's start [s], where any of it lies inside the window."""
        inputs = self.inputs
        begin = (inputs.hammer_start - self.start_tick) * inputs.tick_s
        end = (inputs.hammer_end - self.start_tick) * inputs.tick_s
        if inputs.hammer_force == 0.0 or end <= max(begin, 0.0) or begin >= self.duration_s:
            return None
        return begin, end

    @property
    def corners(self) -> tuple[float, ...]:
        """Instants inside the window where the hammer's force has a corner [s]."""
        return tuple(t for t in self.pulse or () if 0.0 < t < self.duration_s)

    def with_law(
        self,
        *,
        friction: Literal["none", "smoothed", "exact"] | None = None,
        smoothing_speed: float | None = None,
        memory: bool | None = None,
    ) -> Problem:
        """The same window under another contact law.

        Args:
            friction: Friction law; None keeps it.
            smoothing_speed: v_s of the smoothed law [m/s]; None keeps it.
            memory: False takes the damping term with its impact speed out (c = 0); None or True keep the law.
        """
        constants = self.constants
        contact, levels = constants.contact, constants.levels
        if friction is not None:
            levels = levels._replace(friction=FRICTION_LAWS[friction])
        if smoothing_speed is not None:
            contact = contact._replace(smoothing_speed=smoothing_speed)
        if memory is False:
            contact = contact._replace(damping_factor=0.0)
        changed = replace(self, constants=constants._replace(contact=contact, levels=levels))
        keeps = self.phase == FLIGHT or changed.exact_friction == self.exact_friction
        return changed if keeps else replace(changed, phase=_phase(changed))

    @classmethod
    def from_scene(
        cls,
        scene: Scene,
        *,
        start_s: float = 0.0,
        end_s: float | None = None,
        sample_s: float = 1e-4,
        state: np.ndarray | None = None,
        phase: int | None = None,
        onset_speed: float | None = None,
        friction: Literal["none", "smoothed", "exact"] | None = None,
        smoothing_speed: float | None = None,
        memory: bool = True,
    ) -> Problem:
        """Cut a window out of a scene.

        Commands take effect at the tick nearest to their time. (A simulation moves them up to the next observed row,
        which is the same for times of a whole 25 us.)

        Args:
            scene: The scene.
            start_s: Start of the window [s].
            end_s: Its end [s]; None for the scene's end.
            sample_s: States are wanted this often [s], and at the end.
            state: State at the start, shape (14,) or longer (the rest is ignored). None for the scene's initial state
                at time zero; later than that it is integrated up to there (DOP853 with events, tolerance 1e-9) under
                the same contact law.
            phase: Phase of the contact at the start; None to take it from the state.
            onset_speed: v0 of a contact that is running at the start [m/s]; None for the floor.
            friction: Friction law instead of the scene's.
            smoothing_speed: v_s of the smoothed law instead of the scene's [m/s].
            memory: False takes the damping term with its impact speed out of the contact law.

        Raises:
            InputError: The window is empty, or drive, magnets or a second blow change inside it.
        """
        model = build_model(scene.load_parameters(), scene.model)
        end_s = scene.duration_s if end_s is None else end_s
        start_tick, end_tick = round(start_s / TICK_S), round(end_s / TICK_S)
        if not 0 <= start_tick < end_tick:
            raise InputError("end_s", f"above start_s = {start_s:g} s, which is 0 or more", end_s)
        inputs, until = _inputs(scene, model, start_tick)
        if end_tick > until:
            raise InputError("end_s", f"at most {until * TICK_S:g} s, where the scene changes its inputs", end_s)
        if state is None and start_tick > 0:
            state, phase, onset_speed = _state_later(
                scene, model, start_tick, friction=friction, smoothing_speed=smoothing_speed, memory=memory
            )
        elif state is None:
            state = _first_state(scene, model, inputs.speed)
        y0 = np.array(state[:N_STATE], dtype=float)
        stride = max(1, round(sample_s / TICK_S))
        ticks = np.unique(np.append(np.arange(0, end_tick - start_tick, stride), end_tick - start_tick))
        problem = cls(
            name=scene.name,
            constants=model.constants,
            inputs=inputs,
            start_tick=start_tick,
            y0=y0,
            phase=FLIGHT if phase is None else phase,
            onset_speed=model.constants.contact.speed_floor if onset_speed is None else onset_speed,
            times=ticks * TICK_S,
        )
        problem = problem.with_law(friction=friction, smoothing_speed=smoothing_speed, memory=memory)
        return problem if phase is not None else replace(problem, phase=_phase(problem))


def scaled_error(states: np.ndarray, reference: np.ndarray) -> float:
    """Distance of two runs of one problem: RMS over all instants of the scaled states of `ERROR_COLUMNS`.

    Args:
        states: Shape (n, 14).
        reference: Shape (n, 14).
    """
    columns = list(ERROR_COLUMNS)
    distance = (states[:, columns] - reference[:, columns]) / ERROR_SCALE
    return float(np.sqrt(np.mean(distance * distance)))


def _phase(problem: Problem) -> int:
    """Phase of the contact that the state at the start alone tells; one that rolls is taken for one that slides."""
    from replays.studies.peers.right_hand_side import contact_at, pack

    penetration, _, sliding, _, _ = contact_at(0.0, problem.y0, pack(problem)[0], FLIGHT)
    if penetration <= 0.0:
        return FLIGHT
    if not problem.exact_friction:
        return TOUCHING
    return FORWARD if sliding > 0.0 else BACKWARD


def _first_state(scene: Scene, model: Model, spin: float) -> np.ndarray:
    """The scene's state at time zero, shape (14,)."""
    initial, clearance = scene.initial, model.constants.contact.clearance
    # A hair inside the clearance, so that rounding does not make it a contact.
    inside = clearance * (1.0 - 1e-12)
    places: dict[str, tuple[float | None, float | None]] = {
        "equilibrium": (None, None),
        "top": (0.0, inside),
        "bottom": (0.0, -inside),
        "given": (initial.x_mm * 1e-3, initial.y_mm * 1e-3),
    }
    x, y = places[initial.position]
    return model.state(ring_x=x, ring_y=y, spin=spin)[:N_STATE]


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
    blows = [(at, command) for at, command in timed if isinstance(command, HammerCommand)]
    if any(isinstance(command, SpeedCommand) and at <= tick for at, command in timed):
        raise InputError("start_s", "before the scene's first command of speed", tick * TICK_S)

    begun = [blow for blow in blows if blow[0] <= tick] or blows[:1]
    force, (dx, dy), begin, end = 0.0, (1.0, 0.0), 0, 0
    if begun:
        begin, command = begun[-1]
        force, (dx, dy) = float(command.force_n), command.cosines
        end = begin + max(1, round(command.duration_ms * 1e-3 / TICK_S))
    changes = [at for at, _, _ in segments]
    changes += [at for at, command in timed if isinstance(command, ReleaseCommand | SpeedCommand)]
    changes += [at for at, _ in blows if at != begin]
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


def _state_later(
    scene: Scene,
    model: Model,
    tick: int,
    *,
    friction: Literal["none", "smoothed", "exact"] | None,
    smoothing_speed: float | None,
    memory: bool,
) -> tuple[np.ndarray, int, float]:
    """State, phase and v0 at a later tick: every piece of constant inputs up to there is solved in turn."""
    from replays.studies.peers import PEERS, Setting

    now, state, phase, onset_speed = 0, None, None, None
    while now < tick:
        end = min(tick, _inputs(scene, model, now)[1])
        piece = Problem.from_scene(
            scene, start_s=now * TICK_S, end_s=end * TICK_S, sample_s=1.0, state=state, phase=phase,
            onset_speed=onset_speed, friction=friction, smoothing_speed=smoothing_speed, memory=memory,
        )  # fmt: skip
        solution = PEERS["scipy-dop853"].solve(piece, Setting("1e-9", 1e-9), budget_s=600.0)
        if solution.failure is not None:
            raise InputError("start_s", "an instant that DOP853 reaches", solution.failure)
        now, state, phase, onset_speed = end, solution.states[-1], solution.phase, solution.onset_speed
    if state is None or phase is None or onset_speed is None:
        raise InputError("start_s", "after the scene's start", tick * TICK_S)
    return state, phase, onset_speed
