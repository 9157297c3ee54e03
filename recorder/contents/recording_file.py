"""One file of a recording, complete or interrupted."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Container, Iterable, Iterator
from copy import copy
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Self

from mcap.exceptions import McapError

from recorder.contents import documents
from recorder.files import schemas
from recorder.files.chunks import Chunk, DamagedError, messages, unpack
from recorder.files.payload import parse_block
from recorder.files.records import COPY, MAGIC, read_contents
from rig.base.checks import read_json
from rig.base.errors import InputError, Words
from rig.base.files import build_read_error, open_file
from rig.base.wire import EVENTS, FAULTS, Block
from rig.serve import stream_check

_MUST_BE_RECORDING = "a recording made by `rig record`"
_MAX_BLOCK_S = 0.25
"""Longest block found in a file whose blocks are out of order [s]; the blocks of a rig last a few milliseconds."""
Message = tuple[str, int, int, bytes]
"""Topic, simulated time [ns], wall time of arrival [unix ns] and payload of a message."""


class RecordingFile:
    """Recording file, validated when opened; messages are read from the disk on demand.

    Attributes:
        path: The file.
        complete: Whether the recorder finished the file. An interrupted file is read up to its last whole message.
        damaged: Number of damaged records that salvage skips; 0 otherwise.
        unchecked: Parts of the file without a checksum.
        catalogue: Catalogue document of the rig.
        table: Channel table of the catalogue.
        parameters: Parameter document of the rig.
        scene: Scene document of the rig.
        metadata: Metadata records by name: `rig` (start), `end` (final counts, only if complete).
        attachments: All attachments by name, including catalogue, parameters and scene.
        about: Metadata of each topic: names, units and scales of its columns.
        messages: Number of messages by topic.
        chunks: Chunks with messages, in file order.
        stated_rows: Rows by key, as stated at the end of the file.
        read_chunks: Offsets of the chunks to read; None for all; see `between`.
        stated_begin_s: Simulated time of the first row, as stated at the end of the file [s].
    """

    def __init__(self, path: Path, *, salvage: bool = False, in_part: bool = False) -> None:
        """Read the structure of a file.

        Args:
            path: The file.
            salvage: Also read the intact part of a damaged file.
            in_part: Verify checksums only of the parts that are read; see `between`.

        Raises:
            InputError: The file cannot be read, or is not a recording.
        """
        self.path = path
        with self._open() as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise InputError("file", _MUST_BE_RECORDING, Words(f"{path}, which is not an MCAP file"))
            contents = read_contents(file, path.stat().st_size, salvage=salvage, in_part=in_part)
            self._take_metadata(contents.metadata, contents.attachments.get(COPY), salvage=salvage)
        self.complete, self.unchecked = contents.complete, contents.unchecked
        self.damaged += contents.damaged
        self.attachments, self.chunks, self._topics = contents.attachments, tuple(contents.chunks), contents.topics
        self.read_chunks: frozenset[int] | None = None
        self.about, self.stated_rows, self.stated_begin_s = contents.about, dict[str, int](), None
        with contextlib.suppress(InputError):
            stated = contents.metadata.get("end", {}) if contents.finished else {}
            end = documents.read_metadata(documents.End, stated, field="end")
            self.stated_rows, self.stated_begin_s = read_json(end.rows.encode()), end.first_time_s
        self.messages = {self._topics[number]: count for number, count in sorted(contents.counts.items())}
        if len(set(self._topics.values())) < len(self._topics):
            raise InputError("file", "a recording with each channel once", str(path))
        self._check_documents(salvage=salvage)

    def _take_metadata(self, metadata: dict[str, dict[str, str]], copy: bytes | None, *, salvage: bool) -> None:
        """Use the checksummed copy of the metadata where the file has one."""
        self.damaged, self.metadata = 0, metadata
        if copy is None:
            return
        stated = read_json(copy, field=COPY)
        if {name: metadata.get(name) for name in stated} != stated:
            self.damaged = 1
        self.metadata = {**({"end": metadata["end"]} if "end" in metadata and not salvage else {}), **stated}

    def _check_documents(self, *, salvage: bool) -> None:
        """Validate metadata and attached documents."""
        about, name = self.metadata.get("rig", {}), self.path.name
        if about.get("format") != schemas.FORMAT:
            raise InputError("file", _MUST_BE_RECORDING, str(self.path))
        documents.check_version(about)
        for kind, model in documents.METADATA.items():
            if kind in self.metadata:
                documents.read_metadata(model, self.metadata[kind], field=f"{name}: {kind}")
        payloads = [self.attachments.get(f"{kind}.json") for kind in documents.ATTACHED]
        if None in payloads:
            # Salvage drops a damaged attachment.
            must = "a recording with its calibration; this one was cut off in it, or damaged"
            raise InputError("file", must, str(self.path))
        self.catalogue, self.parameters, self.scene = (
            documents.read(model, payload or b"", field=f"{name}: {kind}.json")[0]
            for payload, (kind, model) in zip(payloads, documents.ATTACHED.items(), strict=True)
        )
        if self.damaged and not salvage:
            must, several = "an intact recording (`rig recover` passes over what is damaged)", "s" * (self.damaged > 1)
            raise InputError("file", must, Words(f"{self.path}, with {self.damaged} damaged record{several}"))
        self._catalogue = stream_check.Catalogue.read(self.catalogue)
        self.table = self._catalogue.table

    @property
    def end_reason(self) -> str:
        """Reason for the end of the recording."""
        if self.complete:
            return self.metadata.get("end", {}).get("reason", "unknown")
        return "cut off: the recorder did not finish the file"

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Simulated times of the first and the last row, without reading samples [s]; None if there are no rows.

        Exact for a complete file. For an interrupted file they are message times, accurate to one block.
        """
        if self.complete:
            end = self.metadata.get("end", {})
            if not {"first_time_s", "last_time_s"} <= set(end) or end.get("rows", "{}") == "{}":
                return None
            return float(end["first_time_s"]), float(end["last_time_s"])
        if not self.chunks:
            return None
        return min(each.begin_ns for each in self.chunks) / 1e9, max(each.end_ns for each in self.chunks) / 1e9

    @cached_property
    def formats(self) -> dict[str, stream_check.StreamFormat]:
        """Declared streams of the catalogue by key."""
        return self._catalogue.get_formats()

    def between(self, from_s: float, to_s: float) -> Self:
        """Return the file limited to the rows between two times [s], with all events and gaps.

        Chunks outside the interval are skipped by the index. A file with block faults is read completely, because the
        true times of its blocks depend on all of its fault documents.
        """
        part = copy(self)
        if FAULTS in self.messages:
            return part
        begin_ns, end_ns = (from_s - _MAX_BLOCK_S) * 1e9, to_s * 1e9
        read_chunks = {each for each in self.chunks if each.end_ns >= begin_ns and each.begin_ns <= end_ns}
        latest: dict[int, Chunk] = {}  # a long earlier block may reach into the interval
        for chunk in sorted(set(self.chunks) - read_chunks, key=lambda each: each.begin_ns):
            latest |= dict.fromkeys(chunk.channels or () if chunk.begin_ns < from_s * 1e9 else (), chunk)
        part.read_chunks = frozenset(each.offset for each in read_chunks | set(latest.values()))
        return part

    def _topics_in(self, chunk: Chunk, wanted: dict[int, str]) -> dict[int, str]:
        """Return the requested topics to read in a chunk."""
        if self.read_chunks is None or chunk.offset in self.read_chunks:
            return wanted
        outside = (EVENTS, schemas.GAPS, schemas.CLOCK)[: 3 if chunk == self.chunks[0] else 2]
        return {number: topic for number, topic in wanted.items() if topic in outside}

    def block(self, key: str, payload: bytes) -> Block | None:
        """Return the block in a payload; None if it is invalid or does not fit the catalogue."""
        try:
            block = parse_block(key, payload)
        except ValueError:
            return None
        columns = block.values.shape[1]
        stream_format = self.formats.get(key, stream_check.StreamFormat(columns, 0.0, self._catalogue.tick_rate_hz))
        return block if (columns, block.tick_rate_hz) == (stream_format.columns, stream_format.tick_rate_hz) else None

    def stamped(self, topics: Container[str] | None, chunks: Iterable[Chunk] | None = None) -> Iterator[Message]:
        """Yield the messages of some topics in file order, documents without their ROS 2 string wrapper.

        Args:
            topics: The topics; None for all.
            chunks: Chunks to read; None for all.

        Raises:
            InputError: The file has changed, is damaged, or can no longer be read.
        """
        wanted = {number: topic for number, topic in self._topics.items() if topics is None or topic in topics}
        if not wanted:
            return
        texts = {topic for topic in wanted.values() if documents.has_documents(topic)}
        with self._open() as file:
            for chunk in self.chunks if chunks is None else chunks:
                here = self._topics_in(chunk, wanted)
                if not here or (chunk.channels is not None and chunk.channels.isdisjoint(here)):
                    continue
                for number, log_time, publish_time, payload in messages(unpack(file, chunk), here, cut=chunk.cut):
                    topic = here[number]
                    yield topic, log_time, publish_time, schemas.unwrap_text(payload) if topic in texts else payload

    @contextlib.contextmanager
    def _open(self) -> Iterator[BinaryIO]:
        """Open the file and convert every parser error on damaged data to an InputError."""
        try:
            with open_file(self.path) as file:
                yield file
        except InputError:
            raise
        except OSError as error:
            raise build_read_error(self.path, error) from None
        except DamagedError as error:
            must = "an intact recording (`rig recover` passes over what is damaged)"
            raise InputError("file", must, Words(f"{self.path} ({error})")) from None
        except (McapError, struct.error, ValueError, MemoryError, OverflowError) as error:
            raise InputError("file", "an intact recording", Words(f"{self.path} ({error})")) from None
