"""MuJoCo, a general physics engine, with the closest model that it can represent. Its error is a model error.

Represented exactly: the rigid shaft on its pivot (three hinges: Gamma, beta, theta), the two housings on springs and
dampers (slides), gravity without the housings' weights. Magnets, unbalance, hammer and drive are generalised forces,
set from Python once per step.

Not represented:
- a round ring: MuJoCo has no hollow cylinder. The ring is a polygon of flat boxes, the shaft a sphere in its plane;
- the normal law K delta^1.5 (1 + c delta'/v0): MuJoCo's contact is a linear spring and damper in units of acceleration.
They are set to the contact time and the restitution of the rig's law in an impact at 0.2 m/s;
- Coulomb's friction as a set-valued law: MuJoCo's friction cone is regularised, and a contact may creep;
- loss of a transducer's preload (a slide's spring is linear);
- forces that change within a step: half-sine and magnets are constant over it. First order in the step.
"""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import numpy as np

from replays.studies.peers.common.problem import Problem
from replays.studies.peers.common.solution import Setting, Solution
from rig.physics.kernels.frames.geometry import gap
from rig.physics.kernels.laws.contact import FLIGHT, NO_FRICTION
from rig.physics.kernels.laws.magnet import magnet_force

FACETS = 180
_IMPACT_SPEED = 0.2
_WALL = 0.005
"""Thickness of the polygon's boxes [m]."""


def solve(problem: Problem, *, setting: Setting, budget_s: float) -> Solution:
    """Run the problem with a fixed step; the setting's tolerance is that step [s]."""
    mujoco: Any = import_module("mujoco")
    levels = problem.constants.levels
    if not (levels.euler and levels.inner_house and levels.outer_house and levels.compliant):
        raise NotImplementedError("the MuJoCo model is the full one only, with a compliant contact")
    if problem.inputs.ideal_drive or problem.constants.contact.gap_counts_outer != 0.0:
        raise NotImplementedError("the MuJoCo model has neither the ideal drive nor a gap that counts the outer house")
    model: Any = mujoco.MjModel.from_xml_string(_document(problem, setting.tolerance))
    data: Any = mujoco.MjData(model)
    _set(data, problem.y0)
    magnet_force(0.0, 0.0, problem.constants.magnet)  # compiled before the clock starts
    solution = Solution(problem.times, budget_s)
    solution.states[0] = now = problem.y0.copy()
    reached, touching = 1, problem.phase != FLIGHT
    steps = math.ceil(problem.duration_s / setting.tolerance - 1e-9)
    complaints: list[str] = []
    usual = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(complaints.append)  # the default writes to a file in the working folder
    try:
        for step in range(steps):
            t = step * setting.tolerance
            data.qfrc_applied[:3] = _applied(problem, t, now)
            mujoco.mj_step(model, data)
            solution.steps += 1
            if complaints:
                solution.failure = complaints[0].strip()
            if solution.failure or (step % 64 == 0 and solution.overrun()):
                break
            before, now = now, _state(data)
            end = t + setting.tolerance
            while reached < len(problem.times) and (problem.times[reached] <= end or step == steps - 1):
                share = (problem.times[reached] - t) / setting.tolerance
                solution.states[reached] = before + share * (now - before)
                reached += 1
            if (data.ncon > 0) != touching:
                touching = not touching
                solution.switches += 1
                if touching:
                    solution.onsets.append((end, float(gap(problem.constants, before)[1])))
    finally:
        mujoco.set_mju_user_warning(usual)
    solution.evaluations = solution.steps
    return solution.close()


def _state(data: Any) -> np.ndarray:
    """Return the 14 states; the inner housing's slides are relative to the outer housing."""
    q, v = data.qpos, data.qvel
    return np.array(
        [
            q[0], q[1], q[2], q[5] + q[3], q[6] + q[4], q[3], q[4],
            v[0], v[1], v[2], v[5] + v[3], v[6] + v[4], v[3], v[4],
        ]
    )  # fmt: skip


def _set(data: Any, y: np.ndarray) -> None:
    for target, part in ((data.qpos, y[:7]), (data.qvel, y[7:])):
        target[:] = [part[0], part[1], part[2], part[5], part[6], part[3] - part[5], part[4] - part[6]]


def _applied(problem: Problem, t: float, y: np.ndarray) -> tuple[float, float, float]:
    """Return the generalised forces on Gamma, beta, theta [N m] that MuJoCo does not model."""
    shaft, magnet, inputs = problem.constants.shaft, problem.constants.magnet, problem.inputs
    sG, cG, sb, cb = math.sin(y[0]), math.cos(y[0]), math.sin(y[1]), math.cos(y[1])
    unbalance = shaft.unbalance * y[9] * y[9]
    angle = y[2] + shaft.unbalance_phase
    hammer = 0.0
    pulse = problem.pulse
    if pulse is not None and pulse[0] <= t < pulse[1]:
        hammer = inputs.hammer_force * math.sin(math.pi * (t - pulse[0]) / (pulse[1] - pulse[0]))
    Lx = shaft.arm_disk * (unbalance * math.cos(angle) + hammer * inputs.hammer_x)
    Ly = shaft.arm_disk * (unbalance * math.sin(angle) + hammer * inputs.hammer_y)
    if inputs.magnet_engaged:
        lB = shaft.arm_magnet
        Fx, Fy, _ = magnet_force(lB * sb, -lB * sG * cb, magnet)
        Lx += lB * (Fx - magnet.damping_x * lB * cb * y[8])
        Ly += lB * (Fy - magnet.damping_y * lB * (sG * sb * y[8] - cG * cb * y[7]))
    torque = problem.constants.torque_gain * (inputs.speed + inputs.speed_slope * t - y[9])
    return -cG * cb * Ly + sb * torque, cb * Lx + sG * sb * Ly, torque


def _document(problem: Problem, step: float) -> str:
    """Return the model in MuJoCo's XML."""
    levels, shaft, _, contact, house, _ = problem.constants
    friction = 0.0 if levels.friction == NO_FRICTION else contact.friction
    stiffness, damping = _contact(problem)
    across = shaft.transverse_inertia - shaft.mass * shaft.arm_centre**2
    inner_radius = shaft.radius + contact.clearance
    half_width = inner_radius * math.tan(math.pi / FACETS)
    place = inner_radius + _WALL
    boxes = "".join(
        f'<geom type="box" size="{_WALL} {half_width} 0.01" axisangle="0 0 1 {angle}" conaffinity="1" contype="0" '
        f'pos="{contact.offset_x + place * math.cos(angle)} {contact.offset_y + place * math.sin(angle)} 0"/>'
        for angle in 2.0 * math.pi * np.arange(FACETS) / FACETS
    )
    return f"""
    <mujoco>
      <compiler angle="radian" autolimits="true"/>
      <option><flag autoreset="disable"/></option>
      <option timestep="{step}" gravity="0 {-shaft.gravity} 0" integrator="implicitfast" cone="elliptic" impratio="10"
              tolerance="1e-12"/>
      <default><geom friction="{friction} 0 0" condim="3" solref="{-stiffness} {-damping}"
                     solimp="0.9999 0.9999 0.001" mass="0"/></default>
      <worldbody>
        <body>
          <inertial pos="0 0 {shaft.arm_centre}" mass="{shaft.mass}"
                    diaginertia="{across} {across} {shaft.polar_inertia}"/>
          <joint type="hinge" axis="1 0 0"/>
          <joint type="hinge" axis="0 1 0"/>
          <joint type="hinge" axis="0 0 1"/>
          <geom type="sphere" size="{shaft.radius}" pos="0 0 {shaft.arm_ring}" contype="1" conaffinity="0"/>
        </body>
        <body pos="0 0 {shaft.arm_ring}" gravcomp="1">
          <inertial pos="0 0 0" mass="{house.outer_mass}" diaginertia="1 1 1"/>
          <joint type="slide" axis="1 0 0" stiffness="{house.pair_stiffness_horizontal}"/>
          <joint type="slide" axis="0 1 0" stiffness="{house.outer_beam_stiffness}"
                 damping="{house.outer_beam_damping}"/>
          <body gravcomp="1">
            <inertial pos="0 0 0" mass="{house.inner_mass}" diaginertia="1 1 1"/>
            <joint type="slide" axis="1 0 0" stiffness="{house.inner_beam_stiffness}"
                   damping="{house.inner_beam_damping}"/>
            <joint type="slide" axis="0 1 0" stiffness="{house.pair_stiffness_vertical}"/>
            {boxes}
          </body>
        </body>
      </worldbody>
    </mujoco>"""


def _contact(problem: Problem) -> tuple[float, float]:
    """Return linear stiffness [1/s^2] and damping [1/s] with the law's contact time and restitution in one impact.

    An undamped impact at v with F = K d^n lasts T = 2 sqrt(pi) G(1/(n+1)) / ((n+1) G(1/2 + 1/(n+1))) d_max / v, with
    d_max^(n+1) = (n+1) m v^2 / (2 K); a linear one pi / omega.
    """
    shaft, contact = problem.constants.shaft, problem.constants.contact
    mass = 1.0 / (shaft.arm_ring**2 / shaft.transverse_inertia + 1.0 / problem.constants.house.inner_mass)
    n = contact.exponent + 1.0
    depth = (n * mass * _IMPACT_SPEED**2 / (2.0 * contact.stiffness)) ** (1.0 / n)
    shape = 2.0 * math.sqrt(math.pi) * math.gamma(1.0 / n) / (n * math.gamma(0.5 + 1.0 / n))
    omega = math.pi * _IMPACT_SPEED / (shape * depth)
    undamped = contact.damping_factor == 0.0 and contact.viscous_damping == 0.0
    log = 0.0 if undamped else -math.log(contact.restitution)
    ratio = log / math.hypot(math.pi, log)
    damped = omega / math.sqrt(1.0 - ratio * ratio)
    return damped * damped, 2.0 * ratio * damped
