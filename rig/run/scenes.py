"""Scenes: the definition of a run. Read from TOML, checked and frozen; values can be overridden by dotted key."""

from __future__ import annotations

import json
import tomllib
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, FiniteFloat, field_validator, model_validator

from rig.base.checks import Written, check, get_table, parse_toml, read_toml
from rig.base.errors import InputError, Words, such_as
from rig.base.files import is_file
from rig.base.text import build_html_table
from rig.channels.channel_file import check_table, read_channels
from rig.channels.faults import Setting
from rig.channels.formula import Formulas
from rig.channels.generators import Generator, VoltageSource, sources
from rig.channels.sampling import SensorChoice, check_rates, row_ticks
from rig.channels.table import ChannelTable, check_signals, default_table
from rig.physics.engine_choice import EngineChoice
from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import COLUMN
from rig.physics.levels import ModelLevels
from rig.physics.parameters import DEFAULT_SET, ParameterSet, apply_changes, load_parameters
from rig.run.commands.table import SpeedCommand, TimedCommand, nest_faults
from rig.run.model_choice import Pick, digest, equations_digest
from rig.run.speed_target import Drive

SCENES = Path(__file__).with_name("scenes")


class Initial(Written):
    """Position of the shaft at time zero, at rest except for its spin."""

    position: Literal["equilibrium", "top", "bottom", "given"] = "equilibrium"
    x_mm: FiniteFloat = 0.0
    """Position of the shaft in the ring, for position "given" [mm]."""
    y_mm: FiniteFloat = 0.0
    """Position of the shaft in the ring, for position "given" [mm]."""
    magnets: bool = True
    """False: the shaft is released at the start."""


@cache
def rig_table() -> ChannelTable:
    """Return the rig's own channel table, checked against the model.

    Raises:
        InputError: A channel uses a signal that the model does not have.
    """
    table = default_table()
    check_signals(table.channels.values(), COLUMN)
    return table


class Scene(Written):
    """Definition of a run: initial state, drive, timed commands, engine, sensors, seed, and parameters.

    Frozen and checked; the fields and their units are those of a scene file, such as `duration_s`. `rig.load_scene`
    creates one from a name or a file, with changed values if given.

    Example:
        >>> import rig
        >>> scene = rig.load_scene("hammer", {"duration_s": 0.5})
        >>> scene
        Scene(hammer: 0.5 s at 6.2 Hz, 1 command; parameters corrected, engine split 25 us, seed 1)
        >>> scene.commands[0].at_s, scene.commands[0].request.force_n, scene.table.groups["probes"].rate_hz
        (0.02, 100.0, 20000)
    """

    name: str = "scene"
    title: str = ""
    parameters: str = DEFAULT_SET
    """Name of a parameter set, or path of a file."""
    set: dict[str, Any] = Field(default={})
    """Changed parameters of this scene, each in its own unit."""
    duration_s: Annotated[FiniteFloat, Field(gt=0.0, le=86_400.0)] = 2.0
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    initial: Initial = Initial()
    drive: Drive = Drive()
    commands: tuple[TimedCommand, ...] = ()
    model: ModelLevels = ModelLevels()
    engine: EngineChoice = EngineChoice()
    sensors: SensorChoice = SensorChoice()
    channels: ChannelTable | None = None
    """The user's channel table, from the file in the scene (`rig.channels.channel_file`); None: the rig's own."""
    generator: Generator | None = None
    """Test signals in place of the physics (`rig.channels.generators`)."""
    fidelity: Literal["given", "auto"] = "given"
    """Model and engine as in the scene, or as picked and stored by `rig ladder`."""
    pick: Pick | None = None
    """The pick stored by `rig ladder --write`; used only with fidelity "auto"."""

    @model_validator(mode="before")
    @classmethod
    def _nest_faults(cls, data: Any) -> Any:
        return nest_faults(data)

    @field_validator("commands", mode="before")
    @classmethod
    def _check_command_tables(cls, commands: Any) -> Any:
        if not isinstance(commands, list | tuple):
            raise ValueError("a list of tables, each headed [[commands]]")
        return commands

    @field_validator("set")
    @classmethod
    def _check_parameters(cls, changes: dict[str, Any]) -> dict[str, Any]:
        # Every set has the same keys and limits, so any will do to check them.
        load_parameters().override(changes)
        return changes

    @model_validator(mode="after")
    def _check_engine(self) -> Scene:
        method = ENGINES[self.engine.name]
        for field, accepted in (("friction", method.frictions), ("contact", method.contacts)):
            if getattr(self.model, field) not in accepted:
                must = f"one of {', '.join(accepted)} with engine {self.engine.name}"
                raise InputError(f"model.{field}", must, getattr(self.model, field))
        if self.engine.tolerance and not method.tolerance:
            must = f"left out with engine {self.engine.name}, whose steps are fixed"
            raise InputError("engine.tolerance", must, self.engine.tolerance)
        if self.engine.companion and not self.engine.tolerance:
            raise InputError("engine.companion", "false without an engine.tolerance", True)
        for name, limit in self.engine.limits.as_dict().items():
            if not self.engine.companion:
                must = "left out without engine.companion = true, whose estimate it limits"
                raise InputError(f"engine.limits.{name}", must, limit)
        return self

    @field_validator("channels", mode="before")
    @classmethod
    def _read_table(cls, channels: Any) -> Any:
        if not isinstance(channels, str | Path):
            return channels
        numbers = load_parameters().numbers()
        return read_channels(Path(channels), lambda table: Formulas(numbers, table.curves).check(table))

    @model_validator(mode="after")
    def _check_sensors(self) -> Scene:
        if self.channels is not None:
            check_table(self.channels)
        groups = (self.channels or rig_table()).groups
        for name in self.sensors.groups:
            if name not in groups or self.sensors.groups.count(name) > 1:
                raise InputError("sensors.groups", f"a list of different names out of {', '.join(groups)}", name)
        self.formulas().check(self.table)
        check_rates(self.table, 1_000_000 // self.row_ticks, field="sensors.rate_hz" if self.sensors.rate_hz else "")
        return self

    @model_validator(mode="after")
    def _check_commands(self) -> Scene:
        last: dict[str, TimedCommand] = {}
        for timed in sorted(self.commands, key=lambda timed: timed.at_s):
            timed.request.check_in_scene(timed.at_s, last, magnets=self.initial.magnets)
            last[timed.request.command] = timed
        return self

    @model_validator(mode="after")
    def _check_generator(self) -> Scene:
        if self.generator is not None:
            commands = [one for one in self.commands if one.request.MECHANICAL]
            limits = self.engine.limits.as_dict()
            fields = {"commands": commands, "drive.profile": self.drive.profile, "engine.limits": limits}
            for name, given in fields.items():
                if given:
                    raise InputError(name, "left out with a [generator], which replaces the physics", Words("some"))
            if self.fidelity == "auto":
                raise InputError("fidelity", '"given" with a [generator], which has no model', "auto")
            self.sources()
        return self

    @model_validator(mode="after")
    def _check_pick(self) -> Scene:
        if self.fidelity == "auto":
            if self.pick is None:
                raise InputError("fidelity", '"given" until `rig ladder SCENE --write FILE` has stored a pick', "auto")
            picked = self.pick.apply(self.model_dump())
            own = self.model_dump()
            if any(own[name] != picked[name] for name in ("model", "engine", "drive", "sensors")):
                raise InputError("fidelity", '"given" where model, engine, drive or sensors are chosen by hand', "auto")
        return self

    def __repr__(self) -> str:
        if self.generator is not None:
            return f"Scene({self.name}: {self.duration_s:g} s of signals, {self.generator.kind}; seed {self.seed})"
        speeds = [speed for _, speed in self.drive.profile] or [self.drive.speed_hz]
        speed = " to ".join(f"{each:g}" for each in dict.fromkeys((speeds[0], speeds[-1])))
        commands = f"{len(self.commands)} command{'s' * (len(self.commands) != 1)}"
        return (
            f"Scene({self.name}: {self.duration_s:g} s at {speed} Hz, {commands}; parameters "
            f"{self.parameters}, engine {self.engine.name} {self.engine.step_us} us, seed {self.seed})"
        )

    __str__ = __repr__

    def _repr_html_(self) -> str:
        rows: list[tuple[str, object]] = []
        for name, value in self.model_dump(mode="json", exclude_defaults=True, exclude={"channels"}).items():
            parts = {f"{name}.{key}": part for key, part in value.items()} if isinstance(value, dict) else {name: value}
            rows += parts.items()
        return build_html_table(repr(self), ("setting (others: the default)", "value"), rows)

    @property
    def fidelity_line(self) -> str | None:
        """Line about the pick that a run uses; None for a scene without pick."""
        if self.fidelity == "given" or self.pick is None:
            return None
        pick = self.pick
        levels = ", ".join(getattr(pick, name) for name in ModelLevels.model_fields)
        picked = ", ".join(
            f"{entry.quantity} within {entry.tolerance:g} (measured {entry.total_error:.1e})"
            for entry in pick.quantities
        )
        finest = f" at {pick.engine_tolerance:g}" if pick.engine_tolerance else ""
        return (
            f"fidelity auto: {levels}; drive {pick.drive}, sensors {pick.sensors}; {pick.engine} "
            f"{pick.step_us} us{finest}; picked {pick.date} for {picked}"
        )

    @property
    def table(self) -> ChannelTable:
        """Channel table of the active sensors, at their rates."""
        return (self.channels or rig_table()).select_groups(self.sensors.groups, self.sensors.rate_hz or None)

    @property
    def row_ticks(self) -> int:
        """Ticks between the rows for sensors and truth, determined by the channels and not by the engine's step."""
        sensors = self.sensors
        return row_ticks(self.table, truth_rate_hz=sensors.truth_rate_hz, ideal=sensors.chain == "ideal")

    @property
    def setting(self) -> Setting:
        """Conditions that determine which faults are possible."""
        return Setting(self.sensors.chain == "ideal", self.sensors.noise, self.generator is not None)

    def sources(self) -> dict[str, VoltageSource]:
        """Return the generator's signal at the converter of each active channel: `sources()["disk_x"].volts(times_s)`.

        Raises:
            InputError: The scene has no generator.
        """
        if self.generator is None:
            raise InputError("scene", "one with a [generator]", self.name)
        rate = self.sensors.rate_hz or None
        # A channel's position among all channels does not depend on which are active.
        all_sources = sources(
            self.generator, (self.channels or rig_table()).select_groups((), rate), self.drive.speed_hz
        )
        return {name: all_sources[name] for name in self.table.channels}

    def check_physics(self) -> None:
        """Raise an error for a scene of test signals, in which nothing moves.

        Raises:
            InputError: The scene has a generator.
        """
        if self.generator is not None:
            raise InputError("scene", "one of the physics, without a [generator]", self.name)

    def formulas(self) -> Formulas:
        """Return the names that formulas of channels may use."""
        return Formulas(self.load_parameters().numbers(), self.table.curves)

    def load_parameters(self) -> ParameterSet:
        """Return the scene's parameters with its changes applied."""
        parameters = load_parameters(self.parameters)
        return apply_changes(parameters, self.set, source=f"scene {self.name}") if self.set else parameters


def scene_names() -> list[str]:
    """Return the names of the built-in scenes."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def scene_path(name_or_path: str | Path) -> Path:
    """Return the file of a built-in scene, or of a user's scene.

    Raises:
        InputError: The file does not exist.
    """
    if not isinstance(name_or_path, str | Path):
        raise InputError("scene", "a name, or the path of a .toml file", name_or_path)
    path = SCENES / f"{name_or_path}.toml"
    if not is_file(path):
        path = Path(name_or_path)
        if path.suffix != ".toml" or not is_file(path):
            raise InputError(
                "scene",
                f"one of {', '.join(scene_names())}, or the path of a .toml file that exists",
                str(name_or_path),
            )
    return path


def load_scene(scene: Scene | str | Path, overrides: dict[str, Any] | None = None) -> Scene:
    """Load a scene by name, or a user's file by path; a loaded scene is returned, with changes if given.

    Args:
        scene: One of `scene_names()`, a .toml file, or a loaded scene.
        overrides: Changes by dotted key, of the scene (`drive.speed_hz`) or of its parameters (`contact.friction`, in
            the parameter's own unit). Strings are read as TOML values if possible.

    Raises:
        InputError: A value is wrong; the message has the field, and the file unless the value is among the overrides.

    Example:
        >>> scene = load_scene("hammer", {"drive.speed_hz": 5.2, "contact.friction": 0.3})
        >>> scene.drive.speed_hz, scene.load_parameters()["contact.friction"]
        (5.2, 0.3)
        >>> load_scene("hammer", {"drive.sped_hz": 5.2})
        Traceback (most recent call last):
        rig.base.errors.InputError: drive.sped_hz must be a field of a scene or a parameter, such as drive.speed_hz, ...
    """
    if isinstance(scene, Scene):
        return scene if overrides is None else change_scene(scene, overrides)
    path = scene_path(scene)
    data = {"name": path.stem, **read_toml(path)}
    for table, key in ((data, "channels"), (data.get("generator"), "file")):
        if isinstance(table, dict) and isinstance(table.get(key), str):
            table[key] = path.parent / table[key]  # relative to the scene file
    try:
        for key, value in _list_changes(overrides or {}):
            _override(data, key, read_value(value, field=key) if isinstance(value, str) else value)
        return _build_scene(data, list(overrides or {}))
    except InputError as error:
        if path.parent == SCENES or error.field in (overrides or {}):
            raise
        raise InputError(f"{path.name}: {error.field}", error.must, error.received) from None


def _build_scene(data: dict[str, Any], overrides: list[str]) -> Scene:
    """Return the scene of a file with overrides, if it can run."""
    scene = parse_scene({**data, "fidelity": "given"} if data.get("fidelity") == "auto" else data)
    if data.get("fidelity") == "auto":
        scene = _apply_pick(scene, data, overrides)
    return _check_speeds(scene)


def _check_speeds(scene: Scene) -> Scene:
    """Return a scene after checking its parameters and its speeds, so that a scene that loads can run."""
    top = scene.load_parameters().entries["drive.top_speed"].value
    speeds = {"drive.speed_hz": [scene.drive.speed_hz], "drive.profile": [speed for _, speed in scene.drive.profile]}
    speeds["speed.speed_hz"] = [
        timed.request.speed_hz for timed in scene.commands if isinstance(timed.request, SpeedCommand)
    ]
    for field, values in speeds.items():
        if not isinstance(top, str) and max(values, default=0.0) > top:
            raise InputError(field, f"at most drive.top_speed = {top:g} Hz", max(values))
    return scene


def change_scene(scene: Scene, changes: dict[str, Any]) -> Scene:
    """Return a loaded scene with changed values, by dotted key as in `load_scene`.

    A changed engine has its default step, tolerance and companion, and no limits. Changed limits select
    engine.tolerance again, unless it was given.

    Raises:
        InputError: A value is wrong; the message has the field.
    """
    data = scene.model_dump()
    pairs = _list_changes(changes)
    if "engine.name" in changes:
        data["engine"] = {}
    elif any(key.startswith("engine.limits") for key in changes) and scene.engine.tolerance_by_limits:
        data["engine"]["tolerance"] = 0.0
    for key, value in pairs:
        _override(data, key, value)
    return _check_speeds(parse_scene(data))


def _list_changes(changes: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return keys and values of changes; a notebook may pass any object."""
    if not isinstance(changes, dict) or not all(isinstance(key, str) for key in changes):
        raise InputError("changes", "a dictionary of values by dotted key", changes)
    return list(changes.items())


def _apply_pick(scene: Scene, data: dict[str, Any], overrides: list[str]) -> Scene:
    """Return the scene with its stored pick applied, if the pick belongs to this scene."""
    chosen_keys = [key for key in overrides if key.split(".")[0] in ("model", "engine") or key in _PICKED_KEYS]
    if chosen_keys:
        raise InputError("fidelity", f'"given" where {chosen_keys[0]} is chosen by hand', "auto")
    if scene.pick is not None:
        stored = (scene.pick.scene_digest, scene.pick.parameters_digest, scene.pick.code_digest)
        names = ("the scene", "its parameters", "the rig's equations or engines")
        changed = [name for name, a, b in zip(names, stored, pick_digests(scene), strict=True) if a != b]
        if changed:
            must = f'"given", or picked again by `rig ladder --write`: {" and ".join(changed)} changed since the pick'
            raise InputError("fidelity", must, "auto")
        data = scene.pick.apply(data)
    return parse_scene(data)


_PICKED_KEYS = ("drive.mode", "sensors.chain")


def pick_digests(scene: Scene) -> tuple[str, str, str]:
    """Return the digests that a pick depends on: the scene, its parameters, and equations and engines."""
    # Name and noise seed do not change the motion of a scene.
    left_out = {"name", "title", "seed", "parameters", "set", "model", "engine", "fidelity", "pick", "generator"}
    scene_text = scene.model_dump_json(exclude=left_out)
    values = {key: [entry.value, entry.unit] for key, entry in scene.load_parameters().entries.items()}
    return digest(scene_text.encode()), digest(json.dumps(values, sort_keys=True).encode()), equations_digest()


def parse_scene(data: dict[str, Any]) -> Scene:
    """Return a scene from its fields.

    Raises:
        InputError: The first wrong field.
    """
    return check(Scene, data, field="")


def _override(data: dict[str, Any], key: str, value: Any) -> None:
    if key in load_parameters().entries:
        data["set"] = {**get_table(data, "set"), key: value}
        return
    *path, last = key.split(".")
    fields: Any = Scene
    for part in [*path, last]:
        names = _inner(fields)
        if part not in names and path[:1] == ["commands"]:
            raise InputError(key, "a key outside the list `commands`: edit [[commands]] in the scene file", value)
        if part not in names:
            names = [*_scene_keys(), *load_parameters().entries]
            raise InputError(key, such_as("a field of a scene or a parameter", key, names), value)
        fields = names[part].annotation
    table = data
    for part in path:
        table[part] = dict(get_table(table, part))
        table = table[part]
    table[last] = value
    if key == "drive.speed_hz":
        table.pop("profile", None)


def _scene_keys(table: Any = Scene) -> list[str]:
    keys = []
    for name, field in _inner(table).items():
        inner = _scene_keys(field.annotation)
        keys += [f"{name}.{part}" for part in inner] if inner else [name]
    return keys


def _inner(annotation: Any) -> dict[str, Any]:
    """Return the fields of a table, or of an optional one."""
    return getattr(Generator if Generator in get_args(annotation) else annotation, "model_fields", {})


def read_value(text: str, *, field: str = "value") -> Any:
    """Return a value from the command line: a TOML value if possible, otherwise the text itself."""
    try:
        return parse_toml(f"value = {text}", field=field)["value"]
    except tomllib.TOMLDecodeError:
        return text


def scene_document(scene: Scene) -> dict[str, Any]:
    """Return the scene as a JSON document that is sufficient to run it again."""
    return json.loads(scene.model_dump_json())
