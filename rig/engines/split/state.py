"""The state of a step of `rig.engines.split`, by name."""

from __future__ import annotations

from typing import NamedTuple

from rig.engines.split.inner_motion import Plant
from rig.engines.split.kick import Kick


class Call(NamedTuple):
    """What stays through a call."""

    plant: Plant
    part_ticks: float  # shortest step [ticks]
    half_s: float  # half of it [s]
    per_s: float  # one over it [1/s]


class Step(NamedTuple):
    """One step."""

    level: int
    parts: int  # length in shortest steps
    h: float  # length [s]
    per_h: float  # [1/s]
    begin: float  # tick at its start
    end: int  # its end, in shortest steps from the row on
    owed: int  # level of the half flow that the last kick still owes, -1 for none


class Touch(NamedTuple):
    """The contact as the last kick left it."""

    phase: int
    slid: float  # sliding speed after it, nan before the first of a contact [m/s]
    wanted: int  # level asked for in contact; NONE: it is no longer one for kicks
    factor: float  # damping factor over the onset speed [s/m]


class Coordinates(NamedTuple):
    """Those of the steps at hand, from the motion's own."""

    kicked: int  # level of the last kick, -1 before the first
    conjugate: float  # h^2/24 [s^2]
    kick: Kick  # the last


class Direction(NamedTuple):
    """Of the unbalance; it is turned step by step."""

    cosine: float
    sine: float
    angle: float  # spin angle that it is for [rad]


class Smooth(NamedTuple):
    """Smooth forces of a kick: arm times force [N m], accelerations [1/s^2]."""

    Sx: float  # all but the contact
    Sy: float
    ax: float  # what that makes of the axis beyond the flow, without its turning
    ay: float
    turning_x: float  # the turning
    turning_y: float
    pull_x: float  # unbalance
    pull_y: float
    rotation: float  # theta' [rad/s]


class Work(NamedTuple):
    """Integrals since the last row that are booked kick by kick."""

    drive: float  # [J]
    unbalance: float
    bearing: float
    turn_x: float  # torques [N m s]
    turn_y: float
    turn_z: float
