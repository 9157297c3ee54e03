"""Folder of the compiled kernels: one that can be written; kernels of old versions are removed."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rig.base.errors import DiskError
from rig.physics import kernel_cache
from rig.physics.kernel_cache import choose_folder, remove_old_kernels


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # restored at the end
    monkeypatch.delitem(sys.modules, "numba")
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(kernel_cache.tempfile, "tempdir", str(tmp_path))


def test_a_cache_that_can_be_written_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "new" / "cache"))
    choose_folder()
    assert os.environ["NUMBA_CACHE_DIR"] == ""


@pytest.mark.parametrize("home", [True, False])
def test_another_folder_is_used_without_a_cache(home: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file" / "cache") if home else "")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError))
    for _ in range(2):
        choose_folder()
        own = tmp_path / f"rotor-stator-rig-{os.getuid()}"
        assert os.environ["NUMBA_CACHE_DIR"] == str(own)
        assert own.stat().st_mode & 0o777 == 0o700
        monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    own.chmod(0o777)  # others could replace machine code in it
    choose_folder()
    assert os.environ["NUMBA_CACHE_DIR"] != str(own)
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(tmp_path / "file"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    with pytest.raises(DiskError, match=r"cannot be written \(set NUMBA_CACHE_DIR\)"):
        choose_folder()


def test_only_old_kernels_of_the_default_folder_are_removed(tmp_path: Path) -> None:
    for parent in ("rotor-stator-rig/kernels", "mine/kernels"):
        for number in range(6):
            folder = tmp_path / parent / f"{number:016x}"
            (folder / "inner").mkdir(parents=True)
            age_s = time.time() - 86400.0 * 20 * number
            os.utime(folder, (age_s, age_s))
        (tmp_path / parent / "notes").mkdir()
        remove_old_kernels(tmp_path / parent / f"{0:016x}")
    left = sorted(path.name for path in (tmp_path / "rotor-stator-rig/kernels").iterdir())
    assert left == [*(f"{number:016x}" for number in range(4)), "notes"]
    assert len(list((tmp_path / "mine/kernels").iterdir())) == 7


def test_numba_uses_the_folder(tmp_path: Path) -> None:
    code = "import rig.physics.kernels as k; print(k.numba_config.CACHE_DIR)"
    environment = {**os.environ, "XDG_CACHE_HOME": "/dev/null/cache", "TMPDIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    printed = subprocess.check_output([sys.executable, "-c", code], env=environment, text=True)
    assert printed.strip() == str(tmp_path / f"rotor-stator-rig-{os.getuid()}")
