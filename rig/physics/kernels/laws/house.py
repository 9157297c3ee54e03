"""Housing law: two bodies on beams and pre-compressed transducers, eqs. 22-25 with absolute coordinates."""

from __future__ import annotations

from rig.physics.kernels.stage import stage


@stage
def pair_readings(displacement, pair_stiffness, preload):
    """Return the readings of an opposed, pre-compressed pair of transducers.

    The pair's force is `pair_stiffness` times the displacement: one side gains half of it, the other loses half. A
    transducer without preload reads 0 and no longer contributes to the stiffness.

    Args:
        displacement: Displacement of the body between them, positive toward the first [m].
        pair_stiffness: k_T of the pair with both loaded [N/m].
        preload: Preload of each [N].

    Returns:
        Compression of the first and of the second transducer [N], and the energy stored above the preloaded rest [J].
    """
    change = 0.5 * pair_stiffness * displacement
    first = max(0.0, preload + change)
    second = max(0.0, preload - change)
    stored = (first * first + second * second - 2.0 * preload * preload) / pair_stiffness
    return first, second, stored
