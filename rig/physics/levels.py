"""The ladder of models: how much of the rig's physics a scene asks for, each level by name, the simplest first."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel

from rig.physics.kernels.constants import Levels
from rig.physics.kernels.laws.contact import EXACT, NO_FRICTION, SMOOTHED, SWITCH

FRICTION_LAWS = {"none": NO_FRICTION, "smoothed": SMOOTHED, "switch": SWITCH, "exact": EXACT}


class ModelLevels(BaseModel, frozen=True, extra="forbid"):
    """How much of the model takes part. What is left out costs nothing."""

    magnet: Literal["linear", "map", "cylinders"] = "map"
    """A spring; the radial map of the paper's far-field sum; exact finite cylinders."""
    shaft: Literal["planar", "euler"] = "euler"
    """Small angles, or Euler's equations."""
    stator: Literal["rigid", "inner-house", "two-houses"] = "two-houses"
    """Bodies that move; those that do not pass forces on."""
    contact: Literal["impact", "compliant"] = "compliant"
    """Impacts of a rigid ring (restitution, no force over time), compliant where contact lasts; or compliant always."""
    friction: Literal["none", "smoothed", "switch", "exact"] = "exact"
    """None; tanh of the sliding speed; clamped linear; Coulomb's set-valued law."""

    def constants(self) -> Levels:
        """The levels as the kernels take them."""
        return Levels(
            euler=self.shaft == "euler",
            inner_house=self.stator != "rigid",
            outer_house=self.stator == "two-houses",
            compliant=self.contact == "compliant",
            friction=FRICTION_LAWS[self.friction],
        )
