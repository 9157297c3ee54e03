"""`rig info`: contents and health of a recording."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.outcome import Outcome
from rig.base.text import replace_nonfinite
from rig.cli.options import RecordingFiles
from rig.cli.output.progress import reporting
from rig.cli.output.tables import Form, Table, echo_json, fact_table, make_printable, new_table

if TYPE_CHECKING:
    from rich.console import Console

    from recorder.reader import Recording

_MAX_GAPS = 20
_SCENE = (("", "scene"), ("seed", "seed"), ("parameters", "parameter_set"))


def info(
    files: RecordingFiles,
    *,
    quick: Annotated[bool, typer.Option("--quick", help="Skip the samples, and the verdict")] = False,
    form: Form,
) -> None:
    """Show the calibration, gaps, health and events of a recording; several files count as one.

    Exit status: 0 pass; 1 fail (incomplete, rows lost, or contradictory); 2 wrong input; 3 inconclusive (the rig
    reported warnings, or bytes could not be checked). Doubts about channels do not change the verdict. With --quick
    there is no verdict.
    """
    from recorder.reader import join

    with reporting() as reporter:
        reporter.show("opening")
        recording = join(files)
        document = describe(recording, quick=quick, progress=lambda part: reporter.part(part, "reading the samples"))
    if form.as_json:
        echo_json(document)
    else:
        _print(recording, make_printable(document), form.console())
    if not quick and (status := Outcome(document["outcome"]).exit_status):
        raise typer.Exit(status)


def describe(
    recording: Recording, *, quick: bool, progress: Callable[[float], None] = lambda _: None
) -> dict[str, Any]:
    """Return what the command shows as a JSON document; `progress` receives the fraction of samples read."""
    from dataclasses import asdict

    from recorder.health import examine
    from replays.recordings.parameters import parameter_doubts

    about = recording.metadata["rig"]
    parts = [
        {
            "file": str(part.path),
            "size_bytes": part.path.stat().st_size,
            "complete": part.complete,
            "ended": part.end_reason,
            "unchecked": part.unchecked,
            **{
                name: part.metadata[name] for name in ("series", "trigger", "cut", "recovered") if name in part.metadata
            },
            "end": part.metadata.get("end", {}),
        }
        for part in recording.parts
    ]
    document: dict[str, Any] = {
        "parts": parts,
        "complete": recording.complete,
        "ended": recording.end_reason,
        **{name: about.get(name, "") for name in ("scene", "seed", "parameter_set", "created", "view_rate_hz")},
        "span_s": recording.span_s,
        "messages": recording.messages,
        "gaps": [{**asdict(gap), "time_s": time_s} for time_s, gap in recording.timed_gaps],
        "events": recording.events,
    }
    if not quick:
        health = asdict(examine(recording, progress))  # this pass also counts the streams
        health["findings"] += parameter_doubts(recording)
        document["streams"] = {
            key: {**asdict(stream), "lost": stream.lost + _lost_at_ends(recording, key)}
            for key, stream in recording.streams.items()
        }
        document["health"] = health
        failures, doubts = _reasons(document)
        document["outcome"] = Outcome.judge(failed=bool(failures), has_evidence=not doubts).value
        document["reasons"] = failures + doubts
    return replace_nonfinite(document)


def _reasons(document: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Return the reasons for a fail, and those for an inconclusive verdict otherwise."""
    health = document["health"]
    failures = [] if document["complete"] else ["the recording is not complete"]
    failures += _lost_rows(document)
    failures += [f"{count} blocks of {key} are misplaced" for key, count in health["misplaced"].items()]
    failures += health["findings"]
    doubts = [f"not checked: {text}" for part in document["parts"] for text in part["unchecked"]]
    doubts += [] if any(stream["rows"] for stream in document["streams"].values()) else ["the recording has no samples"]
    return failures, doubts + health["warnings"]


def _print(recording: Recording, document: dict[str, Any], console: Console) -> None:
    size_mb = sum(part["size_bytes"] for part in document["parts"]) / 1e6
    state = "complete" if document["complete"] else "not complete"
    file = document["parts"][0]["file"]
    if len(document["parts"]) > 1:
        file = f"{file} and {len(document['parts']) - 1} more"
    rows: list[tuple[str, str]] = [
        ("file", f"{file}, {size_mb:.1f} MB, {state}"),
        ("scene", ", ".join(f"{text} {document[name]}".strip() for text, name in _SCENE if document[name])),
        ("recorded", document["created"]),
    ]
    streams = document.get("streams", {})
    if filled := [stream for stream in streams.values() if stream["rows"]]:
        first_s = min(stream["first_time_s"] for stream in filled)
        last_s = max(stream["last_time_s"] for stream in filled)
        rows.append(("time", f"{first_s:.4f} s to {last_s:.4f} s ({last_s - first_s:.4f} s)"))
    elif not streams and document["span_s"] is not None:
        first_s, last_s = document["span_s"]
        about = "" if document["complete"] else "about "
        rows.append(("time", f"{about}{first_s:.4f} s to {last_s:.4f} s ({last_s - first_s:.4f} s)"))
    for part in document["parts"]:
        for name in ("trigger", "cut", "recovered"):
            if name in part:
                rows.append((name, ", ".join(f"{key} {value}" for key, value in part[name].items() if value)))
    rows.append(("ended", document["ended"]))
    rows.append(("checked", "every byte" + "".join(f" except {text}" for text in recording.unchecked)))
    if "health" in document:
        rows += _verdict(document)
    if not streams:
        rows.append(("messages", ", ".join(f"{key} {count}" for key, count in document["messages"].items())))
    tables = [fact_table("", rows)]
    if len(document["parts"]) > 1:
        tables.append(_parts_table(document["parts"]))
    if streams:
        tables.append(_streams_table(streams))
    tables.append(_channels_table(recording, document.get("health")))
    if "health" in document and (health_rows := _health(document["health"])):
        tables.append(fact_table("", health_rows, doubt="yellow"))
    if document["events"]:
        tables.append(events_table(document["events"]))
    for table in tables:
        console.print(table)
        console.print()
    gaps = document["gaps"]
    console.print(f"gaps noted by the recorder: {len(gaps) or 'none'}")
    if gaps:
        table = new_table("", ">time [s]", "stream", ">missing", "")
        for gap in gaps[:_MAX_GAPS]:
            what = "messages" if gap["index"] < 0 else f"rows from {gap['index']} on"
            table.add_row(f"{gap['time_s']:.4f}", gap["key"], str(gap["size"]), what)
        console.print(table)
    if len(gaps) > _MAX_GAPS:
        console.print(f"  and {len(gaps) - _MAX_GAPS} more")


def _verdict(document: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the lines for the verdict, the losses and the doubts."""
    reasons = document["reasons"]
    more = f", and {len(reasons) - 1} more" if reasons[1:] else ""
    outcome = document["outcome"] + (f": {reasons[0]}{more}" if reasons else "")
    declared = sum(each["declared"] for each in document["streams"].values())
    health = document["health"]
    doubtful = [channel["name"] for channel in health["channels"] if channel["findings"]]
    doubts = len(health["findings"]) + len(health["warnings"])
    findings = [f"doubts in {', '.join(doubtful)}"] if doubtful else []
    findings += [f"{doubts} {'doubt' if doubts == 1 else 'doubts'} about the recording"] if doubts else []
    return [
        ("verdict", outcome),
        ("lost", "; ".join(_lost_rows(document)) or "nothing"),
        *([("taken", f"{declared} rows removed or delayed by declared faults")] if declared else []),
        ("health", "; ".join(findings) or f"{len(health['channels'])} channels without doubts"),
    ]


def _lost_rows(document: dict[str, Any]) -> list[str]:
    """Return descriptions of the losses; empty if there are none."""
    streams = document["streams"]
    noted = bool(document["gaps"])  # without noted gaps, missing rows appear only in the lines per stream
    lost = sum(_lost(each) - (0 if noted else min(_lost(each), each["missing"])) for each in streams.values())
    declared = sum(each["declared"] for each in streams.values())
    losses = [f"{lost} rows in {len(document['gaps'])} gaps"] if lost or (document["gaps"] and not declared) else []
    missing = {key: stream["missing"] for key, stream in streams.items() if stream["missing"]}
    return losses + [f"{rows} rows of {key} are missing" for key, rows in missing.items()]


def _lost(stream: dict[str, Any]) -> int:
    """Return the lost rows, without those that a fault removed."""
    return max(0, stream["lost"] - stream["declared"])


def _lost_at_ends(recording: Recording, key: str) -> int:
    """Return the rows noted as lost before the first and after the last row, without those that a fault removed."""
    stream = recording.streams[key]
    gaps = [(gap.index, gap.size) for gap in recording.gaps if gap.key == key and gap.index >= 0 < gap.size]
    lost, explained = (
        sum(rows for row, rows in each if row + rows <= stream.first or row >= stream.due)
        for each in (gaps, stream.gap_rows)
    )
    return max(0, lost - explained)


def _number(value: float | None, noise: float) -> str:
    """Return a value rounded to the digit of its noise."""
    if value is None:
        return ""
    digits = -math.floor(math.log10(abs(noise))) if noise else 0
    if not 0 <= digits <= 6 or abs(value) >= 1e7:
        return f"{value:.4g}"
    return f"{round(value, digits) + 0.0:.{digits}f}"  # avoids -0


def _parts_table(parts: list[dict[str, Any]]) -> Table:
    table = new_table("", "part", ">MB", ">from [s]", ">to [s]", "ended", wrapped=["ended"])
    for part in parts:
        end = part["end"]
        times = (f"{float(end[name]):.4f}" if name in end else "?" for name in ("first_time_s", "last_time_s"))
        table.add_row(Path(part["file"]).name, f"{part['size_bytes'] / 1e6:.1f}", *times, part["ended"])
    return table


def _streams_table(streams: dict[str, dict[str, Any]]) -> Table:
    table = new_table("", "stream", ">blocks", ">rows", ">from [s]", ">to [s]", ">lost")
    for key, stream in streams.items():
        times = (f"{stream['first_time_s']:.4f}", f"{stream['last_time_s']:.4f}")
        counts = (str(stream["messages"]), str(stream["rows"]))
        lost = max(_lost(stream), stream["missing"])
        table.add_row(key, *counts, *times, str(lost), style="red" if lost else "")
    return table


def _channels_table(recording: Recording, health: dict[str, Any] | None) -> Table:
    from rig.base.wire import sensor_key

    statistics = {channel["name"]: channel for channel in (health or {}).get("channels", [])}
    statistics_columns = (">mean", ">low", ">high", ">noise", ">calibrated", "health") if statistics else ()
    table = new_table(
        "",
        *("channel", "unit", *statistics_columns, "range", ">step", ">rate [Hz]", "label"),
        wrapped=("health", "label"),
        spare=("label", "rate [Hz]", "step", "range", "calibrated") if statistics else (),
    )
    for group in recording.table.groups.values():
        if sensor_key(group.name) not in recording.messages:
            continue
        for channel in group.channels:
            ends = sorted((volts - channel.bias_v) / channel.sensitivity_v for volts in channel.range_v)
            reach = f"{ends[0]:.4g} to {ends[1]:.4g}" if channel.has_range else "not known"
            entry = statistics.get(make_printable(channel.name), {})
            numbers = [
                _number(entry.get(name), entry.get("noise") or channel.scale) for name in ("mean", "low", "high")
            ]
            noise = ("" if entry.get(name) is None else f"{entry[name]:.2g}" for name in ("noise", "noise_calibrated"))
            findings = entry.get("findings", [])
            verdict = "; ".join(findings) or ("good" if entry else "")
            table.add_row(
                *(channel.name, channel.unit, *((*numbers, *noise, verdict) if statistics else ())),
                *(reach, f"{abs(channel.scale):.2g}", f"{group.rate_hz}", channel.label),
                style="yellow" if findings else "",
            )
    return table


def _health(health: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the lines for the clock, the engine and the doubts about the whole recording."""
    rows = []
    if health["pace"] is not None:
        real_time = abs(health["pace_ppm"]) < 1e4
        ppm = f"{health['pace_ppm']:+.1f} ppm (known to {health['pace_error_ppm']:.1f})"
        pace = f"real time {ppm}" if real_time else f"x{health['pace']:.4g} real time"
        strays = f", without {health['strays']:.1%} strays" if health["strays"] else ""
        jitter = f"jitter {health['jitter_ms']:.2f} ms rms, {health['jitter_max_ms']:.2f} ms at most{strays}"
        rows.append(("clock", f"{pace}, {jitter}"))
    status = health["status"]
    late = status.get("lateness_ms") or {}
    figures = [f"{name} {late[name]:.3f}" for name in ("p50", "p99", "max") if isinstance(late.get(name), float | int)]
    if figures:
        rows.append(("lateness", f"the rig's, in ms: {', '.join(figures)}; overruns {status.get('overruns', '?')}"))
    from rig.cli.output.display import accuracy_text, engine_text

    if isinstance(engine := status.get("engine"), dict):
        rows.append(("engine", engine_text(engine)))
    if isinstance(accuracy := status.get("accuracy"), dict):
        rows.append(("error estimate", f"the rig's: {accuracy_text(accuracy)}"))
    rows += [("doubt", text) for text in health["findings"]]
    return rows + [("doubt", f"the rig warned: {text}") for text in health["warnings"]]


def events_table(events: list[dict[str, Any]]) -> Table:
    """Return a table of the events; a command and its effect share one row, with the sender."""
    from recorder.files.schemas import event_text

    def event_key(event: dict[str, Any], name: str) -> tuple[str, str]:
        return str(event.get("tick")), str(event.get(name))

    effects = {event_key(event, "event") for event in events}
    commands_by_effect: dict[tuple[str, str], list[dict[str, Any]]] = {}
    table = new_table("", ">time [s]", "event", wrapped=["event"])
    for event in events:
        if event.get("event") == "command" and event_key(event, "command") in effects:
            commands_by_effect.setdefault(event_key(event, "command"), []).append(event)
            continue
        if commands := commands_by_effect.get(event_key(event, "event")):
            event = event | {name: value for name, value in commands.pop(0).items() if name in ("id", "from")}
        time_s = event.get("time_s")
        stamp = f"{time_s:.4f}" if isinstance(time_s, float | int) else ""
        table.add_row(stamp, event_text(event)[1], style="bold" if event.get("event") == "note" else "")
    return table
