"""Rigs by name: found by any client while they run, and removed with their process, however it ended."""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path

import pytest

import rig
from drivers.console import Console
from drivers.daq import Daq
from rig.base.errors import InputError
from rig.serve.transport import names
from rig.serve.transport.endpoint import parse_loopback
from rig.serve.transport.zenoh import ZenohServer, connect_url
from tests import processes
from tests.waiting import PATIENCE_S


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "rig"


def test_a_name_exists_while_it_is_held_by_one_process(runtime: Path) -> None:
    with names.register_name("one", "127.0.0.1:7777"):
        assert names.list_running() == [names.NamedRig(name="one", endpoint="127.0.0.1:7777", pid=os.getpid())]
        assert names.resolve_endpoint("one", field="connect") == ("127.0.0.1", 7777)
        with pytest.raises(
            InputError, match=r"--name must be one that no other rig has \(process \d+ at 127.0.0.1:7777"
        ):
            names.check_name("one")
        assert stat.S_IMODE(runtime.stat().st_mode) == 0o700
        assert stat.S_IMODE((runtime / "one.json").stat().st_mode) == 0o600
    names.check_name("one")
    assert names.list_running() == []


def test_the_name_of_a_killed_process_is_removed(runtime: Path) -> None:
    hold = "with register_name('gone', '127.0.0.1:1'): print(1, flush=True); time.sleep(60)"
    code = f"import time; from rig.serve.transport.names import register_name\n{hold}"
    with processes.start_python("-c", code) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "1\n"
        assert [entry.pid for entry in names.list_running()] == [child.pid]
        child.kill()
        child.wait()
    assert (runtime / "gone.json").exists()
    assert names.list_running() == []
    with names.register_name("gone", "127.0.0.1:2"):
        assert names.resolve_endpoint("gone", field="connect") == ("127.0.0.1", 2)


@pytest.mark.parametrize("name", ["", ".lock", "../x", "a b", "a:1", "é", "x" * 65])
def test_invalid_names_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="--name must be 1 to 64 letters, digits"):
        names.check_name(name)


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(
        InputError, match=r"HOST:PORT such as 127.0.0.1:7460, or the name of a running rig \(none runs\)"
    ):
        Console.open("bench", wait_s=0.0)
    with names.register_name("bench-2", "127.0.0.1:7777"), pytest.raises(InputError, match="such as bench-2; received"):
        Daq.open("bench", wait_s=0.0)
    for url in ("http://x", "", "zenoh:", "zenoh:127.0.0.1:x", ":7460", "tcp/127.0.0.1:"):
        for connect in (Console.open, Daq.open, rig.connect):
            with pytest.raises(InputError, match=r"url must be \[zenoh:\]HOST:PORT\[\?tls=DIR\], or the name of a rig"):
                connect(url)
    with ZenohServer("127.0.0.1:0") as server:
        server.announce()
        for url in (server.endpoint, f"zenoh:{server.endpoint}"):
            connect_url(url, wait_s=PATIENCE_S).close()


@pytest.mark.skipif(sys.platform == "win32", reason="folders have no modes there")
def test_a_folder_writable_by_others_is_not_trusted(runtime: Path) -> None:
    runtime.mkdir(mode=0o700)
    runtime.chmod(0o777)
    with pytest.raises(InputError, match=r"a folder private to its owner \(chmod 700"):
        names.list_running()


def test_a_free_port_is_chosen_by_default_on_loopback_only() -> None:
    with ZenohServer("127.0.0.1:0") as one, ZenohServer("127.0.0.1:0") as two:
        assert one.endpoint != two.endpoint
        assert parse_loopback(one.endpoint, field="listen")[1] > 0
    with pytest.raises(InputError, match=r"on 127\.0\.0\.1"):
        ZenohServer("0.0.0.0:0")
    with pytest.raises(InputError, match="a port of 1 to 65535"):
        parse_loopback("127.0.0.1:0", field="--connect")
