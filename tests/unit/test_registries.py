"""Closed sets: a member that is missing in one of its tables is refused; it neither acts nor shows a number."""

import ast
import os
import subprocess
import sys
import textwrap
from contextlib import nullcontext
from pathlib import Path
from typing import Literal

import pytest

import rig
from drivers.can.signals import LIMITS
from replays.recordings import export
from replays.recordings.formats.events.events import format_command
from replays.recordings.formats.events.motion import Impact
from rig.base.errors import InputError
from rig.run.commands import table as commands
from rig.run.commands.command import SceneCommand
from rig.run.commands.table import TimedCommand
from rig.run.scenes import load_scene

UNCOMPUTED_SIGNAL = textwrap.dedent(
    """
    import importlib.util, sys
    import rig.physics.kernels  # not yet the table of signals
    spec = importlib.util.find_spec("rig.physics.kernels.signals")
    source = open(spec.origin).read()
    marks = 'OBSERVED = tuple(_observed.signals)'
    assert marks in source and spec.name not in sys.modules
    added = '_observed("outer_vx_seen", "m/s", "no stage writes it")' + chr(10)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    exec(compile(source.replace(marks, added + marks), spec.origin, "exec"), module.__dict__)

    import tempfile, pathlib
    import numpy as np
    import rig
    for engine in ("taylor", "rk4"):
        changes = {"engine.name": engine, "engine.companion": False}
        run = rig.simulate("stable-run", changes, duration_s=0.002)
        assert len(run.names) == 66 and np.isfinite(run.signals).all(), run.names

    def line(call):
        try:
            call()
        except rig.InputError as error:
            return str(error)
        raise AssertionError("nothing refused")

    print(line(lambda: run["outer_vx_seen"]))
    print(line(lambda: rig.simulate("stable-run", changes, duration_s=0.002, signals=["outer_vx_seen"])))
    for signal in ("outer_vx_seen", "2 * disk_x + abs(outer_vx_seen)"):
        file = pathlib.Path(tempfile.mkdtemp(), "channels.toml")
        file.write_text('[channels.disk_x]' + chr(10) + f'signal = "{signal}"' + chr(10))
        print(line(lambda: rig.simulate("stable-run", {**changes, "channels": str(file)}, duration_s=0.002)))
    """
)


def test_a_signal_that_no_stage_computes_is_refused_by_name() -> None:
    run = subprocess.run(
        [sys.executable, "-c", UNCOMPUTED_SIGNAL], env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, text=True,
        capture_output=True, check=False,
    )  # fmt: skip
    assert not run.returncode, run.stderr
    of_run, requested, channel, formula = run.stdout.splitlines()
    assert "one of the signals it keeps" in of_run
    computed = "must be a signal that engine rk4 computes"
    assert requested.startswith(f"signals {computed}")
    assert channel.startswith(f"channel disk_x.signal {computed}")
    assert formula.startswith(f"channel disk_x.signal {computed}")
    assert all("'outer_vx_seen'" in line for line in (of_run, requested, channel, formula))


class Siren(SceneCommand):
    """A command without an implementation."""

    command: Literal["siren"] = "siren"


def test_a_command_of_the_table_only_is_refused_and_releases_no_magnets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(commands.COMMANDS, "siren", Siren)
    simulation = rig.Simulation("stable-run")
    with pytest.raises(InputError, match=r"command must be one that the simulation can execute; .* 'Siren'"):
        simulation.submit("siren", {})
    timed = TimedCommand.model_construct(at_s=0.0, request=Siren())
    simulation = rig.Simulation(load_scene("stable-run").model_copy(update={"commands": (timed,)}))
    with pytest.raises(InputError, match="command must be one that the simulation can execute"):
        simulation.advance(simulation.block_ticks)


def test_a_format_without_a_writer_is_refused_and_not_written_as_csv(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(export, "SUFFIXES", (*export.SUFFIXES, ".xyz"))
    with pytest.raises(InputError, match=r"output must be a format with a writer; .* '.xyz'"):
        export.make_writer(tmp_path / "run.xyz", rig.Simulation("stable-run"))
    assert not list(tmp_path.iterdir())


def test_choices_between_commands_have_no_default_action() -> None:
    """Every if-chain over two or more classes of commands has no else, or one that raises."""
    classes = {each.__name__ for each in commands.COMMANDS.values()}
    chains, acting = 0, []
    for path in (path for folder in ("rig", "recorder", "replays", "drivers") for path in Path(folder).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if sum(name in text for name in classes) < 2:
            continue
        for node in ast.walk(ast.parse(text)):
            tests, last = 0, node
            while isinstance(last, ast.If) and "isinstance(" in ast.unparse(last.test):
                tests += any(name in ast.unparse(last.test) for name in classes)
                if len(last.orelse) != 1 or not isinstance(last.orelse[0], ast.If):
                    break
                last = last.orelse[0]
            if tests > 1 and isinstance(last, ast.If):
                chains += 1
                if last.orelse and not isinstance(last.orelse[-1], ast.Raise):
                    acting.append(f"{path}:{last.orelse[-1].lineno}")
    assert chains >= 1  # for faults; a command's effect is in its own class
    assert not acting


def test_the_bounds_of_a_hammer_pulse_are_those_of_its_command() -> None:
    assert commands.HAMMER_BOUNDS == {"force_n": (1.0, 1000.0), "duration_ms": (0.5, 50.0)}
    assert commands.HAMMER_BOUNDS.items() <= LIMITS.items()
    for field, (low, high) in commands.HAMMER_BOUNDS.items():
        for value, good in ((low, True), (high, True), (low - 0.01, False), (high + 0.01, False)):
            with nullcontext() if good else pytest.raises(InputError, match=f"hammer.{field}"):
                commands.check_command("hammer", {field: value})
    hit = Impact(0.5, ("disk_x",), (0.5, 1e6, 1e-6, 0.0))
    assert "force_n = 1e+03, duration_ms = 0.5" in format_command(hit)
