"""Turns samples and events into everything that the viewer shows; the same for a file and for a running rig."""

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
from recorder.viewer.drawings.series import REACTIONS, SeriesPlot, Span, reaction_of
from recorder.viewer.drawings.spectrum import SpectrumPlot
from rig.channels.table import ChannelTable, Group

EVENTS = "/events"
FRAME_S = 0.04
"""Orbits and the 3-D rig are drawn at 25 Hz."""
SPECTRUM_EVERY = 5
"""Least number of frames for a spectrum: 5 Hz."""
AROUND_HAMMER_S = 0.05
HELD_S = AROUND_HAMMER_S + 0.02
"""Live curves lag by this much, so that a hammer pulse still finds the rows before it at full rate."""

_LEVELS = {schemas.LOG_INFO: "INFO", schemas.LOG_WARN: "WARN", schemas.LOG_ERROR: "ERROR"}
_SLOW_ROWS_PER_S = 200.0


@dataclass(frozen=True, slots=True)
class _Plane:
    """The two probes of a measuring plane within their group."""

    name: str
    x: int
    y: int
    millimetres: float

    def z(self, values: np.ndarray) -> np.ndarray:
        """X + j y [mm], shape (n,)."""
        return (values[:, self.x] + 1j * values[:, self.y]) * self.millimetres


def planes_of(group: Group) -> list[_Plane]:
    """The measuring planes that a group holds, in the order of `orbit.PLANES`."""
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


def planes_in(table: ChannelTable) -> set[str]:
    """Names of the measuring planes that some channels have."""
    return {plane.name for group in table.groups.values() for plane in planes_of(group)}


def not_drawn(table: ChannelTable) -> list[str]:
    """What of a rig cannot be drawn of other channels, such as those of an imported log, and why."""
    lacking = []
    if not planes_in(table):
        pairs = " or ".join(f"{plane}_x and {plane}_y" for plane in orbit.PLANES)
        lacking.append(f"orbit, spectrum, contact (no channels {pairs})")
    if not any(set(group.names) >= REACTIONS for group in table.groups.values()):
        lacking.append("reaction (no channels P_N, P_S, P_E and P_W in one group)")
    if "speed" not in table.channels:
        lacking.append("turning of the rotor (no channel speed)")
    return lacking


class Painter:
    """Draws on a canvas what it is fed, each group in order of time.

    `add` takes samples, `frame` draws what belongs to one instant (orbits, spectrum, 3-D rig), `flush` draws the
    curves, `close` draws what is left.
    """

    def __init__(
        self,
        canvas: Canvas,
        table: ChannelTable,
        geometry: Geometry,
        *,
        rows_per_s: float,
        whole: bool,
        held_s: float = HELD_S,
        frame_s: float = FRAME_S,
    ) -> None:
        """Prepare the canvas.

        Args:
            canvas: Where to draw.
            table: The channels that will be fed.
            geometry: Lengths of the rig.
            rows_per_s: Points of each curve per simulated second [Hz]; full rate around hammer pulses.
            whole: A file, drawn from its start to its end, in contrast to a stream.
            held_s: How long curves wait for a hammer pulse that is not known yet [s].
            frame_s: Least time between two frames [s].
        """
        self._canvas = canvas
        self._held_s = held_s
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
            name: _parts_of(group, canvas, self._scene, geometry, whole=whole, frame_s=frame_s)
            for name, group in table.groups.items()
        }
        self._groups = table.groups
        self._marks = Marks(canvas)
        self._truth = ContactPlot(canvas, path=contact.TRUTH, touch=Touch(enter=1e-9, leave=1e-9))
        if geometry.assumed and planes_in(table):
            names = ", ".join(geometry.assumed)
            self.note(0.0, f"the stream does not give {names}: usual values are drawn", level="WARN")

    @property
    def points(self) -> int:
        """Values of curves drawn so far."""
        return sum(curves.points for curves in self._curves.values())

    @property
    def now_s(self) -> float:
        """Time of the latest row [s]."""
        return max(self._last_s.values(), default=0.0)

    @property
    def last_contact_s(self) -> float | None:
        """The last instant at which the probes saw contact [s]."""
        seen = [part.last_contact_s for parts in self._parts.values() for part in parts if isinstance(part, _Probes)]
        return max((time for time in seen if time is not None), default=None)

    def add(self, name: str, times_s: np.ndarray, values: np.ndarray) -> None:
        """Take consecutive rows of a group.

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
        """Take the contact's true normal force [N], shape (n,): drawn on a marked path, apart from what is sensed."""
        if len(times_s):
            self._truth.add(times_s, normal_force_n)

    def add_event(self, event: Mapping[str, Any]) -> None:
        """Take an event of the stream."""
        name = str(event.get("event", "event"))
        time_s = float(event.get("time_s") or 0.0)
        if name == "hammer":
            self._windows.append((time_s - AROUND_HAMMER_S, time_s + AROUND_HAMMER_S))
        self._marks.take(event, time_s)
        level, text = schemas.event_text(dict(event))
        self.note(time_s, text, level=_LEVELS[level])

    def note(self, time_s: float, text: str, *, level: str = "INFO") -> None:
        """Write a line into the log of events."""
        self._canvas.draw(EVENTS, time_s, rr.TextLog(text, level=level))

    def frame(self, name: str) -> None:
        """Draw what a group's latest rows show at their instant."""
        if name in self._last_s:
            for part in self._parts[name]:
                part.draw(self._last_s[name])

    def flush(self, *, most: int | None = None) -> None:
        """Draw all curves as far as they are settled, with `most` points each outside of hammer pulses."""
        for name, curves in self._curves.items():
            if name in self._last_s:
                curves.flush(until_s=self._last_s[name] - self._held_s, windows=self._windows, most=most)
        self._flush_contact()
        if self._last_s and not self._whole:
            oldest = min(self._last_s.values()) - self._held_s - 1.0
            self._windows = [window for window in self._windows if window[1] > oldest]

    def fold(self, *, most: int) -> None:
        """Thin what waits for `flush` to `most` points of each curve outside of hammer pulses."""
        for name, curves in self._curves.items():
            if name in self._last_s:
                curves.fold(until_s=self._last_s[name] - self._held_s, windows=self._windows, most=most)

    def close(self) -> None:
        """Draw what is still held."""
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
        struck = times_s[np.abs(values[:, 0]) > threshold]
        if len(struck):
            self._windows.append((float(struck[0]) - AROUND_HAMMER_S, float(struck[-1]) + AROUND_HAMMER_S))


def _is_fast(group: Group) -> bool:
    """Whether curves have detail at all times: speed has none, and the hammer is drawn at full rate when it strikes."""
    return group.name not in {"drive", "hammer"}


class _Part:
    """Something that is drawn from one group besides its curves."""

    last_contact_s: float | None = None

    def add(self, times_s: np.ndarray, values: np.ndarray) -> None:
        """Take rows."""

    def draw(self, time_s: float) -> None:
        """Draw the latest instant."""

    def flush(self) -> None:
        """Draw what was collected."""

    def interrupt(self) -> None:
        """Rows are missing before the next ones."""

    def close(self) -> None:
        """Draw what is known at the end only."""


class _Probes(_Part):
    """Orbits, spectrum, contact and the rotor's tilt."""

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
        # The ring's plane shows most; a rig with probes at the disk only shows the same whirl there.
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
    """The arrow of the reaction."""

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
    """The turning of the rotor."""

    def __init__(self, scene: Scene3D, group: Group) -> None:
        self._scene = scene
        self._column = group.names.index("speed")
        self._rad_per_row = group.channels[self._column].si / group.rate_hz
        self._turned_rad = 0.0

    def add(self, times_s: np.ndarray, values: np.ndarray) -> None:
        self._turned_rad += float(values[:, self._column].sum()) * self._rad_per_row

    def draw(self, time_s: float) -> None:
        self._scene.draw_spin(time_s, self._turned_rad)


def _parts_of(
    group: Group, canvas: Canvas, scene: Scene3D, geometry: Geometry, *, whole: bool, frame_s: float
) -> list[_Part]:
    parts: list[_Part] = []
    if planes := planes_of(group):
        parts.append(_Probes(canvas, scene, group, planes, geometry, whole=whole, frame_s=frame_s))
    if set(group.names) >= REACTIONS:
        parts.append(_Reaction(scene, reaction_of(group)))
    if "speed" in group.names:
        parts.append(_Spin(scene, group))
    return parts
