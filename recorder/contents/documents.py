"""What the documents of a recording must be: checked once, where it is opened, and believed behind that."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from recorder.files import schemas
from rig.base.checks import Count, input_error, read_json
from rig.base.errors import InputError
from rig.base.wire import EVENTS, FAULTS, STATUS, schema_of
from rig.channels.table import ChannelTable

_MOST_KEPT = 64 << 20
"""Documents of one kind that are kept in memory [bytes]."""
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Rate = Annotated[float, Field(gt=0.0, le=1e12, allow_inf_nan=False)]


class _Document(BaseModel):
    """A document that a rig of any version made: what this one reads of it has its types, the rest is kept."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


class _Text(BaseModel):
    """Metadata: numbers stand in them as text."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


def _instant(text: str) -> str:
    datetime.fromisoformat(text)
    return text


class TruthColumn(_Document):
    """A column of a truth table."""

    name: str
    unit: str
    label: str = ""


class TruthTable(_Document):
    """A truth table."""

    rate_hz: _Rate
    columns: Annotated[tuple[TruthColumn, ...], Field(min_length=1)]


class Catalogue(_Document):
    """The catalogue: what the rig measures, and how counts become values."""

    tick_rate_hz: Annotated[float, Field(ge=1.0, le=1e12)]
    table: ChannelTable
    truth: dict[str, TruthTable] = {}
    reference: dict[str, str] = {}


class _Value(_Document):
    value: _Finite | str
    unit: str = ""


class Parameters(_Document):
    """The parameters that the rig ran with."""

    set: str = ""
    values: dict[str, _Value]


class Taken(_Document):
    """A command that the rig took."""

    id: Count
    tick: Count
    command: str
    request: dict[str, Any]


class _Request(_Document):
    command: str


class _Timed(_Document):
    at_s: Annotated[float, Field(ge=0.0, le=1e10)]
    request: _Request


class _Engine(_Document):
    name: str | None = None
    levels: dict[str, str] = {}


class _Sensors(_Document):
    groups: tuple[str, ...] = ()
    rate_hz: Annotated[int, Field(ge=0, le=1_000_000_000)] = 0
    truth_rate_hz: Annotated[int, Field(ge=1, le=1_000_000_000)] | None = None


class _Fields(_Document):
    """Of a scene's fields those that are read before the scene itself is checked."""

    name: str = ""
    seed: int | None = None
    duration_s: _Finite | None = None
    parameters: str = ""
    set: dict[str, _Finite | str] = {}
    commands: tuple[_Timed, ...] = ()
    model: dict[str, str] = {}
    engine: _Engine = _Engine()
    sensors: _Sensors = _Sensors()


class _Mapping(_Document):
    channels: dict[str, dict[str, Any]] = {}


class _Import(_Document):
    mapping: _Mapping = _Mapping()
    unsure: dict[str, Annotated[_Finite, Field(gt=0.0)]] = {}


class Scene(_Document):
    """What was run."""

    name: str = ""
    seed: int | str = ""
    scene: _Fields | None = None
    taken: tuple[Taken, ...] = ()
    imported: _Import | None = Field(None, alias="import")


class Event(_Document):
    """What happened, as the rig or the recorder tells it."""

    event: str
    tick: int | None = None
    time_s: _Finite | None = None
    text: str = ""
    reason: str = ""
    tags: list[str] | None = None
    rows: dict[str, Count] | None = None


class Command(Taken):
    """The event of a command that was taken."""

    event: Literal["command"]
    time_s: _Finite | None = None


class Faults(_Document):
    """What the rig tells of its faults: one that begins or ends, or what has become of blocks."""

    event: str
    tick: int | None = None
    time_s: _Finite | None = None


class _Queue(_Document):
    dropped: Count = 0


class _Lateness(_Document):
    p50: _Finite | None = None
    p99: _Finite | None = None
    max: _Finite | None = None


class Status(_Document):
    """What the rig said of itself."""

    scene: str | None = None
    engine: _Engine = _Engine()
    queue: _Queue = _Queue()
    lateness_ms: _Lateness | None = None
    warnings: list[str] = []


class Gap(_Document):
    """What never arrived."""

    key: str
    index: Annotated[int, Field(ge=-1, lt=2**62)]
    size: Annotated[int, Field(gt=-(2**62), lt=2**62)]


class ClockPair(_Document):
    """Simulated and wall time of one arrival [s]."""

    time_s: Annotated[float, Field(ge=0.0, le=1e10)]
    wall_s: Annotated[float, Field(ge=0.0, le=1e11)]


class Rig(_Text):
    """Metadata `rig`, which opens a file."""

    format: Literal["rig-recording"]
    created: Annotated[str, AfterValidator(_instant)]
    view_rate_hz: Annotated[float, Field(ge=0.0, le=1e6)] = 0.0
    scene: str
    seed: str
    parameter_set: str


def _rows(text: str) -> str:
    """Rows by key, as JSON."""
    if not all(type(rows) is int and rows >= 0 for rows in read_json(text.encode(), field="rows").values()):
        raise ValueError("numbers of rows by key")
    return text


class End(_Text):
    """Metadata `end`, which closes it."""

    reason: str = "unknown"
    rows: Annotated[str, AfterValidator(_rows)] = "{}"
    first_time_s: float | None = None
    last_time_s: float | None = None


class SeriesPart(_Text):
    """Metadata `series`: one of several files in a row."""

    id: str
    number: Count


KINDS: dict[str, type[BaseModel]] = {
    EVENTS: Event,
    FAULTS: Faults,
    STATUS: Status,
    schemas.GAPS: Gap,
    schemas.CLOCK: ClockPair,
}
"""What is read of the documents of a recording, by topic."""
METADATA: dict[str, type[BaseModel]] = {"rig": Rig, "end": End, "series": SeriesPart}
ATTACHED: dict[str, type[BaseModel]] = {"catalogue": Catalogue, "parameters": Parameters, "scene": Scene}


def definition_of(key: str) -> schemas.Definition:
    """Return the message definition of a key's topic."""
    schema = schema_of(key)
    return schemas.TEXT if schema is None else schemas.BLOCKS[schema]


def holds_documents(topic: str) -> bool:
    """Return whether a topic of a recording holds JSON documents, not blocks or plottable messages."""
    return schema_of(topic) is None and not topic.startswith(schemas.VIEW + "/")


Model = TypeVar("Model", bound=BaseModel)


def read(model: type[Model], payload: bytes, *, field: str) -> tuple[dict[str, Any], Model]:
    """A document as it stands, and as its model.

    Raises:
        InputError: It is none, or out of bounds; the message names the first field that is wrong.
    """
    document = read_json(payload, field=field)
    try:
        return document, model.model_validate_json(payload, strict=True)
    except ValidationError as error:
        raise input_error(error, field, model) from None


def document_in(topic: str, payload: bytes) -> dict[str, Any] | None:
    """The document in a message of one of the topics `KINDS`; None where it is not what the topic promises."""
    try:
        document, found = read(KINDS[topic], payload, field=topic)
        if isinstance(found, Event) and found.event == "command":
            read(Command, payload, field=topic)
    except InputError:
        return None
    return document


def check_kept(kept_bytes: int, topic: str, path: Path) -> int:
    """Refuse a recording with more documents of one kind than memory is to hold; gives their size [bytes].

    Raises:
        InputError: It has.
    """
    if kept_bytes > _MOST_KEPT:
        raise InputError("file", f"a recording with at most {_MOST_KEPT} bytes of {topic}", str(path))
    return kept_bytes


def read_metadata(model: type[Model], entries: dict[str, str], *, field: str) -> Model:
    """Metadata as its model.

    Raises:
        InputError: The first field that is wrong.
    """
    try:
        return model.model_validate(entries)
    except ValidationError as error:
        raise input_error(error, field, model) from None


def check_version(about: dict[str, str]) -> None:
    """Refuse a version of the format that is not read.

    Raises:
        InputError: It is another one.
    """
    if about.get("version") not in schemas.READ_VERSIONS:
        must = f"a recording of format version {' or '.join(schemas.READ_VERSIONS)}"
        raise InputError("file", must, about.get("version"))
