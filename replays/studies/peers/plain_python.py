"""Equations as a user of an ODE library would write them: a plain Python callback for "as installed" rows.

Derived from the paper in Lagrange's form for the two tilts (the kernels have Euler's equations in the rotating frame).
Only friction laws that the state determines: none and smoothed.
"""

from __future__ import annotations

import math

import numpy as np

from replays.studies.peers.common.problem import Problem
from rig.physics.kernels.laws.contact import FLIGHT, NO_FRICTION, SMOOTHED
from rig.physics.kernels.laws.magnet import RADIAL, RIPPLED


class PlainPython:
    """Callbacks of one solve.

    Attributes:
        phase: Contact phase, updated by the caller.
        onset_speed: v0 of the current contact [m/s], updated by the caller.
        evaluations: Number of calls of the right-hand side.
    """

    def __init__(self, problem: Problem) -> None:
        levels = problem.constants.levels
        if not (levels.euler and levels.inner_house and levels.outer_house and levels.compliant):
            raise NotImplementedError("the plain Python callback has the full model only, with a compliant contact")
        if levels.friction not in (NO_FRICTION, SMOOTHED):
            raise NotImplementedError("the plain Python callback has no set-valued or switch friction")
        if problem.constants.magnet.terms == RIPPLED:
            raise NotImplementedError("the plain Python callback has a radial map of the magnets only")
        self.phase = problem.phase
        self.onset_speed = problem.onset_speed
        self.evaluations = 0
        _, self._shaft, self._magnet, self._contact, self._house, self._gain = problem.constants
        self._inputs = problem.inputs
        self._friction = 0.0 if levels.friction == NO_FRICTION else self._contact.friction
        self._begin, self._end = problem.pulse or (0.0, 0.0)

    def rates(self, t: float, state: np.ndarray) -> list[float]:
        """Return the rates of the 14 states at `t` [s] from the window's start."""
        self.evaluations += 1
        shaft, magnet, house, inputs = self._shaft, self._magnet, self._house, self._inputs
        Ixx, Izz, lB, lI = shaft.transverse_inertia, shaft.polar_inertia, shaft.arm_magnet, shaft.arm_disk
        G, b, th, xi, yi, xo, yo, dG, db, dth, vxi, vyi, vxo, vyo = state.tolist()
        sG, cG, sb, cb = math.sin(G), math.cos(G), math.sin(b), math.cos(b)

        # Lateral forces, each times its arm.
        unbalance = shaft.unbalance * dth * dth
        angle = th + shaft.unbalance_phase
        hammer = 0.0
        if self._begin < t < self._end:
            hammer = inputs.hammer_force * math.sin(math.pi * (t - self._begin) / (self._end - self._begin))
        Lx = lI * (unbalance * math.cos(angle) + hammer * inputs.hammer_x)
        Ly = (
            lI * (unbalance * math.sin(angle) + hammer * inputs.hammer_y)
            - shaft.arm_centre * shaft.mass * shaft.gravity
        )
        if inputs.magnet_engaged:
            x, y = lB * sb, -lB * sG * cb
            s = x * x + y * y
            k = magnet.stiffness
            if magnet.terms == RADIAL:
                k *= 1.0 + s * (magnet.a3 + s * (magnet.a5 + s * magnet.a7))
            Lx -= lB * (k * x + magnet.damping_x * lB * cb * db)
            Ly -= lB * (k * y + magnet.damping_y * lB * (sG * sb * db - cG * cb * dG))
        _, Fx, Fy, Ft = self._ring(state)
        Lx += shaft.arm_ring * Fx
        Ly += shaft.arm_ring * Fy
        couple = -shaft.radius * Ft
        torque = 0.0 if inputs.ideal_drive else self._gain * (inputs.speed + inputs.speed_slope * t - dth)

        # Lagrange: only b enters the mass matrix [[m, 0, p], [0, Ixx, 0], [p, 0, Izz]] of (G, b, theta).
        m, p = Ixx * cb * cb + Izz * sb * sb, Izz * sb
        slope_m, slope_p = 2.0 * (Izz - Ixx) * sb * cb, Izz * cb
        Q_G = -cG * cb * Ly + sb * (couple + torque) - db * (slope_m * dG + slope_p * dth)
        Q_b = cb * Lx + sG * sb * Ly + 0.5 * slope_m * dG * dG + slope_p * dG * dth
        Q_t = couple + torque - db * slope_p * dG
        if inputs.ideal_drive:  # the unknown torque T adds sb T to Q_G and T to Q_t
            ddG, ddth = (Q_G - sb * Q_t) / (m - sb * p), inputs.speed_slope
        else:
            determinant = m * Izz - p * p
            ddG, ddth = (Izz * Q_G - p * Q_t) / determinant, (m * Q_t - p * Q_G) / determinant

        ns = _pair(yi - yo, house.pair_stiffness_vertical, house.preload)
        ew = _pair(xo, house.pair_stiffness_horizontal, house.preload)
        beam = house.inner_beam_damping * (vxi - vxo) + house.inner_beam_stiffness * (xi - xo)
        return [
            dG, db, dth, vxi, vyi, vxo, vyo,
            ddG, Q_b / Ixx, ddth,
            (-Fx - beam) / house.inner_mass,
            (-Fy - ns) / house.inner_mass,
            (beam - ew) / house.outer_mass,
            (ns - house.outer_beam_damping * vyo - house.outer_beam_stiffness * yo) / house.outer_mass,
        ]  # fmt: skip

    def switching(self, t: float, state: np.ndarray) -> tuple[float, float]:
        """Return the switching functions, as `right_hand_side.switching`: positive within the phase."""
        penetration = self._ring(state)[0]
        return (-penetration if self.phase == FLIGHT else penetration), 1.0

    def _ring(self, state: np.ndarray) -> tuple[float, float, float, float]:
        """Return penetration [m], force on the shaft x, y and friction force [N]."""
        contact, arm = self._contact, self._shaft.arm_ring
        G, b, _, xi, yi, xo, yo, dG, db, dth, vxi, vyi, vxo, vyo = state.tolist()
        sG, cG, sb, cb = math.sin(G), math.cos(G), math.sin(b), math.cos(b)
        both = contact.gap_counts_outer
        ex = arm * sb - xi - both * xo - contact.offset_x
        ey = -arm * sG * cb - yi - both * yo - contact.offset_y
        r = math.hypot(ex, ey)
        penetration = r - contact.clearance
        if self.phase == FLIGHT or penetration <= 0.0:
            return penetration, 0.0, 0.0, 0.0
        vx = arm * cb * db - vxi - both * vxo
        vy = arm * (sG * sb * db - cG * cb * dG) - vyi - both * vyo
        nx, ny = ex / r, ey / r
        elastic = contact.stiffness * penetration**contact.exponent
        damping = elastic * contact.damping_factor / self.onset_speed + contact.viscous_damping
        Fn = max(0.0, elastic + damping * (vx * nx + vy * ny))
        sliding = vy * nx - vx * ny + self._shaft.radius * (dth + dG * sb)
        Ft = self._friction * Fn * math.tanh(sliding / contact.smoothing_speed)
        return penetration, -Fn * nx + Ft * ny, -Fn * ny - Ft * nx, Ft


def _pair(displacement: float, stiffness: float, preload: float) -> float:
    """Return the restoring force of an opposed pair of pre-compressed transducers [N]."""
    change = 0.5 * stiffness * displacement
    return max(preload + change, 0.0) - max(preload - change, 0.0)
