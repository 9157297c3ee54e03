"""Readers of a part of a recording read its chunks by the index, and find the same there as a reader of the whole."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from recorder import rewrite
from recorder.contents import recording_file
from recorder.reader import Recording, join
from recorder.writer import RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import (
    CATALOGUE,
    EVENTS,
    FAULTS,
    PARAMETERS,
    SCENE,
    Block,
    decode_block,
    encode_block,
    encode_document,
    get_schema,
    sensor_key,
)
from tests.commands import run

from . import mcap_variants
from .recorder_stream import generate_stream, make_documents

PROBES = sensor_key("probes")
BLOCKS = 80
HAMMER = {"event": "command", "tick": 100, "time_s": 1e-4, "id": 1, "command": "hammer", "request": {"force_n": 100.0}}


def write(path: Path, items: list[tuple[str, bytes]]) -> Path:
    about = make_documents()
    with RecordingWriter(path, catalogue=about[CATALOGUE], parameters=about[PARAMETERS], scene=about[SCENE]) as file:
        for number, (key, payload) in enumerate(items):
            file.write(key, payload, 1_700_000_000_000_000_000 + number * 1_000_000)
            if number % 20 == 0:
                file.sync()
        file.finish("completed")
    return path


def items() -> list[tuple[str, bytes]]:
    return [(EVENTS, encode_document(HAMMER)), *generate_stream(BLOCKS)]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("between") / "run.mcap", items())


@pytest.fixture
def unpacked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The chunks that were unpacked."""
    found: list[Any] = []
    unpack = recording_file.unpack
    monkeypatch.setattr(recording_file, "unpack", lambda file, chunk: (found.append(chunk), unpack(file, chunk))[1])
    return found


def payloads(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    recording = Recording.open(path)
    return {key: list(recording.payloads(key)) for key in recording.messages if key.startswith("rig/")}


def in_order(rows: list[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
    return rows


def move_block(rows: list[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
    """Move a block of the middle to the end, as after a lost link."""
    place = next(n for n, (key, _) in enumerate(rows) if key == PROBES and n > len(rows) // 2)
    return [*rows[:place], *rows[place + 1 :], rows[place]]


def merge_blocks(rows: list[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
    """Merge all blocks of a stream into one, as an import may have it."""
    blocks = [decode_block(data, get_schema(key) or "") for key, data in rows if key == PROBES]
    first, values = blocks[0], [row for block in blocks for row in block.values.tolist()]
    data = encode_block(Block(first.tick, first.index, first.rate_hz, first.tick_rate_hz, _as(first, values)))
    return [(PROBES, data), *(row for row in rows if row[0] != PROBES)]


def _as(block: Block, values: list[list[int]]) -> Any:
    import numpy as np

    return np.array(values, dtype=block.values.dtype)


def append_fault(rows: list[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
    """Append a document on faults; such a file is read as a whole."""
    return [*rows, (FAULTS, encode_document({"event": "begin", "tick": 5, "id": 1, "time_s": 5e-6}))]


@pytest.mark.parametrize("form", [in_order, move_block, merge_blocks, append_fault])
def test_a_cut_of_a_part_equals_the_cut_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: Any
) -> None:
    source = write(tmp_path / "run.mcap", form(items()))
    rewrite.cut(join([source], in_part=True), tmp_path / "part.mcap", from_s=0.41, to_s=0.43)
    monkeypatch.setattr(Recording, "between", lambda self, from_s, to_s: self)
    rewrite.cut(join([source]), tmp_path / "whole.mcap", from_s=0.41, to_s=0.43)
    assert payloads(tmp_path / "part.mcap") == payloads(tmp_path / "whole.mcap")
    part, whole = (Recording.open(tmp_path / f"{name}.mcap") for name in ("part", "whole"))
    assert part.scene == whole.scene
    assert [taken["id"] for taken in part.scene["taken"]] == [1]  # a command before the part, in another chunk
    assert replace(part.streams[PROBES], messages=0) == replace(whole.streams[PROBES], messages=0)
    assert part.streams[PROBES].rows == 400


def test_a_part_reads_few_chunks(
    source: Path, tmp_path: Path, unpacked: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    total = len(Recording.open(source).chunks)
    assert total > 20
    for number, command in enumerate((["cut", "-o", tmp_path / "part.mcap"], ["export", "-o", tmp_path / "part.csv"])):
        unpacked.clear()
        assert run(command[0], source, *command[1:], "--from", 0.41, "--to", 0.43) == 0, number
        assert 0 < len({chunk.offset for chunk in unpacked}) < total / 2
    capsys.readouterr()


def test_an_export_of_a_part_equals_the_export_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write(tmp_path / "run.mcap", move_block(items()))
    assert run("export", source, "-o", tmp_path / "part.csv", "--from", 0.41, "--to", 0.43, "--channels", "probes") == 0
    shown = capsys.readouterr().out
    monkeypatch.setattr(Recording, "between", lambda self, from_s, to_s: self)
    assert run("export", source, "-o", tmp_path / "all.csv", "--from", 0.41, "--to", 0.43, "--channels", "probes") == 0
    assert capsys.readouterr().out.replace("all.csv", "part.csv") == shown
    assert (tmp_path / "part.csv").read_bytes() == (tmp_path / "all.csv").read_bytes()
    assert (tmp_path / "part.csv.json").read_text() == (tmp_path / "all.csv.json").read_text()


@pytest.mark.parametrize("name", ["without a chunk index", "without chunks", "without statistics"])
def test_a_part_of_a_file_without_an_index_is_the_same(source: Path, tmp_path: Path, name: str) -> None:
    other = mcap_variants.write(source, tmp_path / "other.mcap", name)
    for path, target in ((source, "a.mcap"), (other, "b.mcap")):
        rewrite.cut(join([path], in_part=True), tmp_path / target, from_s=0.41, to_s=0.43)
    assert payloads(tmp_path / "a.mcap") == payloads(tmp_path / "b.mcap")


def test_damage_is_found_only_in_the_chunks_read(source: Path, tmp_path: Path) -> None:
    data = bytearray(source.read_bytes())
    hit = next(chunk for chunk in Recording.open(source).chunks if chunk.begin_ns > 7e8)
    data[hit.offset + hit.length // 2] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    damaged = join([tmp_path / "bad.mcap"], in_part=True)
    rewrite.cut(damaged, tmp_path / "part.mcap", from_s=0.1, to_s=0.12)
    with pytest.raises(InputError, match="an intact recording"):
        rewrite.cut(damaged, tmp_path / "end.mcap", from_s=0.7)
    with pytest.raises(InputError, match="an intact recording"):
        join([tmp_path / "bad.mcap"])
