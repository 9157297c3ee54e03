"""Engine settings of a scene: method, step, tolerance, and error limits by quantity.

`rig.physics.accuracy` compares the companion's estimate with the limits. A run that exceeds a limit gives a warning and
continues.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    Field,
    FiniteFloat,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from rig.base.checks import Written, describe_error
from rig.base.errors import InputError, Words
from rig.physics.engines import BROKEN, ENGINES, Engine, load_engine

Limit = Annotated[FiniteFloat, Field(gt=0.0, strict=True)] | None
"""Error limit; None selects the tolerance derived from engine.tolerance, and no limit for an angle."""
HALF_TURN_DEG = 180.0
"""Largest difference between two whirl angles [deg]: a higher limit could not be exceeded."""
SCALES = {"radius_um": 900.0, "force_n": 1000.0, "frequency_hz": 100.0, "angle_deg": 57.3, "spin_angle_deg": 57.3}
"""Scale of each quantity, which engine.tolerance multiplies: clearance, impact force, whirl frequency, 1 rad."""
MIN_LIMIT_TOLERANCE = 1e-8
"""Smallest engine.tolerance chosen by limits: below it, rounding contributes to the companion's difference."""


class Limits(BaseModel, frozen=True, extra="forbid"):
    """Largest accepted error of each quantity; an omitted limit follows from engine.tolerance."""

    radius_um: Limit = None
    """Whirl radius [um]."""
    force_n: Limit = None
    """Contact force [N]."""
    frequency_hz: Limit = None
    """Whirl frequency [Hz]."""
    angle_deg: Annotated[Limit, Field(le=HALF_TURN_DEG)] = None
    """Whirl angle [deg]."""
    spin_angle_deg: Limit = None
    """Spin angle [deg]."""

    def as_dict(self) -> dict[str, float]:
        """Return the limits that are set, by field."""
        return self.model_dump(exclude_none=True)

    def by_quantity(self) -> dict[str, float]:
        """Return the limits that are set, in their units, by the quantity's name in `rig.physics.accuracy`."""
        return {field.rpartition("_")[0]: limit for field, limit in self.as_dict().items()}

    def choose_tolerance(self, own: float) -> float:
        """Return engine.tolerance for these limits: the smallest ratio of a limit to its quantity's scale.

        It never exceeds the engine's own tolerance, as a limit of one quantity does not bound the others.

        Args:
            own: The engine's own tolerance; 0 for fixed steps.
        """
        return min([own, *(max(limit / SCALES[field], MIN_LIMIT_TOLERANCE) for field, limit in self.as_dict().items())])


class EngineChoice(Written):
    """Integration settings: engine, step, tolerance, error limits, companion."""

    name: str = next(iter(ENGINES))
    step_us: Annotated[int, Field(ge=1, le=1000)] = 0
    """Longest step [us]; the engine's own by default. Steps end on the sensors' samples, at most 25 us apart."""
    limits: Limits = Limits()
    """Largest errors by quantity; a warning is given when the companion's estimate exceeds one."""
    tolerance: Annotated[FiniteFloat, Field(ge=0.0, le=0.1)] = 0.0
    """Scaled error: of the whole run with split, per step with other adaptive engines. The default is the engine's own,
    or finer where limits require it."""
    companion: bool = False
    """Run a companion at a sixteenth of the tolerance to estimate the error; by default with split only."""
    rolling: Literal["series", "collocation"] = "series"
    """Method for rolling contact: collocation, with steps of part of a whirl turn (split only, its default), or the
    series."""

    @field_validator("name")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in ENGINES:
            reason = "".join(f"; {each}" for each in BROKEN if each.startswith(f"{name} ("))
            raise ValueError(f"one of {', '.join(ENGINES)}{reason}")
        return name

    @field_validator("tolerance")
    @classmethod
    def _own_tolerance(cls, tolerance: float, info: ValidationInfo) -> float:
        if 0.0 < tolerance < 1e-30:
            raise ValueError("at least 1e-30, or 0 for the engine's own tolerance")
        if tolerance or not {"name", "limits"} <= info.data.keys():
            return tolerance
        return info.data["limits"].choose_tolerance(ENGINES[info.data["name"]].tolerance)

    @field_validator("rolling")
    @classmethod
    def _of_split(cls, rolling: str, info: ValidationInfo) -> str:
        if rolling == "collocation" and (name := info.data.get("name")) != "split":
            raise ValueError(f"series with engine {name}")
        return rolling

    @model_validator(mode="before")
    @classmethod
    def _own_step(cls, data: Any) -> Any:
        name = data.get("name", next(iter(ENGINES))) if isinstance(data, dict) else None
        if not isinstance(name, str) or (method := ENGINES.get(name)) is None:
            return data
        own = {"step_us": method.step_us, "companion": method.companion, "rolling": method.rolling, **data}
        return {**own, "tolerance": data.get("tolerance") or 0.0}  # recordings of version 0.1 have 0

    @model_serializer(mode="wrap")
    def _without_absent_limits(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data = handler(self)
        limits = {name: limit for name, limit in data.pop("limits", {}).items() if limit is not None}
        return {**data, "limits": limits} if limits else data

    @property
    def tolerance_by_limits(self) -> bool:
        """Whether `tolerance` is the default for these limits."""
        return self.tolerance == self.limits.choose_tolerance(ENGINES[self.name].tolerance)


def load_chosen_engine(name: str) -> Engine:
    """Return the engine of a name in `ENGINES`, ready to run.

    Raises:
        InputError: Another package's engine cannot be imported or is incomplete.
    """
    try:
        return load_engine(name)
    except (Exception, SystemExit) as error:
        if not ENGINES[name].module:
            raise
        received = f"{name}, of which {ENGINES[name].module} fails: {describe_error(error)}"
        raise InputError("engine.name", "an engine that can be loaded", Words(received)) from None
