"""Corrupt recordings: every byte has a checksum, documents have models, sizes are bounded by the file.

The reference is the recording before it was corrupted. RIG_FUZZ_INPUTS sets the number of inputs of each test.
"""

from __future__ import annotations

import contextlib
import copy
import json
import os
import re
import struct
import subprocess
import sys
import time
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.files.records import MAGIC
from recorder.reader import Recording, join
from recorder.rewrite import is_whole, recover
from replays.campaigns.files.campaign import load_campaign
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import open_source
from replays.score.records.can_log import open_can_log
from replays.studies.common.journal import Journal
from rig.base.errors import InputError
from rig.channels.table import default_table
from rig.cli.main import main
from tests.hostile import InputTally, check_tallies, input_count, limit_processor_time
from tests.hostile.files import (
    PROBES,
    SESSIONS,
    Layout,
    find_attachments,
    list_operations,
    make_far_block,
    read_contents,
    spoil_bytes,
    write_file,
)

pytestmark = pytest.mark.filterwarnings("default::RuntimeWarning")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_file(tmp_path_factory.mktemp("hostile") / "run.mcap")


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_file(tmp_path_factory.mktemp("hostile") / "left.mcap", leave=True)


@pytest.fixture(scope="module")
def layout(path: Path) -> Layout:
    return Layout(Recording.open(path))


def flipped(data: bytes, at: int, bit: int) -> bytes:
    return data[:at] + bytes([data[at] ^ (1 << bit)]) + data[at + 1 :]


@pytest.mark.parametrize("finished", [True, False])
def test_each_of_600_flipped_bits_in_attachments_is_reported(
    path: Path, part: Path, finished: bool, tmp_path: Path
) -> None:
    data = (path if finished else part).read_bytes()
    places = [at for start, end in find_attachments(data) for at in range(start, end)]
    rng = np.random.default_rng(1)
    spoilt = tmp_path / ("x.mcap" if finished else "x.mcap.part")
    reported = 0
    for at, bit in zip(rng.choice(places, 600), rng.integers(0, 8, 600), strict=True):
        spoilt.write_bytes(flipped(data, int(at), int(bit)))
        with pytest.raises(InputError):
            Recording.open(spoilt)
        assert not is_whole(spoilt)
        reported += 1
    assert reported == 600


def test_a_changed_calibration_is_never_recovered_as_complete(path: Path, tmp_path: Path) -> None:
    data = path.read_bytes()
    at = data.index(b'"sensitivity_v": ')
    spoilt = tmp_path / "x.mcap"
    spoilt.write_bytes(flipped(data, at + 19, 1))
    with pytest.raises(InputError, match="calibration"):
        recover(spoilt)
    # A record that is not needed is skipped and counted.
    at = data.index(b"A recording of the virtual")
    spoilt.write_bytes(flipped(data, at, 1))
    assert recover(spoilt).damaged == 1


@pytest.mark.parametrize("command", ["info", "validate", "identify", "recover", "cut", "export", "replay", "view"])
def test_every_command_reports_an_inverted_sensitivity(
    command: str, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = path.read_bytes()
    at = data.index(b'"sensitivity_v": 3.94') + len(b'"sensitivity_v": 3.')
    monkeypatch.chdir(tmp_path)
    Path("x.mcap").write_bytes(flipped(data, at, 3))
    assert Path("x.mcap").read_bytes()[at - 2 : at + 2] == b"3.14"
    more = {"cut": ["-o", "y.mcap"], "export": ["-o", "y.csv"], "identify": ["--fit", "contact.friction"],
            "view": ["--save", "y.rrd"], "replay": ["--listen", "127.0.0.1:22990"]}  # fmt: skip
    with pytest.raises(SystemExit) as end:
        main([command, "x.mcap", *more.get(command, [])])
    printed = capsys.readouterr()
    assert end.value.code == 2
    assert printed.err.startswith("rig: file must be")
    assert printed.err.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["x.mcap"]


@pytest.mark.parametrize("finished", [True, False])
def test_every_changed_byte_that_alters_contents_is_reported(
    path: Path, part: Path, finished: bool, tmp_path: Path
) -> None:
    source = path if finished else part
    data, before = source.read_bytes(), read_contents(Recording.open(source))
    messages = before[0]
    spoilt = tmp_path / ("x.mcap" if finished else "x.mcap.part")
    rng = np.random.default_rng([2 + finished, input_count(150)])
    tally, same, shorter = InputTally(), 0, 0
    for number in range(input_count(150)):
        changed = spoil_bytes(data, rng)
        spoilt.write_bytes(changed)
        with tally.attempt(number):
            recording = Recording.open(spoilt)
            found = read_contents(recording)
            if found == before and recording.complete == finished:
                same += 1
                continue
            # Reported as incomplete. It has the first messages unchanged, and reports the parts without a checksum.
            shorter += 1
            assert not recording.complete
            sure = found[0] if not recording.unchecked else found[0][: -_unsure(recording)]
            assert sure == messages[: len(sure)], "a message is another one"
            assert found[3:6] == before[3:6], "a document is another one"
    check_tallies({f"bytes ({same} the same, {shorter} told to be shorter)": tally})
    assert tally.refused > 0.3 * input_count(150)


def _unsure(recording: Recording) -> int:
    (unchecked,) = recording.unchecked
    return int(unchecked.split()[2])


def test_a_malformed_file_is_read_or_refused_without_a_traceback(layout: Layout, tmp_path: Path) -> None:
    rng = np.random.default_rng([4, input_count(160)])
    tallies = {name: InputTally() for name in list_operations()}
    for number in range(input_count(160)):
        path = layout.spoilt(rng).write(tmp_path / "x.mcap", rng)
        name, use = list(list_operations().items())[number % len(tallies)]
        with tallies[name].attempt(number):
            use(path, tmp_path)
    check_tallies(tallies)
    assert all(tally.accepted for tally in tallies.values())


def test_a_block_in_a_far_future_costs_neither_time_nor_memory(layout: Layout, tmp_path: Path) -> None:
    tracemalloc.start()
    begin_s = time.process_time()
    for tick, index in ((2**52, 2**52), (1_003_000, 2**52), (2**52, 60), (2**53, 2**53 - 20), (3_000, 60)):
        changed = copy.copy(layout)
        changed.messages = [*layout.messages, ("rig/sensors/probes", make_far_block(tick, index), 2**62)]
        path = changed.write(tmp_path / "x.mcap")
        for use in list_operations().values():
            with contextlib.suppress(InputError):
                use(path, tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 300e6
    assert time.process_time() - begin_s < 60.0
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 100e6


def _bomb(declared: int, packed: bytes, compression: bytes, checksum: int) -> bytes:
    name = struct.pack("<I", len(compression)) + compression
    body = struct.pack("<QQQI", 0, 0, declared, checksum) + name + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


def _packed(size: int, *, stated_size: int | None) -> bytes:
    """Return a zstd frame of `size` zeros, four bytes per 128 KiB (RFC 8878), with or without its size declared."""
    head = struct.pack("<IB", 0xFD2FB528, 0xC0 if stated_size is not None else 0) + bytes([7 << 3])
    head += b"" if stated_size is None else struct.pack("<Q", stated_size)
    count = size >> 17
    block = struct.pack("<I", (1 << 17) << 3 | 1 << 1)[:3] + b"\0"
    last = struct.pack("<I", (1 << 17) << 3 | 1 << 1 | 1)[:3] + b"\0"
    return head + block * (count - 1) + last


@pytest.mark.parametrize("cut", [0, 40])
@pytest.mark.parametrize(
    ("compression", "declared", "stated_size"),
    [
        *((b"zstd", declared, size) for declared in (4 << 30, 1 << 20) for size in (4 << 30, 1 << 20, None)),
        *((name, size, None) for name in (b"lz4", b"", b"zstd") for size in (2**63, 1 << 20)),
    ],
)
def test_a_packed_chunk_of_4_gb_is_refused_before_it_is_unpacked(
    part: Path, tmp_path: Path, cut: int, compression: bytes, declared: int, stated_size: int | None
) -> None:
    packed = _packed(4 << 30, stated_size=stated_size)
    assert len(packed) < 132_000
    bomb = tmp_path / "bomb.mcap.part"
    chunk = _bomb(declared, packed, compression, zlib.crc32(bytes(1 << 20)))
    bomb.write_bytes(part.read_bytes() + chunk[: len(chunk) - cut])
    tracemalloc.start()
    begin_s = time.process_time()
    with contextlib.suppress(InputError) if cut else pytest.raises(InputError, match="intact"):
        Recording.open(bomb)
    recover(bomb, tmp_path / "new.mcap", force=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6
    assert time.process_time() - begin_s < 10.0


def _of(layout: Layout, key: str = PROBES) -> list[int]:
    return [at for at, (topic, _, _) in enumerate(layout.messages) if topic == key]


def _without(layout: Layout, gone: set[int]) -> None:
    layout.messages = [message for at, message in enumerate(layout.messages) if at not in gone]


def _odd(layout: Layout, at: int) -> None:
    topic, payload, time_ns = layout.messages[at]
    layout.messages[at] = (topic, payload[:-4], time_ns)


def _catalogue(change: Callable[[dict[str, Any]], object]) -> Callable[[Layout], None]:
    def spoil(layout: Layout) -> None:
        document = json.loads(layout.attachments["catalogue.json"])
        change(document)
        layout.attachments["catalogue.json"] = json.dumps(document).encode()

    return spoil


def _slower(document: dict[str, Any]) -> None:
    group = document["table"]["groups"]["probes"]
    for each in (group, *group["channels"]):
        each["rate_hz"] = 10_000


_CORRUPTIONS: dict[str, tuple[Callable[[Layout], object], str]] = {
    "first": (lambda layout: _without(layout, {_of(layout)[0]}), f"20 rows of {PROBES} are missing"),
    "middle": (lambda layout: _without(layout, {_of(layout)[1]}), f"20 rows of {PROBES} are missing"),
    "last": (lambda layout: _without(layout, {_of(layout)[-1]}), f"20 rows of {PROBES} are missing"),
    "all": (lambda layout: _without(layout, set(_of(layout))), f"60 rows of {PROBES} are missing"),
    "undecodable": (lambda layout: _odd(layout, _of(layout)[0]), "are not blocks or do not fit the catalogue: 1"),
    "twice": (
        lambda layout: layout.messages.insert(0, layout.messages[_of(layout)[0]]),
        f"blocks of {PROBES} with repeated or decreasing row numbers: 1",
    ),
    "channel": (
        _catalogue(lambda document: document["table"]["groups"]["probes"]["channels"].pop()),
        f"payloads of {PROBES} that are not blocks or do not fit the catalogue: 3",
    ),
    "ticks": (
        _catalogue(lambda document: document.update(tick_rate_hz=1000.0)),
        f"payloads of {PROBES} that are not blocks or do not fit the catalogue: 3",
    ),
    "rate": (
        _catalogue(_slower),
        f"blocks of {PROBES} whose rate differs from the catalogue: 3",
    ),
    "group": (
        _catalogue(lambda document: document["table"]["groups"].pop("probes")),
        f"{PROBES} is not in the catalogue",
    ),
}


def _rig(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(list(arguments))
    assert isinstance(end.value.code, int)
    return end.value.code


@pytest.mark.parametrize("lie", _CORRUPTIONS)
def test_missing_or_inconsistent_rows_are_reported_despite_valid_checksums(
    lie: str, layout: Layout, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = copy.deepcopy(layout)
    spoil, message = _CORRUPTIONS[lie]
    assert Recording.open(changed.write(tmp_path / "same.mcap")).doubts == ()
    spoil(changed)
    path = changed.write(tmp_path / "x.mcap")
    assert any(message in line for line in Recording.open(path).doubts)
    assert _rig("info", str(path)) == 1
    printed = capsys.readouterr().out
    assert message in printed
    if "missing" in message:
        assert re.search(f"^lost .*{message}", printed, re.MULTILINE)
        assert not is_whole(path)
        assert recover(path, tmp_path / "new.mcap").missing_rows == (message,)
        assert message in Recording.open(tmp_path / "new.mcap").metadata["recovered"]["short"]
        assert _rig("export", str(path), "-o", str(tmp_path / "y.parquet")) == 0
        assert message in capsys.readouterr().err
    if lie in ("channel", "ticks"):
        assert _rig("info", "--json", str(path)) == 1
        channels = json.loads(capsys.readouterr().out)["health"]["channels"]
        assert next(one for one in channels if one["name"] == "disk_x")["findings"]


def test_a_validation_of_an_incomplete_file_does_not_pass(tmp_path: Path) -> None:
    from replays.recordings.validation import validate

    changed = Layout(Recording.open(SESSIONS / "hammer-5.2.mcap"))
    whole = changed.write(tmp_path / "same.mcap")
    assert validate(Recording.open(whole)).good
    _without(changed, {_of(changed)[-1]})
    found = validate(Recording.open(changed.write(tmp_path / "x.mcap")))
    assert not found.good
    assert re.search(r"fail, .* rows of rig/sensors/probes are missing", found.verdict_line)


def test_a_chunk_missing_in_the_index_is_reported_and_statistics_are_optional(path: Path, tmp_path: Path) -> None:
    data = path.read_bytes()
    start, checksum_at = struct.unpack_from("<Q", data, len(data) - 28)[0], len(data) - 12
    spoilt = tmp_path / "x.mcap"
    for opcode in (8, 11):
        summary, position, ended = b"", start, False
        while position < len(data) - 37:
            one, length = struct.unpack_from("<BQ", data, position)
            record = data[position : position + 9 + length]
            summary += b"" if one == opcode and not ended else record
            ended |= one == opcode
            position += 9 + length
        end = summary + data[len(data) - 37 : checksum_at]
        spoilt.write_bytes(data[:start] + end + struct.pack("<I", zlib.crc32(end)) + MAGIC)
        if opcode == 8:
            with pytest.raises(InputError, match="does not fit the file"):
                Recording.open(spoilt)
    assert read_contents(Recording.open(spoilt)) == read_contents(Recording.open(path))


def test_parts_of_a_series_with_another_calibration_are_not_joined(layout: Layout, tmp_path: Path) -> None:
    first, second = copy.deepcopy(layout), copy.deepcopy(layout)
    second.metadata["series"]["number"] = "1"
    paths = [first.write(tmp_path / "0.mcap"), second.write(tmp_path / "1.mcap")]
    assert len(join(paths).parts) == 2
    _catalogue(lambda document: document["reference"].update(disk_zero="elsewhere"))(second)
    second.write(paths[1])
    with pytest.raises(InputError, match="recordings of one run"):
        join(paths)


@pytest.mark.parametrize("opcode", [6, 9, 12, 0x80, 2])
def test_a_record_of_3_gb_is_not_read_into_memory(part: Path, tmp_path: Path, opcode: int) -> None:
    spoilt = tmp_path / "x.mcap.part"
    head = part.read_bytes()
    for data in (MAGIC, head):
        with spoilt.open("wb") as file:
            file.write(data + struct.pack("<BQ", opcode, 3 << 30))
            file.truncate(len(data) + 9 + (3 << 30))
        tracemalloc.start()
        with contextlib.suppress(InputError):
            Recording.open(spoilt)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 100e6


@pytest.mark.parametrize("record", [struct.pack("<BQ", 0x80, 0), struct.pack("<BQII", 12, 8, 0, 0)])
def test_millions_of_tiny_records_are_refused_soon(record: bytes, tmp_path: Path) -> None:
    spoilt = tmp_path / "x.mcap"
    spoilt.write_bytes(MAGIC + record * 500_000)
    begin_s = time.process_time()
    with pytest.raises(InputError, match="file must be"):
        Recording.open(spoilt)
    assert time.process_time() - begin_s < 10.0


@pytest.mark.parametrize(
    ("command", "suffix"),
    [*((name, ".mcap") for name in ("info", "validate", "recover")), ("run", ".toml"),
     *(("score", suffix) for suffix in (".log", ".blf", ".asc", ".trc", ".csv", ".parquet", ".mf4", ".wav")),
     *(("import", suffix) for suffix in (".uff", ".tdms", ".log"))],
)  # fmt: skip
def test_a_pipe_or_a_folder_is_refused_at_once(
    command: str, suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    for name in ("pipe", "folder"):
        assert _rig(command, str(tmp_path / f"{name}{suffix}")) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_compressed_data_are_measured_before_a_library_reads_them(tmp_path: Path) -> None:
    packed = zlib.compress(bytes(300 << 20), 9)
    blf = struct.pack("<4sI", b"LOGG", 144) + bytes(136)
    container = struct.pack("<HH12x", 2, 0) + packed
    blf += struct.pack("<4sHHII", b"LOBJ", 16, 1, 16 + len(container), 10) + container
    mdf = struct.pack("<4s4xQQ2sBxIQQ", b"##DZ", 48 + len(packed), 0, b"DT", 0, 0, 300 << 20, len(packed)) + packed
    (tmp_path / "bomb.blf").write_bytes(blf)
    (tmp_path / "bomb.mf4").write_bytes(mdf)
    tracemalloc.start()
    with pytest.raises(InputError, match="at most 100 times its size"):
        open_can_log(tmp_path / "bomb.blf", default_table())
    with pytest.raises(InputError, match="at most 100 times its size"):
        open_source(tmp_path / "bomb.mf4", FileOptions())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


@pytest.mark.parametrize("suffix", [".mf4", ".blf", ".log", ".trc", ".asc", ".csv", ".wav", ".parquet", ".toml"])
def test_a_sparse_file_of_a_terabyte_is_refused_at_once(suffix: str, tmp_path: Path) -> None:
    blf = struct.pack("<4sI136x4sHHII16x", b"LOGG", 144, b"LOBJ", 16, 1, 0xF0000000, 10)
    heads = {".mf4": b"MDF     4.10    ", ".blf": blf, ".asc": b"date "}
    path = tmp_path / f"a{suffix}"
    with path.open("wb") as file:
        file.write(heads.get(suffix, b""))
        file.truncate(1 << 40)
    with pytest.raises(InputError), limit_processor_time(20.0):  # noqa: PT012
        if suffix == ".toml":
            load_campaign(path)
        elif suffix in (".blf", ".log", ".trc", ".asc"):
            open_can_log(path, default_table())
        else:
            open_source(path, FileOptions())


def test_the_columns_of_a_parquet_file_are_measured_before_they_are_read(tmp_path: Path) -> None:
    from pyarrow import array, parquet, table

    zeros = array(np.zeros(4_000_000))
    parquet.write_table(table({f"x{n}": zeros for n in range(12)}), tmp_path / "a.parquet")
    assert (tmp_path / "a.parquet").stat().st_size < 1 << 20
    with pytest.raises(InputError, match="4000000 rows of 12 columns"):
        open_source(tmp_path / "a.parquet", FileOptions())


@pytest.mark.parametrize("content", [b"\xff\xfe", b"of another program", b"[]\n", b"[" * 3000 + b"\n", b'{"a": 1}\nx'])
def test_a_journal_of_another_program_is_refused_and_kept(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "j.jsonl").write_bytes(content)
    with pytest.raises(InputError, match=r"a folder whose j\.jsonl is of an earlier run"):
        Journal(tmp_path, "j.jsonl", "code")
    assert (tmp_path / "j.jsonl").read_bytes() == content
    (tmp_path / "j.jsonl").write_bytes(b'{"code": "code"}\n{"code": "co')
    assert len(Journal(tmp_path, "j.jsonl", "code").rows) == 1


def test_libraries_print_no_text_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "a.trc").write_bytes(b"\x1b[2J\x1b]0;title\x07\n")
    done = subprocess.run(
        [sys.executable, "-m", "rig", "score", "a.trc", "--against", SESSIONS / "hammer-5.2.mcap"],
        cwd=tmp_path, capture_output=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr.count(b"\n"), b"\x1b" in done.stderr) == (2, 1, False)


@pytest.mark.parametrize("closed", [(0,), (1,), (2,), (0, 1, 2)])
def test_closed_streams_change_neither_status_nor_output(closed: tuple[int, ...], tmp_path: Path) -> None:
    def close() -> None:
        for number in closed:
            os.close(number)

    for arguments in (["info", "--quick"], ["cut", "-o", tmp_path / "a.mcap"]):
        command = [sys.executable, "-m", "rig", arguments[0], SESSIONS / "hammer-5.2.mcap", *arguments[1:]]
        done = subprocess.run(command, stderr=subprocess.PIPE, preexec_fn=close, check=False)
        assert (done.returncode, done.stderr) == (0, b"")
    assert Recording.open(tmp_path / "a.mcap").complete
