"""A user's own channels: `channels = "mine.toml"` in a scene, `--channels mine.toml` on a command line.

The file says what is different from the built-in table (`rig/channels.toml`), or, with `base = "none"`, all there is:

    drop = ["accelerations", "hammer"]          # groups or channels that are left out

    [channels.disk_x]                           # other numbers of a channel that there is
    sensitivity_v = 4.5

    [groups.probes]                             # of a group that there is; `channels` are added to it
    rate_hz = 51200

    [groups.bearing]                            # a new one
    rate_hz = 51200
    defaults = { unit = "mm", si = 1e-3, sensitivity_v = 3.94, bias_v = -10, range_v = [-18, -2], adc_v = 20 }
    channels = [
        { name = "bearing_45", signal = "along(shaft_x(0.35), shaft_y(0.35), 45) + runout(theta)" },
    ]

    [curves]
    runout = "runout.csv"                       # degrees, value in SI; or the points themselves

What a new channel does not say is in `_PLAIN`; a bandwidth that nobody gave is at most a quarter of the rate.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from rig.channels import TABLE, ChannelTable, raw_groups, table_of
from rig.errors import InputError, UnknownNameError, Words
from rig.outside import Written, check, open_file, read_toml

KIND = "user"
"""Provenance of what stands in such a file."""
_PLAIN: dict[str, Any] = {
    "bias_v": 0.0, "range_v": [-10.0, 10.0], "highpass_hz": 0.0, "noise_v": 0.0, "adc_v": 10.0, "adc_bits": 24,
}  # fmt: skip
_RATE_HZ = 20_000
MOST_HZ = 130_000.0
"""Largest bandwidth: what rows of 1 us can show [Hz]."""
_MOST = 512
"""Most channels of a table."""


def _identifier(name: str) -> str:
    if not (name.isascii() and name.isidentifier() and len(name) <= 28):
        raise ValueError("a name of letters, digits and _, 28 at most, as buses and files have them")
    return name


_Name = Annotated[str, AfterValidator(_identifier)]


class _Row(Written):
    """A new channel; numbers are checked where the whole table is."""

    model_config = Written.model_config | {"extra": "allow"}

    name: _Name


class _Group(Written):
    """A group, or what is different of one."""

    title: str | None = None
    rate_hz: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    defaults: dict[str, Any] = Field(default={})
    channels: tuple[_Row, ...] = ()


class _File(Written):
    base: Literal["rig", "none"] = "rig"
    drop: tuple[str, ...] = ()
    channels: dict[str, dict[str, Any]] = Field(default={})
    groups: dict[_Name, _Group] = Field(default={})
    curves: dict[_Name, str | tuple[tuple[float, float], ...]] = Field(default={})


def read_channels(path: Path) -> ChannelTable:
    """The channel table that a user's file makes.

    Raises:
        InputError: The first thing that is wrong in it: its channel and field, behind the file's name.
    """
    try:
        file = check(_File, read_toml(path), field="")
        curves = {name: _curve(name, given, path.parent) for name, given in file.curves.items()}
        table = table_of(_merged(file), curves)
        for channel in table.channels.values():
            if channel.bandwidth_hz > MOST_HZ:
                raise InputError(f"channel {channel.name}.bandwidth_hz", f"at most {MOST_HZ:g}", channel.bandwidth_hz)
        return table
    except InputError as error:
        field = error.field if error.field.startswith(str(path)) else f"{path.name}: {error.field}"
        raise InputError(field, error.must, error.received) from None


def _merged(file: _File) -> dict[str, Any]:
    """The groups of the table, with whole rows."""
    groups = raw_groups(TABLE.read_text()) if file.base == "rig" else {}
    given: dict[str, set[str]] = {}
    """What the file says of each channel."""
    said = [(f"groups.{name}.defaults", group.defaults) for name, group in file.groups.items()]
    said += [(f"channel {row.name}", row.model_dump()) for group in file.groups.values() for row in group.channels]
    for where, fields in [*said, *((f"channels.{name}", changes) for name, changes in file.channels.items())]:
        for name in {"rate_hz", "group", "kind"} & set(fields):
            raise InputError(f"{where}.{name}", "left out: it is the group's", fields[name])
    for name, group in file.groups.items():
        if name not in groups and not group.channels:
            raise InputError(f"groups.{name}.channels", "given, as there is no such group yet", None)
        whole = groups.setdefault(name, {"title": name, "rate_hz": _RATE_HZ, "kind": KIND, "channels": []})
        whole |= group.model_dump(include={"title", "rate_hz"}, exclude_none=True)
        old = whole["channels"]
        alike = (
            {key: value for key, value in old[0].items() if all(row[key] == value for row in old)} if old else _PLAIN
        )
        for row in old:
            row |= group.defaults
            given.setdefault(row["name"], set()).update(group.defaults, {"rate_hz"} if group.rate_hz else ())
        for row in group.channels:
            own = {**group.defaults, **row.model_dump()}
            whole["channels"].append({"label": row.name, **alike, **own})
            given.setdefault(row.name, set()).update(own)
    rows = {row["name"]: row for group in groups.values() for row in group["channels"]}
    for name, changes in file.channels.items():
        if name not in rows:
            raise UnknownNameError(f"channels.{name}", "the name of a channel that there is", name, rows)
        if "name" in changes:
            raise InputError(f"channels.{name}.name", "left out: drop the channel and add another", changes["name"])
        rows[name] |= changes
        given.setdefault(name, set()).update(changes)
    for name in file.drop:
        if name not in groups and name not in rows:
            raise UnknownNameError("drop", "names of groups or channels", name, [*groups, *rows])
    for name, group in list(groups.items()):
        group["channels"] = [row for row in group["channels"] if not {name, row["name"]} & {*file.drop}]
        if not group["channels"]:
            del groups[name]
        for row in group["channels"]:
            if "bandwidth_hz" not in given.get(row["name"], ()):
                row["bandwidth_hz"] = min(row.get("bandwidth_hz", math.inf), group["rate_hz"] / 4.0)
            row |= {"kind": KIND} if given.get(row["name"]) else {}
    if not groups:
        raise InputError("drop", "such that a channel is left", list(file.drop))
    if sum(len(group["channels"]) for group in groups.values()) > _MOST:
        raise InputError("groups", f"of at most {_MOST} channels together", Words("more"))
    return groups


def _curve(name: str, given: str | tuple[tuple[float, float], ...], folder: Path) -> tuple[tuple[float, float], ...]:
    """The points of a curve, from its file or as they are given: degrees from 0 up to 360, and finite values."""
    field = f"curves.{name}"
    if not isinstance(given, str):
        points = given
    else:
        try:
            with open_file(folder / given) as file:
                table = np.loadtxt(file, delimiter=",", comments="#", ndmin=2, max_rows=10_001)
        except OSError as error:
            raise InputError(field, "a file that can be read, degrees and values", Words(error.strerror)) from None
        except ValueError as error:
            raise InputError(field, "a file of lines `degrees, value`", Words(str(error))) from None
        if table.shape[1] != 2:
            raise InputError(field, "a file of lines `degrees, value`", Words(f"{table.shape[1]} columns"))
        points = tuple((float(a), float(b)) for a, b in table)
    degrees = [a for a, _ in points]
    if not 2 <= len(points) <= 10_000 or any(b <= a for a, b in pairwise(degrees)):
        raise InputError(field, "2 to 10000 points of ascending angle", Words(f"{len(points)} points"))
    if not (degrees[0] >= 0.0 and degrees[-1] < 360.0 and all(math.isfinite(value) for _, value in points)):
        raise InputError(field, "points from 0 to below 360 degrees with finite values", [points[0], points[-1]])
    return points
