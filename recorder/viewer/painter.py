"""Painter: draws samples and events as orbits, spectra, curves, contact and 3-D rig, for files and live views."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from recorder.files import schemas
from recorder.viewer.canvas import Canvas
from recorder.viewer.drawings import contact, orbit
from recorder.viewer.drawings.contact import ContactPlot, Touch
from recorder.viewer.drawings.geometry import Geometry
from recorder.viewer.drawings.marks import Marks
from recorder.viewer.drawings.orbit import OrbitPlot
from recorder.viewer.drawings.scene3d import Scene3D
from recorder.viewer.drawings.series import REACTIONS, SeriesPlot, Span, find_reaction
from recorder.viewer.drawings.spectrum import SpectrumPlot
from rig.channels.table import ChannelTable, Group

EVENTS = "/events"
FRAME_S = 0.04
"""Time between two frames of orbits and 3-D rig [s]."""
SPECTRUM_EVERY = 5
"""Frames per spectrum; gives 5 Hz."""
HAMMER_MARGIN_S = 0.05
"""Time before and after a hammer pulse with curves at full rate [s]."""
HOLD_S = HAMMER_MARGIN_S + 0.02
"""Delay of live curves [s], so that the rows before a hammer pulse are still available at full rate."""

_LEVELS = {schemas.LOG_INFO: "INFO", schemas.LOG_WARN: "WARN", schemas.LOG_ERROR: "ERROR"}
_SLOW_ROWS_PER_S = 200.0
"""Points per second of curves without fast detail [Hz]."""


@dataclass(frozen=True, slots=True)
class _Plane:
    """Column pair of the two probes of a measuring plane."""

    name: str
    x: int
    y: int
    millimetres: float

    def z(self, values: np.ndarray) -> np.ndarray:
        """Return x + j y [mm], shape (n,)."""
        return (values[:, self.x] + 1j * values[:, self.y]) * self.millimetres


def find_group_planes(group: Group) -> list[_Plane]:
    """Return the measuring planes of a group, in the order of `orbit.PLANES`."""
    return [
        _Plane(
            name=plane,
            x=group.names.index(f"{plane}_x"),
            y=group.names.index(f"{plane}_y"),
            millimetres=group.channels[group.names.index(f"{plane}_x")].si * 1e3,
        )
        for plane in orbit.PLANES
        if {f"{plane}_x", f"{plane}_y"} <= set(group.names)
    ]


def find_table_planes(table: ChannelTable) -> set[str]:
    """Return the names of the measuring planes in a channel table."""
    return {plane.name for group in table.groups.values() for plane in find_group_planes(group)}


def list_missing_views(table: ChannelTable) -> list[str]:
    """Return the drawings that a channel table, such as that of an imported log, does not support, with reasons."""
    missing = []
    if not find_table_planes(table):
        pairs = " or ".join(f"{plane}_x and {plane}_y" for plane in orbit.PLANES)
        missing.append(f"orbit, spectrum, contact (no channels {pairs})")
    if not any(set(group.names) >= REACTIONS for group in table.groups.values()):
        missing.append("reaction (no channels P_N, P_S, P_E and P_W in one group)")
    if "speed" not in table.channels:
        missing.append("turning of the rotor (no channel speed)")
    return missing


class Painter:
    """Painter of samples, each group in order of time.

    `add` adds samples, `frame` draws one instant (orbits, spectrum, 3-D rig), `flush` draws the curves, `close` draws
    the rest.
    """

    def __init__(
        self,
        canvas: Canvas,
        table: ChannelTable,
        geometry: Geometry,
        *,
        rows_per_s: float,
        whole: bool,
        hold_s: float = HOLD_S,
        frame_s: float = FRAME_S,
    ) -> None:
        """Prepare the canvas.

        Args:
            canvas: Canvas to draw on.
            table: Channel table of the samples.
            geometry: Lengths of the rig.
            rows_per_s: Points of each curve per simulated second [Hz], except for full rate around hammer pulses.
            whole: Whether a complete file is drawn, not a live stream.
            hold_s: Time that curves wait for a hammer pulse still to come [s].
            frame_s: Shortest time between two frames [s].
        """
        self._canvas = canvas
        self._held_s = hold_s
        self._whole = whole
        self._last_s: dict[str, float] = {}
        self._windows: list[Span] = []
        self._curves = {
            name: SeriesPlot(
                canvas, group, rows_per_s=rows_per_s if _is_fast(group) else min(rows_per_s, _SLOW_ROWS_PER_S)
            )
            for name, group in table.groups.items()
        }
        self._scene = Scene3D(canvas, geometry)
        self._parts = {
            name: _build_parts(group, canvas, self._scene, geometry, whole=whole, frame_s=frame_s)
            for name, group in table.groups.items()
        }
        self._groups = table.groups
        self._marks = Marks(canvas)
        self._truth = ContactPlot(canvas, path=contact.TRUTH, touch=Touch(enter=1e-9, leave=1e-9))
        if geometry.assumed and find_table_planes(table):
            names = ", ".join(geometry.assumed)
            self.note(0.0, f"the stream does not state {names}: drawn with default values", level="WARN")

    @property
    def points(self) -> int:
        """Number of curve values drawn."""
        return sum(curves.points for curves in self._curves.values())

    @property
    def now_s(self) -> float:
        """Time of the latest row [s]."""
        return max(self._last_s.values(), default=0.0)

    @property
    def last_contact_s(self) -> float | None:
        """Last instant of contact sensed by the probes [s]; None without contact."""
        contact_times = [
            part.last_contact_s for parts in self._parts.values() for part in parts if isinstance(part, _Probes)
        ]
        return max((time for time in contact_times if time is not None), default=None)

    def add(self, name: str, times_s: np.ndarray, values: np.ndarray) -> None:
        """Add consecutive rows of a group.

        Args:
            name: The group.
            times_s: Simulated times [s], shape (n,).
            values: Engineering values, shape (n, channels).
        """
        if not len(times_s):
            return
        period = 1.0 / self._groups[name].rate_hz
        if name in self._last_s and abs(times_s[0] - self._last_s[name] - period) > 0.5 * period:
            self._curves[name].lift(at_s=self._last_s[name] + period, windows=self._windows)
            for part in self._parts[name]:
                part.interrupt()
        self._last_s[name] = float(times_s[-1])
        self._curves[name].add(times_s, values)
        for part in self._parts[name]:
            part.add(times_s, values)
        if name == "hammer":
            self._watch_hammer(self._groups[name], times_s, values)

    def add_truth(self, times_s: np.ndarray, normal_force_n: np.ndarray) -> None:
        """Add the contact's true normal force [N], shape (n,), drawn on a separate path from the sensed contact."""
        if len(times_s):
            self._truth.add(times_s, normal_force_n)

    def add_event(self, event: Mapping[str, Any]) -> None:
        """Draw an event."""
        name = str(event.get("event", "event"))
        time_s = float(event.get("time_s") or 0.0)
        if name == "hammer":
            self._windows.append((time_s - HAMMER_MARGIN_S, time_s + HAMMER_MARGIN_S))
        self._marks.take(event, time_s)
        level, text = schemas.event_text(dict(event))
        self.note(time_s, text, level=_LEVELS[level])

    def note(self, time_s: float, text: str, *, level: str = "INFO") -> None:
        """Write a line to the event log."""
        self._canvas.draw(EVENTS, time_s, rr.TextLog(text, level=level))

    def frame(self, name: str) -> None:
        """Draw the latest instant of a group."""
        if name in self._last_s:
            for part in self._parts[name]:
                part.draw(self._last_s[name])

    def flush(self, *, most: int | None = None) -> None:
        """Draw all final curve points, at most `most` per curve outside hammer pulses."""
        for name, curves in self._curves.items():
            if name in self._last_s:
                curves.flush(until_s=self._last_s[name] - self._held_s, windows=self._windows, most=most)
        self._flush_contact()
        if self._last_s and not self._whole:
            oldest = min(self._last_s.values()) - self._held_s - 1.0
            self._windows = [window for window in self._windows if window[1] > oldest]

    def fold(self, *, most: int) -> None:
        """Reduce the pending points to `most` per curve outside hammer pulses."""
        for name, curves in self._curves.items():
            if name in self._last_s:
                curves.fold(until_s=self._last_s[name] - self._held_s, windows=self._windows, most=most)

    def close(self) -> None:
        """Draw all remaining data."""
        for name, curves in self._curves.items():
            curves.flush(until_s=np.inf, windows=self._windows, rest=True)
            for part in self._parts[name]:
                part.close()
        self._flush_contact()

    def _flush_contact(self) -> None:
        self._truth.flush()
        for parts in self._parts.values():
            for part in parts:
                part.flush()

    def _watch_hammer(self, group: Group, times_s: np.ndarray, values: np.ndarray) -> None:
        channel = group.channels[0]
        threshold = max(1.0, 20.0 * channel.noise_v / abs(channel.sensitivity_v))
        pulse_s = times_s[np.abs(values[:, 0]) > threshold]
        if len(pulse_s):
            self._windows.append((float(pulse_s[0]) - HAMMER_MARGIN_S, float(pulse_s[-1]) + HAMMER_MARGIN_S))


def _is_fast(group: Group) -> bool:
    """Return whether a group's curves need detail at all times; hammer pulses are drawn at full rate anyway."""
    return group.name not in {"drive", "hammer"}


class _Part:
    """Drawing of one group other than its curves."""

    last_contact_s: float | None = None

    def add(self, times_s: np.ndarray, values: np.ndarray) -> None:
        """Add rows."""

    def draw(self, time_s: float) -> None:
        """Draw the latest instant."""

    def flush(self) -> None:
        """Draw the collected data."""

    def interrupt(self) -> None:
        """Handle missing rows before the next ones."""

    def close(self) -> None:
        """Draw what requires the complete data."""


class _Probes(_Part):
    """Orbits, spectrum, contact and tilt of the rotor."""

    def __init__(
        self,
        canvas: Canvas,
        scene: Scene3D,
        group: Group,
        planes: list[_Plane],
        geometry: Geometry,
        *,
        whole: bool,
        frame_s: float,
    ) -> None:
        self._scene = scene
        self._planes = {plane.name: plane for plane in planes}
        self._orbits = {
            plane.name: OrbitPlot(
                canvas, plane=plane.name, clearance_mm=geometry.clearance_mm(plane.name), rate_hz=group.rate_hz
            )
            for plane in planes
        }
        # The ring plane is preferred; with probes only at the disk, the same whirl is visible there.
        self._main = planes[0]
        self._spectrum = SpectrumPlot(canvas, rate_hz=group.rate_hz, interval_s=frame_s * SPECTRUM_EVERY, whole=whole)
        self._contact = None
        if "ring" in self._planes:
            clearance = geometry.clearance_mm("ring")
            resolution = contact.resolution_mm(group.channels[self._planes["ring"].x])
            touch = Touch(enter=clearance - resolution, leave=clearance - 2.0 * resolution)
            self._contact = ContactPlot(canvas, path=contact.SENSED, touch=touch)
        self._geometry = geometry
        self._z = {plane.name: 0j for plane in planes}

    def add(self, times_s: np.ndarray, values: np.ndarray) -> None:
        for name, plane in self._planes.items():
            z = plane.z(values)
            self._z[name] = complex(z[-1])
            self._orbits[name].add(z)
            if plane is self._main:
                self._spectrum.add(z)
            if name == "ring" and self._contact is not None:
                self._contact.add(times_s, np.abs(z))
                self.last_contact_s = self._contact.last_contact_s

    def draw(self, time_s: float) -> None:
        for plot in self._orbits.values():
            plot.draw(time_s)
        arms = {"ring": self._geometry.ring_arm_m, "disk": self._geometry.disk_arm_m}
        plane = "disk" if "disk" in self._z else "ring"
        self._scene.draw_tilt(time_s, 1e-3 * self._z[plane] * self._geometry.disk_arm_m / arms[plane])
        if self._contact is not None:
            self._scene.draw_contact(time_s, 1e-3 * self._z["ring"], touching=self._contact.touching)
        self._spectrum.draw(time_s)

    def flush(self) -> None:
        if self._contact is not None:
            self._contact.flush()

    def interrupt(self) -> None:
        for plot in self._orbits.values():
            plot.interrupt()
        self._spectrum.interrupt()
        if self._contact is not None:
            self._contact.interrupt()

    def close(self) -> None:
        self._spectrum.close()


class _Reaction(_Part):
    """Arrow of the reaction force."""

    def __init__(self, scene: Scene3D, reaction: Callable[[np.ndarray], np.ndarray]) -> None:
        self._scene = scene
        self._reaction = reaction
        self._latest_n = 0j

    def add(self, times_s: np.ndarray, values: np.ndarray) -> None:
        x, y = self._reaction(values[-1:])[0]
        self._latest_n = complex(x, y)

    def draw(self, time_s: float) -> None:
        self._scene.draw_reaction(time_s, self._latest_n)


class _Spin(_Part):
    """Rotation of the rotor."""

    def __init__(self, scene: Scene3D, group: Group) -> None:
        self._scene = scene
        self._column = group.names.index("speed")
        self._rad_per_row = group.channels[self._column].si / group.rate_hz
        self._turned_rad = 0.0

    def add(self, times_s: np.ndarray, values: np.ndarray) -> None:
        self._turned_rad += float(values[:, self._column].sum()) * self._rad_per_row

    def draw(self, time_s: float) -> None:
        self._scene.draw_spin(time_s, self._turned_rad)


def _build_parts(
    group: Group, canvas: Canvas, scene: Scene3D, geometry: Geometry, *, whole: bool, frame_s: float
) -> list[_Part]:
    parts: list[_Part] = []
    if planes := find_group_planes(group):
        parts.append(_Probes(canvas, scene, group, planes, geometry, whole=whole, frame_s=frame_s))
    if set(group.names) >= REACTIONS:
        parts.append(_Reaction(scene, find_reaction(group)))
    if "speed" in group.names:
        parts.append(_Spin(scene, group))
    return parts
