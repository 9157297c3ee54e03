"""`rig keys init`: complete, private folders, never overwritten and never half written; and the requirements of
--expose.
"""

from __future__ import annotations

import contextlib
import stat
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers.sources import open_source
from rig.base.errors import InputError
from rig.cli.connections.connection import Serving, print_addresses
from rig.cli.main import main
from rig.serve.transport.exposure.access import ROLE_NAMES, ROLES
from rig.serve.transport.exposure.certificates import (
    HOLDERS,
    SERVER,
    add_device,
    create_keys,
    read_holder,
    remove_holder,
)
from rig.serve.transport.exposure.secret import read_secret


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
    changed = {name for name, data in files(folder).items() if data != before[name]}
    assert changed == before.keys() - {"server/allowed.txt"}
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


def run_command(*arguments: object) -> None:
    with pytest.raises(SystemExit) as end:
        main(["keys", *map(str, arguments)])
    assert end.value.code == 0


def test_a_device_is_added_and_withdrawn_by_a_kept_authority(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "keys"
    run_command("init", folder, "--keep-authority", "--days", 10)
    run_command("add", folder, "daq1", "--truth", "--days", 300)
    assert f"{folder}/daq1: for the device daq1, role recorder, until" in capsys.readouterr().out
    device, rig = read_holder(folder / "daq1", server=False), read_holder(folder, server=True)
    assert rig.allowed == ("operator", "recorder", "viewer", device.name)
    assert device.name.startswith("recorder+truth@daq1.")
    assert device.expires == rig.expires, "no longer than the authority"
    for name in ("daq1", "authority"):
        assert stat.S_IMODE((folder / name / "key.pem").stat().st_mode) == 0o600
        assert stat.S_IMODE((folder / name).stat().st_mode) == 0o700
    run_command("remove", folder, "daq1")
    run_command("remove", folder, "viewer")
    assert read_holder(folder, server=True).allowed == ("operator", "recorder")
    assert sorted(path.name for path in folder.iterdir()) == ["authority", "operator", "recorder", "server"]
    add_device(folder, "daq1", "viewer")
    create_keys(folder, force=True)  # replaces the folders of devices too
    assert sorted(path.name for path in folder.iterdir()) == sorted(HOLDERS)
    other = tmp_path / "other"  # with files of the same names, which the product did not make
    other.mkdir()
    (other / "site").mkdir()
    (other / "site" / "key.pem").write_text("mine")
    with pytest.raises(InputError, match=r"^DIR must be a new folder"):
        create_keys(other, force=True)
    assert (other / "site" / "key.pem").read_text() == "mine"


def test_devices_that_cannot_be_added_or_withdrawn(tmp_path: Path) -> None:
    folder, without = tmp_path / "keys", tmp_path / "without"
    create_keys(folder, keep_authority=True)
    create_keys(without)
    add_device(folder, "daq1", "viewer")
    before = files(folder)
    for name in ("daq1", "operator", "server", "authority", "", "..", "a/b", "a b", "a*", "-a", "x" * 33, "a\n"):
        with pytest.raises(InputError, match=r"^NAME must be a new name of letters, digits and hyphens"):
            add_device(folder, name, "viewer")
    for name in ("daq2", "server", "authority", "", "..", "recorder+truth"):
        with pytest.raises(InputError, match=r"^NAME must be a device or role that .* admits"):
            remove_holder(folder, name)
    with pytest.raises(InputError, match=r"^--role must be one of operator, recorder, viewer; received 'boss'"):
        add_device(folder, "daq2", "boss")
    for other in (without, tmp_path / "nowhere"):
        with pytest.raises(InputError, match=r"^DIR must be a folder made by: rig keys init --keep-authority"):
            add_device(other, "daq2", "viewer")
    assert files(folder) == before
    create_keys(folder, keep_authority=True, days=-0.01, force=True)
    with pytest.raises(InputError, match=r"^DIR must be a folder with an authority that is valid .* expired on 2"):
        add_device(folder, "daq2", "viewer")
    for wrong in (b"root\n", b"viewer@a/b.00000000\n", b"\xff"):
        (without / "server" / "allowed.txt").write_bytes(wrong)
        with pytest.raises(InputError, match=r"allowed.txt must be a list of certificates' names"):
            read_holder(without, server=True)
    (without / "server" / "allowed.txt").unlink()  # as in folders of earlier versions
    assert read_holder(without, server=True).allowed == ROLE_NAMES


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


def test_exposure_prints_who_is_admitted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    create_keys(tmp_path / "keys", truth=["viewer"])
    remove_holder(tmp_path / "keys", "operator")
    exposed = Serving(expose="192.0.2.1", tls=tmp_path / "keys").exposure()
    print_addresses(SimpleNamespace(endpoint="127.0.0.1:7460"), exposed)  # type: ignore[arg-type]
    assert "rig: exposed at 192.0.2.1:7463 to recorder, viewer+truth (permissions: rig keys)" in capsys.readouterr().err


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


def test_the_secret_of_a_file_is_created_once_and_private(tmp_path: Path) -> None:
    path = tmp_path / "secret.txt"
    secret = read_secret(path)
    assert (len(secret), path.read_text(), path.stat().st_mode & 0o777) == (32, f"{secret}\n", 0o600)
    assert read_secret(path) == secret
    path.chmod(0o640)
    with pytest.raises(InputError, match="private to its owner"):
        read_secret(path)
    other = tmp_path / "notes.txt"
    other.write_text("mine")
    with pytest.raises(InputError, match="32 hexadecimal digits"):
        read_secret(other)
    assert other.read_text() == "mine"
    for wrong in (tmp_path, tmp_path / "none" / "secret.txt"):
        with pytest.raises(InputError, match="--secret must be"):
            read_secret(wrong)


@pytest.mark.parametrize("command", ["daqmx", "foxglove"])
@pytest.mark.parametrize(
    ("options", "must"),
    [
        (("--secret", "new.txt"), "--secret must be given with --allow-commands"),
        (("--allow-commands", "--tls", "keys/operator"), "--allow-commands must be given with --secret FILE"),
    ],
)
def test_commands_with_a_certificate_need_a_secret(
    command: str, options: tuple[str, ...], must: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip({"daqmx": "nidaqmx"}.get(command, command))
    with pytest.raises(SystemExit) as end, contextlib.chdir(tmp_path):
        main([command, "--listen", "127.0.0.1:0", *options])
    error = capsys.readouterr().err
    assert (end.value.code, error.count("\n"), must in error) == (2, 1, True), error
    assert not list(tmp_path.iterdir())
