"""Each legal form of an MCAP file is read by every command like the rig's own form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from recorder.reader import Recording
from recorder.rewrite import cut, is_whole, recover
from tests.hostile.files import read_contents
from tests.hostile.files import write_file as write_recording
from tests.unit import mcap_variants
from tests.unit.mcap_variants import NAMES


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("variants") / "run.mcap", blocks=12)


@pytest.mark.parametrize("name", NAMES)
def test_a_variant_is_read_like_the_rigs_own_file(source: Path, tmp_path: Path, name: str) -> None:
    ours, path = Recording.open(source), mcap_variants.write(source, tmp_path / "x.mcap", name)
    theirs = Recording.open(path)
    assert theirs.complete
    assert read_contents(theirs) == read_contents(ours)
    assert (theirs.doubts, theirs.streams) == (ours.doubts, ours.streams)
    assert ("checksum" in name or name in ("without anything", "private records")) == bool(theirs.unchecked)
    assert is_whole(path)
    rows = {key: stream.rows for key, stream in ours.streams.items() if stream.rows}
    assert recover(path, tmp_path / "recovered.mcap").counts.rows == rows
    pieces = [cut(each, tmp_path / "cut.mcap", from_s=0.003, to_s=0.007, force=True).counts for each in (ours, theirs)]
    assert replace(pieces[0], size_bytes=0) == replace(pieces[1], size_bytes=0)
