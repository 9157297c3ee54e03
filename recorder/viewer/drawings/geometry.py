"""Lengths of the rig used by the drawings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

_KEYS = {
    "ring_clearance_m": "ring.clearance",
    "shaft_radius_m": "shaft.radius",
    "ring_arm_m": "shaft.arm_ring",
    "disk_arm_m": "shaft.arm_disk",
    "magnet_arm_m": "shaft.arm_magnet",
}
_UNITS = {"m": 1.0, "mm": 1e-3, "um": 1e-6}


@dataclass(frozen=True, slots=True)
class Geometry:
    """Lengths of the rig [m]; the defaults are those of the parameter set `corrected`.

    Attributes:
        ring_clearance_m: Radial clearance between shaft and ring, r0 [m].
        shaft_radius_m: Shaft radius in the ring, R_S [m].
        ring_arm_m: Pivot to ring, l0A [m].
        disk_arm_m: Pivot to disk, l0I [m].
        magnet_arm_m: Pivot to magnet, l0B [m].
        assumed: Parameter keys without a value in the document, for which the defaults are used.
    """

    ring_clearance_m: float = 0.926e-3
    shaft_radius_m: float = 12.5e-3
    ring_arm_m: float = 0.197
    disk_arm_m: float = 0.314
    magnet_arm_m: float = 0.391
    assumed: tuple[str, ...] = field(default=tuple(_KEYS.values()))

    @classmethod
    def from_parameters(cls, document: Mapping[str, Any] | None) -> Geometry:
        """Return the lengths of a parameter document, with defaults for missing ones.

        Args:
            document: `{"values": {key: {"value", "unit"}}}`, or None.
        """
        values = (document or {}).get("values", {})
        lengths: dict[str, float] = {}
        for name, key in _KEYS.items():
            entry = values.get(key)
            if not isinstance(entry, Mapping) or entry.get("unit") not in _UNITS:
                continue
            value = entry.get("value")
            if isinstance(value, int | float) and value > 0.0:
                lengths[name] = value * _UNITS[entry["unit"]]
        return cls(**lengths, assumed=tuple(key for name, key in _KEYS.items() if name not in lengths))

    @property
    def disk_clearance_m(self) -> float:
        """Displacement at the disk when the rigid shaft touches the ring [m]."""
        return self.ring_clearance_m * self.disk_arm_m / self.ring_arm_m

    def clearance_mm(self, plane: str) -> float:
        """Return the radius of the clearance circle in a measuring plane, `ring` or `disk` [mm]."""
        return 1e3 * (self.ring_clearance_m if plane == "ring" else self.disk_clearance_m)
