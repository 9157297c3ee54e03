"""Campaign files, `*.campaign.toml`: parsing, checks of signals and units, and expansion of the matrix into cases."""

from __future__ import annotations

import ast
import itertools
import json
import math
import re
import shlex
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat

from replays.campaigns.equipment.bench import BenchSettings, Pace, Waits
from replays.campaigns.equipment.device import CAN_PLACES, PLACEHOLDER, PLACES, check_program, fill_placeholders
from replays.campaigns.files.case_results import Time, Units
from replays.campaigns.files.event_fields import check_event
from replays.campaigns.files.expectation import KINDS, Expect, ExpectEvent, find_selectors
from replays.campaigns.files.line_numbers import find_line, number_lines
from replays.campaigns.measurement import quantity, split_quantity
from rig.base.checks import TOML_BYTES, Written, check, parse_toml
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.files import build_read_error, is_file, read_file
from rig.channels.faults import find_channels, find_group
from rig.channels.faults.blocks import BlockFault
from rig.physics.kernels import signals
from rig.run.commands.table import COMMANDS, FaultCommand, TimedCommand, check_command
from rig.run.scenes import Scene, load_scene

SUFFIX = ".campaign.toml"
FOLDER = Path(__file__).parents[1]
"""Folder of the shipped campaigns."""
MAX_CASES = 10_000
"""Largest number of cases in a file."""
MAX_UNCONFIRMED_CASES = 1000
"""Largest number of cases that run without a confirmation."""
_BLOCK_MS = (1.0, 1000.0)
Line = Annotated[str, Field(min_length=1, max_length=1000)]


def _check_name(text: str) -> str:
    if not re.fullmatch(r"[\w.-]{1,50}", text):
        raise ValueError("1 to 50 letters, digits, dots, dashes and underscores")
    return text


def _check_quantity(text: Any) -> str:
    if not isinstance(text, str):
        raise ValueError("a number with its unit as a text, such as '0.2 mm'")
    return text


Quantity = Annotated[str, BeforeValidator(_check_quantity)]


class _Device(Written):
    command: Line
    name: Annotated[str, AfterValidator(_check_name)] = "device"
    joins: bool = True
    """True if it takes part in lockstep; if not, the rig does not wait for it."""
    commands: bool = True
    """True if it sends commands, which a recording does not accept."""
    folder: str = ""
    """Working folder, relative to that of the campaign file."""
    may_end: bool = False
    """True if it may end, or leave lockstep, before the end of the case."""


class _Matrix(Written):
    scene: list[str] = Field(default=[], min_length=1)
    set: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default={})
    fault: list[dict[str, Any]] = Field(default=[], min_length=1)
    limits: dict[str, Annotated[list[Quantity], Field(min_length=1)]] = Field(default={})
    device: dict[str, Annotated[list[str | int | float], Field(min_length=1)]] = Field(default={})


class _File(Written):
    title: Line
    about: str = ""
    scene: str = ""
    pace: Pace = "lockstep"
    block_ms: Annotated[FiniteFloat, Field(ge=_BLOCK_MS[0], le=_BLOCK_MS[1])] = 10.0
    duration_s: Annotated[FiniteFloat, Field(gt=0.0, le=86_400.0)] | None = None
    set: dict[str, Any] = Field(default={})
    channels: str = ""
    can: bool = False
    wait: Waits = Waits()
    device: _Device | None = None
    devices: list[_Device] = Field(default=[], min_length=1)
    limits: dict[str, Quantity] = Field(default={})
    matrix: _Matrix = _Matrix()
    steps: list[dict[str, Any]] = Field(default=[], min_length=1)
    expect: Annotated[list[dict[str, Any]], Field(min_length=1)]


@dataclass(frozen=True)
class Step:
    """A command or note at a time of the case.

    Attributes:
        at_s: Time from the start of the case [s].
        command: A command or fault; None for a note.
        note, tags: The note.
    """

    at_s: float
    command: TimedCommand | None = None
    note: str = ""
    tags: tuple[str, ...] = ()

    def describe(self) -> str:
        """Return the step as text, such as "0.4 s: fault channel=disk_x kind=hum amplitude_v=3"."""
        if self.command is None:
            return " ".join([f"{self.at_s:g} s: note {self.note}", *(f"#{tag}" for tag in self.tags)])
        values = {"command": "", **self.command.request.request()}
        shown = [f"{name}={value}" for name, value in values.items() if name != "command" and value is not None]
        return " ".join([f"{self.at_s:g} s: {self.command.request.command}", *shown])


@dataclass(frozen=True)
class Case:
    """One case of a campaign.

    Attributes:
        id: Name of the case, unique within the campaign: its values on the axes of the matrix.
        title: Title of the campaign.
        file: Campaign file.
        bench: Settings of the bench.
        duration_s: Length of the case [s].
        steps: Steps in order of time.
        devices: Devices under test, in the order of their start; without one the rig runs alone.
        expects: Expectations.
        axes: Values on the axes of the matrix, by axis.
        limits: Limits as text, by name.
        device_commands: Command lines of the devices with their placeholders.
    """

    id: str
    title: str
    file: Path
    bench: BenchSettings
    duration_s: float
    steps: tuple[Step, ...]
    devices: tuple[_Device, ...]
    expects: tuple[Expect, ...]
    axes: Mapping[str, str]
    limits: Mapping[str, str]
    device_commands: tuple[str, ...]

    def describe(self) -> dict[str, Any]:
        """Return settings and stimuli of the case for a sheet: texts that are the same in every run."""
        settings = {f"command line of {each.name}": each.command for each in self.devices}
        return {"settings": {**settings, **self.limits}, "stimuli": [each.describe() for each in self.steps]}


@dataclass(frozen=True)
class Campaign:
    """A campaign file and its cases."""

    title: str
    about: str
    cases: tuple[Case, ...]


def find_shipped() -> dict[str, Path]:
    """Return the files of the shipped campaigns, in TOML or for pytest, by name."""
    files = {file.name.removesuffix(SUFFIX): file for file in FOLDER.glob(f"*{SUFFIX}")}
    files |= {file.stem.removeprefix("test_").replace("_", "-"): file for file in FOLDER.glob("test_*.py")}
    return dict(sorted(files.items()))


def read_title(path: Path) -> str:
    """Return the title of a shipped campaign."""
    text = path.read_text("utf-8")
    if path.suffix == ".toml":
        return str(tomllib.loads(text)["title"])
    return (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0].removesuffix(".")


def campaign_path(name_or_path: str) -> Path:
    """Return the path of a shipped campaign, by its name, or of a user's campaign.

    Raises:
        UnknownNameError: If the argument looks like a name but is neither a shipped campaign nor a file.
    """
    shipped, path = find_shipped(), Path(name_or_path)
    if name_or_path not in shipped and re.fullmatch(r"[\w-]+", name_or_path) and not path.exists():
        raise UnknownNameError("FILE", "a file or a shipped campaign", name_or_path, shipped)
    return shipped.get(name_or_path, path)


def load_campaign(
    path: Path, device: str | None = None, limits: Sequence[str] = (), *, max_cases: int = MAX_CASES
) -> Campaign:
    """Read and check a campaign file.

    Args:
        path: The file.
        device: Command line that replaces that of the file's device.
        limits: Limits that replace those of the file and of its matrix, such as "danger=500 um".
        max_cases: Largest number of cases.

    Raises:
        InputError: For the first error, with the file and line.
    """
    try:
        text = read_file(path, TOML_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(str(path), "a TOML file", Words("bytes that are not UTF-8")) from None
    except OSError as error:
        raise build_read_error(path, error) from None
    try:
        document = parse_toml(text, field=str(path))
    except tomllib.TOMLDecodeError as error:
        problem, _, place = str(error).partition(" (at ")
        line = re.search(r"line (\d+)", place)
        where = f"{path}:{line[1] if line else text.count(chr(10)) + 1}"
        raise InputError(f"{where}: the text", "TOML", Words(problem)) from None
    with _add_location(path, text, {} if device is None else {"device.command": "--device"}):
        file = check(_File, document, field="")
        written = file
        if device is not None:
            if len(known := [file.device] if file.device else file.devices) != 1:
                raise InputError("--device", f"left out, as the campaign has {len(known)} devices, not one", device)
            own = known[0].model_copy(update={"command": device, "folder": str(Path.cwd())})
            can = file.can or any(f"{{{place}}}" in device for place in CAN_PLACES)
            file = file.model_copy(update={"device": own, "devices": [], "can": can})
        cases = tuple(_cases(path, _replace_limits(file, limits), max_cases))
        ids: set[str] = set()
        for case in cases:
            if case.id in ids:
                raise InputError("matrix", "cases with different names (give the faults an id)", case.id)
            ids.add(case.id)
        _check_use(written)
    return Campaign(file.title, file.about, cases)


def _replace_limits(file: _File, limits: Sequence[str]) -> _File:
    new = {name.strip(): value.strip() for name, _, value in (each.partition("=") for each in limits)}
    for name, value in new.items():
        known = {**file.limits, **file.matrix.limits}
        if name not in known:
            raise UnknownNameError("--limit", "NAME=QUANTITY with a limit of the campaign", name, known)
        of_file = known[name]
        first = of_file if isinstance(of_file, str) else of_file[0]
        unit = split_quantity(first, field=f"limits.{name}")[1]
        quantity(value, unit, field=f"--limit {name}", of=f"that of the file ({first})")
    matrix = {name: values for name, values in file.matrix.limits.items() if name not in new}
    return file.model_copy(
        update={"limits": {**file.limits, **new}, "matrix": file.matrix.model_copy(update={"limits": matrix})}
    )


@contextmanager
def _add_location(path: Path, text: str, options: Mapping[str, str]) -> Iterator[None]:
    """Add file and line to errors of fields, except of those that an option of the command line replaces."""
    try:
        yield
    except InputError as error:
        if (option := options.get(error.field, error.field)).startswith("--"):
            raise InputError(option, error.must, error.received) from None
        lines = number_lines(text)
        line = find_line(error.field, lines) or 1
        field = re.sub(r"\.\d+(?=\.|$)", "", error.field)
        must, received = error.must, error.received
        raise InputError(f"{path}:{line}: {field}", must, received) from None


def _check_use(file: _File) -> None:
    """Raise an error for a limit, or an axis of the matrix, that nothing uses."""
    commands = [each.command for each in (file.device, *file.devices) if each is not None]
    places = [file.steps, file.expect, file.matrix.fault, commands]
    used = {match[1] for match in PLACEHOLDER.finditer(json.dumps(places, default=str))}
    used |= {axis for each in file.expect if isinstance(when := each.get("when"), dict) for axis in when}
    matrix = file.matrix
    others = {"matrix.device": {**file.limits, **matrix.limits}, "matrix.set": {**matrix.limits, **matrix.device}}
    for table, names in {"limits": file.limits, "matrix.limits": matrix.limits, "matrix.device": matrix.device,
                         "matrix.set": matrix.set}.items():  # fmt: skip
        for name in names:
            if name in (*PLACES, "scene", "fault", *others.get(table, ())):
                raise InputError(f"{table}.{name}", "another name than those of placeholders, limits and axes", name)
            if table == "matrix.set":
                continue
            if name not in used:
                raise InputError(f"{table}.{name}", f"used somewhere as {{{name}}}", Words("a name that nothing uses"))


def _cases(path: Path, file: _File, max_cases: int) -> Iterator[Case]:
    axes = list(_axes(file))
    if (count := math.prod(len(values) for _, values in axes)) > max_cases:
        must = f"at most {max_cases:,} cases{', unless --yes is given' if max_cases < MAX_CASES else ''}"
        raise InputError("matrix", must, count)
    scenes: dict[str, Scene] = {}
    stem = path.name.removesuffix(SUFFIX)
    for chosen in itertools.product(*(values for _, values in axes)):
        entries = {name: entry for (name, _), entry in zip(axes, chosen, strict=True)}
        labels = {name.rpartition(" ")[2]: label for name, (label, _) in entries.items()}
        yield _case(path, file, entries, labels, ",".join(labels.values()) or stem, scenes)


_Entries = Mapping[str, tuple[str, Any]]


def _axes(file: _File) -> Iterator[tuple[str, list[tuple[str, Any]]]]:
    """Yield the axes of the matrix, each with the label and value of every entry."""
    matrix = file.matrix
    if matrix.scene:
        yield "scene", [(Path(each).stem, each) for each in matrix.scene]
    for key, values in matrix.set.items():
        short = key.rpartition(".")[2]
        yield f"set {key}", [(f"{short}={_shorten(value)}", value) for value in values]
    if matrix.fault:
        yield "fault", [(_fault_name(each, n), (n, each)) for n, each in enumerate(matrix.fault)]
    for key, values in matrix.limits.items():
        yield f"limits {key}", [(f"{key}={_shorten(value)}", value) for value in values]
    for key, values in matrix.device.items():
        yield f"device {key}", [(f"{key}={_shorten(value)}", value) for value in values]


def _shorten(value: Any) -> str:
    return re.sub(r"[^\w.+-]+", "", f"{value:g}" if isinstance(value, float) else str(value))[:40] or "empty"


def _fault_name(fault: Mapping[str, Any], number: int) -> str:
    name = fault.get("id", "-".join(str(fault[key]) for key in ("channel", "kind") if key in fault))
    if not isinstance(name, str) or not re.fullmatch(r"[\w.+-]+", name):
        raise InputError(f"matrix.fault.{number}.id", "a name of letters, digits, dots and dashes", name or None)
    return name


def _case(
    path: Path, file: _File, entries: _Entries, axis_labels: Mapping[str, str], name: str, scenes: dict[str, Scene]
) -> Case:  # fmt: skip
    values = {axis: value for axis, (_, value) in entries.items()}
    scene_name = values.get("scene", file.scene)
    if not scene_name:
        raise InputError("scene", "given, here or in [matrix]", None)
    beside = path.parent / scene_name
    scene_name = str(beside) if scene_name.endswith(".toml") and is_file(beside) else scene_name
    changes = {**file.set, **{axis.partition(" ")[2]: each for axis, each in values.items() if axis.startswith("set ")}}
    limits = {**file.limits, **{axis[7:]: each for axis, each in values.items() if axis.startswith("limits ")}}
    knobs = {axis[7:]: str(each) for axis, each in values.items() if axis.startswith("device ")}
    for key, text in limits.items():
        split_quantity(text, field=f"limits.{key}")
    places = {**limits, **knobs}
    table = None if not file.channels else path.parent / file.channels
    scene = _scene(file, scene_name, changes, table, scenes)
    duration_s = file.duration_s or scene.duration_s
    steps = [_step(one, f"steps.{n}", places, duration_s, scene, file) for n, one in enumerate(file.steps)]
    number, fault = values.get("fault", (0, {}))
    if set(fault) - {"id"}:
        one = {"command": "fault", "at_s": 0.0, **{key: each for key, each in fault.items() if key != "id"}}
        steps.append(_step(one, f"matrix.fault.{number}", places, duration_s, scene, file))
    timed = [step.command.model_dump(exclude_none=True) for step in steps if step.command is not None]
    own = [each.model_dump(exclude_none=True) for each in scene.commands]
    with _field("steps"):
        load_scene(scene_name, {**changes, **({"channels": table} if table else {}), "commands": [*own, *timed]})
    units_by_table: Units = {"": {key: each.unit for key, each in scene.table.channels.items()}, **_TRUTH}
    axes = {axis.rpartition(" ")[2]: [label for label, _ in each] for axis, each in _axes(file)}
    devices = tuple(_devices(file, places, path))
    sources = {"note" if step.command is None else "command" for step in steps} | {"command" for _ in own}
    expects, channels = [], [*scene.table.channels, *scene.table.groups]
    for n, one in enumerate(file.expect):
        expect = _expect(one, f"expect.{n}", places, units_by_table, duration_s)
        for at, selector in find_selectors(expect):
            check_event(selector, channels, field=f"expect.{n}{at}")
        if isinstance(expect, ExpectEvent):
            _check_reach(expect, f"expect.{n}", steps, file)
        _check_when(expect, f"expect.{n}.when", axes)
        _check_pace(expect, f"expect.{n}", devices if file.pace == "lockstep" else (), sources)
        if all(axis_labels[axis] in labels for axis, labels in _when(expect)):
            expects.append(expect)
    if not expects:
        raise InputError("expect", "with something for each case", Words(f"nothing for {name}"))
    bench = BenchSettings(
        scene=scene_name,
        pace=file.pace,
        block_ms=file.block_ms,
        set=changes,
        table=table,
        can=file.can,
        wait=file.wait,
    )
    ordered = tuple(sorted(steps, key=lambda step: step.at_s))
    written = tuple(each.command for each in (file.device, *file.devices) if each is not None)
    return Case(
        name, file.title, path, bench, duration_s, ordered, devices, tuple(expects), axis_labels, limits, written
    )  # fmt: skip


_TRUTH: Units = {
    table: {name: signal.unit for name in columns for signal in signals.ROW if signal.name == name}
    for table, columns in signals.TRUTH.items()
}


def _scene(
    file: _File, name: str, changes: Mapping[str, Any], table: Path | None, scenes: dict[str, Scene]
) -> Scene:  # fmt: skip
    key = f"{name} {sorted(changes.items())!r}"
    if key not in scenes:
        try:
            scenes[key] = load_scene(name, {**changes, **({"channels": table} if table else {})})
        except InputError as error:
            # Name the place of the change that causes the error: the file's own table or the matrix.
            place = error.field
            if place in file.matrix.set:
                place = f"matrix.set.{place}"
            elif place in file.set:
                place = f"set.{place}"
            elif place == "scene":
                place = "matrix.scene" if name in file.matrix.scene else "scene"
            elif table is not None:
                place = f"channels.{place}"
            raise InputError(place, error.must, error.received) from None
    return scenes[key]


@contextmanager
def _field(name: str) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}.{error.field}", error.must, error.received) from None


def _fill_placeholders(value: Any, places: Mapping[str, str], field: str, kept: tuple[str, ...] = ()) -> Any:
    """Fill in the placeholders of all texts of a value."""
    if isinstance(value, dict):
        return {key: _fill_placeholders(each, places, f"{field}.{key}", kept) for key, each in value.items()}
    if isinstance(value, list):
        return [_fill_placeholders(each, places, f"{field}.{n}", kept) for n, each in enumerate(value)]
    return fill_placeholders(value, places, field, kept) if isinstance(value, str) else value


def _step(
    entry: Mapping[str, Any], field: str, places: Mapping[str, str], duration_s: float, scene: Scene, file: _File
) -> Step:  # fmt: skip
    one = _fill_placeholders(dict(entry), places, field)
    for key, text in entry.items():
        if isinstance(text, str) and (match := PLACEHOLDER.fullmatch(text)) and match[2]:
            one[key] = float(one[key])  # a number in a unit
    if "note" in one:
        note = check(_Note, one, field=field)
        step = Step(note.at_s, None, note.note, tuple(note.tags))
    else:
        step = Step(check(_Timed, {"at_s": one.pop("at_s", None)}, field=field).at_s, None)
        name = one.pop("command", None)
        if not isinstance(name, str):
            must = f"given ({', '.join(COMMANDS)}), or a note"
            raise InputError(f"{field}.command", must, name)
        try:
            request = check_command(name, one)
        except InputError as error:
            inner = error.field.removeprefix(f"{name}.")
            raise InputError(f"{field}.{inner}", error.must, error.received) from None
        if isinstance(request, FaultCommand):
            _check_fault(request, field, scene, can=file.can)
        step = replace(step, command=TimedCommand(at_s=step.at_s, request=request))
    if step.at_s >= duration_s:
        raise InputError(f"{field}.at_s", f"before the case's end, {duration_s:g} s", step.at_s)
    return step


class _Timed(Written):
    at_s: Time


class _Note(_Timed):
    note: Line
    tags: list[str] = Field(default=[])


def _check_fault(request: FaultCommand, field: str, scene: Scene, *, can: bool) -> None:
    what, setting = request.what, scene.setting
    try:
        if isinstance(what, BlockFault):
            find_group(what, request.channel, scene.table, ("zenoh", "can") if can else ("zenoh",))
        else:
            find_channels(
                what, request.channel, scene.table,
                ideal=setting.ideal, noisy=setting.noisy, generated=setting.generated,
            )  # fmt: skip
    except InputError as error:
        raise InputError(f"{field}.{error.field.removeprefix('fault.')}", error.must, error.received) from None


def _expect(
    entry: Mapping[str, Any], field: str, places: Mapping[str, str], units_by_table: Units, duration_s: float
) -> Expect:  # fmt: skip
    kinds = [key for key in KINDS if key in entry]
    if len(kinds) != 1:
        received = Words(" and ".join(kinds) or "none of them")
        raise InputError(field, f"about one of {', '.join(KINDS)}", received)
    expect = check(KINDS[kinds[0]], _fill_placeholders(dict(entry), places, field), field=field)
    expect.check(units_by_table, where=field)
    times = {name: getattr(expect, name, None) for name in ("from_s", "at_s", "to_s")}
    times["since.at_s"] = getattr(getattr(expect, "since", None), "at_s", None)
    for name, time_s in times.items():
        if time_s is not None and (time_s > duration_s or (time_s == duration_s and name != "to_s")):
            raise InputError(f"{field}.{name}", f"within the case, which ends at {duration_s:g} s", time_s)
    if times["to_s"] is not None and not times["from_s"] < times["to_s"]:
        raise InputError(f"{field}.to_s", f"after from_s, {times['from_s']:g} s", times["to_s"])
    return expect


def _when(expect: Expect) -> Iterator[tuple[str, list[str]]]:
    """Yield the axes that restrict an expectation, each with the labels of its values."""
    for axis, values in expect.when.items():
        labels = [_shorten(each) for each in (values if isinstance(values, list) else [values])]
        short = "" if axis in ("scene", "fault") else f"{axis.rpartition('.')[2]}="
        yield axis, [label if label.startswith(short) else f"{short}{label}" for label in labels]


def _check_when(expect: Expect, field: str, axes: Mapping[str, list[str]]) -> None:
    for axis, labels in _when(expect):
        if axis not in axes:
            raise UnknownNameError(f"{field}.{axis}", "an axis of the matrix", axis, axes)
        if not labels:
            raise InputError(f"{field}.{axis}", "a value or a list of values", labels)
        for label in labels:
            if label not in axes[axis]:
                raise UnknownNameError(f"{field}.{axis}", f"a value of {axis} in the matrix", label, axes[axis])


def _check_reach(expect: ExpectEvent, field: str, steps: Sequence[Step], file: _File) -> None:
    """Check that a device can decide an expected event: no step of the campaign is the event, and a block ends in time.

    Raises:
        InputError: If a step of the campaign is the event, or events of devices have no possible time between the two.
    """
    for step in steps if expect.appears and "from" not in expect.where else ():
        sent = {"event": "note", "text": step.note, "tags": list(step.tags)}
        if step.command is not None:
            request = step.command.request
            sent = {"event": "command", "command": request.command, "request": request.request()}
        if (step.command is None or file.pace != "lockstep") and expect.of.matches(sent, {}):
            must = f"given with from, as the step at {step.at_s:g} s is such a {expect.event} too"
            raise InputError(f"{field}.where", must, str(expect.of))
    if file.pace != "lockstep" or expect.to_s is None or expect.event not in ("note", "command", "device"):
        return
    block_s = 1e-3 * file.block_ms
    if math.ceil(expect.from_s / block_s - 1e-6) * block_s >= expect.to_s - 1e-9:
        must = f"after a multiple of block_ms since from_s, as {expect.event} has such times in lockstep"
        raise InputError(f"{field}.to_s", must, expect.to_s)


def _check_pace(expect: Expect, field: str, devices: tuple[_Device, ...], sources: set[str]) -> None:
    """Check that an expectation in lockstep is not about events of a device for which the rig does not wait.

    An event without `from` is that of such a device if all devices are such ones, and the case has no step that may be
    its source.
    """
    outside = [device.name for device in devices if not device.joins]
    sends = any(device.commands for device in devices if not device.joins)
    known = {"campaign", *(device.name for device in devices if device.joins)}
    for _, event in find_selectors(expect) if outside else ():
        sender = event.where.get("from")
        is_device_event = event.event in ("note", "command", *COMMANDS)
        is_from_step = ("note" if event.event == "note" else "command") in sources
        only_outside = sends and len(known) == 1 and is_device_event and not (sender is None and is_from_step)
        if sender in outside or (only_outside and sender not in known):
            must = (
                f"about events whose time is exact, not of {' or '.join(outside)}: the rig does not wait for it in "
                'lockstep (use joins = true, or pace = "real-time")'
            )
            raise InputError(field, must, str(event))


def _devices(file: _File, places: Mapping[str, str], path: Path) -> Iterator[_Device]:
    if file.device is not None and file.devices:
        raise InputError("devices", "left out with [device]", len(file.devices))
    several = {f"devices.{n}": device for n, device in enumerate(file.devices)}
    names = {"rig"}  # the log of the rig is rig.log
    for field, device in (several if file.device is None else {"device": file.device}).items():
        if device.name in names:
            raise InputError(f"{field}.name", "another name than rig and those of other devices", device.name)
        names.add(device.name)
        folder = path.parent / device.folder
        if not folder.is_dir():
            raise InputError(f"{field}.folder", "a folder", device.folder)
        field = f"{field}.command"
        command = _fill_placeholders(device.command, places, field, PLACES)
        for place in CAN_PLACES:
            if not file.can and f"{{{place}}}" in command.replace("{{", ""):
                raise InputError(field, f"without {{{place}}} unless can = true", command)
        try:
            words = shlex.split(command)
        except ValueError as error:
            raise InputError(field, "a command line", Words(f"{command} ({error})")) from None
        check_program(words, folder, field=field)
        yield _Device(**{**device.model_dump(), "command": command})
