"""Models of the documents in a recording. Documents are validated once, when the file is opened."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from recorder.files import schemas
from rig.base.checks import Count, input_error, read_json
from rig.base.errors import InputError
from rig.base.wire import EVENTS, FAULTS, STATUS, get_schema
from rig.channels.table import ChannelTable

_MAX_KEPT_BYTES = 64 << 20
"""Size limit of the documents of one kind that are held in memory [bytes]."""
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Rate = Annotated[float, Field(gt=0.0, le=1e12, allow_inf_nan=False)]


class _Document(BaseModel):
    """JSON document of any rig version: fields used here are type-checked, all others are kept."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


class _Text(BaseModel):
    """Metadata record, in which numbers are stored as text."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


def _instant(text: str) -> str:
    datetime.fromisoformat(text)
    return text


class TruthColumn(_Document):
    """Column of a truth table."""

    name: str
    unit: str
    label: str = ""


class TruthTable(_Document):
    """Truth table."""

    rate_hz: _Rate
    columns: Annotated[tuple[TruthColumn, ...], Field(min_length=1)]


class Catalogue(_Document):
    """Catalogue document: channels, truth tables and the conversion from counts to values."""

    tick_rate_hz: Annotated[float, Field(ge=1.0, le=1e12)]
    table: ChannelTable
    truth: dict[str, TruthTable] = {}
    reference: dict[str, str] = {}


class _Value(_Document):
    value: _Finite | str
    unit: str = ""


class Parameters(_Document):
    """Parameter document of the run."""

    set: str = ""
    values: dict[str, _Value]


class AcceptedCommand(_Document):
    """Command accepted by the rig."""

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
    """Scene fields that are read before the scene itself is validated."""

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
    mark_deg: tuple[_Finite, Annotated[_Finite, Field(gt=0.0)]] | None = None


class Scene(_Document):
    """Scene document: what was run."""

    name: str = ""
    seed: int | str = ""
    scene: _Fields | None = None
    taken: tuple[AcceptedCommand, ...] = ()
    imported: _Import | None = Field(None, alias="import")


class Event(_Document):
    """Event of the rig or of the recorder."""

    event: str
    tick: int | None = None
    time_s: _Finite | None = None
    text: str = ""
    reason: str = ""
    tags: list[str] | None = None
    rows: dict[str, Count] | None = None


class Command(AcceptedCommand):
    """Event of an accepted command."""

    event: Literal["command"]
    time_s: _Finite | None = None


class Faults(_Document):
    """Fault document: a fault begins or ends, or reports what it did to blocks."""

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
    """Status document of the rig."""

    scene: str | None = None
    engine: _Engine = _Engine()
    queue: _Queue = _Queue()
    lateness_ms: _Lateness | None = None
    warnings: list[str] = []


class Gap(_Document):
    """Gap document: rows or messages that never arrived."""

    key: str
    index: Annotated[int, Field(ge=-1, lt=2**62)]
    size: Annotated[int, Field(gt=-(2**62), lt=2**62)]


class ClockPair(_Document):
    """Simulated and wall time of one arrival [s]."""

    time_s: Annotated[float, Field(ge=0.0, le=1e10)]
    wall_s: Annotated[float, Field(ge=0.0, le=1e11)]


class Rig(_Text):
    """Metadata record `rig` at the start of a file."""

    format: Literal["rig-recording"]
    created: Annotated[str, AfterValidator(_instant)]
    view_rate_hz: Annotated[float, Field(ge=0.0, le=1e6)] = 0.0
    scene: str
    seed: str
    parameter_set: str


def _rows(text: str) -> str:
    """Return JSON text of row counts by key; raise ValueError if it is anything else."""
    if not all(type(rows) is int and rows >= 0 for rows in read_json(text.encode(), field="rows").values()):
        raise ValueError("numbers of rows by key")
    return text


class End(_Text):
    """Metadata record `end` that closes a file."""

    reason: str = "unknown"
    rows: Annotated[str, AfterValidator(_rows)] = "{}"
    first_time_s: float | None = None
    last_time_s: float | None = None


class SeriesPart(_Text):
    """Metadata record `series` of one file in a series."""

    id: str
    number: Count


KINDS: dict[str, type[BaseModel]] = {
    EVENTS: Event,
    FAULTS: Faults,
    STATUS: Status,
    schemas.GAPS: Gap,
    schemas.CLOCK: ClockPair,
}
"""Document models by topic."""
METADATA: dict[str, type[BaseModel]] = {"rig": Rig, "end": End, "series": SeriesPart}
ATTACHED: dict[str, type[BaseModel]] = {"catalogue": Catalogue, "parameters": Parameters, "scene": Scene}


def get_definition(key: str) -> schemas.Definition:
    """Return the message definition of a key's topic."""
    schema = get_schema(key)
    return schemas.TEXT if schema is None else schemas.BLOCKS[schema]


def has_documents(topic: str) -> bool:
    """Return whether a topic of a recording holds JSON documents, not blocks or plottable messages."""
    return get_schema(topic) is None and not topic.startswith(schemas.VIEW + "/")


Model = TypeVar("Model", bound=BaseModel)


def read(model: type[Model], payload: bytes, *, field: str) -> tuple[dict[str, Any], Model]:
    """Return a document both as parsed JSON and as its model.

    Raises:
        InputError: The payload is not a valid document; the message names the first wrong field.
    """
    document = read_json(payload, field=field)
    try:
        return document, model.model_validate_json(payload, strict=True)
    except ValidationError as error:
        raise input_error(error, field, model) from None


def parse_document(topic: str, payload: bytes) -> dict[str, Any] | None:
    """Return the document in a message of one of the topics in `KINDS`; None if it is invalid."""
    try:
        document, entry = read(KINDS[topic], payload, field=topic)
        if isinstance(entry, Event) and entry.event == "command":
            read(Command, payload, field=topic)
    except InputError:
        return None
    return document


def check_total_size(kept_bytes: int, topic: str, path: Path) -> int:
    """Return the size of the documents of one kind, or refuse a recording that exceeds the memory limit [bytes].

    Raises:
        InputError: The size exceeds the limit.
    """
    if kept_bytes > _MAX_KEPT_BYTES:
        raise InputError("file", f"a recording with at most {_MAX_KEPT_BYTES} bytes of {topic}", str(path))
    return kept_bytes


def read_metadata(model: type[Model], entries: dict[str, str], *, field: str) -> Model:
    """Return a metadata record as its model.

    Raises:
        InputError: The record is invalid; the message names the first wrong field.
    """
    try:
        return model.model_validate(entries)
    except ValidationError as error:
        raise input_error(error, field, model) from None


def check_version(about: dict[str, str]) -> None:
    """Refuse a format version that cannot be read.

    Raises:
        InputError: The version is not one of `schemas.READ_VERSIONS`.
    """
    if about.get("version") not in schemas.READ_VERSIONS:
        must = f"a recording of format version {' or '.join(schemas.READ_VERSIONS)}"
        raise InputError("file", must, about.get("version"))
