"""Compiled kernels compared with the same Python in a separate process; outputs preset to nan; the cache."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import rig
from rig.channels.sensors import conditioning
from rig.ensemble import lanes
from rig.physics.engines import ENGINES, load_engine
from rig.physics.kernels import signals as S
from rig.physics.kernels.dynamics import evaluate
from rig.physics.kernels.laws.contact import BACKWARD, FLIGHT, FORWARD, ROLLING, TOUCHING
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

PACKAGE = Path(rig.__file__).parent
FRICTION = {name: "exact" if "exact" in method.frictions else "smoothed" for name, method in ENGINES.items()}
"""Friction law with which every engine is tested, ..."""
PAIRS = [*FRICTION.items(), ("rosenbrock", "switch"), ("verlet", "smoothed"), ("split", "none"), ("taylor", "smoothed")]
"""... and further pairs."""

JIT_RUN = """
import sys
import numpy as np
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

def run(engine, friction):
    # A hair off the ring, hit hard toward it: flight, onset, contact and flight again within 2 ms.
    simulation = Simulation(load_scene("hammer", {
        "engine.name": engine, "engine.step_us": 25, "model.friction": friction,
        "initial.position": "given", "initial.x_mm": 0.92,
        "commands": [{"at_s": 0.0, "command": "hammer", "force_n": 1000.0, "duration_ms": 1.0}],
    }))
    frame = simulation.advance(2_000)
    arrays = {"rows": frame.rows.copy(), "memory": simulation._motion.memory, "y": simulation._motion.y}
    return arrays | {group: block.values for group, block in frame.samples.items()}
"""


def process(code: str, *, place: Path = PACKAGE.parent, **environment: str) -> str:
    """Run Python code in a separate process with the package at a place and warnings as errors; return its output."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA_")}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=place,
        env={**kept, "PYTHONPATH": str(place), **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def python_runs(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], dict[str, np.ndarray]]:
    folder = tmp_path_factory.mktemp("python")
    code = JIT_RUN + (
        "import types\n"
        "from rig.physics.kernels.dynamics import evaluate\n"
        "assert isinstance(evaluate, types.FunctionType), 'not plain Python'\n"
        f"for engine, friction in {PAIRS!r}:\n"
        f"    np.savez({str(folder)!r} + f'/{{engine}}-{{friction}}.npz', **run(engine, friction))\n"
    )
    process(code, NUMBA_DISABLE_JIT="1")
    return {pair: dict(np.load(folder / f"{'-'.join(pair)}.npz")) for pair in PAIRS}


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing to compare: this process is plain Python")
@pytest.mark.parametrize(("engine", "friction"), PAIRS)
def test_compiled_is_python(
    engine: str, friction: str, python_runs: dict[tuple[str, str], dict[str, np.ndarray]]
) -> None:
    space: dict[str, Any] = {}
    exec(JIT_RUN, space)
    compiled, plain = space["run"](engine, friction), python_runs[engine, friction]
    touched = compiled["rows"][:, S.COLUMN["normal_force"]] > 0.0
    assert 0 < touched.sum() < len(touched), "flight and contact are both in it"
    assert compiled.keys() == plain.keys()
    for name, array in compiled.items():
        assert array.dtype == plain[name].dtype
        # Both use the C library's functions, and nothing is reordered without fastmath.
        np.testing.assert_array_equal(array, plain[name], err_msg=name)


def test_no_kernel_has_its_bits_from_its_caller() -> None:
    # numba inherits an option that a function does not set from the caller that is compiled first.
    for engine in ENGINES:
        load_engine(engine)
    kernels = [
        (module.__name__, name, value)
        for module in list(sys.modules.values())
        if getattr(module, "__name__", "").startswith("rig.")
        for name, value in vars(module).items()
        if isinstance(value, Dispatcher)
    ]
    assert len(kernels) > 150
    assert [kernel[:2] for kernel in kernels if "fastmath" not in kernel[2].targetoptions] == []


def hit(engine: str = "split") -> Simulation:
    changes = {"engine.name": engine, "engine.step_us": 25, "model.friction": FRICTION[engine]}
    simulation = Simulation(load_scene("hammer", changes))
    simulation.advance(40_000)
    return simulation


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("steps", "stride"), [(400, 1), (400, 2), (401, 4), (1, 1)])
def test_engine_writes_every_value_of_every_row(engine: str, steps: int, stride: int) -> None:
    simulation, module = hit(engine), load_engine(engine)
    created = []
    for poison in (np.nan, 1e300):
        y, memory = simulation._motion.y.copy(), simulation._motion.memory.copy()
        rows = np.full((-(-steps // stride), S.N_ROW), poison)
        arguments = (simulation.model.constants, simulation._inputs(), y, memory, simulation.tick, 25, steps, stride)
        module.advance(*arguments, rows)
        created.append((rows, y, memory))
    assert np.isfinite(created[0][0]).all()
    for one, other in zip(*created, strict=True):
        assert one.tobytes() == other.tobytes(), "what lay in the output leaks into the result"


@pytest.mark.parametrize("phase", [FLIGHT, TOUCHING, FORWARD, BACKWARD, ROLLING])
def test_evaluation_writes_every_rate_and_every_observed_value(phase: int) -> None:
    simulation = hit()
    rate, out = np.full(S.N_VECTOR, np.nan), np.full(S.N_OBSERVED, np.nan)
    arguments = (
        simulation.model.constants,
        simulation._inputs(),
        simulation.tick,
        0.0,
        0.1,
        phase,
        True,
        simulation._motion.y,
    )
    evaluate(*arguments, rate, out)
    assert np.isfinite(rate).all()
    assert np.isfinite(out).all()


def test_conditioner_writes_every_count(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = Simulation(load_scene("stable-run"))
    rows = simulation.advance(10_000).rows
    made, empty = [], np.empty
    for poison in (-(2**31), 12345):

        def poisoned(shape: Any, dtype: Any = np.float64, *more: Any, fill: int = poison, **options: Any) -> np.ndarray:
            array = empty(shape, dtype, *more, **options)
            if array.dtype in (np.int32, np.float64):
                array[...] = fill if array.dtype == np.int32 else np.nan
            return array

        with monkeypatch.context() as patch:
            patch.setattr(conditioning.np, "empty", poisoned)
            conditioner = conditioning.Conditioner(
                tuple(simulation.table.groups.values()), row_rate_hz=40_000, seed=1, noise=True
            )
            made.append(conditioner.counts(rows))
    assert made[0].keys() == simulation.table.groups.keys()
    for name, counts in made[0].items():
        np.testing.assert_array_equal(counts, made[1][name])


def test_simulations_do_not_share_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    clean, poisoned = Simulation(load_scene("hammer")), Simulation(load_scene("hammer"))
    poisoned._rows = np.full((4_000, S.N_ROW), np.nan)
    assert clean.advance(50_000).rows.tobytes() == poisoned.advance(50_000).rows.tobytes()


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Folder of a copy of the package that may be changed."""
    shutil.copytree(PACKAGE, tmp_path / "rig", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


DIGESTS = """
import json
from pathlib import Path
import rig
from rig.physics.kernels import source_digest

def compiled(path):
    text = path.read_text()
    if path.name == "lanes.py" and path.parent.name == "ensemble":
        return False  # calls no compiled function of another file, so that numba's own check of the file suffices
    return "njit" in text or "@kernel" in text or "kernels" in path.parts

package = Path(rig.__file__).parent
assert package.parent.samefile("."), "the copy, never the package itself"
digests = {"": source_digest()}
for path in sorted(package.rglob("*.py")):
    text = path.read_bytes()
    path.write_bytes(text[:-1] + bytes([text[-1] ^ 1]) if text else b"#")
    if compiled(path):
        digests[path.relative_to(package).as_posix()] = source_digest()
    path.write_bytes(text)
digests["again"] = source_digest()
print(json.dumps(digests))
"""


def test_a_changed_byte_of_any_kernel_file_changes_the_digest(copied: Path) -> None:
    digests = json.loads(process(DIGESTS, place=copied))
    assert digests.pop("again") == digests[""]
    assert {
        *("physics/kernels/dynamics.py", "physics/kernels/__init__.py", "physics/engines/common/march.py"),
        "channels/sensors/noise.py",
    } <= set(digests)
    assert len(set(digests.values())) == len(digests)


def test_the_batch_kernel_calls_no_function_of_another_file() -> None:
    tree = ast.parse(Path(lanes.__file__).read_text(encoding="utf-8"))
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    # The last only sets the folder.
    assert modules == {"__future__", "math", "typing", "numpy", "numba", "scipy.integrate", "rig.physics.kernels"}


CACHE = """
import numba
from rig.physics.kernels import has_compiled_kernels, source_digest
print(numba.config.CACHE_DIR, source_digest(), has_compiled_kernels())
"""


def test_cache_folder_is_named_by_the_digest_unless_the_user_names_one(tmp_path: Path) -> None:
    folder, digest, before = process(CACHE, XDG_CACHE_HOME=str(tmp_path)).split()
    assert Path(folder) == tmp_path / "rotor-stator-rig" / "kernels" / digest
    assert before == "False"
    named, _, _ = process(CACHE, XDG_CACHE_HOME=str(tmp_path), NUMBA_CACHE_DIR=str(tmp_path / "mine")).split()
    assert Path(named) == tmp_path / "mine"


GAP = """
import numpy as np
from rig.physics.kernels.constants import Constants, Contact, House, Levels, Magnet, Shaft
from rig.physics.kernels.frames.geometry import gap
parts = [part(*np.ones(len(part._fields))) for part in (Shaft, Magnet, Contact, House)]
print(repr(gap(Constants(Levels(True, True, True, True, 1), *parts, 1.0), np.full(14, 0.01))))
"""


def test_a_change_in_a_file_that_a_kernel_calls_reaches_it(copied: Path) -> None:
    # numba checks only the file of `gap`, and would load its old machine code.
    cache = copied / "cache"
    angles = copied / "rig" / "physics" / "kernels" / "frames" / "angles.py"
    text = angles.read_text()
    before = process(GAP, place=copied, XDG_CACHE_HOME=str(cache))
    assert list(cache.rglob("*.nbc")), "the machine code was kept"
    changed = text.replace("return sine, cosine", "return 2.0 * sine, cosine")
    assert changed != text
    angles.write_text(changed)
    assert process(GAP, place=copied, XDG_CACHE_HOME=str(cache)) != before
    angles.write_text(text)
    assert process(GAP, place=copied, XDG_CACHE_HOME=str(cache)) == before
