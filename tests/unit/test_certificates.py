"""`rig keys init`: complete, private folders, never overwritten and never half written; and the requirements of
--expose.
"""

from __future__ import annotations

import stat
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers.sources import open_source
from rig.base.errors import InputError
from rig.cli.connections.connection import Serving, print_addresses
from rig.cli.main import main
from rig.serve.transport.exposure.access import ROLES
from rig.serve.transport.exposure.certificates import HOLDERS, SERVER, create_keys, read_holder


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_every_holder_gets_a_complete_private_folder(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    assert create_keys(folder, hosts=["lab.example", "192.0.2.7", "::1"], days=2, truth=["viewer"]) == [
        "lab.example",
        "192.0.2.7",
        "::1",
        "localhost",
        "127.0.0.1",
    ]
    assert sorted(path.name for path in folder.iterdir()) == sorted(HOLDERS)
    for path in folder.rglob("*"):
        mode = stat.S_IMODE(path.stat().st_mode)
        assert mode == (0o700 if path.is_dir() else 0o600 if path.name == "key.pem" else mode)
        assert not mode & 0o022
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert read_holder(folder, server=True).name == "lab.example"
    assert read_holder(folder, server=True) == read_holder(folder / SERVER, server=True)
    assert {role: read_holder(folder / role, server=False).name for role in ROLES} == {
        "operator": "operator",
        "recorder": "recorder",
        "viewer": "viewer+truth",
    }
    assert [path.name for path in tmp_path.iterdir()] == ["keys"], "nothing else is left"


def test_existing_keys_are_replaced_only_on_request_and_if_ours(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    folder.mkdir()
    create_keys(folder)  # an empty folder is not refused
    before = files(folder)
    with pytest.raises(InputError, match=r"^DIR must be a new folder"):
        create_keys(folder)
    (folder / "viewer" / "key.pem").unlink()
    with pytest.raises(InputError, match=r"^DIR must be a new folder"):
        create_keys(folder)
    create_keys(folder, force=True)
    assert files(folder).keys() == before.keys()
    assert not set(files(folder).values()) & set(before.values())
    (folder / "viewer" / "notes.txt").write_text("mine")
    for other in (folder, folder / "viewer" / "notes.txt"):
        with pytest.raises(InputError, match=r"^DIR must be a new folder"):
            create_keys(other, force=True)
    assert (folder / "viewer" / "notes.txt").read_text() == "mine"


def test_a_failure_keeps_the_existing_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "keys"
    create_keys(folder)
    before = files(folder)
    folders: set[Path] = set()
    write = Path.write_bytes

    def fail(path: Path, data: bytes) -> int:
        folders.add(path.parent)
        if len(folders) == 3:
            raise OSError(28, "No space left on device")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="No space"):
        create_keys(folder, force=True)
    assert files(folder) == before
    assert [path.name for path in tmp_path.iterdir()] == ["keys"]


@pytest.mark.parametrize("host", ["", "bad host", "a_b", "-a", "a..b", "x" * 65, "*", "lab.example:7463", "ä.example"])
def test_invalid_names_are_refused(host: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^--host must be the name or address"):
        create_keys(tmp_path / "keys", hosts=[host])
    assert list(tmp_path.iterdir()) == []


def test_folders_without_keys_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    create_keys(folder, days=-0.01)
    with pytest.raises(InputError, match=r"^--tls must be a certificate that is valid .*, expired"):
        read_holder(folder / "viewer", server=False)
    create_keys(folder, force=True)
    for wrong, server in ((folder, False), (folder / "server", False), (folder / "viewer", True), (tmp_path, True)):
        with pytest.raises(InputError, match=r"^--tls must be a folder with the keys of "):
            read_holder(wrong, server=server)
    for name, broken in (("certificate.pem", b"\xff\x00 no certificate"), ("key.pem", None)):
        part = folder / "viewer" / name
        part.unlink() if broken is None else part.write_bytes(broken)
        with pytest.raises(InputError, match=r"^--tls must be a folder with the keys of one role"):
            read_holder(folder / "viewer", server=False)


def test_the_command_explains_where_each_folder_belongs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "keys"
    with pytest.raises(SystemExit) as end:
        main(["keys", "init", str(folder), "--host", "lab.example", "--truth", "recorder"])
    assert end.value.code == 0
    output = capsys.readouterr().out
    assert f"rig run SCENE --expose lab.example --tls {folder}" in output
    assert "for the role recorder, with access to the truth; copy it" in output
    assert "rig status --connect lab.example:7463 --tls viewer" in output
    for arguments, message in (
        ((str(folder),), "DIR must be a new folder (--force"),
        ((str(tmp_path / "b"), "--truth", "nobody"), "--truth must be one of operator, recorder, viewer"),
        ((str(tmp_path / "c" / "d"),), "DIR must be in a folder that can be written"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["keys", "init", *arguments])
        assert end.value.code == 2
        assert capsys.readouterr().err.startswith(f"rig: {message}")


def test_exposure_reports_the_admitted_roles(tmp_path: Path) -> None:
    create_keys(tmp_path / "keys")
    assert Serving().exposure() is None
    exposed = Serving(expose="192.0.2.1", tls=tmp_path / "keys").exposure()
    assert exposed is not None
    assert exposed.endpoint == "192.0.2.1:7463"
    assert exposed.holder == read_holder(tmp_path / "keys" / "server", server=True)
    assert Serving(expose="lab.example:9000", plaintext=True).exposure() == ("lab.example:9000", None)
    with pytest.raises(
        InputError, match=r"--expose must be given with --tls DIR \(create it: rig keys init DIR --host lab"
    ):
        Serving(expose="lab.example:9000").exposure()
    with pytest.raises(InputError, match="received both"):
        Serving(expose="lab.example", tls=tmp_path / "keys", plaintext=True).exposure()
    for keys, plaintext in ((tmp_path / "keys", False), (None, True)):
        with pytest.raises(InputError, match="given with --expose HOST"):
            Serving(tls=keys, plaintext=plaintext).exposure()


def test_exposure_without_tls_reports_what_is_open(capsys: pytest.CaptureFixture[str]) -> None:
    server = SimpleNamespace(endpoint="127.0.0.1:7460")
    print_addresses(server, Serving(expose="192.0.2.1", plaintext=True).exposure())  # type: ignore[arg-type]
    errors = capsys.readouterr().err
    assert "WARNING: 192.0.2.1:7463 is open to every client, unencrypted" in errors
    assert "commands, notes, truth" in errors
    print_addresses(server, None)  # type: ignore[arg-type]
    assert capsys.readouterr().err == "rig: listening on 127.0.0.1:7460; Ctrl-C or `rig stop` ends it\n"


def test_the_url_of_a_daq_names_its_keys_too(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^--tls must be a folder with the keys of one role .*nowhere'"):
        open_source(f"zenoh:127.0.0.1:7463?tls={tmp_path}/nowhere")
    with pytest.raises(InputError, match=r"^connect must be HOST:PORT"):
        open_source("zenoh:127.0.0.1?tls=keys")
