"""Magnet force at the shaft's end: the radial map, fitted to the field sum that is in `rig.magnets`."""

from __future__ import annotations

from numba import njit


@njit(cache=True)
def magnet_force(x, y, stiffness, a3, a5, a7):
    """Restoring force and potential of the radial map.

    F = -K (r + a3 r^3 + a5 r^5 + a7 r^7) r/|r|, with its potential, so that the energy ledger is exact.

    Args:
        x: Shaft at the magnets, horizontal [m].
        y: Shaft at the magnets, vertical [m].
        stiffness: K at the centre [N/m].
        a3: Hardening [1/m^2].
        a5: Hardening [1/m^4].
        a7: Hardening [1/m^6].

    Returns:
        Force x, y [N] and potential [J], 0 at the centre.
    """
    s = x * x + y * y
    gain = -stiffness * (1.0 + s * (a3 + s * (a5 + s * a7)))
    potential = 0.5 * stiffness * s * (1.0 + s * (a3 / 2.0 + s * (a5 / 3.0 + s * a7 / 4.0)))
    return gain * x, gain * y, potential
