"""Layout of the Foxglove and Lichtblick apps for the plot messages of a channel table."""

from __future__ import annotations

import json
from typing import Any

from recorder.contents.views import View, Views
from recorder.files.schemas import VIEW_EVENTS
from recorder.foxglove.server import SERVICES, describe_fields
from rig.channels.table import ChannelTable

_WINDOW_S = 5.0
"""Time range of the plots of a live rig [s]."""
_EXAMPLES = {"speed_hz": 6.0, "channel": "disk_x", "kind": "gain", "factor": 1.05, "for_s": 1.0}
"""Values of fields without a default, in the requests of the buttons."""


def make_layout(table: ChannelTable) -> bytes:
    """Return the layout as JSON: plots by unit, events, scene values, and a button for each command."""
    panels: dict[str, dict[str, Any]] = {}
    for view in Views(table, rate_hz=1.0).all:
        panels |= {f"Plot!{name}": plot for name, plot in _make_plots(view).items()}
    plots = [*panels]
    panels["RosOut!events"] = {"topicToRender": VIEW_EVENTS, "minLogLevel": 1}
    panels["Parameters!scene"] = {}
    buttons = [f"CallService!{name}" for name in SERVICES]
    for name in SERVICES:
        request = {field: form.get("default", _EXAMPLES.get(field)) for field, form in describe_fields(name).items()}
        request |= {"factor": _EXAMPLES["factor"]} if name == "fault" else {}
        settings = {"serviceName": name, "requestPayload": json.dumps(request, indent=2), "buttonText": name}
        panels[f"CallService!{name}"] = {**settings, "layout": "vertical", **_make_title(name)}
    right = _stack(["RosOut!events", "Parameters!scene", _stack(buttons, "row")], "column")
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": _stack(plots, "column"), "second": right, "splitPercentage": 65},
    }
    return json.dumps(layout, indent=2).encode() + b"\n"


def _make_plots(view: View) -> dict[str, dict[str, Any]]:
    """Return a plot for each array of a topic, which holds one unit for most channels."""
    plots: dict[str, dict[str, Any]] = {}
    for place, (slot, channel) in enumerate(zip(view.slots, view.channels, strict=True)):
        title = f"{'+'.join(view.groups)} [{channel.unit}]"
        plot = plots.setdefault(title, {**_make_title(title), "xAxisVal": "timestamp", "paths": []})
        plot |= {"followingViewWidth": _WINDOW_S, "showLegend": True, "isSynced": True, "showXAxisLabels": True}
        # The index, because not every program with this layout format can filter parallel arrays by name.
        path = f'"{view.topic}".{slot}[{place}]'
        plot["paths"].append({"value": path, "label": channel.name, "enabled": True, "timestampMethod": "receiveTime"})
    return plots


def _make_title(title: str) -> dict[str, str]:
    """Return the title of a panel, as Foxglove and as Lichtblick name it."""
    return {"foxglovePanelTitle": title, "lichtblickPanelTitle": title}


def _stack(parts: list[Any], direction: str) -> Any:
    """Return parts of equal size side by side (`row`) or below each other (`column`)."""
    if len(parts) == 1:
        return parts[0]
    second = _stack(parts[1:], direction)
    return {"direction": direction, "first": parts[0], "second": second, "splitPercentage": 100.0 / len(parts)}
