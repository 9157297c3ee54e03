"""Choice of an engine in a scene: method, step, tolerance, and limits of a run's error by quantity.

`rig.physics.accuracy` compares the companion's estimate with the limits. A run may exceed a limit; it then warns.
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
"""A limit of an error; None: that of engine.tolerance, or of an angle none."""
HALF_TURN_DEG = 180.0
"""Largest difference between two whirl angles [deg]: a limit above it could not be exceeded."""
SCALES = {"radius_um": 900.0, "force_n": 1000.0, "frequency_hz": 100.0, "angle_deg": 57.3, "spin_angle_deg": 57.3}
"""Size of each quantity, of which engine.tolerance is a part: clearance, force of an impact, whirl frequency, 1 rad."""
FINEST_TOLERANCE = 1e-8
"""Smallest engine.tolerance that limits choose: below it rounding is a part of the companion's difference."""


class Limits(BaseModel, frozen=True, extra="forbid"):
    """Largest error of each quantity that a user accepts; those left out have the tolerance of engine.tolerance."""

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

    def given(self) -> dict[str, float]:
        """Return the limits that are given, by field."""
        return self.model_dump(exclude_none=True)

    def by_quantity(self) -> dict[str, float]:
        """Return the limits that are given, in their units, by the quantity's name in `rig.physics.accuracy`."""
        return {field.rpartition("_")[0]: limit for field, limit in self.given().items()}

    def choose_tolerance(self, own: float) -> float:
        """Return engine.tolerance for these limits: the smallest limit over its quantity's scale, at most the own one.

        Never a coarser one than the engine's own: a limit of one quantity says nothing about the others.

        Args:
            own: The engine's own tolerance; 0 where its steps are fixed.
        """
        return min([own, *(max(limit / SCALES[field], FINEST_TOLERANCE) for field, limit in self.given().items())])


class EngineChoice(Written):
    """Settings of the integration: engine, step, tolerance, limits of the error, companion."""

    name: str = next(iter(ENGINES))
    step_us: Annotated[int, Field(ge=1, le=1000)] = 0
    """Longest step [us]: steps end on the rows that sensors see, 25 us apart or closer; left out: the engine's own."""
    limits: Limits = Limits()
    """Largest errors, by quantity: a companion's estimate above one of them gives a warning."""
    tolerance: Annotated[FiniteFloat, Field(ge=0.0, le=0.1)] = 0.0
    """Scaled error: of the whole run with split, of a step with another adaptive engine; left out: the engine's own,
    or a finer one where limits ask for it."""
    companion: bool = False
    """A second run at a sixteenth of the tolerance estimates the error; left out: with split only."""
    rolling: Literal["series", "collocation"] = "series"
    """Method for rolling contact: long steps of a whirl turn (with split only; its own), or as for other motion."""

    @field_validator("name")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in ENGINES:
            reason = f" ({BROKEN[name]})" if name in BROKEN else ""
            raise ValueError(f"one of {', '.join(ENGINES)}{reason}")
        return name

    @field_validator("tolerance")
    @classmethod
    def _own_tolerance(cls, tolerance: float, info: ValidationInfo) -> float:
        if 0.0 < tolerance < 1e-30:
            raise ValueError("at least 1e-30, far below rounding; 0 is the engine's own")
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
        return {**own, "tolerance": data.get("tolerance") or 0.0}  # 0 is what recordings of 0.1 say

    @model_serializer(mode="wrap")
    def _without_absent_limits(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data = handler(self)
        given = {name: limit for name, limit in data.pop("limits", {}).items() if limit is not None}
        return {**data, "limits": given} if given else data

    @property
    def tolerance_by_limits(self) -> bool:
        """Whether `tolerance` is the one chosen where it is left out."""
        return self.tolerance == self.limits.choose_tolerance(ENGINES[self.name].tolerance)


def load_chosen_engine(name: str) -> Engine:
    """Return one of `ENGINES`, ready to run.

    Raises:
        InputError: It is another package's, and cannot be imported or lacks what an engine must have.
    """
    try:
        return load_engine(name)
    except (Exception, SystemExit) as error:
        if not ENGINES[name].module:
            raise
        received = f"{name}, of which {ENGINES[name].module} fails: {describe_error(error)}"
        raise InputError("engine.name", "an engine that can be loaded", Words(received)) from None
