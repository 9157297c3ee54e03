"""Magnet force at the shaft's end: the map fitted to the models in `rig.physics.magnets`."""

from __future__ import annotations

from rig.physics.kernels.stage import stage

LINEAR, RADIAL, RIPPLED = range(3)
"""Terms of the map: a spring; hardening with the radius; also the ripple of the single magnets."""


@stage
def complex_power(x, y, exponent):
    """Return real and imaginary part of (x + i y)^exponent, by repeated squaring."""
    px, py = 0.0 * x + 1.0, 0.0 * x  # same type as x, which may be an array
    qx, qy = x, y
    bits = exponent
    while bits > 0:
        if bits & 1:
            px, py = px * qx - py * qy, px * qy + py * qx
        qx, qy = qx * qx - qy * qy, 2.0 * qx * qy
        bits >>= 1
    return px, py


@stage
def magnet_force(x, y, magnet):
    """Return restoring force and potential of the map.

    The potential is K [r^2/2 + a3 r^4/4 + a5 r^6/6 + a7 r^8/8 + ripple r^N (1 + growth r^2) cos(N angle)], with the
    angle from straight below, the position of one of the N magnets. The force is its exact gradient, so that the energy
    ledger closes. r^N cos(N angle) is the real part of w^N with w = -y + i x: products, no angle.

    The Python function also takes numpy arrays of positions (`rig.physics.magnets`).

    Args:
        x: Shaft at the magnets, horizontal [m].
        y: Shaft at the magnets, vertical [m].
        magnet: Magnet constants.

    Returns:
        Force x, y [N] and potential [J], 0 at the centre.
    """
    s = x * x + y * y
    if magnet.terms == LINEAR:
        return -magnet.stiffness * x, -magnet.stiffness * y, 0.5 * magnet.stiffness * s
    gain = -magnet.stiffness * (1.0 + s * (magnet.a3 + s * (magnet.a5 + s * magnet.a7)))
    potential = 0.5 * magnet.stiffness * s * (1.0 + s * (magnet.a3 / 2.0 + s * (magnet.a5 / 3.0 + s * magnet.a7 / 4.0)))
    if magnet.terms == RADIAL:
        return gain * x, gain * y, potential
    wx, wy = -y, x
    px, py = complex_power(wx, wy, magnet.number - 1)
    amplitude = magnet.stiffness * magnet.ripple
    wave = px * wx - py * wy
    grown = amplitude * (1.0 + magnet.growth * s)
    gain -= 2.0 * amplitude * magnet.growth * wave
    # d(w^N)/dx = N p i and d(w^N)/dy = -N p.
    side = magnet.number * grown
    return gain * x + side * py, gain * y + side * px, potential + grown * wave
