"""Interfaces for documents, files and messages: generated inputs for each, and the use of one by the product.

Inputs are real ones of the product with changes that have a meaning: other lengths, counts, offsets, types, numbers,
units and names, missing and repeated parts, and in places other bytes. Each is a file, so that one that failed can be
kept (see `tests.hostile.generate`); messages are a sequence of a hundred, as their effect depends on those before.
"""

from __future__ import annotations

import contextlib
import copy
import gc
import io
import json
import math
import re
import struct
import threading
import tomllib
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import numpy as np

from recorder.reader import Recording, join
from replays.campaigns.files.campaign import find_shipped, load_campaign
from replays.campaigns.files.case_results import CaseRecording
from replays.campaigns.files.expectation import EventOf
from replays.campaigns.reporting.page import make_page
from replays.campaigns.reporting.results import load_results
from replays.campaigns.reporting.sheet import make_sheet
from replays.recordings.formats.conversion import convert, write_recording
from replays.recordings.formats.exporting.export import export, holds_one_table
from replays.recordings.formats.exporting.selection import select
from replays.recordings.formats.guessing.template import guess_mapping
from replays.recordings.formats.mapping import FileOptions, parse_mapping
from replays.recordings.formats.source import open_source
from replays.score.card.limits import FOLDER as LIMITS
from replays.score.card.limits import load_limits
from replays.score.card.scorecard import QUANTITIES
from replays.score.judgement import judge
from replays.score.records.can_log import open_can_log
from replays.score.records.sent import Session
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import default_table
from tests.hostile.documents import generate_documents
from tests.hostile.files import Layout, Rng, list_operations, spoil_bytes, spoil_json, write_file
from tests.score_daqs import write_session
from tests.score_files import _can_log, write_values
from tests.waiting import PATIENCE_S

BATCH = 100
"""Messages of a sequence."""
RATE_HZ = 20_000
NUMBERS: tuple[Any, ...] = (
    0, -0.0, 1, -1, 2, 255, 256, 65_535, 1 << 31, (1 << 32) - 1, 1 << 40, 1 << 60, (1 << 63) - 1, -(1 << 63), 1 << 63,
    1e-12, 1e-300, 5e-324, 1e12, 1e30, 1e300, 1e308, -1e308, float("nan"), float("inf"), float("-inf"), 0.5, 3.0,
)  # fmt: skip
TEXTS = (
    "", " ", "x", "\u202e", "\x1b[2J", "[/]", "[red]", "\U0001f4a9", "é", "\x00", "x" * 3000, "../../x", "/dev/zero",
    "%s%n", "{danger}", "{0}", "{{", "{x.__class__}", "{folder}", "$(x)", "nan", "time", "time [s]", "disk_x [mm]",
    "x [parsec]", "5 parsecs", "1e308 mm", "nan mm", "-1 s", "0 s", "1e400 N", "0x10 mm", "\uff15 mm", "5mm", "1e-12 s",
    "[mm]", "µm", "V²",
)  # fmt: skip
PIECES = (
    "9" * 5000, "0x" + "f" * 5000, "1e400", "nan", "-inf", "2" * 30, "[" * 3000, "{a=" * 500, '"""', "true", "-1",
    "0", "1e-300", "1e308", '"[/]"', '"\\u001b[2J"', "[]", "{}", "1979-05-27", "'x'", "a." * 300 + "a = 1\n",
    "[[drive]]\n", "[set]\n", '"' + "x" * 10_000 + '"', "\x00", "=", "\n",
)  # fmt: skip


def pick(rng: Rng, values: Sequence[Any]) -> Any:
    return values[int(rng.integers(0, len(values)))]


def spoil_toml(text: str, rng: Rng) -> bytes:
    """Return TOML with other values, moved lines, inserted pieces or other bytes."""
    for _ in range(int(rng.integers(1, 4))):
        lines = text.split("\n")
        at = int(rng.integers(0, len(lines)))
        piece = pick(rng, PIECES)
        match rng.integers(0, 9):
            case 0:
                lines[at] = re.sub(r"=.*", lambda _, piece=piece: f"= {piece}", lines[at], count=1)
            case 1:
                del lines[at]
            case 2:
                lines.insert(int(rng.integers(0, len(lines))), lines[at])
            case 3:
                lines.insert(at, f"x{rng.integers(0, 9)} = {piece}")
            case 4:
                return spoil_bytes(text.encode() or b"x", rng)
            case 5:
                place = int(rng.integers(0, len(lines[at]) + 1))
                lines[at] = lines[at][:place] + piece + lines[at][place:]
            case _:
                return spoil_token(text, rng).encode("utf-8", "replace")
        text = "\n".join(lines)
    return text.encode()


def spoil_token(text: str, rng: Rng) -> str:
    """Return a text with other numbers, quoted texts or words in place of one to three of its own."""
    for _ in range(int(rng.integers(1, 4))):
        found = list(re.finditer(r'"[^"\n]*"|[-+]?\d[\d.]*(?:[eE][-+]?\d+)?|[A-Za-z_]\w*', text))
        if not found:
            return text
        one = pick(rng, found)
        if one[0].startswith('"'):
            new = json.dumps(pick(rng, TEXTS)) if rng.random() < 0.8 else str(pick(rng, NUMBERS))
        elif one[0][0].isalpha():
            new = str(pick(rng, [other[0] for other in found]))
        else:
            new = str(pick(rng, NUMBERS)) if rng.random() < 0.9 else json.dumps(pick(rng, TEXTS))
        text = text[: one.start()] + new + text[one.end() :]
    return text


def spoil_numbers(data: bytes, rng: Rng) -> bytes:
    """Return a binary file with other numbers in place of some that may be lengths, counts, offsets or values."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        form = pick(rng, ("<I", "<Q", ">I", "<H", "<d", "<i"))
        size = struct.calcsize(form)
        if len(changed) < size:
            break
        head = min(len(changed), 600) if rng.random() < 0.5 else len(changed)
        found = {at: struct.unpack_from(form, changed, at)[0] for at in rng.integers(0, head - size + 1, 200).tolist()}
        # Small integers and ordinary doubles are meant; most other places are texts and samples.
        low, high = (1e-9, 1e9) if form == "<d" else (1, 1 << 20)
        at = pick(rng, [at for at, old in found.items() if low <= abs(old) < high] or list(found))
        old = found[at]
        number = pick(rng, [*NUMBERS, old + 1, old - 1, -old, 2 * old, 1000 * old, len(changed)])
        if form == "<d":
            struct.pack_into(form, changed, at, number)
        else:
            put_integer(changed, at, size, number, "big" if form[0] == ">" else "little")
    return bytes(changed)


def put_integer(data: bytearray, at: int, size: int, number: float, order: Literal["little", "big"] = "little") -> None:
    """Write a number as an integer of some bytes, as far as they hold it."""
    whole = int(number) if abs(number) < 1e300 else 0
    data[at : at + size] = (whole & ((1 << 8 * size) - 1)).to_bytes(size, order)


def spoil_file(data: bytes, rng: Rng) -> bytes:
    return spoil_bytes(data or b"x", rng) if rng.random() < 0.3 else spoil_numbers(data, rng)


class Interface(NamedTuple):
    """An interface: a function that generates suffix and content of an input, and one that passes it to the product."""

    generate: Callable[[Rng], tuple[str, bytes]]
    use: Callable[[Path], object]
    inputs: int = 1
    """Inputs in a file."""


class Interfaces:
    """All interfaces, with what they share: a folder, a session of the rig, its files in all formats."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._stack = folder, ExitStack()
        self.thorough, self.rare = False, 1
        self._made: dict[str, Any] = {}

    def __enter__(self) -> Interfaces:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def end(self, name: str) -> None:
        """End an interface with what it runs: a rig in lockstep that is not stepped for 300 s ends by itself."""
        self._made.pop(name, None)
        self._stack.close()

    def __getitem__(self, name: str) -> Interface:
        if name not in self._made:
            self._made[name] = self.log(name) if name in _SUFFIXES else getattr(self, name)()
        return self._made[name]

    # ---- documents ----

    def campaigns(self) -> Interface:
        texts = [path.read_text() for path in find_shipped().values() if path.suffix == ".toml"]
        return Interface(
            lambda rng: (".toml", spoil_toml(pick(rng, texts), rng)), lambda path: load_campaign(path, max_cases=1000)
        )

    def results(self) -> Interface:
        from tests.unit.test_campaign_results import results

        now = results(one=0.1, two=-0.2)

        def use(path: Path) -> None:
            earlier = load_results(path)
            make_page(now, self.folder, [earlier, earlier])
            make_sheet(now, self.folder, {}, earlier)

        return Interface(lambda rng: (".json", spoil_json(now, rng)), use)

    def limits(self) -> Interface:
        texts = [path.read_text() for path in LIMITS.glob("*.toml")]
        channels = [None, *default_table().channels.values()]

        def use(path: Path) -> None:
            limits = load_limits(path)
            for way, quantities in QUANTITIES.items():
                for quantity in quantities:
                    for channel in channels:
                        with contextlib.suppress(InputError):
                            limits.bounds(way, quantity, channel, amplitude=0.5)

        return Interface(lambda rng: (".toml", spoil_toml(pick(rng, texts), rng)), use)

    # ---- messages ----

    def lockstep(self) -> Interface:
        """Generate requests of devices and testers to a run in lockstep, as zenoh passes them to the service."""

        def generate(rng: Rng) -> tuple[str, bytes]:
            requests = [make_request(rng) for _ in range(BATCH)]
            return ".txt", "\n".join(f"{name} {payload.hex()}" for name, payload in requests).encode()

        def use(path: Path) -> None:
            with serve_lockstep() as (server, _):
                replies: list[Future[bytes]] = []
                for line in path.read_text().splitlines():
                    name, _, payload = line.partition(" ")
                    replies += [ask(server, name, bytes.fromhex(payload))]
            done = wait(replies, timeout=2.0)
            assert not done.not_done, f"{len(done.not_done)} requests without a reply"
            for reply in done.done:
                document = wire.decode_document(reply.result())
                assert isinstance(document["accepted"], bool)
                assert str(document).isprintable()

        return Interface(generate, use, BATCH)

    def can_lockstep(self) -> Interface:
        """Generate frames from the bus to the gateway of a rig in lockstep, and to a device that takes part in it."""
        import can

        from drivers.can.gateway import Gateway
        from drivers.can.schedule import Schedule
        from drivers.can.signals import default_messages
        from drivers.sources.can_client import CanClient
        from rig.serve.transport.memory import MemoryClient

        messages = default_messages()
        enter = self._stack.enter_context
        server, service = enter(serve_lockstep())
        bus = enter(can.Bus("interfaces", interface="virtual", ignore_config=True))
        gateway = enter(Gateway(MemoryClient(server), bus, Schedule(), paced=False))
        ask(server, "step", b'{"blocks": 3}')
        client = enter(CanClient("virtual:interfaces"))

        def generate(rng: Rng) -> tuple[str, bytes]:
            return ".txt", "\n".join(make_frame_line(rng, messages) for _ in range(BATCH)).encode()

        def use(path: Path) -> None:
            for line in path.read_text().splitlines():
                identifier, _, data = line.partition(" ")
                frame = can.Message(arbitration_id=int(identifier, 16), data=bytes.fromhex(data), is_extended_id=False)
                gateway.commands.take_message(frame)
                client.source.take(frame.arbitration_id, bytes(frame.data))
            client.source.deliver()
            document = wire.decode_document(client.request(wire.STATUS))
            assert document["state"] in ("running", "ended")
            names = {thread.name for thread in threading.enumerate()}
            assert names >= {"can gateway sends", "can gateway receives", "can gateway asks"}
            assert not gateway.guard.warnings(), gateway.guard.warnings()
            ask(server, "step", b'{"blocks": 1}')
            assert service.status()["state"] == "running"

        return Interface(generate, use, BATCH)

    def daqmx(self) -> Interface:
        """Generate calls of programs to the NI-DAQmx device, without its sockets."""
        from tests.hostile.daqmx import generate_calls, pass_calls

        def generate(rng: Rng) -> tuple[str, bytes]:
            return ".txt", "\n".join(f"{name} {data.hex()}" for name, data in generate_calls(rng, BATCH)).encode()

        def use(path: Path) -> None:
            lines = [line.split(" ") for line in path.read_text().splitlines()]
            for with_secret in (False, True):
                pass_calls(((name, bytes.fromhex(data)) for name, data in lines), with_secret=with_secret)

        return Interface(generate, use, BATCH)

    def foxglove(self) -> Interface:
        """Generate messages of clients to the server for the Foxglove app."""
        from tests.hostile.foxglove import decode_messages, encode_messages, generate_messages, pass_messages

        return Interface(
            lambda rng: (".json", encode_messages(generate_messages(rng, BATCH))),
            lambda path: pass_messages(decode_messages(path.read_bytes())),
            BATCH,
        )

    # ---- files ----

    def session(self) -> Path:
        """Return a session of the rig: probes and forces of 0.2 s."""
        if "session" not in self._made:
            rng, table = np.random.default_rng(3), default_table()
            counts = {
                name: rng.normal(0.0, 1e5, (4000, len(table.groups[name].channels))).round()
                for name in ("probes", "forces")
            }
            self._made["session"] = write_session(self.folder / "session.mcap", counts), counts
        return self._made["session"][0]

    def judged(self, path: Path) -> None:
        """Judge a file, as `rig score`, if its content selects it."""
        if self.selects(path, 12):
            with contextlib.suppress(InputError):
                judge(path, [self.session()])

    def selects(self, path: Path, one_of: int) -> bool:
        """Return whether a file is one of the few for long work, by its content; in a long run fewer, if kept every."""
        return self.thorough or zlib.crc32(path.read_bytes()) % (one_of * self.rare) == 0

    def can_logs(self) -> Interface:
        self.session()
        _, counts = self._made["session"]
        table = default_table()
        sent = SimpleNamespace(
            table=table, channels=[c for g in ("probes", "forces") for c in table.groups[g].channels]
        )
        whole = np.hstack(list(counts.values())).astype(np.int64)
        logs: dict[str, list[bytes]] = {}
        for suffix in (".log", ".blf", ".asc", ".trc"):
            for fd in (False, True):
                path = _can_log(self.folder / f"a{suffix}", sent, whole[: 800 if fd else 4000], 0, fd=fd)  # type: ignore[arg-type]
                logs.setdefault(suffix, []).append(path.read_bytes())

        def generate(rng: Rng) -> tuple[str, bytes]:
            suffix = pick(rng, list(logs))
            data = pick(rng, logs[suffix])
            if suffix == ".blf":
                return suffix, spoil_blf(data, rng)
            return suffix, spoil_lines(data, rng)

        def use(path: Path) -> None:
            self.judged(path)
            for signal in open_can_log(path, table):
                assert signal.values.shape == (signal.rows,)
                assert signal.rate_hz is None or signal.rate_hz > 0.0
                assert signal.first_s is None or isinstance(signal.first_s, float)

        return Interface(generate, use)

    def events(self) -> Interface:
        """Generate recordings with changed events and documents, whose checksums are right."""
        layout = Layout(Recording.open(write_file(self.folder / "events.mcap")))
        at = [n for n, (topic, _, _) in enumerate(layout.messages) if topic == wire.EVENTS]
        operations = list_operations()
        fault = {"channel": "disk_x", "kind": "offset", "value": 0.5, "for_s": 0.001}
        more = [
            {"event": "command", "tick": 1000, "time_s": 1e-3, "id": 3, "command": "fault", "request": fault},
            {"event": "fault", "tick": 1000, "time_s": 1e-3, "id": 3, **fault},
            {"event": "hammer", "tick": 0, "time_s": 0.0, "force_n": 10.0, "direction": "x", "duration_ms": 5.0},
            {"event": "device", "tick": 0, "time_s": 0.0, "device": "a", "state": "joined"},
        ]  # fmt: skip

        def generate(rng: Rng) -> tuple[str, bytes]:
            changes: list[Any] = []  # place, whether it is replaced, time, payload; or name and content of a document
            for _ in range(int(rng.integers(1, 4))):
                _, payload, time_ns = layout.messages[pick(rng, at)]
                document = json.loads(payload) if rng.random() < 0.5 else copy.deepcopy(pick(rng, more))
                for _ in range(int(rng.integers(0, 3))):
                    place = pick(rng, [document, *(each for each in document.values() if isinstance(each, dict))])
                    number = pick(rng, [each for each in NUMBERS if np.isfinite(each)])
                    place[pick(rng, list(place) or ["x"])] = number if rng.random() < 0.6 else pick(rng, TEXTS)
                data = spoil_json(document, rng) if rng.random() < 0.4 else json.dumps(document).encode()
                new, time_ns = rng.random() < 0.5, pick(rng, (time_ns, 0, 1, 2_000_000, 1 << 40, 1 << 62))
                changes.append(
                    (pick(rng, at) if new else int(rng.integers(0, len(layout.messages))), new, time_ns, data.hex())
                )
            if rng.random() < 0.3:
                name = pick(rng, ("scene.json", "catalogue.json"))
                changes.append((name, spoil_json(json.loads(layout.attachments[name]), rng).hex()))
            return ".json", json.dumps(changes).encode()

        def use(changes: Path) -> None:
            changed = copy.copy(layout)
            changed.messages, changed.attachments = list(layout.messages), dict(layout.attachments)
            for where, *what in json.loads(changes.read_bytes()):
                if isinstance(where, str):
                    changed.attachments[where] = bytes.fromhex(what[0])
                else:
                    replaced, time_ns, data = what
                    changed.messages[where : where + replaced] = [(wire.EVENTS, bytes.fromhex(data), time_ns)]
            path = changed.write(self.folder / "changed.mcap")
            recording = Recording.open(path)
            case = CaseRecording(recording, self.folder)
            for name in ("hammer", "fault", "command", "note", "end"):
                EventOf(event=name, text="a").times_s(case)
            assert Session([path]).trigger_s is not math.nan
            number = zlib.crc32(changes.read_bytes())
            uses = list(operations.values())
            for operation in uses if self.thorough else [uses[number % len(uses)]] if self.selects(changes, 1) else []:
                with contextlib.suppress(InputError):
                    operation(path, self.folder)

        return Interface(generate, use)

    def log(self, kind: str) -> Interface:
        """Generate files of other systems: those that the product exports, and some that other programs would write."""
        if "logs" not in self._made:
            self._made["logs"] = make_logs(self.folder, self.session())
        logs: dict[str, list[bytes]] = {
            suffix: whole for suffix, whole in self._made["logs"].items() if suffix in _SUFFIXES[kind]
        }

        def generate(rng: Rng) -> tuple[str, bytes]:
            suffix = pick(rng, list(logs))
            data = pick(rng, logs[suffix])
            if rng.random() < 0.35 and suffix in WRITTEN:
                with contextlib.suppress(Exception):  # what the library does not write
                    return suffix, write_odd(self.folder / f"odd{suffix}", rng)
            if suffix == ".wav.json":
                return suffix, spoil_json(json.loads(data), rng)
            if suffix in (".csv", ".lvm"):
                return suffix, spoil_lines(data, rng)
            if suffix == ".uff" and rng.random() < 0.6:
                return suffix, spoil_head(data, rng)
            if suffix == ".parquet" and rng.random() < 0.4:
                return suffix, spoil_footer(data, rng)
            return suffix, spoil_file(data, rng)

        def use(path: Path) -> None:
            if path.suffix == ".json":
                path = path.rename(path.with_name(f"{path.name.partition('.')[0]}.wav.json")).with_suffix("")
                path.write_bytes(logs[".wav"][0])
            try:
                self.read(path)
            finally:
                path.with_name(path.name + ".json").unlink(missing_ok=True)

        return Interface(generate, use)

    def read(self, path: Path) -> None:
        """Read a log, as `rig import` with a mapping, and as it does without one or `rig score`."""
        with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            self.judged(path)
            source = open_source(path, FileOptions())
            for entry in source.entries[: 20 if self.selects(path, 4) else 2]:
                with contextlib.suppress(InputError):
                    assert source.read(entry).physical.dtype == float
            if self.selects(path, 6):
                with contextlib.suppress(InputError):
                    text, _ = guess_mapping([path])
                    convert([path], parse_mapping(tomllib.loads(text), name="guess"))
            entry = source.entries[0]
            one = {"source": entry.name, "unit": "mm", **({"group": entry.group} if entry.group else {})}
            conversion = convert([path], parse_mapping({"channels": {"disk_x": one}}, name="m.toml"))
            if self.selects(path, 7):
                write_recording(conversion, self.folder / "imported.mcap", force=True)
                Recording.open(self.folder / "imported.mcap")


_SUFFIXES = {
    "parquet": (".parquet",), "wav": (".wav", ".wav.json"), "mdf": (".mf4",), "tdms": (".tdms",), "uff": (".uff",),
    "text": (".csv", ".lvm"),
}  # fmt: skip
NAMES = (
    "campaigns", "results", "limits", "lockstep", "can_lockstep", "can_logs", "events", "daqmx", "foxglove", *_SUFFIXES,
)  # fmt: skip
"""Names of all interfaces."""
WRITTEN = {".parquet": "parquet", ".mf4": "mdf", ".tdms": "tdms", ".uff": "uff", ".csv": "comma"}
"""Formats that `write_odd` writes, by suffix."""


@contextlib.contextmanager
def serve_lockstep(server: Any = None) -> Iterator[tuple[Any, Any]]:
    """Serve a run in lockstep from a thread; raise an error if it fails or does not end.

    Args:
        server: Transport; in this process by default.

    Yields:
        The transport and the service.
    """
    from rig.serve.pacing import Lockstep
    from rig.serve.service import Service
    from rig.serve.transport.limit import CommandLimit
    from rig.serve.transport.memory import MemoryServer
    from tests.unit.service_fake import FakeSimulation

    class Simulation(FakeSimulation):
        def catalogue(self) -> dict[str, Any]:
            return {**super().catalogue(), "table": default_table().model_dump(mode="json")}

        def submit(self, command: str, request: dict[str, Any]) -> int:
            from rig.run.commands.table import check_command

            check_command(command, request)
            return self.tick

    server = server or MemoryServer(cache=0)
    service = Service(
        Simulation(duration_s=None),
        server,
        Lockstep(),
        block_ticks=10_000,
        linger_s=0.0,
        limit=CommandLimit(1e9, 10**9),
    )
    summary: dict[str, Any] = {}
    service.prepare()
    thread = threading.Thread(target=lambda: summary.update(service.run()), daemon=True)
    thread.start()
    try:
        yield server, service
    finally:
        service.stop()
        thread.join(PATIENCE_S)
    assert summary.get("reason") == "stopped", summary or "the run does not end"
    assert summary["troubles"] == [], summary["troubles"]


_DEVICE = {"device": "a", "from": "a", "secret": "s"}
_REQUESTS: dict[str, list[dict[str, Any]]] = {
    "join": [{**_DEVICE, "patience_s": 0.01}, {**_DEVICE, "device": "b"}, {"device": "c", "patience_s": 3600.0}],
    "done": [{**_DEVICE, "block": 1}, {**_DEVICE, "tick": 10_000}, {**_DEVICE, "device": "b", "block": 1 << 40}],
    "leave": [_DEVICE, {**_DEVICE, "device": "b"}, {"device": "c"}],
    "step": [{"ticks": 10_000, "from": "a"}, {"blocks": 1}, {"ticks": 1 << 40}],
    "note": [{"text": "warm", "tags": ["a", "b"], "from": "a"}],
    "hammer": [{"force_n": 100.0, "duration_ms": 5.0, "direction": "x", "from": "a"}],
}


def make_request(rng: Rng) -> tuple[str, bytes]:
    """Return name and payload of a request to a run in lockstep, valid or with changes."""
    name = pick(rng, list(_REQUESTS))
    return name, next(generate_documents(rng, 1, _REQUESTS[name]))


def ask(server: Any, name: str, payload: bytes) -> Future[bytes]:
    """Send a request as a transport does; the reply may depend on later requests."""
    handler = server.handler_of(wire.command_key(name))
    reply = handler(wire.command_key(name), payload)
    if isinstance(reply, Future):
        return reply
    done: Future[bytes] = Future()
    done.set_result(reply)
    return done


def make_frame_line(rng: Rng, messages: Any) -> str:
    """Return identifier and data of a frame: of a device, or with other values of any of the rig's messages."""
    from drivers.can.devices import DeviceKind, device_frame
    from drivers.can.message import checksum

    row = pick(rng, messages.messages)
    kind = int(rng.integers(0, 6))
    if kind <= 1:
        what = pick(rng, (DeviceKind.JOIN, DeviceKind.DONE, DeviceKind.LEAVE))
        block, patience_s = int(pick(rng, (0, 1, 2, 3, (1 << 32) - 1))), 0.1 * int(rng.integers(0, 1 << 16))
        identifier, data = device_frame(
            messages.by_name["Device"], what, int(rng.integers(0, 4)), block=block, patience_s=patience_s
        )
    elif kind == 2:
        row = messages.by_name["Device"]
        identifier, data = row.identifier, rng.bytes(7)
        data += bytes([checksum(identifier, data)])
    else:
        size = row.length if rng.random() < 0.8 else int(rng.integers(0, 9))
        identifier, data = row.identifier, bytes(pick(rng, (0, 1, 0x7F, 0x80, 0xFF)) for _ in range(size))
        data = rng.bytes(size) if kind == 3 else data
    if rng.random() < 0.1:
        data = spoil_bytes(data or b"x", rng)
    return f"{identifier:x} {data[:8].hex()}"


def spoil_lines(data: bytes, rng: Rng) -> bytes:
    """Return a text log with other numbers, or other lines."""
    if rng.random() < 0.15:
        return spoil_bytes(data or b"x", rng)
    lines = data.decode("utf-8", "replace").split("\n")
    for _ in range(int(rng.integers(1, 4)) if len(lines) > 3 else 0):
        head = min(len(lines), 12) if rng.random() < 0.5 else len(lines)
        at = int(rng.integers(0, head))
        match rng.integers(0, 8):
            case 0:
                lines[at], lines[-2] = lines[-2], lines[at]
            case 1:
                lines.insert(at, lines[int(rng.integers(0, len(lines)))])
            case 2:
                del lines[at]
            case 3:  # times or values of many lines
                column = int(rng.integers(0, 3))
                number = str(pick(rng, NUMBERS))
                for n in range(at, min(len(lines), at + int(rng.integers(1, 400)))):
                    found = list(re.finditer(r"\d[\d.]*", lines[n]))[column : column + 1]
                    for one in found:
                        step = str(float(number) * n) if rng.random() < 0.9 else number
                        lines[n] = lines[n][: one.start()] + step + lines[n][one.end() :]
            case 4:  # backwards
                lines[at:] = lines[at:][::-1]
            case _:
                lines[at] = spoil_token(lines[at], rng)
    return "\n".join(lines).encode("utf-8", "replace")


_BLF_FIELDS = ((4, 2), (6, 2), (8, 4), (12, 4), (16, 4), (24, 8), (32, 2), (35, 1), (36, 4))
"""Offset and size of fields of an object [bytes]: sizes, version, type, flags, time; channel, length, identifier."""


def spoil_blf(data: bytes, rng: Rng) -> bytes:
    """Return a BLF file with other numbers in its head, in a container's head or in its objects, compressed again."""
    at = struct.unpack_from("<I", data, 4)[0]
    size = struct.unpack_from("<I", data, at + 8)[0]
    inside = bytearray(zlib.decompress(data[at + 32 : at + size]))
    match rng.integers(0, 4):
        case 0:
            return spoil_file(data, rng)
        case 1:
            inside = bytearray(spoil_file(bytes(inside), rng))
        case _:
            places, place = [], 0
            while place + 32 <= len(inside) and inside[place : place + 4] == b"LOBJ":
                places.append(place)
                place += struct.unpack_from("<I", inside, place + 8)[0]
            for _ in range(int(rng.integers(1, 4))):
                start, (offset, size) = pick(rng, places), pick(rng, _BLF_FIELDS)
                if start + offset + size <= len(inside):
                    put_integer(inside, start + offset, size, pick(rng, NUMBERS))
    packed = zlib.compress(bytes(inside))
    head = bytearray(data[at : at + 32])
    struct.pack_into("<I", head, 8, 32 + len(packed))
    declared = len(inside) if rng.random() < 0.7 else pick(rng, (0, 1, 1 << 31, (1 << 32) - 1))
    struct.pack_into("<I", head, 24, declared)
    return data[:at] + bytes(head) + packed + bytes((32 + len(packed)) % 4)


def spoil_head(data: bytes, rng: Rng) -> bytes:
    """Return a universal file with other numbers and texts in the eleven lines before its values."""
    lines = data.split(b"\n")
    at = int(rng.integers(1, min(13, len(lines))))
    lines[at] = spoil_token(lines[at].decode("latin-1"), rng).encode("utf-8", "replace")
    if rng.random() < 0.3:
        lines[at] = lines[at][: int(rng.integers(0, 81))]
    return b"\n".join(lines)


def spoil_footer(data: bytes, rng: Rng) -> bytes:
    """Return a Parquet file with another number (a varint) or text in its footer, and the right length of it."""
    length = struct.unpack_from("<I", data, len(data) - 8)[0]
    footer = bytearray(data[-8 - length : -8])
    for _ in range(int(rng.integers(1, 3))):
        at, number = (
            int(rng.integers(0, len(footer))),
            int(pick(rng, (0, 1, 2, 99, 1 << 16, 1 << 33, 1 << 60, (1 << 64) - 1))),
        )
        varint = bytearray()
        while number > 127:
            varint.append(number & 127 | 128)
            number >>= 7
        footer[at : at + 1] = varint + bytes([number])
    return data[: -8 - length] + bytes(footer) + struct.pack("<I", len(footer)) + b"PAR1"


def write_odd(path: Path, rng: Rng) -> bytes:
    """Return a file of the format's library, with values, times, names and units that no measurement has."""
    rows = int(pick(rng, (0, 1, 2, 3, 50, 300)))
    t = np.arange(rows) * float(pick(rng, (1e-3, 5e-5, 1e-12, 1e-300, 1e300, 0.0, -1e-3, 1.0)))
    if rng.random() < 0.5 and rows:
        t[int(rng.integers(0, rows)) :] += float(pick(rng, NUMBERS))
    if rng.random() < 0.3:
        t = t[::-1].copy()
    columns: dict[str, tuple[str, np.ndarray]] = {}
    for n in range(int(rng.integers(1, 4))):
        values = rng.normal(size=rows)
        if rng.random() < 0.5 and rows:
            values[int(rng.integers(0, rows)) :: int(rng.integers(1, 9))] = float(pick(rng, NUMBERS))
        if rng.random() < 0.3:
            kind = pick(
                rng, (np.int8, np.uint8, np.int16, np.uint64, np.int64, np.float32, np.float16, bool, complex, str)
            )
            with np.errstate(all="ignore"):
                values = values.astype(kind)
        name = pick(rng, ("disk_x", "disk_y", "hammer", f"x{n}")) if rng.random() < 0.6 else pick(rng, TEXTS)
        columns[name] = pick(rng, ("mm", "V", "", "N", *TEXTS)), values
    rate = float(pick(rng, (1000.0, 20_000.0, 1e-300, 1e300, 1e12, 0.3, 1e-5)))
    stamps = None if rng.random() < 0.2 else t
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        return write_values(WRITTEN[path.suffix], path.with_suffix(""), columns, stamps, rate).read_bytes()


def make_logs(folder: Path, session: Path) -> dict[str, list[bytes]]:
    """Return small logs by suffix: those that the product exports, and as other programs write them."""
    import soundfile
    from asammdf import MDF

    logs: dict[str, list[bytes]] = {}
    t = np.arange(200) / 1000.0
    x = np.round(np.sin(100 * t), 4)
    for suffix, form in WRITTEN.items():
        path = write_values(form, folder / "a", {"x": ("mm", x), "disk_x": ("mm", x)}, t, 1000.0)
        logs.setdefault(suffix, []).append(path.read_bytes())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with MDF(folder / "a.mf4") as mdf:
            logs[".mf4"].append(Path(mdf.save(folder / "packed.mf4", compression=2, overwrite=True)).read_bytes())
    soundfile.write(folder / "a.wav", np.stack([x, x], axis=1), 1000, subtype="PCM_16")
    logs[".wav"] = [(folder / "a.wav").read_bytes()]
    column = {"name": "x", "unit": "mm", "label": "l", "full_scale": 2.0, "offset_exported": 0.5}
    beside = {"start": "2024-01-01T00:00:00+00:00", "tables": [{"first_s": 0.0, "columns": [column, column]}]}
    logs[".wav.json"] = [json.dumps(beside).encode()]
    head = (
        "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tOne\nDate\t2024/01/01\n"
        "Time\t10:00:00\n"
        "***End_of_Header***\t\nChannels\t1\nY_Unit_Label\tmm\nDelta_X\t0.001\n***End_of_Header***\t\nX_Value\tx\tComment\n"
    )
    logs[".lvm"] = [(head + "\n".join(f"{time:.4f}\t{value:.4f}" for time, value in zip(t, x, strict=True))).encode()]
    small = write_file(folder / "small.mcap")
    for suffix in (*WRITTEN, ".wav"):
        path = folder / f"exported{suffix}"
        for source in (small, session):
            merged = holds_one_table(path)
            channels = ("probes",) if source == session else ()
            export(select(join([source]), channels=channels, to_s=0.02, merged=merged), path, force=True)
            logs[suffix].append(path.read_bytes())
    gc.collect()
    return logs
