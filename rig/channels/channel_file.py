"""User-defined channels: `channels = "mine.toml"` in a scene, `--channels mine.toml` on a command line.

The file states the differences from the built-in table (`channels.toml` in this folder) or, with `base = "none"`, the
whole table:

    drop = ["accelerations", "hammer"]          # groups or channels to leave out

    [channels.disk_x]                           # changes to an existing channel
    sensitivity_v = 4.5

    [groups.probes]                             # changes to an existing group; `channels` are added to it
    rate_hz = 51200

    [groups.bearing]                            # a new group
    rate_hz = 51200
    defaults = { unit = "mm", si = 1e-3, sensitivity_v = 3.94, bias_v = -10, range_v = [-18, -2], adc_v = 20 }
    channels = [
        { name = "bearing_45", signal = "along(shaft_x(0.35), shaft_y(0.35), 45) + runout(theta)" },
    ]

    [curves]
    runout = "runout.csv"                       # degrees, value in SI; or the points themselves

A new channel takes omitted fields from `_DEFAULTS`; an omitted bandwidth is at most a quarter of the rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field

from rig.base.checks import TOML_BYTES, Written, check, read_toml
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.files import read_file
from rig.base.text import printable
from rig.channels.sampling import TICKS_HZ
from rig.channels.table import TABLE, Channel, ChannelTable, FilterKind, build_table, raw_groups

KIND = "user"
"""Provenance of values from such a file."""
_DEFAULTS: dict[str, Any] = {
    "bias_v": 0.0, "range_v": [-10.0, 10.0], "highpass_hz": 0.0, "noise_v": 0.0, "adc_v": 10.0, "adc_bits": 24,
}  # fmt: skip
_RATE_HZ = 20_000
MAX_BANDWIDTH_HZ = 130_000.0
"""Largest bandwidth [Hz] that rows at an interval of 1 us can represent."""
_MAX_CHANNELS, _MAX_CURVE_POINTS = 512, 10_000
"""Largest number of channels in a table, and of points in a curve."""


def _identifier(name: str) -> str:
    if not (name.isascii() and name.isidentifier() and len(name) <= 28):
        raise ValueError("a name of at most 28 letters, digits and _, as required by buses and files")
    return name


_Name = Annotated[str, AfterValidator(_identifier)]


class _Row(Written):
    """New channel; its values are validated with the whole table."""

    model_config = ConfigDict(extra="allow")

    name: _Name


class _Group(Written):
    """New group, or changes to an existing one."""

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


def read_channels(path: Path, check_more: Callable[[ChannelTable], None] = lambda _: None) -> ChannelTable:
    """Return the channel table of a user's file.

    Args:
        path: The file.
        check_more: Additional check of the table by the caller.

    Raises:
        InputError: The file is invalid; the message names the file, channel and field.
    """
    try:
        file = check(_File, read_toml(path), field="")
        curves = {name: _curve(name, curve, path.parent) for name, curve in file.curves.items()}
        table = build_table(_merge_groups(file), curves)
        check_table(table)
        check_more(table)
        return table
    except InputError as error:
        field = error.field if error.field.startswith(str(path)) else f"{path.name}: {error.field}"
        raise InputError(field, error.must, error.received) from None


def check_table(table: ChannelTable) -> None:
    """Refuse a table that streams, buses and files cannot represent.

    Raises:
        InputError: The table is invalid; the message names the first wrong field.
    """
    if not table.groups or len(table.channels) > _MAX_CHANNELS:
        raise InputError("groups", f"of 1 to {_MAX_CHANNELS} channels together", len(table.channels))
    for group in table.groups.values():
        if not 1 <= group.rate_hz <= TICKS_HZ:
            raise InputError(f"groups.{group.name}.rate_hz", f"from 1 to {TICKS_HZ}", group.rate_hz)
        for channel in group.channels:
            field = f"channel {channel.name}"
            for name in ("bandwidth_hz", "highpass_hz"):
                if getattr(channel, name) > MAX_BANDWIDTH_HZ:
                    raise InputError(f"{field}.{name}", f"at most {MAX_BANDWIDTH_HZ:g}", getattr(channel, name))
            if channel.group_delay_us is not None and channel.group_delay_us < (least := 1e6 * channel.half_length_s):
                must = f"at least {least:.6g}, half of the filter's length, as samples are not delayed here"
                raise InputError(f"{field}.group_delay_us", must, channel.group_delay_us)
            if (channel.rate_hz, channel.group) != (group.rate_hz, group.name):
                raise InputError(f"{field}.rate_hz", f"that of its group, {group.rate_hz}", channel.rate_hz)
            gain = channel.sensitivity_v / channel.si
            if not 1e-30 < abs(gain) < 1e30:
                raise InputError(f"{field}.sensitivity_v", "of 1e-30 to 1e30 volts per SI unit", gain)
            for name in ("unit", "label"):
                if not getattr(channel, name).isprintable():
                    raise InputError(f"{field}.{name}", "printable, in one line", getattr(channel, name))
        for name in (group.name, *group.names):
            try:
                _identifier(name)
            except ValueError as error:
                raise InputError("channels", str(error), name) from None
    for name, points in table.curves.items():
        _check_curve(name, points)


def _merge_groups(file: _File) -> dict[str, Any]:
    """Return the groups of the table with complete rows."""
    groups = raw_groups(TABLE.read_text()) if file.base == "rig" else {}
    fields_by_channel: dict[str, set[str]] = {}
    """Fields that the file states for each channel."""
    sources = [(f"groups.{name}.defaults", group.defaults) for name, group in file.groups.items()]
    sources += [(f"channel {row.name}", row.model_dump()) for group in file.groups.values() for row in group.channels]
    for field_prefix, fields in [*sources, *((f"channels.{name}", changes) for name, changes in file.channels.items())]:
        for name in (one for one in ("rate_hz", "group", "kind") if one in fields):
            raise InputError(f"{field_prefix}.{name}", "left out: it is the group's", fields[name])
    for name, group in file.groups.items():
        if name not in groups and not group.channels:
            raise InputError(f"groups.{name}.channels", "given, as there is no such group yet", None)
        merged = groups.setdefault(name, {"title": name, "rate_hz": _RATE_HZ, "kind": KIND, "channels": []})
        merged |= group.model_dump(include={"title", "rate_hz"}, exclude_none=True)
        existing = merged["channels"]
        common = (
            {key: value for key, value in existing[0].items() if all(row[key] == value for row in existing)}
            if existing
            else _DEFAULTS
        )
        for row in existing:
            row |= group.defaults
            fields_by_channel.setdefault(row["name"], set()).update(
                group.defaults, {"rate_hz"} if group.rate_hz else ()
            )
        for row in group.channels:
            own = {**group.defaults, **row.model_dump()}
            merged["channels"].append({"label": row.name, **common, **own})
            fields_by_channel.setdefault(row.name, set()).update(own)
    rows = {row["name"]: row for group in groups.values() for row in group["channels"]}
    for name, changes in file.channels.items():
        if name not in rows:
            raise UnknownNameError(f"channels.{name}", "the name of a channel that there is", name, rows)
        if "name" in changes:
            raise InputError(f"channels.{name}.name", "left out: drop the channel and add another", changes["name"])
        rows[name] |= changes
        fields_by_channel.setdefault(name, set()).update(changes)
    for name in file.drop:
        if name not in groups and name not in rows:
            raise UnknownNameError("drop", "names of groups or channels", name, [*groups, *rows])
    for name, group in list(groups.items()):
        group["channels"] = [row for row in group["channels"] if not {name, row["name"]} & {*file.drop}]
        if not group["channels"]:
            del groups[name]
        for row in group["channels"]:
            _check_kinds(row)
            if "bandwidth_hz" not in fields_by_channel.get(row["name"], ()):
                row["bandwidth_hz"] = min(row.get("bandwidth_hz", math.inf), group["rate_hz"] / 4.0)
            row |= {"kind": KIND} if fields_by_channel.get(row["name"]) else {}
    if not groups:
        raise InputError("drop", "such that a channel is left", list(file.drop))
    return groups


def _check_kinds(row: dict[str, Any]) -> None:
    """Refuse text and Boolean values in number fields."""
    for name, field in Channel.model_fields.items():
        value = row.get(name)
        if field.annotation not in (str, FilterKind) and isinstance(value, bool | str):
            raise InputError(f"channel {row['name']}.{name}", "a number", value)


def _curve(name: str, source: str | tuple[tuple[float, float], ...], folder: Path) -> tuple[tuple[float, float], ...]:
    """Return the points of a curve, from its file or from the table."""
    field = f"curves.{name}"
    if not isinstance(source, str):
        points = source
    else:
        try:
            lines = read_file(folder / source, TOML_BYTES).decode("utf-8-sig").splitlines()
            rows = [row.split(",") for line in lines if (row := line.partition("#")[0].strip())]
            points = tuple((float(degrees), float(value)) for degrees, value in rows)
        except OSError as error:
            received = Words(f"{source} ({error.strerror})")
            raise InputError(field, "a file that can be read, degrees and values", received) from None
        except ValueError as error:
            raise InputError(field, "a file of lines `degrees, value`", Words(printable(str(error), 100))) from None
    return points


def _check_curve(name: str, points: tuple[tuple[float, float], ...]) -> None:
    field, degrees = f"curves.{name}", [a for a, _ in points]
    if not 2 <= len(points) <= _MAX_CURVE_POINTS or any(b <= a for a, b in pairwise(degrees)):
        raise InputError(field, f"2 to {_MAX_CURVE_POINTS} points of ascending angle", Words(f"{len(points)} points"))
    if not (degrees[0] >= 0.0 and degrees[-1] < 360.0 and all(math.isfinite(value) for _, value in points)):
        raise InputError(field, "points from 0 to below 360 degrees with finite values", [points[0], points[-1]])
