"""The commands on recordings: `rig info`, `rig cut`, `rig recover`, and refusals of `rig record`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from recorder.contents.summary import Progress, Summary
from recorder.files.chunks import Chunk
from recorder.reader import Recording
from recorder.writer import RecordingWriter
from rig.base.wire import CATALOGUE, EVENTS, PARAMETERS, SCENE, encode_document, sensor_key
from rig.cli.commands.record import print_result, run_session
from rig.cli.main import main
from tests.commands import run

from .recorder_stream import generate_stream, make_documents

NOTE = {"event": "note", "tick": 100_000, "time_s": 0.1, "text": "bearing is warm", "tags": ["look"], "from": "me"}


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("commands") / "run.mcap"
    about = make_documents()
    with RecordingWriter(
        path, catalogue=about[CATALOGUE], parameters=about[PARAMETERS], scene=about[SCENE], sync_every_s=1e9
    ) as file:
        for number, (key, payload) in enumerate([*generate_stream(60), (EVENTS, encode_document(NOTE))]):
            if number not in (100, 101, 102):
                file.write(key, payload, 1_700_000_000_000_000_000 + number * 1_000_000)
        file.finish("completed")
    return path


def test_info_shows_contents_gaps_health_and_notes(path, capsys):
    assert run("info", path) == 1  # rows are lost
    output = capsys.readouterr().out
    for text in (
        "run.mcap",
        "complete",
        "completed",
        "rig/sensors/probes",
        "disk_x",
        "bearing is warm #look",
        "gaps noted",
    ):
        assert text in output
    assert "noise" in output  # the stream of the tests has far more than its calibration


def test_info_as_json(path, capsys):
    assert run("info", "--json", path) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["streams"][sensor_key("probes")]["rows"] in (11_800, 12_000)
    assert sum(gap["size"] for gap in document["gaps"]) == sum(
        stream["lost"] for stream in document["streams"].values()
    )
    assert sum(stream["lost"] for stream in document["streams"].values()) > 0
    assert [event["text"] for event in document["events"] if event["event"] == "note"] == ["bearing is warm"]
    assert {channel["name"] for channel in document["health"]["channels"]} >= {"disk_x", "P_N", "hammer"}


def test_quick_info_reads_no_samples(path, capsys, monkeypatch):
    def fail(*_: object) -> None:
        raise AssertionError("samples were read")

    monkeypatch.setattr(Recording, "blocks_of", fail)
    monkeypatch.setattr(Recording, "scan", fail)
    monkeypatch.setattr(Recording, "streams", property(fail))
    assert run("info", "--quick", path) == 0
    assert "rig/sensors/probes 60" in " ".join(capsys.readouterr().out.split())


def test_cut_and_info_of_the_pieces_as_one(path, tmp_path, capsys):
    for name, times in (("a", ("--to", 0.3)), ("b", ("--from", 0.3))):
        assert run("cut", path, "-o", tmp_path / f"{name}.mcap", *times) == 0
    capsys.readouterr()
    assert run("info", "--json", tmp_path / "b.mcap", tmp_path / "a.mcap") == 1
    document = json.loads(capsys.readouterr().out)
    assert [Path(part["file"]).name for part in document["parts"]] == ["a.mcap", "b.mcap"]
    assert document["streams"] == {
        key: {**row, "messages": document["streams"][key]["messages"]} for key, row in _streams(path).items()
    }


def _streams(path: Path) -> dict[str, dict]:
    from dataclasses import asdict

    return {key: asdict(row) for key, row in Recording.open(path).streams.items()}


def test_recover_takes_several_files(path, tmp_path, capsys):
    parts = []
    for number, length in enumerate((-200, -1500)):
        part = tmp_path / f"{number}.mcap.part"
        part.write_bytes(path.read_bytes()[:length])
        parts.append(part)
    assert run("recover", *parts) == 1  # the recorder had lost rows
    assert "0.recovered.mcap: 0.000 s to" in capsys.readouterr().out
    for number in range(2):
        assert Recording.open(tmp_path / f"{number}.recovered.mcap").end_reason == "recovered"


def test_a_complete_file_is_not_recovered(path, tmp_path, capsys):
    source = tmp_path / "run.mcap"
    source.write_bytes(path.read_bytes())
    assert run("recover", source) == 0
    assert "run.mcap is complete" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [source]
    assert run("recover", source, "--force") == 1
    assert (tmp_path / "run.recovered.mcap").exists()


def test_a_finished_file_with_a_damaged_chunk_is_not_whole(path, tmp_path, capsys):
    source = tmp_path / "run.mcap"
    data = bytearray(path.read_bytes())
    chunk = Recording.open(path).chunks[0]
    data[chunk.offset + chunk.length // 2] ^= 0xFF
    source.write_bytes(data)
    assert run("recover", source) == 1
    assert "1 damaged record skipped" in capsys.readouterr().out
    # A finished .part that was not yet renamed still becomes a recording.
    part = tmp_path / "other.mcap.part"
    part.write_bytes(path.read_bytes())
    assert run("recover", part) == 1
    assert (tmp_path / "other.recovered.mcap").exists()


def test_quick_info_shows_the_times_of_cuts_and_of_truncated_files(path, tmp_path, capsys):
    cut, broken = tmp_path / "cut.mcap", tmp_path / "broken.mcap"
    assert run("cut", path, "-o", cut, "--from", 0.2, "--to", 0.4) == 0
    broken.write_bytes(path.read_bytes()[:-300])
    capsys.readouterr()
    assert run("info", "--quick", cut) == 0
    assert "time      0.2000 s to 0.4000 s (0.2000 s)" in capsys.readouterr().out
    assert run("info", "--quick", broken) == 0
    assert "time      about 0.0000 s to 0.6000 s" in capsys.readouterr().out
    assert run("info", "--quick", "--json", cut, "--json") == 0
    assert json.loads(capsys.readouterr().out)["span_s"] == [0.2, 0.39995]


def test_nothing_is_recovered_if_a_file_is_missing(path, tmp_path, capsys):
    part = tmp_path / "0.mcap.part"
    part.write_bytes(path.read_bytes()[:-200])
    assert run("recover", part, tmp_path / "1.mcap.part") == 2
    assert capsys.readouterr().err.startswith("rig: file must be a file that can be read")
    assert list(tmp_path.iterdir()) == [part]


@pytest.mark.parametrize(
    ("options", "must"),
    [
        (["--rotate-mb", "0"], "--rotate-mb must be"),
        (["--rotate-s", "nan"], "--rotate-s must be"),
        (["--trigger", "hit"], "--trigger must be one of"),
        (
            ["--trigger", "hammer", "--rotate-s", "5"],
            "--rotate-s must be omitted for a recording around triggers; received 5.0",
        ),
        (["--trigger-count", "3"], "--trigger-count must be used with --trigger"),
        (["--pre-s", "0.5"], "--pre-s must be used with --trigger; received 0.5"),
        (["--post-s", "3"], "--post-s must be used with --trigger"),
        (["--again", "ignore"], "--again must be used with --trigger; received 'ignore'"),
        (["--longest-s", "9"], "--longest-s must be used with --trigger"),
        (["--trigger", "hammer", "--longest-s", "1"], "--longest-s must be at least"),
        (["--when-full", "remove-oldest"], "--when-full must be stop"),
        (["--backlog-mb", "0"], "--backlog-mb must be"),
        (["--duration-s", "0"], "--duration-s must be"),
    ],
)
def test_impossible_options_are_refused_before_a_rig_is_looked_for(tmp_path, capsys, options, must):
    assert run("record", "-o", tmp_path / "run.mcap", "--connect", "127.0.0.1:1", *options) == 2
    error = capsys.readouterr().err
    assert must in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def _summary(**values: Any) -> Summary:
    about = {
        "path": Path("run.mcap"),
        "reason": "completed",
        "error": "",
        "first_time_s": 0.0,
        "duration_s": 0.0,
        "rows": {},
        "lost": {},
        "gaps": 0,
        "missed": {},
        "dropped": 0,
        "malformed": 0,
        "size_bytes": 0,
    }
    return Summary(**{**about, **values})


def test_a_triggered_recording_counts_its_own_rows(capsys):
    print_result(_summary(fired=0, received_s=6.4))
    assert capsys.readouterr().out.splitlines()[0] == ("no trigger in 6.400 s; nothing written; ended: completed")
    files = (Path("run.hammer-001.mcap"),)
    print_result(
        _summary(path=files[0], files=files, fired=2, received_s=9.0, duration_s=2.5, rows={sensor_key("probes"): 50})
    )
    assert capsys.readouterr().out.startswith(
        "run.hammer-001.mcap: 2.500 s from 0.000 s on (around 2 triggers, of 9.000 s received), 50 samples in 1 streams"
    )


def test_remarks_are_printed_once(capsys):
    class Session:
        path, first_files = Path("run.mcap"), [Path("run.mcap")]

        def run(self, show: Callable[[Progress], None]) -> Summary:
            for remarks in ((), ("first",), ("first",), ("first", "second")):
                show(Progress(0.0, 0, 0, 0, 0, remarks=remarks))
            return _summary(remarks=("first", "second", "third"))

    run_session(Session())  # type: ignore[arg-type]
    lines = [line for line in capsys.readouterr().err.splitlines() if line in ("first", "second", "third")]
    assert lines == ["first", "second", "third"]


def test_a_disk_error_is_reported_in_one_line(path, tmp_path, capsys, monkeypatch):
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(SystemExit) as exit_info:
        main(["cut", str(path), "-o", str(tmp_path / "new.mcap")])
    assert exit_info.value.code == 1
    assert capsys.readouterr().err.strip().endswith("new.mcap.part could not be started")
    assert not list(tmp_path.glob("new*"))


CHUNKS = 8


@pytest.fixture(scope="module")
def in_chunks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording without gaps in chunks of 64 KiB; see `_damaged`."""
    from tests.unit import mcap_variants

    folder, about = tmp_path_factory.mktemp("chunks"), make_documents()
    with RecordingWriter(
        folder / "whole.mcap", catalogue=about[CATALOGUE], parameters=about[PARAMETERS], scene=about[SCENE]
    ) as file:
        for number, (key, payload) in enumerate(generate_stream(40)):
            file.write(key, payload, 1_700_000_000_000_000_000 + number * 1_000_000)
        file.finish("completed")
    return mcap_variants.write(folder / "whole.mcap", folder / "run.mcap", "zstd")


@pytest.mark.parametrize(
    "which", ["first", "middle", "last", "first and last", "all but the first", "all but the last"]
)
def test_recover_ends_with_1_and_info_counts_each_row_that_is_lost(
    in_chunks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], which: str
) -> None:
    recording = Recording.open(in_chunks)
    chunks = [one for one in recording.chunks if any(key == sensor_key("probes") for key, *_ in recording.read(one))]
    middle = len(chunks) // 2
    assert len(chunks) > 4
    hit = {
        "first": chunks[:1], "middle": chunks[middle : middle + 1], "last": chunks[-1:],
        "first and last": [chunks[0], chunks[-1]], "all but the first": chunks[1:], "all but the last": chunks[:-1],
    }[which]  # fmt: skip
    source, target = _damaged(in_chunks, tmp_path / "x.mcap", hit), tmp_path / "made.mcap"
    assert run("recover", source, "-o", target) == 1
    assert f"{len(hit)} damaged record{'s' * (len(hit) > 1)} skipped" in capsys.readouterr().out
    whole, kept = recording.streams, Recording.open(target).streams
    assert run("info", "--json", target) == 1
    streams = json.loads(capsys.readouterr().out)["streams"]
    lost_rows = {key: whole[key].rows - kept[key].rows for key in kept}
    assert {key: each["lost"] for key, each in streams.items()} == lost_rows
    assert run("info", target) == 1
    assert f"{sum(lost_rows.values())} rows in " in capsys.readouterr().out
    assert set(Recording.open(target).doubts) <= set(recording.doubts)


def test_recover_writes_no_file_if_all_chunks_are_unreadable(
    in_chunks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = _damaged(in_chunks, tmp_path / "x.mcap", Recording.open(in_chunks).chunks)
    assert run("recover", source) == 2
    assert "must be a recording with readable rows" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [source]


def _damaged(source: Path, target: Path, chunks: Sequence[Chunk]) -> Path:
    """Write a recording with a changed byte in some of its chunks."""
    data = bytearray(source.read_bytes())
    for chunk in chunks:
        data[chunk.offset + chunk.length // 2] ^= 0xFF
    target.write_bytes(data)
    return target
