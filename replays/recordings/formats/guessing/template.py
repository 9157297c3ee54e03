"""Mappings to start from: one made of what is guessed of files, which imports as it is, and one with every option."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from importlib.resources import files as files_of
from pathlib import Path

from replays.recordings.formats.events.events import told_as
from replays.recordings.formats.events.motion import Motion, impact, turning
from replays.recordings.formats.guessing.attached import Attached, attached
from replays.recordings.formats.guessing.guess import SURE, Guess, guess
from replays.recordings.formats.guessing.noise import white_or_not
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import Entry, Source, open_source
from rig.base import units
from rig.channels.table import default_table

CHECK = "PLEASE CHECK"
"""Marks a line that cannot be known from the files."""
_LABEL = 60
_TABLES = ("[[align]]", "[keyphasor]", "[hammer]", "[experiment]")
"""What stands at the end of a mapping, to be taken up."""
_FITS = 1.3
"""By so much better values must fit one kind of times than the other for it to be told."""
_HEIGHT, _ABOVE = 0.1, 8.0
"""A hammer pulse is told from the rest by this part of the largest one, and so many times the noise."""
_COMMON_CORNERS = 0.1
"""Corners that are so near each other are those of one kind of filter."""


def guessed(files: Sequence[Path], options: FileOptions | None = None) -> tuple[str, list[Guess]]:
    """A mapping file for some files, and the guesses that it is made of.

    Signals that are taken for channels of the rig become these; all others become channels of their own, in their unit.

    Args:
        files: The files.
        options: How to read them, where that cannot be found out.

    Raises:
        InputError: A file cannot be read.
    """
    sources = [open_source(path, options or FileOptions()) for path in files]
    known = {source.path: attached(source) for source in sources}
    told = {(path, name) for path, each in known.items() for name in each.channels}
    guesses = guess(sources, told=lambda source, entry: (source.path, entry.name) in told)
    return _text(sources, known, guesses), guesses


def template(files: Sequence[Path], options: FileOptions | None = None) -> str:
    """A mapping file for some files; see `guessed`."""
    return guessed(files, options)[0]


def _text(sources: Sequence[Source], known: dict[Path, Attached], guesses: Sequence[Guess]) -> str:
    lines = [
        f"# Mapping for `rig import {' '.join(_quoted(path.name) for path in known)} -m THIS.toml -o OUT.mcap`;",
        "# value = sign * factor * (source - bias), in the channel's unit; + is EAST, up, compression. It imports as",
        "# it is; lines that ask to be checked hold what the files do not tell. Rename [channels.NAME] to one of the",
        "# rig's (then drop `to` and `to_unit`), so that pictures, verdicts and models know it:",
    ]
    for group in default_table().groups.values():
        names = (channel.name + (f" [{channel.unit}]" if channel.unit != "1" else "") for channel in group.channels)
        lines.append(f"#   {group.name}: {', '.join(names)}")
    lines += ["# Every option is explained by `rig import --template EXAMPLE.toml`.", ""]
    for source in sources:
        start = "" if source.start is None else f", from {source.start.isoformat()}"
        lines.append(f"# {source.path.name}: {source.format}, {len(source.entries)} signals{start}")
        lines += [f"#   {remark}" for remark in source.remarks]
    if dialect := sources[0].options:
        lines += ["", "[file]", *(f"{key} = {_quoted(value)}" for key, value in dialect.items())]
    lines += _time(guesses)
    filters, corner_hz = _filters(guesses, known)
    lines += filters
    taken: set[str] = set()
    for each in guesses:
        if each.look.missing == len(each.look.values):
            lines += ["", f"# {_quoted(each.entry.name)} has no numbers in it, and is left out"]
            continue
        lines += ["", *_channel(each, taken, several=len(sources) > 1)]
        if (channel := known[each.source.path].channels.get(each.entry.name)) is not None:
            lines += [f"bandwidth_hz = {channel.bandwidth_hz!r}"]
            lines += [f"highpass_hz = {channel.highpass_hz!r}"] * bool(channel.highpass_hz)
        elif each.look.timed and corner_hz > (most_hz := 0.5 * each.look.axis.rate_hz):
            lines += [f"bandwidth_hz = {most_hz:.6g}    # {CHECK}: half of its rate; that of [defaults] is above it"]
    lines += _happened(guesses, several=len(sources) > 1)
    first, about = sources[0].path, known[sources[0].path]
    if about.experiment:
        lines += ["", f"[experiment]    # as attached to {first.name}", *about.experiment]
    elif about.doubt:
        lines += ["", f"# Of what is attached to {first.name} no [experiment] is made: {about.doubt}"]
    lines += ["", "# Take away the `# ` of what you need:"]
    for table in _TABLES:
        if any(line.startswith(table) for line in lines):
            continue
        lines += ["#", *(f"# {line}" for line in _example_of(table, guesses))]
    return "\n".join(lines) + "\n"


def _time(guesses: Sequence[Guess]) -> list[str]:
    """What is to be said of time: nothing, where the samples keep the times that the files give them."""
    if any(not each.look.timed for each in guesses):
        return [
            "",
            "[time]",
            f"# rate_hz = HZ    # {CHECK}: no rate is told of some signals, and no time_column",
        ]
    uneven = [each for each in guesses if each.look.axis.times_s is not None]
    if not uneven:
        return []
    most = max(uneven, key=lambda each: abs(math.log(each.look.unevenness)))
    rms, largest = (f"{1e6 * value:.3g} µs" for value in most.look.axis.jitter_s)
    factor = most.look.unevenness
    told = f"# Time stamps lie up to {largest} (rms {rms}) off even ones. The values of {most.entry.name} "
    if factor > _FITS:
        told += f"fit their stamps {factor:.2g} times better:"
        asked = f"{CHECK}: samples were taken unevenly; lines between them colour the noise"
        return ["", told, "[resample]", f'method = "linear"    # {asked}']
    if factor < 1.0 / _FITS:
        told += f"fit even times {1.0 / factor:.2g} times better: only stamps jitter."
        return ["", told, "[time]", 'stamps = "line"']
    told += "do not tell which is right:"
    asked = f'{CHECK}: only stamps jitter; if samples were taken unevenly: [resample] method = "linear"'
    return ["", told, "[time]", f'stamps = "line"    # {asked}']


def _filters(guesses: Sequence[Guess], known: dict[Path, Attached]) -> tuple[list[str], float]:
    """The question after the low-passes before the converter, and the corner that the noise shows, else 0 [Hz]."""
    open_ones = [each for each in guesses if each.channel and each.entry.name not in known[each.source.path].channels]
    if not open_ones:
        return [], 0.0
    lines = [
        "",
        "[defaults]    # of all channels that do not say it themselves",
        "# A low-pass before the converter makes a channel late, by 0.42 / bandwidth_hz if it is of order 4. Untold,",
        "# it is half of the rate: models then see impacts shifted, and `rig identify` ends at the first contact.",
    ]
    corners = sorted(corner for each in open_ones if (corner := each.look.corner_hz) is not None)
    middle = corners[len(corners) // 2] if corners else 0.0
    alike = [corner for corner in corners if abs(corner / middle - 1.0) < _COMMON_CORNERS]
    if 2 * len(alike) > len(open_ones):
        text = f"the noise of {len(alike)} of {len(open_ones)} signals ends there, as behind a low-pass of order 4"
        return [*lines, f"bandwidth_hz = {float(f'{middle:.3g}'):g}    # {CHECK}: {text}"], middle
    rates = [each.look.axis.rate_hz for each in open_ones if each.look.timed]
    apart = len(rates) and max(rates) > 1.01 * min(rates)
    slow = f"; channels of {min(rates):.6g} Hz have their own, at most half of that" if apart else ""
    return [
        *lines,
        f"# bandwidth_hz = HZ    # {CHECK}: the low-pass before the converter; the noise does not show it{slow}",
    ], 0.0


def _happened(guesses: Sequence[Guess], *, several: bool) -> list[str]:
    """Edges of the keyphasor and pulses of the hammer, where they were found."""
    lines = []
    for each in guesses:
        if each.channel == "keyphasor" and len(each.look.pulses):
            mark = f"    # {CHECK}: {text}" if (text := each.asks.get("pulses_per_turn")) else ""
            lines += ["", f"[keyphasor]    # {len(each.look.pulses)} edges", f"source = {_quoted(each.entry.name)}"]
            lines += [*_where(each, several=several), f"threshold = {each.look.threshold:.4g}"]
            lines += [f"pulses_per_turn = {each.pulses_per_turn}{mark}"]
        if each.channel == "hammer" and each.look.blows and each.gain:
            peak = max(each.gain * (value - each.zero) for value in each.look.extent)
            lines += ["", f"[hammer]    # its pulses in the channel `hammer`; the largest has {peak:.3g} N"]
            least = max(_HEIGHT * peak, _ABOVE * abs(each.gain) * white_or_not(each.look.values))
            lines += [f"threshold_n = {least:.2g}"]
    return lines


def _where(each: Guess, *, several: bool) -> list[str]:
    """The lines that say where a signal stands."""
    lines = [f"group = {_quoted(each.entry.group)}"] if each.entry.group else []
    return [*lines, f"file = {_quoted(each.source.path.name)}"] if several else lines


def example() -> str:
    """A mapping with every option, explained, for a usual rig."""
    return files_of("replays.recordings.formats").joinpath("example.toml").read_text(encoding="utf-8")


def _example_of(table: str, guesses: Sequence[Guess]) -> list[str]:
    """The lines of one table of the example, without options at their default, with what is known of these files."""
    lines = example().splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith(table))
    stop = next((n for n, line in enumerate(lines[start + 1 :], start + 1) if line.startswith("[")), len(lines))
    kept = [line for line in lines[start:stop] if line and not line.startswith("#")]
    if table == "[[align]]":
        return _shared(kept, guesses)
    if table != "[experiment]":
        return kept
    kept = [line for line in kept if line.split(" ")[0] not in ("set", "lead_s") and not line.startswith(" ")]
    motions, zero_s = _motions(guesses)
    struck = any(each.channel == "hammer" and each.look.blows for each in guesses)
    hit = None if struck else impact(motions)
    said = {}
    if hit is not None:
        at = f"{', '.join(hit.names[:4])}{' and more' if len(hit.names) > 4 else ''} move suddenly at {hit.at_s:.3f} s"
        force = "force and length assumed" if hit.pulse is None else "time, force and length as the probes show them"
        said["commands"] = f"commands = [{told_as(hit)}]    # {CHECK}: no hammer pulse is known, but {at}: {force}"
    elif not struck:
        said["scene"] = 'scene = "stable-run"                # a name of `rig scenes`, or a file'
        said["commands"] = (
            "commands = []                       # no hammer pulse was found; where one was: "
            '[{ at_s = 0.8, command = "hammer", force_n = 100, duration_ms = 5 }]'
        )
    if not {each.channel for each in guesses} & {"speed", "keyphasor"} and any(one.kind == "mm" for one in motions):
        blow = next((each.look for each in guesses if struck and each.channel == "hammer"), None)
        until_s = math.inf if hit is None else hit.at_s
        until_s = until_s if blow is None else blow.struck_s - zero_s
        turned = turning(motions, until_s=until_s)
        shown = "# speed_hz = HZ" if turned is None else 'speed_hz = "measured"'
        tell = "nor do the probes" if turned is None else f"the probes turn at {turned[0]:.4g} ±{2 * turned[1]:.1g} Hz"
        said["speed_hz"] = f"{shown}    # {CHECK}: no channel tells the speed; {tell}"
    return [said.get(line.split(" ")[0], line) for line in kept]


def _motions(guesses: Sequence[Guess]) -> tuple[list[Motion], float]:
    """The channels as they move, in the time of the recording, and where that begins [s]."""
    table = default_table().channels
    known = [each for each in guesses if each.look.timed and each.gain and table[each.channel].unit != "1"]
    first = dict[str, float]()
    for each in known:
        group = table[each.channel].group
        first[group] = max(first.get(group, -math.inf), each.look.axis.first_s)
    zero_s = min(first.values(), default=0.0)
    return [
        Motion(each.channel, each.gain * (each.look.values - each.zero), each.look.axis.moved(-zero_s))
        for each in known
    ], zero_s


def _shared(lines: list[str], guesses: Sequence[Guess]) -> list[str]:
    """The lines of [[align]] with a signal that two files have, if there is one, a pulse train first."""
    files: dict[str, list[Guess]] = {}
    for each in sorted(guesses, key=lambda each: not len(each.look.edges)):
        files.setdefault(each.entry.name, []).append(each)
    pair = next((found[:2] for found in files.values() if len({each.source.path for each in found}) > 1), None)
    if pair is None:
        return lines
    sides = {
        side: f"{side} = {{ source = {_quoted(each.entry.name)}, file = {_quoted(each.source.path.name)} }}"
        for side, each in zip(("reference", "moved"), pair, strict=True)
    }
    kept = [line for line in lines if not line.startswith(("threshold", "within_s"))]
    return [sides.get(line.split(" ")[0], line) for line in kept]


def _channel(each: Guess, taken: set[str], *, several: bool) -> list[str]:
    entry = each.entry
    name = each.channel or re.sub(r"\W+", "_", entry.name).strip("_") or "signal"
    plain, number = name, 2
    while name in taken or (not each.channel and name in default_table().channels):
        name, number = f"{plain}_{number}", number + 1
    taken.add(name)
    rate = f"{entry.rate_hz:.9g} Hz" if entry.rate_hz else "no rate"
    label = f"  {label_of(entry)}".rstrip()
    asked = f"{CHECK}: {each.asks['name']} ({each.why})" if "name" in each.asks else f"{each.sure}: {each.why}"
    mark = f"    # {asked}" if each.channel and each.sure != SURE else ""
    lines = [
        f"[channels.{_key(name)}]{mark}",
        f"source = {_quoted(entry.name)}    # {entry.rows} values, {rate}{label}",
    ]
    lines += _where(each, several=several)
    known = units.known(entry.unit) and entry.unit != ""
    if not each.channel:
        target = entry.unit if known else "1"
        told = f"    # {CHECK}: the file says {entry.unit!r}" if entry.unit and not known else ""
        lines += [f"unit = {_quoted(target)}{told}"]
        group = re.sub(r"\W+", "_", entry.group or each.source.path.stem).strip("_").lower() or "imported"
        group += "_log" if group in default_table().groups else ""
        return [*lines, f"to = {_quoted(group)}", f"to_unit = {_quoted(target)}"]
    said = {
        "sign": each.sign if each.sign < 0 else None, "unit": each.unit or (entry.unit if known else None),
        "sensitivity": each.sensitivity, "bias": each.bias,
    }  # fmt: skip
    for field, value in said.items():
        if value is not None:
            asked = f"    # {CHECK}: {each.asks[field]}" if field in each.asks else ""
            lines.append(f"{field} = {_quoted(value) if isinstance(value, str) else repr(value)}{asked}")
    return lines


def label_of(entry: Entry) -> str:
    """What the file says of a signal, in a few words."""
    text = " ".join(entry.label.split())
    return text if len(text) <= _LABEL else f"{text[: _LABEL - 3]}..."


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(value: str | int) -> str:
    # A JSON string is a TOML basic string.
    return json.dumps(value, ensure_ascii=False)
