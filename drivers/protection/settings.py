"""What a protection monitor is set to. What is said here of a 3500/42 or of API 670 is known at second hand."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat, ValidationError, model_validator

from rig.base.checks import Name, Written, input_error
from rig.base.errors import InputError

Above0 = Annotated[FiniteFloat, Field(gt=0.0, le=1e9)]
Seconds = Annotated[FiniteFloat, Field(ge=0.0, le=86_400.0)]


class Settings(Written):
    """What a monitor is set to; `Settings(alert_um=500, danger_um=1500)` has the rest as it stands here.

    Raises:
        InputError: A value is none that it can have.
    """

    alert_um: Above0
    """Set point of the first alarm [um]."""
    danger_um: Above0
    """Set point of the second, which trips [um]."""
    alert_delay_s: Seconds = 1.0
    danger_delay_s: Seconds = 0.1
    """How long a level must be above [s]; a 3500/42 has whole seconds, and 0.1 s for danger alone."""
    hysteresis: Annotated[FiniteFloat, Field(ge=0.0, lt=1.0)] = 0.02
    """By which part of its set point a level must fall below it, for the alarm's cause to be over; assumed."""
    measure: Literal["peak-to-peak", "smax"] = "peak-to-peak"
    """Of each probe; or the largest distance of the orbit from its mean, one level for both probes."""
    window_s: Annotated[FiniteFloat, Field(gt=0.0, le=10.0)] = 0.25
    """What the measure is of [s]; a turn or more."""
    corner_hz: Annotated[FiniteFloat, Field(gt=0.0, le=1000.0)] = 0.5
    """Corner of the high-pass that takes the gap away: one pole, -3 dB [Hz]."""
    x: Name = "disk_x"
    y: Name = "disk_y"
    bias_v: FiniteFloat = -10.0
    """Output of the probes at 0 [V]."""
    scale_v_per_mm: Above0 = 3.94
    ok_low_v: FiniteFloat = -17.5
    ok_high_v: FiniteFloat = -2.5
    """OK limits of the output [V]."""
    ok_recovery_s: Seconds = 30.0
    """How long a probe must be within them to be OK again [s]; a 3500/42 takes 30 s where this is asked for."""
    vote: Literal["1oo2", "2oo2"] = "1oo2"
    not_ok: Literal["leaves", "against", "for"] = "leaves"
    """Whether a probe that is NOT OK leaves the vote to the other one, or votes against a trip, or for it. One that is
    bypassed never votes for a trip."""
    bypass: tuple[Name, ...] = ()
    """Channels without alarms."""
    latch_alert: bool = False
    latch_danger: bool = True
    """Whether an alarm stays until it is reset; a trip does."""
    startup_s: Seconds = 1.0
    """No alarm for so long from the first row on [s]."""
    keyphasor: Name = "keyphasor"
    overspeed_hz: Seconds = 0.0
    """Turns a second beyond which a turn is too fast [Hz]; 0: none is."""
    overspeed_turns: Annotated[int, Field(ge=1, le=100)] = 3
    """So many in a row trip: a pulse too many makes two."""
    speed_lost_s: Seconds = 0.0
    """So long without a pulse is an alarm, not a trip [s]; 0: never."""
    trip: Literal["speed 0", "stop"] = "speed 0"
    """What a trip does to the rig."""

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise input_error(error, "", type(self)) from None

    @model_validator(mode="after")
    def _together(self) -> Settings:
        for field, most in (("alert_um", "danger_um"), ("ok_low_v", "ok_high_v"), ("window_s", "ok_recovery_s")):
            if getattr(self, field) > getattr(self, most):
                raise InputError(field, f"at most {most}, {getattr(self, most):g}", getattr(self, field))
        if strange := sorted(set(self.bypass) - {self.x, self.y, self.keyphasor}):
            raise InputError("bypass", f"of {self.x}, {self.y}, {self.keyphasor}", strange[0])
        return self

    @property
    def timed(self) -> bool:
        """Whether it reads the keyphasor."""
        return self.overspeed_hz > 0.0 or self.speed_lost_s > 0.0

    @property
    def channels(self) -> list[str]:
        """What it reads."""
        return [self.x, self.y, *([self.keyphasor] if self.timed else [])]
