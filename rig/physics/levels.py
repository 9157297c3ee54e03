"""Model levels: how much of the rig's physics a scene includes, by name, the simplest first."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel

from rig.physics.kernels.constants import Levels
from rig.physics.kernels.laws.contact import EXACT, NO_FRICTION, SMOOTHED, SWITCH

FRICTION_LAWS = {"none": NO_FRICTION, "smoothed": SMOOTHED, "switch": SWITCH, "exact": EXACT}


class ModelLevels(BaseModel, frozen=True, extra="forbid"):
    """Selected parts of the model. Excluded parts cost no computing time."""

    magnet: Literal["linear", "map", "cylinders"] = "map"
    """Linear spring; radial map of the paper's far-field sum; map of exact finite cylinders."""
    shaft: Literal["planar", "euler"] = "euler"
    """Small angles, or Euler's equations."""
    stator: Literal["rigid", "inner-house", "two-houses"] = "two-houses"
    """Housings that move. A fixed housing transmits forces."""
    contact: Literal["impact", "compliant"] = "compliant"
    """Rigid impacts by restitution, with compliant contact where it lasts; or compliant contact always."""
    friction: Literal["none", "smoothed", "switch", "exact"] = "exact"
    """None; tanh of the sliding speed; clamped linear law; Coulomb's set-valued law."""

    def constants(self) -> Levels:
        """Return the levels as constants of the kernels."""
        return Levels(
            euler=self.shaft == "euler",
            inner_house=self.stator != "rigid",
            outer_house=self.stator == "two-houses",
            compliant=self.contact == "compliant",
            friction=FRICTION_LAWS[self.friction],
        )
