"""Campbell diagram against closed forms: eigenvalues of two degrees of freedom, a gyroscopic rotor, known circles."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from replays.plots.campbell import campbell
from replays.plots.signals import read_signals
from rig.base.errors import InputError
from rig.physics.levels import ModelLevels
from rig.physics.model import build_model
from rig.physics.parameters import load_parameters
from tests.unit.test_plots import SESSION, SPEED_HZ, build_samples, build_whirl


def draw(samples: Any, changes: dict[str, Any], **options: Any) -> Any:
    """Draw the diagram of a shaft on linear magnets with measured samples."""
    model = build_model(load_parameters().override(changes), ModelLevels(magnet="linear"))
    return model.constants, campbell(replace(read_signals(samples), model=lambda: model), **options)


def test_isotropic_rotor_has_the_frequencies_and_critical_speeds_of_the_closed_form() -> None:
    changes = {"shaft.damping_ratio_x": 0.0, "shaft.damping_ratio_y": 0.0, "shaft.polar_inertia": 0.03}
    constants, plot = draw(build_whirl(0.3, 0.1), changes, max_speed_hz=40.0)
    shaft = constants.shaft
    share = shaft.polar_inertia / shaft.transverse_inertia
    natural = math.sqrt(constants.magnet.stiffness * shaft.arm_magnet**2 / shaft.transverse_inertia)
    table = plot.table.values[:81]
    half = 0.5 * share * 2.0 * math.pi * table[:, 0]
    for name, sign in (("upper mode", 1.0), ("lower mode", -1.0)):
        expected = (sign * half + np.sqrt(half**2 + natural**2)) / (2.0 * math.pi)
        assert plot.table[name][:81] == pytest.approx(expected, rel=1e-3)
        assert plot.table[f"{name} whirl"][1:81] == pytest.approx(sign, abs=0.01)
    # At a critical speed w = n W: (n W)^2 -+ share n W^2 - natural^2 = 0.
    found = sorted(line.get_xdata()[0] for line in plot.axes[0].lines if len(line.get_xdata()) == 1)
    expected = [natural / math.sqrt(n * n - sign * share * n) / (2.0 * math.pi) for n in (1, 2) for sign in (1, -1)]
    assert found == pytest.approx(sorted(expected), rel=1e-3)
    assert f"{max(found):.2f} Hz" in [text.get_text() for text in plot.axes[0].texts]


def test_damped_rotor_has_the_eigenvalues_of_two_degrees_of_freedom() -> None:
    from scipy.linalg import eigvals

    constants, plot = draw(build_whirl(0.3, 0.1), {"shaft.damping_ratio_x": 0.02, "shaft.damping_ratio_y": 0.3})
    shaft, magnet = constants.shaft, constants.magnet
    row = 60
    lever, gyroscopic = shaft.arm_magnet**2, shaft.polar_inertia * 2.0 * math.pi * plot.table["speed"][row]
    damping = np.array([[magnet.damping_x * lever, gyroscopic], [-gyroscopic, magnet.damping_y * lever]])
    rates = np.block([
        [np.zeros((2, 2)), np.eye(2)],
        [-magnet.stiffness * lever / shaft.transverse_inertia * np.eye(2), -damping / shaft.transverse_inertia],
    ])  # fmt: skip
    poles = sorted((pole for pole in eigvals(rates) if pole.imag > 0.0), key=abs)
    for name, pole in zip(("lower mode", "upper mode"), poles, strict=True):
        assert plot.table[name][row] == pytest.approx(abs(pole) / (2.0 * math.pi), rel=1e-3)
        assert plot.table[f"{name} damping ratio"][row] == pytest.approx(-pole.real / abs(pole), rel=1e-3)


def test_measured_peaks_stand_at_their_speed_and_frequency() -> None:
    samples = build_samples(
        8.0,
        disk_x=lambda times_s, _: 0.3 * np.cos(26.6 * math.pi * times_s) + 0.2 * np.cos(17.2 * math.pi * times_s),
        disk_y=lambda times_s, _: 0.3 * np.sin(26.6 * math.pi * times_s) - 0.2 * np.sin(17.2 * math.pi * times_s),
    )
    _, (axes, table) = draw(samples, {})
    measured = table["measured"][81:]
    assert table["speed"][81:] == pytest.approx(SPEED_HZ, rel=0.01)
    assert np.unique(np.round(measured[measured > 0.0], 1)) == pytest.approx([13.3], rel=0.01)
    assert np.unique(np.round(measured[measured < 0.0], 1)) == pytest.approx([-8.6], rel=0.01)
    assert [line.get_label() for line in axes[0].lines[-2:]] == ["measured, forward", "measured, backward"]


def test_a_recording_has_the_diagram_of_its_run_and_a_log_has_none() -> None:
    import rig

    run = rig.simulate("hammer", duration_s=0.05)
    with Recording.open(SESSION) as recording:
        found = recording.plot.campbell(max_speed_hz=16.0).table
    assert found.values[:81, :7] == pytest.approx(run.plot.campbell(max_speed_hz=16.0).table.values[:81, :7], rel=1e-6)
    with pytest.raises(InputError, match="campbell must be drawn of a run or a recording of the rig, which has its"):
        build_whirl(0.3, 0.1).plot.campbell()
    with pytest.raises(InputError, match=r"max_speed_hz must be a number greater than 0; received 0\.0"):
        run.plot.campbell(max_speed_hz=0.0)
