"""Recordings in several files, and their limit of disk space."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import defaultdict
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import recorder.output.series
from recorder.contents.metadata import Beginning
from recorder.files.payload import Payload
from recorder.files.unfinished_file import Draft
from recorder.output.disk_limits import DiskLimits
from recorder.output.series import Series, part_path
from recorder.output.sink import Needs
from recorder.reader import Recording, join
from recorder.rewrite import cut, recover
from recorder.writer import RecordingError, RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import (
    CATALOGUE,
    EVENTS,
    PARAMETERS,
    SCENE,
    Gap,
    encode_block,
    encode_document,
    get_schema,
    sensor_key,
)
from rig.channels.table import default_table

from .recorder_stream import TICK_RATE_HZ, generate_stream, make_block, make_documents

PROBES = sensor_key("probes")


def series(
    path: Path, *, force: bool = False, monotonic_s: Callable[[], float] = time.monotonic, **limits: Any
) -> Series:
    about = make_documents()
    calls = count()

    def open_file(name: Path, scene: dict[str, Any], beginning: Beginning) -> RecordingWriter:
        return RecordingWriter(
            name,
            catalogue=about[CATALOGUE],
            parameters=about[PARAMETERS],
            scene=scene,
            beginning=beginning,
            force=force,
            monotonic_s=lambda: 0.01 * next(calls),  # a flush every 25 payloads
        )

    needs = Needs(default_table(), TICK_RATE_HZ, about[SCENE], open_file, DiskLimits(**limits), force, monotonic_s)
    return Series(path, needs)


def write(file: Series, items: list[tuple[str, bytes]]) -> None:
    for number, (key, payload) in enumerate(items):
        if file.ended:
            break
        file.take(Payload.read(key, payload, 1_700_000_000_000_000_000 + number))
    file.finish("completed")


@pytest.fixture(scope="module")
def items() -> list[tuple[str, bytes]]:
    return list(generate_stream(100))


@pytest.fixture(scope="module")
def parts(tmp_path_factory, items) -> list[Path]:
    file = series(tmp_path_factory.mktemp("series") / "run.mcap", rotate_s=0.3)
    write(file, items)
    return file.files


def test_every_payload_is_in_one_part_and_the_parts_join_to_the_stream(parts, items):
    assert [part.name for part in parts] == [f"run.{number:04d}.mcap" for number in range(4)]
    assert sorted(parts) == parts
    sent = defaultdict(list)
    for key, payload in items:
        sent[key].append(payload)
    recordings = [Recording.open(part) for part in parts]
    for key, payloads in sent.items():
        assert [p for part in recordings for _, p in part.payloads(key)] == payloads, key
    joined = join(list(reversed(parts)))
    assert joined.streams == _streams_of(items, parts[0].parent)
    np.testing.assert_array_equal(joined.samples("probes").index, np.arange(20_000))


def _streams_of(items: list[tuple[str, bytes]], folder: Path) -> dict[str, Any]:
    file = series(folder / "whole.mcap")
    write(file, items)
    return Recording.open(folder / "whole.mcap").streams


def test_files_are_split_at_one_instant_for_all_streams(parts):
    for number, part in enumerate(parts):
        streams = Recording.open(part).streams
        firsts = [stream.first_time_s for key, stream in streams.items() if "edges" not in key]
        assert firsts == pytest.approx([0.3 * number] * len(firsts))


def test_each_part_is_complete_and_names_its_neighbours(parts):
    from mcap.reader import make_reader

    for number, part in enumerate(parts):
        recording = Recording.open(part)
        assert recording.complete
        about = recording.metadata["series"]
        assert about["number"] == str(number)
        assert about["previous"] == (parts[number - 1].name if number else "")
        following = parts[number + 1].name if number + 1 < len(parts) else None
        assert recording.metadata["end"].get("next") == following
        due = json.loads(about["due"])
        assert due == ({} if not number else {key: due[key] for key in recording.streams})
        if number:
            assert due[PROBES] == recording.samples("probes").index[0]
        with part.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(recording.messages.values())


def test_a_part_contains_earlier_commands(tmp_path, items):
    command = {
        "event": "command",
        "tick": 100_000,
        "time_s": 0.1,
        "id": 3,
        "command": "hammer",
        "request": {"force_n": 50.0},
        "from": "test",
    }
    file = series(tmp_path / "run.mcap", rotate_s=0.3)
    write(file, [*items[:100], (EVENTS, encode_document(command)), *items[100:]])
    earlier = {"id": 3, "tick": 100_000, "command": "hammer", "request": {"force_n": 50.0}}
    scenes = [Recording.open(part).scene for part in file.files]
    assert "taken" not in scenes[0]
    assert [scene["taken"] for scene in scenes[1:]] == [[earlier]] * 3


def test_rows_lost_at_a_seam_are_a_gap(tmp_path):
    missing = {(PROBES, encode_block(make_block(PROBES, number))) for number in (29, 30, 31)}
    file = series(tmp_path / "run.mcap", rotate_s=0.3)
    write(file, [item for item in generate_stream(60) if item not in missing])
    assert [Recording.open(part).gaps for part in file.files] == [[], [Gap(PROBES, 5800, 600)]]
    assert {key: lost for key, lost in file.counts().lost.items() if lost} == {PROBES: 600}
    assert join(file.files).streams[PROBES].lost == 600


def test_history_received_stream_by_stream_is_in_the_first_part(tmp_path, items):
    then, now = (
        [item for item in items if get_schema(item[0])][:700],
        [item for item in items if get_schema(item[0])][700:],
    )
    file = series(tmp_path / "run.mcap", rotate_s=0.1)
    write(file, sorted(then, key=lambda item: item[0]) + now)
    extents = []
    for part in file.files:
        streams = [stream for key, stream in Recording.open(part).streams.items() if key.startswith("rig/truth/")]
        extents.append({(round(stream.first_time_s, 3), round(stream.last_time_s, 2)) for stream in streams})
    assert len(extents) > 2
    assert [len(each) for each in extents] == [1] * len(extents)
    assert next(iter(extents[0]))[0] == 0.0
    assert all(stream.lost == 0 for stream in join(file.files).streams.values())


def test_a_missing_stream_does_not_delay_rotation_for_long(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder.output.series, "_CATCH_UP_S", 0.0)
    file = series(tmp_path / "run.mcap", rotate_s=0.1)
    write(file, [(PROBES, encode_block(make_block(PROBES, number))) for number in range(100)])
    assert len(file.files) == 10


def test_rotation_by_size(tmp_path):
    file = series(tmp_path / "run.mcap", rotate_mb=1.0)
    write(file, list(generate_stream(200)))
    sizes = [part.stat().st_size for part in file.files]
    assert len(sizes) >= 3
    assert all(1_000_000 < size < 1_300_000 for size in sizes[:-1])


def test_the_budget_ends_a_recording_with_a_finished_file(tmp_path):
    file = series(tmp_path / "run.mcap", budget_mb=5.0)
    write(file, list(generate_stream(400)))
    assert file.ended == "the budget of 5 MB is used up"
    assert file.out_of_room
    assert 4_500_000 < (tmp_path / "run.mcap").stat().st_size <= 5_000_000
    assert Recording.open(tmp_path / "run.mcap").complete


def test_the_oldest_files_are_deleted_on_request(tmp_path):
    file = series(tmp_path / "run.mcap", rotate_mb=1.0, budget_mb=5.0, when_full="remove-oldest")
    write(file, list(generate_stream(500)))
    assert file.ended == ""
    assert file.removed > 0
    assert file.files == sorted(tmp_path.iterdir())
    assert sum(part.stat().st_size for part in file.files) <= 5_000_000
    assert join(file.files).streams[PROBES].last_time_s == pytest.approx(5.0 - 50e-6)
    assert int(Recording.open(file.files[0]).metadata["series"]["number"]) == file.removed


@pytest.mark.parametrize("more", [{"budget_mb": 5.0, "when_full": "remove-oldest"}, {}])
def test_the_counts_are_those_of_the_existing_files(tmp_path, more):
    """Rows, gaps, invalid payloads, and times: deleted files do not count."""
    file, items = series(tmp_path / "run.mcap", rotate_mb=1.0, **more), list(generate_stream(500))
    lost = [item for number, item in enumerate(items) if item[0] != PROBES or number % 100]
    write(file, [*lost[:50], (PROBES, b"no block"), *lost[50:-9], (PROBES, b"no block"), *lost[-9:]])
    assert (file.removed > 0) == bool(more)
    (counted,), found = file.kept(), join(file.files)
    assert counted.rows == {key: stream.rows for key, stream in found.streams.items() if stream.rows}
    assert counted.first_time_ns == pytest.approx(1e9 * found.streams[PROBES].first_time_s)
    assert counted.gaps == len(found.gaps) > 0
    assert counted.malformed == sum(stream.invalid for stream in found.streams.values()) == (1 if more else 2)


def test_the_oldest_files_are_deleted_on_a_full_disk(tmp_path, monkeypatch):
    disk_bytes = 8_000_000

    def statvfs(_: object) -> SimpleNamespace:
        used = sum(file.stat().st_size for file in tmp_path.iterdir())
        return SimpleNamespace(f_bavail=disk_bytes - used, f_frsize=1)

    monkeypatch.setattr(os, "statvfs", statvfs)
    file = series(tmp_path / "run.mcap", rotate_mb=1.0, keep_free_mb=0.0, when_full="remove-oldest")
    write(file, list(generate_stream(700)))
    assert (file.ended, file.files) == ("", sorted(tmp_path.iterdir()))
    assert file.removed > 0
    assert sum(part.stat().st_size for part in file.files) <= disk_bytes
    assert join(file.files).streams[PROBES].last_time_s == pytest.approx(7.0 - 50e-6)


def test_free_space_is_kept_on_the_disk(tmp_path, monkeypatch):
    free = [100]
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=free[0], f_frsize=1_000_000))
    now_s = [0.0]
    file = series(tmp_path / "run.mcap", monotonic_s=lambda: now_s[0], keep_free_mb=50.0)
    items = list(generate_stream(40))
    for key, payload in items[:160]:
        file.take(Payload.read(key, payload, 0))
    assert file.ended == ""
    free[0] = 51
    now_s[0] = 1.0
    file.take(Payload.read(*items[160], 0))
    assert file.ended == "less than 50 MB are free on the disk"
    file.finish(file.ended)
    assert Recording.open(tmp_path / "run.mcap").end_reason == file.ended


@pytest.mark.parametrize(
    ("limits", "must"),
    [
        ({"rotate_mb": 0.5}, "rotate_mb must be from 1"),
        ({"rotate_s": 0.0}, "rotate_s must be from 0.1"),
        ({"rotate_s": float("nan")}, "rotate_s must be from 0.1"),
        ({"budget_mb": 1.0}, "budget_mb must be from 5"),
        ({"keep_free_mb": -1.0}, "keep_free_mb must be from 0"),
        ({"budget_mb": -1.0}, "budget_mb must be from 5"),
        ({"when_full": "remove-oldest"}, "stop for a recording in one file"),
        (
            {"when_full": "remove-oldest", "rotate_mb": 5.0, "budget_mb": 9.0},
            "budget_mb must be at least two files, 10",
        ),
    ],
)
def test_impossible_limits_are_refused(limits, must):
    with pytest.raises(InputError, match=must):
        DiskLimits(**limits)


def test_parts_of_an_earlier_recording_are_not_mixed_with_new_ones(tmp_path, items):
    old = part_path(tmp_path / "run.mcap", 7)
    old.write_text("precious")
    other = tmp_path / "run.other.mcap"
    other.write_text("somebody else's")
    with pytest.raises(InputError, match=r"run\.0007\.mcap, which exists"):
        series(tmp_path / "run.mcap", rotate_s=0.3)
    file = series(tmp_path / "run.mcap", rotate_s=0.3, force=True)
    write(file, items)
    assert not old.exists()
    assert other.read_text() == "somebody else's"
    assert len(file.files) == 4


def test_force_removes_no_file_of_a_recording_in_the_making(tmp_path, items):
    path = tmp_path / "run.mcap"
    first = series(path, rotate_s=0.1)
    for number, (key, payload) in enumerate(items[:300]):
        first.take(Payload.read(key, payload, number))
    there = sorted(tmp_path.iterdir())
    assert len(there) > 2
    with pytest.raises(InputError, match="no other recording is writing to"):
        series(path, rotate_s=0.1, force=True)
    assert sorted(tmp_path.iterdir()) == there
    first.finish("completed")
    write(series(path, rotate_s=10.0, force=True), items)
    assert [file.name for file in tmp_path.iterdir()] == ["run.0000.mcap"]


def test_a_file_that_cannot_be_deleted_ends_the_recording_normally(tmp_path, items, monkeypatch):
    def refused(self: Path, **_: object) -> None:
        raise OSError(30, "Read-only file system", str(self))

    file = series(tmp_path / "run.mcap", rotate_mb=1.0, budget_mb=5.0, when_full="remove-oldest")
    monkeypatch.setattr(Path, "unlink", refused)
    write(file, list(generate_stream(600)))
    assert "Read-only file system" in file.ended
    assert file.out_of_room
    assert all(Recording.open(part).complete for part in file.files)


def test_a_removed_folder_leaves_a_copy_in_the_nearest_one(tmp_path, items):
    folder = tmp_path / "day"
    folder.mkdir()
    file = series(folder / "run.mcap")
    for key, payload in items[:200]:
        file.take(Payload.read(key, payload, 0))
    for each in folder.iterdir():
        each.unlink()
    folder.rmdir()
    with pytest.raises(RecordingError, match=r"was removed while it was being written.*are kept in .*run\.mcap\.part"):
        write(file, items[200:])
    copy = tmp_path / "run.mcap.part"
    assert file.part == copy
    payloads = [payload for _, payload in Recording.open(copy).payloads(PROBES)]
    assert payloads == [payload for key, payload in items if key == PROBES][: len(payloads)]
    assert len(payloads) >= 24


@pytest.mark.parametrize("size_bytes", [0, 5000, 10_000_000])
def test_a_file_that_another_process_truncates_or_appends_to_ends_at_the_next_flush(tmp_path, items, size_bytes):
    file = series(tmp_path / "run.mcap")
    for key, payload in items[:200]:
        file.take(Payload.read(key, payload, 0))
    os.truncate(file.part, size_bytes)
    with pytest.raises(RecordingError, match=r"\.part was truncated or appended to while it was being written"):
        [file.take(Payload.read(*each, 0)) for each in items[200:]]  # not its end
    assert [each.name for each in tmp_path.iterdir()] == ["run.mcap.part"]


@pytest.mark.parametrize("length", [b"\xff" * 8, b"\xff" * 7 + b"\0", b"\1" + b"\0" * 7])
def test_a_file_whose_index_cannot_be_read_at_the_end_is_an_error(tmp_path, items, length):
    file = series(tmp_path / "run.mcap")
    for key, payload in items[:200]:
        file.take(Payload.read(key, payload, 0))
    with file.part.open("r+b") as part:
        part.seek(9)  # length of the first record
        part.write(length)
    with pytest.raises(RecordingError, match="the file was altered while it was being written"):
        file.finish("completed")
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.parametrize("at_end", [True, False])
@pytest.mark.parametrize("how", ["copy", "link"])
def test_a_replaced_file_is_an_error_and_is_not_published(how, at_end, tmp_path, items):
    file = series(tmp_path / "run.mcap")
    for key, payload in items[:200]:
        file.take(Payload.read(key, payload, 0))
    other = tmp_path / "other"
    other.write_bytes(b"old")
    file.part.rename(tmp_path / "away")
    file.part.hardlink_to(other) if how == "copy" else file.part.symlink_to(other)
    with pytest.raises(RecordingError, match=r"was replaced .* are kept in .*run\.saved\.mcap"):
        file.finish("completed") if at_end else [file.take(Payload.read(*each, 0)) for each in items[200:300]]
    assert not (tmp_path / "run.mcap").exists()
    saved = [payload for _, payload in Recording.open(tmp_path / "run.saved.mcap.part").payloads(PROBES)]
    assert saved == [payload for key, payload in items if key == PROBES][: len(saved)]
    assert len(saved) >= 24


@pytest.mark.parametrize("moment", ["before", "during"])
def test_a_file_replaced_at_its_end_is_an_error(moment, tmp_path, monkeypatch):
    draft, rename = Draft(tmp_path / "run.mcap"), Path.replace

    def replace(*_: object) -> None:
        monkeypatch.undo()
        rename(draft.part, tmp_path / "away")
        draft.part.write_bytes(b"old!")
        if moment == "during":
            rename(draft.part, draft.path)

    draft.write(b"data")
    if moment == "before":
        replace()
    else:
        monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(OSError, match="was replaced"):
        draft.finish()
    draft.close()
    assert draft.path.exists() == (moment == "during")
    assert draft.part.read_bytes() == b"data"


def test_the_digest_is_that_of_the_file(tmp_path, items):
    file = series(tmp_path / "run.mcap")
    write(file, items)
    assert file.sha256 == hashlib.sha256((tmp_path / "run.mcap").read_bytes()).hexdigest()


def test_a_recovered_part_and_cuts_of_parts_join(parts, tmp_path):
    torn = tmp_path / "run.0003.mcap.part"
    torn.write_bytes(parts[3].read_bytes()[:-300])
    whole = join([*parts[:3], recover(torn).path])
    assert whole.streams[PROBES].rows == 20_000
    pieces = [
        cut(whole, tmp_path / "a.mcap", from_s=0.1, to_s=0.45).path,
        cut(whole, tmp_path / "b.mcap", from_s=0.45).path,
    ]
    np.testing.assert_array_equal(join(pieces).samples("probes").index, np.arange(2000, 20_000))
    assert "series" not in Recording.open(pieces[0]).metadata


def test_files_of_different_runs_are_not_joined(tmp_path, items):
    about = make_documents()
    for name, seed in (("a", 1), ("b", 2)):
        with RecordingWriter(
            tmp_path / f"{name}.mcap",
            catalogue=about[CATALOGUE],
            parameters=about[PARAMETERS],
            scene={**about[SCENE], "seed": seed},
        ) as file:
            for key, payload in items[:50]:
                file.take(Payload.read(key, payload, 0))
    with pytest.raises(InputError, match="recordings of one run"):
        join([tmp_path / "a.mcap", tmp_path / "b.mcap"])


def test_overlapping_parts_are_not_joined(tmp_path, items):
    for name in ("a", "b"):
        write(series(tmp_path / f"{name}.mcap"), items[:100])
    with pytest.raises(InputError, match="recordings that do not overlap in time"):
        join([tmp_path / "a.mcap", tmp_path / "b.mcap"])
