"""Mappings to start from: one made of what is in files, which imports as it is, and one that has every option."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from importlib.resources import files as files_of
from pathlib import Path

from replays.recordings.formats.attached import attached
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import Entry, Source, open_source
from rig import units
from rig.channels import default_table

CHECK = "PLEASE CHECK"
"""Marks a line that is a guess."""
_LABEL = 60
_TABLES = ("[[align]]", "[keyphasor]", "[hammer]", "[experiment]")
"""What stands at the end of a mapping, to be taken up."""
_USUAL_HZ = (100, 200, 500, 1000, 2000, 2500, 5000, 10_000, 20_000, 25_000, 50_000, 100_000)


def template(files: Sequence[Path], options: FileOptions | None = None) -> str:
    """A mapping file for some files.

    Signals named like a channel of the rig become it; all others become channels of their own, in their own unit.

    Args:
        files: The files.
        options: How to read them, where that cannot be found out.

    Raises:
        InputError: A file cannot be read.
    """
    sources = [open_source(path, options or FileOptions()) for path in files]
    rig = default_table().channels
    lines = [
        f"# Mapping for `rig import {' '.join(_quoted(path.name) for path in files)} -m THIS.toml -o OUT.mcap`.",
        "# value = sign * factor * (source - bias), in the unit of the channel. Rename [channels.NAME] to one of the",
        "# rig's channels (then drop `to` and `to_unit`), so that pictures, verdicts and models know it:",
    ]
    for group in default_table().groups.values():
        names = (channel.name + (f" [{channel.unit}]" if channel.unit != "1" else "") for channel in group.channels)
        lines.append(f"#   {group.name}: {', '.join(names)}")
    lines += [
        '# A channel in volts: unit = "V", sensitivity = "200 mV/mil" (or "100 mV/g", "2 mV/N"), bias = "mean".',
        "# Probes at other angles than 0 and 90 degrees: [[rotate]]. Another recorder's clock: [[align]]. To simulate",
        "# it again (`rig validate`, `rig identify`): [experiment], with [hammer] and [keyphasor], as at the end.",
        "# Every option is explained by `rig import --template EXAMPLE.toml`.",
        "",
    ]
    for source in sources:
        start = "" if source.start is None else f", from {source.start.isoformat()}"
        lines.append(f"# {source.path.name}: {source.format}, {len(source.entries)} signals{start}")
        lines += [f"#   {remark}" for remark in source.remarks]
    if dialect := sources[0].options:
        lines += ["", "[file]", *(f"{key} = {_quoted(value)}" for key, value in dialect.items())]
    lines += ["", *_rates([entry for source in sources for entry in source.entries])]
    taken: set[str] = set()
    known = [attached(source) for source in sources]
    for source, told in zip(sources, known, strict=True):
        for entry in source.entries:
            lines += ["", *_channel(entry, source, taken, rig=set(rig), several=len(sources) > 1)]
            if (channel := told.channels.get(entry.name)) is not None:
                lines += [f"bandwidth_hz = {channel.bandwidth_hz!r}"]
                lines += [f"highpass_hz = {channel.highpass_hz!r}"] * bool(channel.highpass_hz)
    if known[0].experiment:
        lines += ["", f"[experiment]    # as attached to {sources[0].path.name}", *known[0].experiment]
    elif known[0].doubt:
        lines += ["", f"# Of what is attached to {sources[0].path.name} no [experiment] is made: {known[0].doubt}"]
    lines += ["", "# Take away the `# ` of what you need:"]
    for table in _TABLES:
        if any(line.startswith(table) for line in lines):
            continue
        lines += ["#", *(f"# {line}" for line in _example_of(table))]
    return "\n".join(lines) + "\n"


def example() -> str:
    """A mapping with every option, explained, for a usual rig."""
    return files_of("replays.recordings.formats").joinpath("example.toml").read_text(encoding="utf-8")


def _example_of(table: str) -> list[str]:
    """The lines of one table of the example, without options at their default."""
    lines = example().splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith(table))
    stop = next((n for n, line in enumerate(lines[start + 1 :], start + 1) if line.startswith("[")), len(lines))
    return [line for line in lines[start:stop] if line and not line.startswith("#")]


def _rates(entries: Sequence[Entry]) -> list[str]:
    rates = [entry.rate_hz for entry in entries if entry.rate_hz]
    if len(rates) < len(entries):
        return ["[time]", "# rate_hz = 20000    # some signals have no rate: say it, or name file.time_column"]
    if all(abs(rate - round(rate)) / rate * entry.rows < 0.05 for rate, entry in zip(rates, entries, strict=True)):
        return [
            "# [resample]",
            '# method = "polyphase"    # samples are taken as they are without it',
            "# rate_hz = 20000",
        ]
    fastest = max(rates)
    whole = next((usual for usual in _USUAL_HZ if usual >= 0.999 * fastest), round(fastest))
    return [
        f"# The file's rates: {', '.join(f'{rate:.9g}' for rate in sorted(set(rates))[:5])} Hz. If samples came at a",
        '# whole one and the file rounds it, or its stamps jitter, say it instead: [time] rate_hz, or stamps = "line".',
        "[resample]",
        'method = "linear"    # "polyphase" where the time stamps are even',
        f"rate_hz = {whole}",
    ]


def _channel(entry: Entry, source: Source, taken: set[str], *, rig: set[str], several: bool) -> list[str]:
    name = entry.name if entry.name in rig else re.sub(r"\W+", "_", entry.name).strip("_") or "signal"
    plain, number = name, 2
    while name in taken:
        name, number = f"{plain}_{number}", number + 1
    taken.add(name)
    rate = f"{entry.rate_hz:.9g} Hz" if entry.rate_hz else "no rate"
    label = f"  {label_of(entry)}".rstrip()
    lines = [f"[channels.{_key(name)}]    # {entry.rows} values, {rate}{label}", f"source = {_quoted(entry.name)}"]
    if entry.group:
        lines.append(f"group = {_quoted(entry.group)}")
    if several:
        lines.append(f"file = {_quoted(source.path.name)}")
    ours = name in rig
    known = units.known(entry.unit) and entry.unit != ""
    target = default_table().channels[name].unit if ours else (entry.unit if known else "1")
    fits = known and units.kind(entry.unit) == units.kind(target)
    if ours and known and not fits and units.kind(entry.unit) == "voltage" and target != "1":
        sensitivity = default_table().channels[name].sensitivity_v
        lines += [
            f"unit = {_quoted(entry.unit)}",
            f'sensitivity = "{sensitivity:g} V/{target}"    # {CHECK}: assumed',
        ]
    elif fits:
        lines.append(f"unit = {_quoted(entry.unit)}")
    else:
        told = f"the file says {entry.unit!r}" if entry.unit else "the file tells none"
        lines.append(f"unit = {_quoted(target)}    # {CHECK}: {told}")
    if not ours:
        group = re.sub(r"\W+", "_", entry.group or source.path.stem).strip("_").lower() or "imported"
        if group in default_table().groups:
            group += "_log"
        lines += [f"to = {_quoted(group)}", f"to_unit = {_quoted(target)}"]
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
