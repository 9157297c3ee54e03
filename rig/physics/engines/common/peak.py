"""Peak of a force that is known at discrete instants."""

from __future__ import annotations

from rig.physics.kernels.stage import kernel


@kernel
def parabolic_peak(before, back, last, ahead, force):
    """Return the larger of the latest value and the parabola's peak, if the middle of three values is the largest.

    Args:
        before: Value before the last; 0 for none in this contact.
        back: Time from it to the last value; 0 for none.
        last: Last value.
        ahead: Time from it to the present value, in the same unit.
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
