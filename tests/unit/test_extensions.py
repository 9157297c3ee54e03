"""Engines and file formats of another package: found by entry points, used, and refused in one line if wrong."""

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
quits = my_wrong.exits:ROW
silent = my_wrong.mute:ROW
homeless = my_wrong.methods:ROW
[rig.formats]
bad = my_engine:ROW
exits = my_wrong.exits:ROW
mute = my_wrong.mute:ROW
text = my_formats.raw:RAW
twice = my_formats.raw:RAW
number = my_wrong.formats:NUMBER
endless = my_wrong.formats:ENDLESS
loud = my_wrong.formats:LOUD
ours = my_wrong.formats:OURS
nowhere = my_wrong.formats:NOWHERE
empty = my_wrong.formats:EMPTY
reader = my_wrong.formats:READER
writer = my_wrong.formats:WRITER
"""
MODULES = {
    "__init__": "",
    "exits": "import sys\nsys.exit('no licence')",
    "mute": "class Mute(Exception):\n    def __str__(self): raise ValueError\nraise Mute",
    "methods": 'from rig.physics.engines import Method\nROW = Method("no module", 5, 0.0, ("none",))',
    "formats": """
from replays.recordings.formats.source import Format
NUMBER = Format("n", (".n",), 3)
ENDLESS = Format("n", (), "my_wrong.reader")
LOUD = Format("n", (".N",), "my_wrong.reader")
OURS = Format("n", (".n", ".csv"), "my_wrong.reader")
NOWHERE = Format("nowhere", (".no",), "my_wrong.missing")
EMPTY = Format("empty", (".em",), "my_wrong.exits")
READER = Format("reader", (".rd",), "my_wrong.reader")
WRITER = Format("writer", (".wr",), "my_wrong.reader", "Writer")
""",
    "reader": """
import sys
def look_into(path, options):
    return None if path.read_bytes() == b"1" else sys.exit("no licence")
""",
    "lame": "METHOD = 3",
}
"""Modules of the package my_wrong."""
LINES = """
from pathlib import Path
import rig
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import open_source, load_format, formats
from rig.physics.engine_choice import load_chosen_engine
from rig.physics.engines import ENGINES

def line(act, *given):
    try:
        act(*given)
    except rig.InputError as error:
        print(error)

folder = Path(sys.argv[1])
for name, text in (("a.x", "1"), ("a.no", "1"), ("a.em", "1"), ("a.rd", "1"), ("b.rd", "2"), ("a.wr", "1")):
    (folder / name).write_text(text)
    line(open_source, folder / name, FileOptions())
for module in ("my_wrong.missing", "my_wrong.exits", "my_wrong.lame"):
    ENGINES["own"] = ENGINES["heun"]._replace(module=module)
    line(load_chosen_engine, "own")
"""
QUESTION_PROGRAM = """
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
for name in ("quits", "silent", "homeless"):
    print(line(name))
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
    return rig.simulate("hammer", changes, duration_s=0.024)["disk_x"]  # the impact begins at 0.02 s

exact = end("rk8", 25)
coarse, fine = (np.abs(end("heun", step) - exact).max() for step in (25, 5))
print(coarse / fine)
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder with the packages of the page, as an installer would create them, and with wrong entry points."""
    for name, text in re.findall(r"```python\n# (my_\w+/\w+\.py)\n(.*?)```", PAGE, re.DOTALL):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "my_formats/__init__.py").touch()
    (tmp_path / "my_wrong").mkdir()
    for name, text in MODULES.items():
        (tmp_path / f"my_wrong/{name}.py").write_text(text)
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


def test_an_external_engine_is_used_like_a_built_in_one(package: Path) -> None:
    names, takes, wrong, missing, quits, silent, homeless, digest = python(QUESTION_PROGRAM, package)
    assert names == "heun ours", "the rig's own engines keep their names"
    assert takes == "True"
    assert "my_engine.heun:ORDER must be a rig.physics.engines.Method" in wrong
    assert "my_engine.missing:ROW cannot be loaded: ModuleNotFoundError" in missing
    assert "my_wrong.exits:ROW cannot be loaded: SystemExit: no licence" in quits
    assert "my_wrong.mute:ROW cannot be loaded: Mute" in silent
    assert "homeless (its Method must name a module)" in homeless
    assert digest != source_digest(), "numba's cache must not serve code of another version of it"
    module = package / "my_engine/heun.py"
    module.write_text(module.read_text().replace("[0.5, 0.5]", "[0.4, 0.6]"))
    assert python(QUESTION_PROGRAM, package)[-1] not in (digest, source_digest())


def test_an_external_engine_converges_at_its_order(package: Path) -> None:
    assert float(python(RUN, package)[0]) == pytest.approx(25.0, rel=0.1)


def test_an_external_format_is_read_like_a_built_in_one(package: Path) -> None:
    values, damaged, unknown = python(IMPORT, package)
    assert values == "raw 0.0 1.0 2.0 3.0 4.0"
    assert "file must be an intact raw file" in damaged
    assert "; not usable: bad (my_engine:ROW must be a replays.recordings.formats.source.Format)" in unknown


def test_errors_in_an_external_package_are_one_line(package: Path) -> None:
    unknown, *lines = python(LINES, package)
    for words in (
        "exits (my_wrong.exits:ROW cannot be loaded: SystemExit: no licence)",
        "mute (my_wrong.mute:ROW cannot be loaded: Mute)",
        "text (my_formats.raw:RAW has a name that is in use)",
        "twice (.raw is the ending of another format)",
        "number (my_wrong.formats:NUMBER: module must be a valid string; received 3)",
        "endless (my_wrong.formats:ENDLESS: suffixes must be a value of at least 1 item",
        "loud (my_wrong.formats:LOUD: suffixes.0 must be an ending in lower case such as .raw",
        "ours (.csv is the ending of another format)",
    ):
        assert words in unknown
    lines = [line.replace(f"{package}/", "") for line in lines]
    missing = "which fails: ModuleNotFoundError: No module named 'my_wrong.missing'"
    must = "engine.name must be an engine that can be loaded; received own, of which"
    assert lines == [
        f"nowhere files need my_wrong.missing, {missing}",
        "empty files need my_wrong.exits, which fails: SystemExit: no licence",
        "file must be an intact reader file; received a.rd "
        "(TypeError: my_wrong.reader.look_into returns NoneType, not Source)",
        "file must be an intact reader file; received b.rd (SystemExit: no licence)",
        "writer files need Writer in my_wrong.reader, which lacks it",
        f"{must} my_wrong.missing fails: ModuleNotFoundError: No module named 'my_wrong.missing'",
        f"{must} my_wrong.exits fails: SystemExit: no licence",
        f"{must} my_wrong.lame fails: AttributeError: module 'my_wrong.lame' has no attribute 'ORDER'",
    ]
