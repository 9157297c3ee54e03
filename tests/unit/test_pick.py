"""Dependencies of a stored choice: the code of the equations and engines, each file of it, and no other."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import rig
from rig.run.model_choice import equations_digest

RIG = Path(rig.__file__).parent


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    return Path(shutil.copytree(RIG, tmp_path / "rig", ignore=shutil.ignore_patterns("__pycache__")))


def test_the_digest_does_not_depend_on_the_folder(copy: Path) -> None:
    assert equations_digest(copy) == equations_digest()
    kernel = next(iter(sorted((copy / "physics/kernels").glob("*.py"))))
    kernel.write_bytes(kernel.read_bytes().replace(b"\n", b"\r\n"))
    assert equations_digest(copy) == equations_digest(), "line ends differ between systems"


@pytest.mark.parametrize(
    "changed",
    ["model.py", "contacts.py", "magnets.py", "levels.py", "kernels/laws/contact.py", "../base/maths/roots.py"],
)
def test_a_changed_file_of_the_equations_changes_the_digest(copy: Path, changed: str) -> None:
    with (copy / "physics" / changed).open("a") as file:
        file.write("# changed\n")
    assert equations_digest(copy) != equations_digest()


def test_new_and_renamed_files_change_the_digest(copy: Path) -> None:
    (copy / "physics/engines/deep").mkdir()
    (copy / "physics/engines/deep/another.py").write_text("")
    deeper = equations_digest(copy)
    assert deeper != equations_digest()
    (copy / "physics/rolling.py").write_text("")
    assert equations_digest(copy) == deeper, "nothing of the model uses it"
    with (copy / "physics/model.py").open("a") as file:
        file.write("import rig.physics.rolling\n")
    used = equations_digest(copy)
    (copy / "physics/rolling.py").write_text("WORK = 0\n")
    assert equations_digest(copy) != used


@pytest.mark.parametrize(
    "other", ["serve/service.py", "run/scenes.py", "base/errors.py", "cli/commands/run.py", "base/wire.py"]
)
def test_files_without_equations_are_not_in_the_digest(copy: Path, other: str) -> None:
    with (copy / other).open("a") as file:
        file.write("# changed\n")
    assert equations_digest(copy) == equations_digest()
