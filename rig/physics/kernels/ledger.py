"""The ledger: power of every force, and the forces and torques behind the momenta; engines carry their integrals."""

from __future__ import annotations

from typing import NamedTuple

from rig.physics.kernels.stage import stage


class Powers(NamedTuple):
    """Rates of the integrals (`rig.physics.kernels.signals.INTEGRALS` has units and meaning)."""

    drive_work: float
    hammer_work: float
    unbalance_work: float
    gap_work: float
    release_work: float
    bearing_loss: float
    house_loss: float
    contact_loss: float
    friction_loss: float
    contact_impulse: float
    angular_impulse_x: float
    angular_impulse_y: float
    angular_impulse_z: float
    house_impulse_x: float
    house_impulse_y: float


@stage
def gap_power(contact, Fx, Fy, state):
    """Power that a gap makes which counts the outer house as well [W]."""
    if contact.gap_counts_outer == 0.0:
        return 0.0
    return contact.gap_counts_outer * (Fx * state.vx_oh + Fy * state.vy_oh)


@stage
def powers_of(constants, state, pose, ring, magnets, disk, stator, support, Lx, Ly, Fx, Fy, Ft, torque):
    """Rates of the integrals.

    Args:
        constants: Numbers of the model.
        state: The state.
        pose: Of the shaft.
        ring: Force of the ring, but for friction that depends on the whole motion.
        magnets: Forces of the magnets.
        disk: Forces at the disk.
        stator: Of the houses.
        support: What their transducers and the outer beam carry (`rig.physics.kernels.forces.passed_on`).
        Lx: Arm times lateral force without the ring's, x [N m].
        Ly: The same, y [N m].
        Fx: Force of the ring on the shaft, x [N].
        Fy: The same, y [N].
        Ft: Friction force [N].
        torque: Of the drive [N m].
    """
    shaft, house = constants.shaft, constants.house
    lA, lB, lI = shaft.arm_ring, shaft.arm_magnet, shaft.arm_disk
    ux, uy, uz, dux, duy = pose.ux, pose.uy, pose.uz, pose.dux, pose.duy
    vy_oh = state.vy_oh
    _, _, east, west, beam_y = support
    Lx += lA * Fx
    Ly += lA * Fy
    net = torque - shaft.radius * Ft
    return Powers(
        drive_work=torque * pose.w,
        hammer_work=lI * (disk.hammer_x * dux + disk.hammer_y * duy),
        unbalance_work=lI * (disk.unbalance_x * dux + disk.unbalance_y * duy),
        gap_work=gap_power(constants.contact, Fx, Fy, state),
        release_work=0.0,
        bearing_loss=-lB * (magnets.damping_x * dux + magnets.damping_y * duy),
        house_loss=house.inner_beam_damping * stator.slip * stator.slip + house.outer_beam_damping * vy_oh * vy_oh,
        contact_loss=(ring.Fn - ring.elastic) * ring.rate,
        friction_loss=Ft * ring.sliding,
        contact_impulse=ring.Fn,
        angular_impulse_x=-uz * Ly + net * ux,
        angular_impulse_y=uz * Lx + net * uy,
        angular_impulse_z=ux * Ly - uy * Lx + net * uz,
        house_impulse_x=-Fx - (east - west),
        house_impulse_y=-Fy - beam_y,
    )
