"""The examples in docstrings give the documented results, and functions for notebooks have one."""

from __future__ import annotations

import doctest
import importlib
import runpy
from pathlib import Path

import numpy as np
import pytest

import rig
from drivers.console import Console
from drivers.daq import Daq
from recorder.reader import Recording
from rig.physics import contacts, magnets

ROOT = Path(__file__).parents[2]
MODULES = (
    "drivers.client",
    "drivers.console",
    "drivers.daq",
    "recorder.reader",
    "replays.recordings.export",
    "replays.sessions.session",
    "rig.cli.output.progress",
    "rig.ensemble",
    "rig.ensemble.axes",
    "rig.ensemble.ensemble",
    "rig.ensemble.sweep",
    "rig.physics.contacts",
    "rig.base.errors",
    "rig.physics.magnets",
    "rig.run.offline",
    "rig.channels.orbit",
    "rig.physics.parameters",
    "rig.base.samples",
    "rig.run.scenes",
    "rig.run.simulation",
    "rig.base.text",
)
NOTEBOOK_FUNCTIONS = (
    *(getattr(rig, name) for name in rig.__all__), contacts.restitution_factor, contacts.returned_restitution,
    contacts.linear_damping_ratio, contacts.fit_power, contacts.free_impact, magnets.field_sum_force,
    magnets.cylinder_force, magnets.pair_force, Recording, Daq, Console,
)  # fmt: skip


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_a_module(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)  # folder of the reference sessions
    output: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for example in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name)):
        runner.run(example, out=output.append)
    assert runner.tries > 0
    assert runner.failures == 0, "".join(output)


# Warnings of matplotlib about its own layout.
@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_the_notebook_plots_as_documented(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib

    matplotlib.use("agg")
    (tmp_path / "replays").symlink_to(ROOT / "replays")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["notebook.py", "page.png"])
    rows = runpy.run_path(str(ROOT / "docs/notebook.py"))["axes"]
    assert (tmp_path / "page.png").stat().st_size > 20_000
    for row, whirl_hz in zip(rows, (-82.0, -69.0), strict=True):
        orbit, spectrum, amplitude, phase = (ax.lines[0].get_xydata() for ax in row)
        assert np.hypot(*orbit.T).max() == pytest.approx(1.55, abs=0.1)
        assert spectrum[spectrum[:, 1].argmax(), 0] == pytest.approx(whirl_hz, abs=3.0)
        assert [row[1].get_ylabel(), row[2].get_ylabel()] == ["[mm]", "1X of disk_x [mm]"]
        free = amplitude[:, 1] < 1.0
        assert (np.diff(amplitude[free], axis=0) > 0.0).all(), "it grows with the speed until it touches the ring"
        assert phase[free, 1].max() - phase[free, 1].min() < 60.0
    matplotlib.pyplot.close("all")


@pytest.mark.parametrize("called", NOTEBOOK_FUNCTIONS, ids=lambda called: called.__name__)
def test_functions_for_notebooks_have_an_example(called: object) -> None:
    assert ">>> " in (called.__doc__ or "")
    assert getattr(called, "__module__", "") in MODULES
