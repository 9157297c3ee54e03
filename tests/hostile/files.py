"""Small recordings, and functions that corrupt their bytes, documents, records and blocks."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import typer

import replays
from recorder.contents.metadata import Beginning
from recorder.reader import Recording
from recorder.writer import RecordingWriter
from rig.base.wire import CATALOGUE, PARAMETERS, SCENE, Block, encode_block, encode_document, sensor_key
from tests.unit.recorder_stream import generate_stream, make_documents

SESSIONS = Path(replays.__file__).with_name("sessions")
Rng = np.random.Generator
PROBES = sensor_key("probes")


def write_file(path: Path, *, leave: bool = False, blocks: int = 3, **changes: Any) -> Path:
    """Write a short recording; with `leave` in the state that a killed recorder leaves."""
    about = make_documents()
    session = Recording.open(SESSIONS / "hammer-5.2.mcap")
    scene = session.scene["scene"]
    scene |= {"seed": 7, "duration_s": 1e-3 * blocks, "commands": []}  # as in the stream
    scene["sensors"] |= {"rate_hz": 0, "truth_rate_hz": 2000}
    about[PARAMETERS], about[SCENE] = session.parameters, {**session.scene, "seed": 7, "scene": scene}
    about[SCENE]["taken"] = [{"id": 1, "tick": 0, "command": "hammer", "request": {"force_n": 10.0}}]
    file = RecordingWriter(
        path, catalogue=about[CATALOGUE], parameters=about[PARAMETERS], scene=about[SCENE], view_rate_hz=100.0,
        sync_every_s=0.0, wall_ns=lambda: 1_700_000_000_000_000_000,
        beginning=Beginning(metadata={"series": {"id": "a1", "number": "0", "previous": "", "due": "{}"}}), **changes,
    )  # fmt: skip
    for number, (key, payload) in enumerate(generate_stream(blocks, block_ms=1)):
        file.write(key, payload, number)
    note = {"event": "note", "tick": 0, "time_s": 0.0, "text": "a note", "tags": ["x"]}
    command = {"event": "command", "tick": 0, "time_s": 0.0, "id": 2, "command": "hammer", "request": {"force_n": 1.0}}
    for event in (note, command, {"event": "warning", "tick": 0, "time_s": 0.0, "text": "warned"}):
        file.write("rig/events", encode_document(event), 0)
    file.write_missed(PROBES, 2, 0)
    if leave:
        file.sync()
        kept = path.with_name(path.name + ".part")
        kept.write_bytes(file.part.read_bytes())
        data = kept.read_bytes()
        file.abandon()
        kept.write_bytes(data)
        return kept
    file.finish("completed")
    return path


def read_contents(recording: Recording) -> tuple[Any, ...]:
    """Return everything that a reader obtains from a recording."""
    rows = [recording.samples(name) for name in recording.table.groups]
    return (
        list(recording.everything()), recording.metadata, recording.attachments, recording.catalogue,
        recording.parameters, recording.scene, recording.messages, recording.span_s,
        [(one.values.tobytes(), one.index.tobytes(), one.times_s.tobytes(), one.names, one.units) for one in rows],
    )  # fmt: skip


def find_attachments(data: bytes) -> list[tuple[int, int]]:
    """Start and end of the body of each attachment."""
    found, position = [], 8
    while position + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, position)
        if opcode == 9:
            found.append((position + 9, position + 9 + length))
        position += 9 + length
        if opcode == 0x0F:
            break
    return found


def spoil_bytes(data: bytes, rng: Rng) -> bytes:
    """Change bytes: a flipped bit, another byte, a cut, a splice, a repeated piece or zeros."""
    spoilt = bytearray(data)
    at, to = sorted(int(n) for n in rng.integers(0, len(data), 2))
    match rng.integers(0, 7):
        case 0 | 1 | 2:
            spoilt[at] ^= 1 << int(rng.integers(0, 8))
        case 3:
            spoilt[at] = int(rng.integers(0, 256))
        case 4:
            del spoilt[at:]
        case 5:
            piece = bytes(spoilt[at : min(to, at + 400)])
            place = int(rng.integers(0, len(data)))
            spoilt[place : place + (len(piece) if rng.random() < 0.5 else 0)] = piece
        case _:
            spoilt[at : at + 64] = bytes(len(spoilt[at : at + 64]))
    return bytes(spoilt)


VALUES: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 7, 2**31, 2**62, 2**63, -(2**63), 10**30, 0.0, -0.5, 1e-300, 1e300, 1e308, "", "x",
    "[/]", "[red]", "\x1b[2J", "\u202e", "x" * 10_000, "\ud800", "NaN", [], {}, [[]], [1, 2], ["a"], {"": 0},
    {"value": 1}, [{}], json.loads("[" * 40 + "]" * 40),
)  # fmt: skip


def spoil_document(document: Any, rng: Rng) -> Any:
    """Return a document with another value, a field less or more, or one field in the place of another."""
    document = copy.deepcopy(document)
    place, parent, key = document, None, None
    for _ in range(int(rng.integers(1, 9))):
        if not isinstance(place, dict | list) or not place:
            break
        parent = place
        key = (
            list(place)[int(rng.integers(0, len(place)))]
            if isinstance(place, dict)
            else int(rng.integers(0, len(place)))
        )
        place = place[key]
    if parent is None:
        return VALUES[int(rng.integers(0, len(VALUES)))]
    match rng.integers(0, 6):
        case 0:
            del parent[key]
        case 1 if isinstance(parent, dict):
            parent[f"{key}s"] = parent.pop(key)
        case 2 if isinstance(parent, list):
            parent.append(copy.deepcopy(place))
        case 3 if isinstance(place, int | float) and not isinstance(place, bool):
            parent[key] = place * float(rng.choice([-1.0, 0.0, 1e3, 1e9, 1e-9]))
        case _:
            parent[key] = copy.deepcopy(VALUES[int(rng.integers(0, len(VALUES)))])
    return document


def spoil_json(document: Any, rng: Rng) -> bytes:
    """Return a changed document as bytes, occasionally as invalid JSON."""
    for _ in range(int(rng.integers(1, 3))):
        document = spoil_document(document, rng)
    text = json.dumps(document)
    match rng.integers(0, 12):
        case 0:
            return spoil_bytes(text.encode() or b"x", rng)
        case 1:
            return text.replace("1", "NaN", 1).encode()
        case 2:
            return text.replace(": 1", f": {'9' * 5000}", 1).encode()
        case 3:
            return text.replace("{", '{"tick_rate_hz": 2, "tick_rate_hz": 3, ', 1).encode()
    return text.encode()


def spoil_block(payload: bytes, rng: Rng) -> bytes:
    """Return a block with another header, or other bytes."""
    if len(payload) < 44:
        return spoil_bytes(payload or b"x", rng)
    head = list(struct.unpack_from("<qqddII", payload, 4))
    numbers = (0, -1, 1, 2**31, 2**40, 2**52, 2**53, 2**62, 2**63 - 1, -(2**63))
    rates = (0.0, -1.0, 1e-300, 1e-5, 1.0, 1e6, 1e12, 1e300, float("nan"), float("inf"))
    match rng.integers(0, 6):
        case 0 | 1:
            head[int(rng.integers(0, 2))] = int(rng.choice(np.array(numbers, dtype=object)))
        case 2:
            head[int(rng.integers(2, 4))] = float(rng.choice(rates))
        case 3:
            head[int(rng.integers(4, 6))] = int(rng.choice([0, 1, 2, 3, 2**32 - 1, 100]))
        case 4:
            return spoil_bytes(payload, rng)
        case _:
            head[0], head[1] = int(rng.integers(0, 2**53)), int(rng.integers(0, 2**53))
    return payload[:4] + struct.pack("<qqddII", *head) + payload[44:]


Message = tuple[str, bytes, int]


class Layout:
    """Contents of a recording, written by the library's own writer so that its checksums are right."""

    def __init__(self, recording: Recording) -> None:
        self.metadata = copy.deepcopy(recording.metadata)
        self.attachments = dict(recording.attachments)
        self.about = dict(recording.parts[0].about)
        self.messages: list[Message] = [
            (topic, payload, time_ns) for topic, time_ns, _, payload in recording.everything() if topic[:4] != "view"
        ]

    def spoilt(self, rng: Rng) -> Layout:
        """Return a copy with one to three faults."""
        layout = copy.copy(self)
        layout.metadata, layout.attachments = copy.deepcopy(self.metadata), dict(self.attachments)
        layout.messages = list(self.messages)
        for _ in range(int(rng.integers(1, 4))):
            layout.spoil(rng)
        return layout

    def spoil(self, rng: Rng) -> None:
        kind = int(rng.integers(0, 10))
        at = int(rng.integers(0, len(self.messages)))
        topic, payload, time_ns = self.messages[at]
        if kind <= 3:
            name = str(rng.choice(["catalogue.json", "parameters.json", "scene.json"]))
            try:
                document = json.loads(self.attachments.get(name, b"{}"))
            except ValueError:
                return
            self.attachments[name] = spoil_json(document, rng)
        elif kind == 4:
            name = str(rng.choice(list(self.metadata)))
            entries = self.metadata[name]
            key = str(rng.choice(list(entries)))
            text = str(rng.choice(["", "x", "-1", "1e400", "nan", "9" * 5000, "[/]", "\x1b[2J", "{}", "1e300"]))
            entries[key] = text
            if rng.random() < 0.2:
                del entries[key]
        elif kind == 5:
            self.attachments.pop(str(rng.choice(list(self.attachments))))
        elif kind == 6:
            self.messages[at] = (topic, payload, (0, 2**40, 2**62, 2**63, 2**64 - 1)[int(rng.integers(0, 5))])
        elif kind == 7:
            other = self.messages[int(rng.integers(0, len(self.messages)))][1]
            self.messages[at] = (topic, other, time_ns)
        elif payload[:1] == b"{":
            try:
                self.messages[at] = (topic, spoil_json(json.loads(payload), rng), time_ns)
            except ValueError:  # spoilt already
                return
        else:
            self.messages[at] = (topic, spoil_block(payload, rng), time_ns)

    def write(self, path: Path, rng: Rng | None = None) -> Path:
        """Write the recording; with `rng` occasionally with undeclared channels or with two settings of the writer."""
        from mcap.writer import CompressionType, IndexType, Writer

        strange = 0.0 if rng is None else rng.random()
        with path.open("wb") as file:
            mcap = Writer(
                file, chunk_size=5000, enable_data_crcs=strange < 0.9, repeat_channels=not 0.1 < strange < 0.15,
                index_types=IndexType.MESSAGE if 0.15 < strange < 0.2 else IndexType.ALL,
                compression=CompressionType.NONE if 0.2 < strange < 0.4 else CompressionType.ZSTD,
                use_chunking=not 0.4 < strange < 0.43,
            )  # fmt: skip
            mcap.start(profile="ros2", library="x")
            for name, entries in self.metadata.items():
                if name != "end":
                    mcap.add_metadata(name, entries)
            for name, data in self.attachments.items():
                if name != "metadata.json":
                    mcap.add_attachment(0, 0, name, "", data)
            if strange < 0.95:
                kept = {name: entries for name, entries in self.metadata.items() if name != "end"}
                mcap.add_attachment(0, 0, "metadata.json", "", json.dumps(kept).encode())
            if 0.5 < strange < 0.53:
                mcap.add_metadata("rig", self.metadata["rig"])
            schema = mcap.register_schema("x", "jsonschema", b"{}")
            channels: dict[str, int] = {}
            for number, (topic, payload, time_ns) in enumerate(self.messages):
                if topic not in channels or (0.55 < strange < 0.58 and number == 9):
                    channels[topic] = mcap.register_channel(topic, "x", schema, self.about.get(topic, {}))
                channel = 999 if 0.6 < strange < 0.65 and number % 7 == 3 else channels[topic]
                mcap.add_message(channel, time_ns, payload, time_ns)
            if "end" in self.metadata:
                mcap.add_metadata("end", self.metadata["end"])
            mcap.finish()
        return path


@contextlib.contextmanager
def capture_output() -> Iterator[io.StringIO]:
    """Capture output and error output."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        yield out


def make_far_block(tick: int, index: int) -> bytes:
    """Return a block of probes far ahead in time."""
    return encode_block(Block(tick, index, 20_000.0, 1e6, np.zeros((20, 4), np.int32)))


Use = Callable[[Path, Path], object]


def list_operations() -> dict[str, Use]:
    """Return the operations on a recording, each through the function that its command uses."""
    from recorder.reader import join
    from recorder.rewrite import cut, recover
    from replays.player.messages import Track
    from replays.player.timeline import By, Timeline
    from replays.recordings.formats.exporting.export import export, holds_one_table
    from replays.recordings.formats.exporting.selection import select
    from replays.recordings.resimulation.experiment import Experiment
    from rig.cli.commands import info
    from rig.cli.output.tables import Form

    def told(path: Path, _: Path) -> object:
        recording = join([path])
        with capture_output():
            with contextlib.suppress(typer.Exit):  # the verdict is irrelevant here
                info.info([path], form=Form())
            return json.dumps(info.describe(recording, quick=True))

    def exported(suffix: str) -> Use:
        def use(path: Path, folder: Path) -> object:
            output = folder / f"out{suffix}"
            return export(select(join([path]), merged=holds_one_table(output), truth=True), output, force=True)

        return use

    def played(path: Path, _: Path) -> object:
        track = Track([path])
        return [sum(1 for _ in Timeline(track, by).play(0)) for by in By]

    return {
        "info": told,
        "csv": exported(".csv"),
        "uff": exported(".uff"),
        "parquet": exported(".parquet"),
        "recover": lambda path, folder: recover(path, folder / "new.mcap", force=True),
        "cut": lambda path, folder: cut(join([path]), folder / "new.mcap", from_s=0.0005, force=True),
        "play": played,
        "experiment": lambda path, _: Experiment.from_recording(join([path])),
    }
