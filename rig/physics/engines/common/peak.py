"""The largest value of a force that is known at single instants."""

from __future__ import annotations

from rig.physics.kernels.stage import kernel


@kernel
def peak(before, back, last, ahead, force):
    """Largest of the latest value and of the parabola through the latest three, where the middle one is the largest.

    Args:
        before: Value before the last; 0: there is none in this contact.
        back: Time from it to the last value; 0: there is none.
        last: Last value.
        ahead: Time from it to the present one, in the same unit.
        force: Present value.
    """
    if last > before and last >= force and before > 0.0 and force > 0.0 and back > 0.0 and ahead > 0.0:
        # F(t) = last + p t + q t^2 around the middle instant.
        left, right = (before - last) / back, (force - last) / ahead
        q = (left + right) / (back + ahead)
        p = right - q * ahead
        if q < 0.0:
            return last - 0.25 * p * p / q
    return force
