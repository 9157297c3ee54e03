"""Import paths of earlier versions, and a user's own folders with the same names."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import rig
from rig.base import import_paths
from tests.waiting import PATIENCE_S


@pytest.mark.filterwarnings("ignore:(rig.(kernels|sensors)|drivers.force) is")
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("rig.scenes", "rig.run.scenes"),
        ("rig.wire", "rig.base.wire"),
        ("rig.transport", "rig.serve.transport"),
        ("rig.kernels.signals", "rig.physics.kernels.signals"),
        ("rig.sensors.conditioning", "rig.channels.sensors.conditioning"),
        ("drivers.force.driver", "drivers.instruments.force.driver"),
    ],
)
def test_an_old_path_is_the_same_module(old: str, new: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if f"{old}.".startswith(f"{name}.") and name != "rig"]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.warns(DeprecationWarning, match=f"^{old} is {new} now$"):
        assert import_module(old) is import_module(new)


@pytest.mark.filterwarnings("ignore:rig.kernels is")
@pytest.mark.parametrize("name", ["rig.nonsense", "rig.kernels.nonsense", "rig.run.nonsense"])
def test_a_wrong_path_is_no_module(name: str) -> None:
    with pytest.raises(ModuleNotFoundError, match=f"No module named '{name}'"):
        import_module(name)


def run_script(folder: Path, code: str, script: str = "script.py") -> str:
    """Return the output of a script in a folder, or the last line of its error."""
    (folder / script).write_text(code)
    command = [sys.executable, str(folder / script)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    return done.stdout.strip() or done.stderr.splitlines()[-1]


@pytest.mark.parametrize("package", ["drivers", "recorder", "replays"])
def test_a_users_folder_hides_no_module_of_the_rig(package: str, tmp_path: Path) -> None:
    (tmp_path / package).mkdir()
    (tmp_path / package / "__init__.py").write_text("MINE = True")
    (tmp_path / package / "mine.py").write_text("VALUE = 7")
    module = {"drivers": "drivers.daq", "recorder": "recorder.reader", "replays": "replays.report.canvas"}[package]
    code = f"import rig, {package}.mine, {module}\nfrom rig import connect\n"
    output = run_script(
        tmp_path, f"{code}print({package}.MINE, {package}.mine.VALUE, {module}.__name__, connect.__name__)"
    )
    assert output == f"True 7 {module} connect"


@pytest.mark.parametrize("first", ["", "import {package}\n"])
@pytest.mark.parametrize("package", ["drivers", "recorder", "replays"])
def test_a_users_file_hides_no_module_of_the_rig(package: str, first: str, tmp_path: Path) -> None:
    (tmp_path / f"{package}.py").write_text("MINE = True")
    module = {"drivers": "drivers.link", "recorder": "recorder.viewer", "replays": "replays.report"}[package]
    code = f"{first}import rig, {package}, {module}\n".format(package=package)
    assert run_script(tmp_path, f"{code}print({package}.MINE, {module}.__name__)") == f"True {module}"


@pytest.mark.parametrize("package", ["drivers", "recorder", "replays"])
def test_a_script_named_like_a_module_runs_once(package: str, tmp_path: Path) -> None:
    code = f"print('once')\nimport rig, {package}\nprint({package}.__path__[0].endswith('{package}'))"
    assert run_script(tmp_path, code, script=f"{package}.py") == "once\nTrue"


def test_the_client_is_recognised_by_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "link").symlink_to(import_paths.PLACE)
    monkeypatch.setattr(import_paths, "PLACE", str(tmp_path / "link"))
    assert rig.connect.__module__ == "drivers.client"
    other = ModuleType("drivers.client")
    other.__file__ = f"{tmp_path}/link-of-mine/drivers/client.py"
    monkeypatch.setitem(sys.modules, "drivers.client", other)
    with pytest.raises(ImportError, match=r"^drivers\.client must be the rig's own; received .*/link-of-mine/"):
        _ = rig.connect


def test_a_users_module_that_replaces_one_of_the_rig_is_named(tmp_path: Path) -> None:
    (tmp_path / "drivers").mkdir()
    (tmp_path / "drivers/__init__.py").touch()
    (tmp_path / "drivers/client.py").touch()
    output = run_script(tmp_path, "import rig\nrig.connect()")
    assert output == (
        f"ImportError: drivers.client must be the rig's own; received {tmp_path}/drivers/client.py; rename it"
    )
