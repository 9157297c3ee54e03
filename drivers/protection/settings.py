"""Settings of the protection monitor. Statements about the 3500/42 and API 670 are from secondary sources."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat, ValidationError, model_validator

from rig.base.checks import Name, Written, input_error
from rig.base.errors import InputError

Above0 = Annotated[FiniteFloat, Field(gt=0.0, le=1e9)]
Seconds = Annotated[FiniteFloat, Field(ge=0.0, le=86_400.0)]


class Settings(Written):
    """Settings of a monitor; `Settings(alert_um=500, danger_um=1500)` takes the defaults for the others.

    Raises:
        InputError: A value is out of range.
    """

    alert_um: Above0
    """Set point of the alert [um]."""
    danger_um: Above0
    """Set point of the danger, which trips [um]."""
    alert_delay_s: Seconds = 1.0
    danger_delay_s: Seconds = 0.1
    """Time for which the level must exceed the set point [s]; a 3500/42 has whole seconds, and 0.1 s for danger only.
    """
    hysteresis: Annotated[FiniteFloat, Field(ge=0.0, lt=1.0)] = 0.02
    """Fraction of the set point by which a level must fall below it to end the alarm's cause; assumed value."""
    measure: Literal["peak-to-peak", "smax"] = "peak-to-peak"
    """Peak-to-peak of each probe, or the orbit's largest distance from its mean, one level for both probes."""
    window_s: Annotated[FiniteFloat, Field(gt=0.0, le=10.0)] = 0.25
    """Length of the window of the measure [s]; at least one turn."""
    corner_hz: Annotated[FiniteFloat, Field(gt=0.0, le=1000.0)] = 0.5
    """Corner frequency of the high-pass that removes the DC gap: one pole, -3 dB [Hz]."""
    x: Name = "disk_x"
    y: Name = "disk_y"
    bias_v: FiniteFloat = -10.0
    """Output of the probes at zero displacement [V]."""
    scale_v_per_mm: Above0 = 3.94
    ok_low_v: FiniteFloat = -17.5
    ok_high_v: FiniteFloat = -2.5
    """OK limits of the output [V]."""
    ok_recovery_s: Seconds = 30.0
    """Time for which a probe must be within the OK limits to be OK again [s]; a 3500/42 offers 30 s as an option."""
    vote: Literal["1oo2", "2oo2"] = "1oo2"
    not_ok: Literal["leaves", "against", "for"] = "leaves"
    """Vote of a probe that is NOT OK: leaves the vote to the other probe, against a trip, or for a trip. A bypassed
    probe never votes for a trip."""
    bypass: tuple[Name, ...] = ()
    """Channels without alarms."""
    latch_alert: bool = False
    latch_danger: bool = True
    """Whether an alarm stays on until a reset; a trip always does."""
    startup_s: Seconds = 1.0
    """Time without alarms after the first row [s]."""
    keyphasor: Name = "keyphasor"
    overspeed_hz: Seconds = 0.0
    """Speed limit of a turn [Hz]; 0 switches overspeed off."""
    overspeed_turns: Annotated[int, Field(ge=1, le=100)] = 3
    """Consecutive turns above the limit that trip; one spurious pulse makes two."""
    speed_lost_s: Seconds = 0.0
    """Time without a pulse that raises an alarm, not a trip [s]; 0 switches it off."""
    reverse_turns: Annotated[int, Field(ge=0, le=100)] = 0
    """Consecutive turns with an orbit against the rotation that raise an alarm, not a trip; 0 switches it off."""
    trip: Literal["speed 0", "stop"] = "speed 0"
    """Action on the rig at a trip."""

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise input_error(error, "", type(self)) from None

    @model_validator(mode="after")
    def _check_consistency(self) -> Settings:
        for field, upper in (("alert_um", "danger_um"), ("ok_low_v", "ok_high_v"), ("window_s", "ok_recovery_s")):
            if getattr(self, field) > getattr(self, upper):
                raise InputError(field, f"at most {upper}, {getattr(self, upper):g}", getattr(self, field))
        if unknown := sorted(set(self.bypass) - {self.x, self.y, self.keyphasor}):
            raise InputError("bypass", f"of {self.x}, {self.y}, {self.keyphasor}", unknown[0])
        return self

    @property
    def uses_keyphasor(self) -> bool:
        """Whether the monitor reads the keyphasor."""
        return self.overspeed_hz > 0.0 or self.speed_lost_s > 0.0 or self.reverse_turns > 0

    @property
    def channels(self) -> list[str]:
        """Channels that the monitor reads."""
        return [self.x, self.y, *([self.keyphasor] if self.uses_keyphasor else [])]
