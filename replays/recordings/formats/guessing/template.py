"""Mapping templates: one guessed from files, which can be imported as it is, and one with every option."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from importlib.resources import files as files_of
from pathlib import Path

from replays.recordings.formats.events.events import format_command
from replays.recordings.formats.events.motion import ChannelMotion, detect_impact, estimate_speed
from replays.recordings.formats.guessing.attachments import Attachments, read_attachments
from replays.recordings.formats.guessing.guess import SURE, Guess, guess_channels
from replays.recordings.formats.guessing.noise import estimate_noise
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import Entry, Source, open_source
from rig.base import units
from rig.channels.table import default_table

CHECK = "PLEASE CHECK"
"""Mark of a line that cannot be determined from the files."""
_CONTROL = re.compile(r"[\0-\x08\x0a-\x1f\x7f]")
"""Characters that TOML forbids in a line."""
_LABEL = 60
_TABLES = ("[[align]]", "[keyphasor]", "[hammer]", "[experiment]")
"""Optional tables at the end of a mapping."""
_MIN_FIT_RATIO = 1.3
"""Minimum ratio by which values fit one kind of times better than the other."""
_THRESHOLD_FRACTION, _THRESHOLD_TO_NOISE = 0.1, 8.0
"""Threshold of hammer pulses: the larger of this fraction of the largest one and this multiple of the noise."""
_CORNER_TOLERANCE = 0.1
"""Relative distance within which corners count as those of the same filter."""


def guess_mapping(files: Sequence[Path], options: FileOptions | None = None) -> tuple[str, list[Guess]]:
    """Return a mapping file for some files, and the guesses in it.

    Signals that match a channel of the rig are mapped to it; all others become separate channels, in their unit.

    Args:
        files: The files.
        options: Options for reading them, if needed.

    Raises:
        InputError: A file cannot be read.
    """
    sources = [open_source(path, options or FileOptions()) for path in files]
    attached = {source.path: read_attachments(source) for source in sources}
    exported = {(path, name) for path, each in attached.items() for name in each.channels}
    guesses = guess_channels(sources, exported=lambda source, entry: (source.path, entry.name) in exported)
    return write_text(sources, attached, guesses), guesses


def template(files: Sequence[Path], options: FileOptions | None = None) -> str:
    """Return a mapping file for some files; see `guess_mapping`."""
    return guess_mapping(files, options)[0]


def write_text(sources: Sequence[Source], attached: dict[Path, Attachments], guesses: Sequence[Guess]) -> str:
    """Return the text of a mapping with the guesses, and questions on what is undetermined."""
    lines = [
        f"# Mapping for `rig import {' '.join(_quoted(path.name) for path in attached)} -m THIS.toml -o OUT.mcap`;",
        "# value = sign * factor * (source - bias), in the channel's unit; + is EAST, up, compression. It can be",
        "# imported as it is; lines marked for checking are assumptions. To show a signal in pictures and verdicts,",
        "# rename its [channels.NAME] to one of the rig's (and remove `to` and `to_unit`):",
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
    filters, corner_hz = _filters(guesses, attached)
    lines += filters
    used_names: set[str] = set()
    asked: set[tuple[str, str]] = set()
    for each in guesses:
        if each.features.missing == len(each.features.values):
            lines += ["", f"# {_quoted(each.entry.name)} has no numeric values and is omitted"]
            continue
        lines += ["", *_channel(each, used_names, asked, several=len(sources) > 1)]
        if (channel := attached[each.source.path].channels.get(each.entry.name)) is not None:
            lines += [f"bandwidth_hz = {channel.bandwidth_hz!r}"]
            lines += [f"{key} = {json.dumps(value)}" for key, value in channel.shape.items()]
            lines += [f"highpass_hz = {channel.highpass_hz!r}"] * bool(channel.highpass_hz)
        elif each.features.timed and corner_hz > (max_hz := 0.5 * each.features.axis.rate_hz):
            lines += [f"bandwidth_hz = {max_hz:.6g}    # {CHECK}: half of its rate; [defaults] is higher"]
        elif each.channel == "speed":
            lines += ["# bandwidth_hz = HZ    # a tachometer is often slower than the other channels"]
    lines += _event_tables(guesses, several=len(sources) > 1)
    first, about = sources[0].path, attached[sources[0].path]
    if about.experiment:
        lines += ["", f"[experiment]    # as attached to {first.name}", *about.experiment]
    elif about.doubt:
        lines += ["", f"# No [experiment] from the documents attached to {first.name}: {about.doubt}"]
    lines += ["", "# Uncomment the tables that you need:"]
    for table in _TABLES:
        if any(line.startswith(table) for line in lines):
            continue
        lines += ["#", *(f"# {line}" for line in _example_table(table, guesses))]
    return "".join(_CONTROL.sub("?", line) + "\n" for line in lines)


def _time(guesses: Sequence[Guess]) -> list[str]:
    """Return the lines on the time axis; none if the samples keep the times in the files."""
    if any(not each.features.timed for each in guesses):
        return [
            "",
            "[time]",
            f"# rate_hz = HZ    # {CHECK}: some signals have neither a rate nor a time_column",
        ]
    uneven = [each for each in guesses if each.features.axis.times_s is not None]
    if not uneven:
        return []
    most = max(uneven, key=lambda each: abs(math.log(each.features.unevenness)))
    rms, largest = (f"{1e6 * value:.3g} µs" for value in most.features.axis.jitter_s)
    factor = most.features.unevenness
    comment = f"# Time stamps lie up to {largest} (rms {rms}) from even ones. The values of {most.entry.name} "
    if factor > _MIN_FIT_RATIO:
        comment += f"fit their stamps {factor:.2g} times better:"
        note = f"{CHECK}: uneven sampling; linear interpolation colours the noise"
        return ["", comment, "[resample]", f'method = "linear"    # {note}']
    if factor < 1.0 / _MIN_FIT_RATIO:
        comment += f"fit even times {1.0 / factor:.2g} times better: only stamps jitter."
        return ["", comment, "[time]", 'stamps = "line"']
    comment += "fit both equally well:"
    note = f'{CHECK}: assumes that only stamps jitter; for uneven sampling: [resample] method = "linear"'
    return ["", comment, "[time]", f'stamps = "line"    # {note}']


def _filters(guesses: Sequence[Guess], files: dict[Path, Attachments]) -> tuple[list[str], float]:
    """Return the lines on the low-pass filters, and the corner seen in the noise [Hz], else 0."""
    open_ones = [each for each in guesses if each.channel and each.entry.name not in files[each.source.path].channels]
    if not open_ones:
        return [], 0.0
    lines = [
        "",
        "[defaults]    # for all channels without their own value",
        "# The anti-aliasing low-pass delays a channel, by 0.42 / bandwidth_hz for order 4. The default is half of the",
        "# rate; if that is wrong, impacts appear shifted, and `rig identify` ends at the first contact.",
    ]
    corners = sorted(corner for each in open_ones if (corner := each.features.corner_hz) is not None)
    middle = corners[len(corners) // 2] if corners else 0.0
    similar = [corner for corner in corners if abs(corner / middle - 1.0) < _CORNER_TOLERANCE]
    if 2 * len(similar) > len(open_ones):
        text = f"the noise of {len(similar)} of {len(open_ones)} signals ends there, as after a low-pass of order 4"
        return [*lines, f"bandwidth_hz = {float(f'{middle:.3g}'):g}    # {CHECK}: {text}"], middle
    rates = [each.features.axis.rate_hz for each in open_ones if each.features.timed]
    apart = len(rates) and max(rates) > 1.01 * min(rates)
    slow = f"; channels of {min(rates):.6g} Hz have their own, at most half of that" if apart else ""
    return [
        *lines,
        f"# bandwidth_hz = HZ    # {CHECK}: the anti-aliasing low-pass, which the noise does not show{slow}",
    ], 0.0


def _event_tables(guesses: Sequence[Guess], *, several: bool) -> list[str]:
    """Return the lines on keyphasor edges and hammer pulses, if there are any."""
    lines = []
    for each in guesses:
        if each.channel == "keyphasor" and len(each.features.pulses):
            mark = f"    # {CHECK}: {text}" if (text := each.asks.get("pulses_per_turn")) else ""
            lines += ["", f"[keyphasor]    # {len(each.features.pulses)} edges", f"source = {_quoted(each.entry.name)}"]
            lines += [*_location(each, several=several), f"threshold = {each.features.threshold:.4g}"]
            lines += [f"pulses_per_turn = {each.pulses_per_turn}{mark}"]
        if each.channel == "hammer" and each.features.is_hammer and each.gain:
            peak = max(each.gain * (value - each.zero) for value in each.features.extent)
            lines += ["", f"[hammer]    # pulses in the channel `hammer`; the largest has {peak:.3g} N"]
            noise_n = abs(each.gain) * estimate_noise(each.features.values)
            least = max(_THRESHOLD_FRACTION * peak, _THRESHOLD_TO_NOISE * noise_n)
            lines += [f"threshold_n = {least:.2g}"]
    return lines


def _location(each: Guess, *, several: bool) -> list[str]:
    """Return the lines that locate a signal."""
    lines = [f"group = {_quoted(each.entry.group)}"] if each.entry.group else []
    return [*lines, f"file = {_quoted(each.source.path.name)}"] if several else lines


def example() -> str:
    """Return a mapping for a typical rig with every option explained."""
    return files_of("replays.recordings.formats").joinpath("example.toml").read_text(encoding="utf-8")


def _example_table(table: str, guesses: Sequence[Guess]) -> list[str]:
    """Return one table of the example without options at their default, completed from the files."""
    lines = example().splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith(table))
    stop = next((n for n, line in enumerate(lines[start + 1 :], start + 1) if line.startswith("[")), len(lines))
    kept = [line for line in lines[start:stop] if line and not line.startswith("#")]
    if table == "[[align]]":
        return _align_lines(kept, guesses)
    if table != "[experiment]":
        return kept
    kept = [line for line in kept if line.split(" ")[0] not in ("set", "lead_s") and not line.startswith(" ")]
    motions, zero_s = _motions(guesses)
    has_pulses = any(each.channel == "hammer" and each.features.is_hammer for each in guesses)
    hit = None if has_pulses else detect_impact(motions)
    new_lines = {}
    if hit is not None:
        at = f"{', '.join(hit.names[:4])}{' and more' if len(hit.names) > 4 else ''} move suddenly at {hit.at_s:.3f} s"
        force = "force and length assumed" if hit.pulse is None else "time, force and length from the probes"
        new_lines["commands"] = f"commands = [{format_command(hit)}]    # {CHECK}: no hammer pulse, but {at}: {force}"
    elif not has_pulses:
        new_lines["scene"] = 'scene = "stable-run"                # a log without impact; see `rig scenes`, or a file'
        new_lines["commands"] = (
            "commands = []                       # no hammer pulse was found; example: "
            '[{ at_s = 0.8, command = "hammer", force_n = 100, duration_ms = 5 }]'
        )
    if not {each.channel for each in guesses} & {"speed", "keyphasor"} and any(one.kind == "mm" for one in motions):
        blow = next((each.features for each in guesses if has_pulses and each.channel == "hammer"), None)
        until_s = math.inf if hit is None else hit.at_s
        until_s = until_s if blow is None else blow.pulse_start_s - zero_s
        turned = estimate_speed(motions, until_s=until_s)
        shown = "# speed_hz = HZ" if turned is None else 'speed_hz = "measured"'
        probes_text = "nor from the probes" if turned is None else f"probes: {turned[0]:.4g} ±{2 * turned[1]:.1g} Hz"
        new_lines["speed_hz"] = f"{shown}    # {CHECK}: no speed from a channel; {probes_text}"
    return [new_lines.get(line.split(" ")[0], line) for line in kept]


def _motions(guesses: Sequence[Guess]) -> tuple[list[ChannelMotion], float]:
    """Return the channels on the recording's time axis, and its start in source time [s]."""
    table = default_table().channels
    usable = [each for each in guesses if each.features.timed and each.gain and table[each.channel].unit != "1"]
    first = dict[str, float]()
    for each in usable:
        group = table[each.channel].group
        first[group] = max(first.get(group, -math.inf), each.features.axis.first_s)
    zero_s = min(first.values(), default=0.0)
    return [
        ChannelMotion(each.channel, each.gain * (each.features.values - each.zero), each.features.axis.shift(-zero_s))
        for each in usable
    ], zero_s


def _align_lines(lines: list[str], guesses: Sequence[Guess]) -> list[str]:
    """Return the lines of [[align]] with a signal that two files share, if any; pulse trains come first."""
    files: dict[str, list[Guess]] = {}
    for each in sorted(guesses, key=lambda each: not len(each.features.edges)):
        files.setdefault(each.entry.name, []).append(each)
    pair = next((matches[:2] for matches in files.values() if len({each.source.path for each in matches}) > 1), None)
    if pair is None:
        return lines
    sides = {
        side: f"{side} = {{ source = {_quoted(each.entry.name)}, file = {_quoted(each.source.path.name)} }}"
        for side, each in zip(("reference", "moved"), pair, strict=True)
    }
    kept = [line for line in lines if not line.startswith(("threshold", "within_s"))]
    return [sides.get(line.split(" ")[0], line) for line in kept]


def _channel(each: Guess, used_names: set[str], asked: set[tuple[str, str]], *, several: bool) -> list[str]:
    def mark(field: str) -> str:
        """Return the question on a field; it is marked once for all signals of a quantity."""
        about = ("force" if each.kind == "hammer" else each.kind, field)
        first = about not in asked
        asked.add(about)
        return f"{f'{CHECK}: ' * first}{each.asks[field]}{', as above' * (not first)}"

    entry = each.entry
    name = each.channel or re.sub(r"\W+", "_", entry.name).strip("_") or "signal"
    plain, number = name, 2
    while name in used_names or (not each.channel and name in default_table().channels):
        name, number = f"{plain}_{number}", number + 1
    used_names.add(name)
    rate = f"{entry.rate_hz:.9g} Hz" if entry.rate_hz else "no rate"
    label = f"  {shorten_label(entry)}".rstrip()
    note = f"{each.confidence}: {each.why}"
    if "name" in each.asks:
        note = f"{mark('name')} ({note})"
    comment = f"    # {note}" if each.channel and each.confidence != SURE else ""
    lines = [
        f"[channels.{_key(name)}]{comment}",
        f"source = {_quoted(entry.name)}    # {entry.rows} values, {rate}{label}",
    ]
    lines += _location(each, several=several)
    has_unit = units.is_known(entry.unit) and entry.unit != ""
    if not each.channel:
        target = entry.unit if has_unit else "1"
        comment = f"    # {CHECK}: the file has {entry.unit!r}" if entry.unit and not has_unit else ""
        lines += [f"unit = {_quoted(target)}{comment}"]
        group = re.sub(r"\W+", "_", entry.group or each.source.path.stem).strip("_").lower() or "imported"
        group += "_log" if group in default_table().groups else ""
        return [*lines, f"to = {_quoted(group)}", f"to_unit = {_quoted(target)}"]
    fields = {
        "sign": each.sign if each.sign < 0 else None, "unit": each.unit or (entry.unit if has_unit else None),
        "sensitivity": each.sensitivity, "bias": each.bias,
    }  # fmt: skip
    for field, value in fields.items():
        if value is not None:
            note = f"    # {mark(field)}" if field in each.asks else ""
            lines.append(f"{field} = {_quoted(value) if isinstance(value, str) else repr(value)}{note}")
    return lines


def shorten_label(entry: Entry) -> str:
    """Return the file's description of a signal, shortened."""
    text = " ".join(entry.label.split())
    return text if len(text) <= _LABEL else f"{text[: _LABEL - 3]}..."


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(value: str | int) -> str:
    # A JSON string is a valid TOML basic string, apart from the character 127.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
