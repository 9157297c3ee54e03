"""Engines and file formats of another package: found by entry points, used, and refused in one line where wrong."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from rig.physics.kernels import source_digest

PAGE = (Path(__file__).parents[2] / "docs/extending.md").read_text(encoding="utf-8")
WRONG = """
[rig.engines]
split = my_engine:ROW
wrong = my_engine.heun:ORDER
gone = my_engine.missing:ROW
[rig.formats]
bad = my_engine:ROW
"""
ASK = """
import rig
from replays.studies.chart.methods import competitors
from rig.physics.engines import ENGINES
from rig.physics.kernels import source_digest

def line(name):
    try:
        rig.load_scene("stable-run", {"engine.name": name})
    except rig.InputError as error:
        return str(error)

print(list(ENGINES)[-1], ENGINES["split"].module or "ours")
print(competitors(peers=False)["heun"].takes("exact"))
print(line("wrong"))
print(line("gone"))
print(source_digest())
"""
IMPORT = """
from pathlib import Path
import numpy as np
import rig
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import open_source

folder = Path(sys.argv[1])
(folder / "x.raw").write_bytes(np.arange(5, dtype="<f4").tobytes())
source = open_source(folder / "x.raw", FileOptions())
print(source.format, *source.read(source.entries[0]).physical)
(folder / "y.raw").write_bytes(b"123")
(folder / "x.dxd").write_bytes(b"1")
for name in ("y.raw", "x.dxd"):
    try:
        open_source(folder / name, FileOptions())
    except rig.InputError as error:
        print(error)
"""
RUN = """
import numpy as np
import rig

def end(engine, step_us):
    changes = {"engine.name": engine, "engine.step_us": step_us, "engine.companion": False}
    return rig.simulate("hammer", changes, duration_s=0.024)["disk_x"]  # the blow begins at 0.02 s

exact = end("rk8", 25)
coarse, fine = (np.abs(end("heun", step) - exact).max() for step in (25, 5))
print(coarse / fine)
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder with the packages of the page, as an installer would leave them, and with wrong entry points."""
    for name, text in re.findall(r"```python\n# (my_\w+/\w+\.py)\n(.*?)```", PAGE, re.DOTALL):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "my_formats/__init__.py").touch()
    added = re.findall(r'entry-points\."(rig\.\w+)"\]\n(\w+) = "(.*?)"\n', PAGE)
    entries = "".join(f"[{group}]\n{name} = {value}\n" for group, name, value in added)
    for name, text in (("page", entries), ("wrong", WRONG)):
        information = tmp_path / f"{name}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(text)
    return tmp_path


def python(code: str, package: Path) -> list[str]:
    code = f"import sys; sys.path.insert(0, {str(package)!r})\n{code}"
    done = subprocess.run(
        [sys.executable, "-c", code, str(package)], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_it_is_an_engine_as_any_other(package: Path) -> None:
    names, takes, wrong, gone, digest = python(ASK, package)
    assert names == "heun ours", "the rig's own engines keep their names"
    assert takes == "True"
    assert "my_engine.heun:ORDER must be a rig.physics.engines.Method with a module" in wrong
    assert "my_engine.missing:ROW cannot be loaded: ModuleNotFoundError" in gone
    assert digest != source_digest(), "numba's cache must not serve code of another version of it"
    module = package / "my_engine/heun.py"
    module.write_text(module.read_text().replace("[0.5, 0.5]", "[0.4, 0.6]"))
    assert python(ASK, package)[-1] not in (digest, source_digest())


def test_it_runs_and_converges_at_its_order(package: Path) -> None:
    assert float(python(RUN, package)[0]) == pytest.approx(25.0, rel=0.1)


def test_a_format_is_read_as_any_other(package: Path) -> None:
    values, damaged, unknown = python(IMPORT, package)
    assert values == "raw 0.0 1.0 2.0 3.0 4.0"
    assert "file must be an intact raw file" in damaged
    assert ".raw; not usable: bad (my_engine:ROW must be a replays.recordings.formats.source.Format)" in unknown
