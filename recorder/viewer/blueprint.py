"""Layout of the viewer."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr
import rerun.blueprint as rrb

from recorder.viewer import canvas, painter
from recorder.viewer.drawings import contact, marks, orbit, scene3d, series, spectrum
from recorder.viewer.drawings.geometry import Geometry
from rig.base.errors import InputError
from rig.channels.table import ChannelTable

LIVE_S = 10.0
"""Time span of the time series in a live view [s]."""
_BACKGROUND = (16, 18, 23)
_LOW_PLOTS = ("Spin speed [Hz]", "Hammer [N]")
"""Plots of reduced height."""
_Column = tuple[list[tuple[rrb.View | rrb.Container, float]], float]
"""Views with their heights, and the width of the column."""


def layout(table: ChannelTable, geometry: Geometry, *, live: bool, only: str | None = None) -> rrb.Blueprint:
    """Return the layout of the views of a recording or of the running rig.

    Args:
        table: Channels; views without a channel are left out.
        geometry: Clearances and arms of the rig.
        live: Whether time series show the last `LIVE_S` seconds.
        only: Part of the titles of the views to show, in any case; None for all views.

    Raises:
        InputError: No title contains `only`.
    """
    curves = _curve_views(table, geometry, live=live)
    small = [curves.pop(name) for name in _LOW_PLOTS if name in curves]
    planes = [plane for plane in orbit.PLANES if plane in painter.find_table_planes(table)]
    # Views with their heights. An imported log with other channels gets only the views that it has data for.
    motion: list[tuple[rrb.View | rrb.Container, float]] = []
    frequency: list[tuple[rrb.View | rrb.Container, float]] = []
    if planes:
        motion.append((rrb.Horizontal(*(_orbit_view(plane, geometry) for plane in planes)), 5.2))
        frequency += [(_spectrum_view(), 3.6), (_waterfall_view(), 5.0), (_contact_view(live=live), 2.6)]
    if planes or "speed" in table.channels:
        motion.append((_scene_view(), 5.0))
    if small:
        motion.append((rrb.Horizontal(*small), 2.6))
    frequency += [(_marks_view(live=live), 1.8), (_events_view(), 2.6)]
    columns: list[_Column] = [(motion, 5.2), ([(view, 1.0) for view in curves.values()], 5.0), (frequency, 4.6)]
    if only is not None:
        columns = [([(view, 1.0) for view in _views_titled(only, columns)], 1.0)]
    columns = [(views, share) for views, share in columns if views]
    return rrb.Blueprint(
        rrb.Horizontal(
            *(
                rrb.Vertical(*(view for view, _ in views), row_shares=[height for _, height in views])
                for views, _ in columns
            ),
            column_shares=[share for _, share in columns],
        ),
        rrb.TimePanel(
            timeline=canvas.SIMULATED,
            state="collapsed",
            play_state="following" if live else "playing",
            playback_speed=1.0,
        ),
        rrb.TopPanel(state="expanded" if only is None else "hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _views_titled(text: str, columns: list[_Column]) -> list[rrb.View | rrb.Container]:
    """Return the views whose title contains a text."""
    rows = [row for views, _ in columns for row, _ in views]
    views = [view for row in rows for view in (row.contents if isinstance(row, rrb.Container) else [row])]
    shown = [view for view in views if text.strip() and text.lower() in str(view.name).lower()]
    if not shown:
        raise InputError("--only", f"part of a title: {'; '.join(str(view.name) for view in views)}", text)
    return shown


def _spectrum_view() -> rrb.BarChartView:
    return rrb.BarChartView(
        origin=f"{spectrum.ROOT}/now",
        name="Full spectrum at the ring [mm] over [Hz]: backward < 0",
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _waterfall_view() -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin=spectrum.WATERFALL,
        name="Waterfall of the full spectrum [dB re 1 um]",
        visual_bounds=rrb.VisualBounds2D(x_range=[-34, 216], y_range=[-18, spectrum.HEIGHT + 26]),
        background=_BACKGROUND,
    )


def _events_view() -> rrb.TextLogView:
    return rrb.TextLogView(
        origin=painter.EVENTS,
        name="Events",
        columns=rrb.TextLogColumns(timeline_columns=[canvas.SIMULATED], text_log_columns=["loglevel", "body"]),
    )


def _orbit_view(plane: str, geometry: Geometry) -> rrb.Spatial2DView:
    limit = 1.9 * geometry.clearance_mm(plane)
    return rrb.Spatial2DView(
        origin=f"{orbit.ROOT}/{plane}",
        name=f"Orbit at the {plane} [mm]",
        visual_bounds=rrb.VisualBounds2D(x_range=[-limit, limit], y_range=[-limit, limit]),
        background=_BACKGROUND,
    )


def _scene_view() -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin=scene3d.ROOT,
        name=f"Rig, displacements x {scene3d.EXAGGERATION:g}",
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind="Orbital", position=(-0.26, 0.11, 0.38), look_target=(0.0, -0.004, 0.205), eye_up=(0.0, 1.0, 0.0)
        ),
    )


def _curve_views(table: ChannelTable, geometry: Geometry, *, live: bool) -> dict[str, rrb.TimeSeriesView]:
    """Return the time series plots by title, limited to the channels of the table."""
    # Titles name the colours, because a legend would hide the first impacts.
    plots = {
        "Ring [mm]: x blue, y amber": [f"{series.ROOT}/probes/ring"],
        "Disk [mm]: x blue, y amber": [f"{series.ROOT}/probes/disk"],
        "Reaction [N]: x = E - W blue, y = N - S amber": [series.REACTION],
        "Forces [N]: N blue, S dark blue, E amber, W brown": [f"{series.ROOT}/forces/P"],
        "Accelerations [m/s²]: x blue, y amber, outer housing darker": [
            f"{series.ROOT}/accelerations/inner",
            f"{series.ROOT}/accelerations/outer",
        ],
        "Spin speed [Hz]": [f"{series.ROOT}/drive/speed"],
        "Hammer [N]": [f"{series.ROOT}/hammer/hammer"],
    }
    limits = {f"{series.ROOT}/probes/{plane}": 1.15 * geometry.clearance_mm(plane) for plane in orbit.PLANES}
    drawn = series.get_paths(table)
    planned = {path for paths in plots.values() for path in paths}
    views = {
        title: _curve_view(title, [path for path in paths if path in drawn], limit=limits.get(paths[0]), live=live)
        for title, paths in plots.items()
        if set(paths) & set(drawn)
    }
    others = {path.removeprefix(f"{series.ROOT}/"): path for path in drawn if path not in planned}
    return views | {
        title: _curve_view(title, [path], limit=None, live=live, legend=True) for title, path in others.items()
    }


def _curve_view(
    title: str, paths: Sequence[str], *, limit: float | None, live: bool, legend: bool = False
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"+ {path}" for path in paths],
        name=title,
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=legend),
        axis_x=_time_axis(live=live),
        axis_y=None if limit is None else rrb.ScalarAxis(range=(-limit, limit)),
    )


def _contact_view(*, live: bool) -> rrb.StateTimelineView:
    return rrb.StateTimelineView(
        origin="/contact",
        contents=[f"+ {contact.SENSED}", f"+ {contact.TRUTH}"],
        name="Contact at the ring: from probes, and from the model if available",
        time_view=_time_axis(live=live),
    )


def _marks_view(*, live: bool) -> rrb.StateTimelineView:
    return rrb.StateTimelineView(
        origin=marks.ROOT, contents=[f"+ {marks.ROOT}/**"], name="Commands and faults", time_view=_time_axis(live=live)
    )


def _time_axis(*, live: bool) -> rrb.TimeAxis:
    if not live:
        return rrb.TimeAxis(link="LinkToGlobal")
    past = rr.TimeRange(
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-LIVE_S),
        end=rr.TimeRangeBoundary.cursor_relative(seconds=0.0),
    )
    return rrb.TimeAxis(view_range=past, zoom_lock=False)
