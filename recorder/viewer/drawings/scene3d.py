"""3-D view of the rig: pivoted shaft with disk and magnet, ring, housings, and the reaction, displacements exaggerated.

The shaft is a rigid line from the pivot through the displacement measured at the disk. Displacement and clearance are
both multiplied by `EXAGGERATION`, so that shaft and ring touch in the picture when they touch in the rig.
"""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from recorder.viewer.canvas import Canvas
from recorder.viewer.drawings.geometry import Geometry
from recorder.viewer.drawings.whirl import BACKWARD_RGB

ROOT = "/rig3d"
EXAGGERATION = 25.0
FORCE_M_PER_N = 1.2e-4
"""Scale of the reaction's arrow [m/N]: 500 N are 60 mm."""

_STEEL = (168, 176, 190)
_DARK = (110, 118, 132)
_DISK = (86, 150, 205)
_MAGNET = (190, 80, 90)
_RING = (225, 190, 110)
_HOUSE = (120, 128, 142)
_DISK_RADIUS_M = 0.060
_HUB_RADIUS_M = 0.008


class Scene3D:
    """3-D rig on a canvas."""

    def __init__(self, canvas: Canvas, geometry: Geometry) -> None:
        self._canvas = canvas
        self._geometry = geometry
        self._draw_stator()
        self._draw_rotor()

    def _draw_stator(self) -> None:
        g = self._geometry
        self._canvas.fix(ROOT, rr.ViewCoordinates.RIGHT_HAND_Y_UP)
        bore = g.shaft_radius_m + EXAGGERATION * g.ring_clearance_m
        turn = np.linspace(0.0, 2.0 * math.pi, 73)
        circles = [
            np.stack((bore * np.cos(turn), bore * np.sin(turn), np.full(73, g.ring_arm_m + dz)), axis=1)
            for dz in np.linspace(-0.008, 0.008, 5)
        ]
        self._canvas.fix(f"{ROOT}/stator/ring", rr.LineStrips3D(circles, colors=[_RING], radii=[0.0016]))
        inner, outer = bore + 0.012, bore + 0.034
        self._canvas.fix(
            f"{ROOT}/stator/houses",
            rr.Boxes3D(
                centers=[(0.0, 0.0, g.ring_arm_m)] * 2,
                half_sizes=[(inner, inner, 0.012), (outer, outer, 0.014)],
                colors=[_HOUSE, _DARK],
                radii=[0.0008],
                labels=["inner housing", "outer housing"],
                show_labels=False,
                fill_mode="MajorWireframe",
            ),
        )
        eighth = np.arange(8) * math.pi / 4.0
        around = [(0.045 * math.cos(a), 0.045 * math.sin(a), g.magnet_arm_m) for a in eighth]
        self._canvas.fix(
            f"{ROOT}/stator/magnets",
            rr.Cylinders3D(
                lengths=[0.017] * 8, radii=[0.006] * 8, centers=around, colors=[_MAGNET], fill_mode="Solid",
            ),
        )  # fmt: skip
        self._canvas.fix(
            f"{ROOT}/stator/pivot",
            rr.Boxes3D(
                centers=[(0.0, 0.0, -0.012)], half_sizes=[(0.022, 0.022, 0.012)], colors=[_DARK], fill_mode="Solid",
            ),
        )  # fmt: skip
        places = {
            "pivot": (0.0, 0.06, 0.0),
            "ring in its housings": (0.0, -outer - 0.035, g.ring_arm_m),
            "disk": (0.0, _DISK_RADIUS_M + 0.03, g.disk_arm_m),
            "magnets": (0.0, -0.085, g.magnet_arm_m),
        }
        self._canvas.fix(
            f"{ROOT}/stator/names",
            rr.Points3D(
                list(places.values()), radii=[0.0], colors=[(190, 195, 205)], labels=list(places), show_labels=True,
            ),
        )  # fmt: skip
        origin, length = np.array([0.0, -0.13, -0.05]), 0.05
        vectors = np.array([[length, 0.0, 0.0], [0.0, length, 0.0]])
        colors = [(86, 180, 233), (240, 190, 70)]
        self._canvas.fix(
            f"{ROOT}/stator/directions",
            rr.Arrows3D(vectors=vectors, origins=[origin] * 2, colors=colors, radii=[0.0015]),
        )
        self._canvas.fix(
            f"{ROOT}/stator/direction_names",
            rr.Points3D(
                origin + 1.5 * vectors, radii=[0.0], colors=colors, labels=["EAST +x", "UP +y"], show_labels=True
            ),
        )

    def _draw_rotor(self) -> None:
        g = self._geometry
        rotor = f"{ROOT}/rotor"
        length = g.magnet_arm_m + 0.01
        self._canvas.fix(
            f"{rotor}/spin/shaft",
            rr.Cylinders3D(
                lengths=[length, 0.06],
                radii=[_HUB_RADIUS_M, g.shaft_radius_m],
                centers=[(0.0, 0.0, length / 2.0), (0.0, 0.0, g.ring_arm_m)],
                colors=[_STEEL, _STEEL],
                fill_mode="Solid",
            ),
        )
        self._canvas.fix(
            f"{rotor}/spin/disk",
            rr.Cylinders3D(
                lengths=[0.016, 0.017],
                radii=[_DISK_RADIUS_M, 0.014],
                centers=[(0.0, 0.0, g.disk_arm_m), (0.0, 0.0, g.magnet_arm_m)],
                colors=[_DISK, _MAGNET],
                fill_mode="Solid",
            ),
        )
        self._canvas.fix(
            f"{rotor}/spin/mark",
            rr.LineStrips3D(
                [[(0.0, 0.0, g.disk_arm_m + dz), (_DISK_RADIUS_M, 0.0, g.disk_arm_m + dz)] for dz in (-0.0095, 0.0095)],
                colors=[(255, 255, 255)],
                radii=[0.002],
            ),
        )

    def draw_tilt(self, time_s: float, disk_m: complex) -> None:
        """Draw the rotor tilted so that its disk is at x + j y [m]."""
        tilt = EXAGGERATION * abs(disk_m) / self._geometry.disk_arm_m
        half = 0.5 * math.atan(tilt)
        direction = disk_m / abs(disk_m) if abs(disk_m) > 0.0 else 1.0 + 0.0j
        # Rotate +z towards the displacement, about the axis (-y, x, 0).
        axis = (-direction.imag * math.sin(half), direction.real * math.sin(half), 0.0)
        self._canvas.draw(
            f"{ROOT}/rotor", time_s, rr.Transform3D(quaternion=rr.Quaternion(xyzw=(*axis, math.cos(half))))
        )

    def draw_spin(self, time_s: float, turned_rad: float) -> None:
        """Rotate the rotor by the angle accumulated since the start [rad]; its absolute angle is unknown."""
        half = 0.5 * math.remainder(turned_rad, 4.0 * math.pi)
        turned = rr.Quaternion(xyzw=(0.0, 0.0, math.sin(half), math.cos(half)))
        self._canvas.draw(f"{ROOT}/rotor/spin", time_s, rr.Transform3D(quaternion=turned))

    def draw_contact(self, time_s: float, ring_m: complex, *, touching: bool) -> None:
        """Mark the point of the ring nearest to the shaft at x + j y [m], or remove the mark."""
        g = self._geometry
        path = f"{ROOT}/contact"
        if not touching or ring_m == 0.0:
            self._canvas.draw(path, time_s, rr.Points3D(np.empty((0, 3))))
            return
        at = (g.shaft_radius_m + EXAGGERATION * g.ring_clearance_m) * ring_m / abs(ring_m)
        self._canvas.draw(
            path,
            time_s,
            rr.Points3D([(at.real, at.imag, g.ring_arm_m)], radii=[0.006], colors=[BACKWARD_RGB]),
        )

    def draw_reaction(self, time_s: float, reaction_n: complex) -> None:
        """Draw the force of the shaft on the housings, x + j y [N], at the ring."""
        g = self._geometry
        bore = g.shaft_radius_m + EXAGGERATION * g.ring_clearance_m
        size = abs(reaction_n)
        direction = reaction_n / size if size > 0.0 else 1.0 + 0.0j
        length = FORCE_M_PER_N * size
        self._canvas.draw(
            f"{ROOT}/reaction",
            time_s,
            rr.Arrows3D(
                vectors=[(length * direction.real, length * direction.imag, 0.0)],
                origins=[(bore * direction.real, bore * direction.imag, g.ring_arm_m)],
                colors=[(255, 235, 120)],
                radii=[0.003],
                labels=[f"{size:.0f} N"],
                show_labels=size > 5.0,
            ),
        )
