"""The commands on recordings: `rig info`, `rig cut`, `rig recover`, and what `rig record` refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from recorder.reader import Recording
from recorder.writer import RecordingWriter
from rig.cli.main import main
from rig.wire import CATALOGUE, EVENTS, PARAMETERS, SCENE, encode_document, sensor_key

from .recorder_stream import documents, stream

NOTE = {"event": "note", "tick": 100_000, "time_s": 0.1, "text": "bearing is warm", "tags": ["look"], "from": "me"}


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("commands") / "run.mcap"
    about = documents()
    with RecordingWriter(
        path, catalogue=about[CATALOGUE], parameters=about[PARAMETERS], scene=about[SCENE], sync_every_s=1e9
    ) as file:
        for number, (key, payload) in enumerate([*stream(60), (EVENTS, encode_document(NOTE))]):
            if number not in (100, 101, 102):
                file.write(key, payload, 1_700_000_000_000_000_000 + number * 1_000_000)
        file.finish("completed")
    return path


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def test_info_shows_contents_gaps_health_and_notes(path, capsys):
    assert run("info", path) == 0
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
    assert run("info", "--json", path) == 0
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
    monkeypatch.setattr(Recording, "streams", property(fail))
    assert run("info", "--quick", path) == 0
    assert "rig/sensors/probes 60" in " ".join(capsys.readouterr().out.split())


def test_cut_and_info_of_the_pieces_as_one(path, tmp_path, capsys):
    for name, times in (("a", ("--to", 0.3)), ("b", ("--from", 0.3))):
        assert run("cut", path, "-o", tmp_path / f"{name}.mcap", *times) == 0
    capsys.readouterr()
    assert run("info", "--json", tmp_path / "b.mcap", tmp_path / "a.mcap") == 0
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
    assert run("recover", *parts) == 0
    assert "0.recovered.mcap: 0.000 s to" in capsys.readouterr().out
    for number in range(2):
        assert Recording.open(tmp_path / f"{number}.recovered.mcap").end_reason == "recovered"


def test_nothing_is_recovered_where_one_file_is_missing(path, tmp_path, capsys):
    part = tmp_path / "0.mcap.part"
    part.write_bytes(path.read_bytes()[:-200])
    assert run("recover", part, tmp_path / "1.mcap.part") == 2
    assert capsys.readouterr().err.startswith("rig: file must be a file that can be read")
    assert list(tmp_path.iterdir()) == [part]


@pytest.mark.parametrize(
    ("options", "must"),
    [
        (["--rotate-mb", "0"], "rotate_mb must be"),
        (["--rotate-s", "nan"], "rotate_s must be"),
        (["--trigger", "hit"], "trigger must be one of"),
        (["--trigger", "hammer", "--rotate-s", "5"], "limits must be without rotation"),
        (["--trigger-count", "3"], "trigger_count must be used with --trigger"),
        (["--when-full", "remove-oldest"], "when_full must be stop"),
        (["--backlog-mb", "0"], "backlog_mb must be"),
        (["--duration-s", "0"], "duration_s must be"),
    ],
)
def test_impossible_options_are_refused_before_a_rig_is_looked_for(tmp_path, capsys, options, must):
    assert run("record", "-o", tmp_path / "run.mcap", "--connect", "127.0.0.1:1", *options) == 2
    error = capsys.readouterr().err
    assert must in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_refuses_is_told_in_a_line(path, tmp_path, capsys, monkeypatch):
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(SystemExit) as exit_info:
        main(["cut", str(path), "-o", str(tmp_path / "new.mcap")])
    assert exit_info.value.code == 1
    assert capsys.readouterr().err.strip().endswith("new.mcap.part could not be begun")
    assert not list(tmp_path.glob("new*"))
