"""Plots of the contact against reference solutions of a free impact and the law of rolling."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from replays.plots.contact import contact, restitution, rolling
from replays.plots.signals import Signals, read_signals
from replays.studies.common.closed_forms import impact
from rig.base.errors import InputError
from rig.base.samples import Samples
from rig.physics.model import build_model, reference_impact
from rig.physics.parameters import load_parameters
from tests.unit.test_plots import SESSION, build_samples, drop_rows, rig_plot

RATE_HZ = 20_000.0
SPEEDS = (0.3, 0.15, 0.05)


@lru_cache
def build_impacts() -> tuple[Signals, float]:
    """Return free impacts at three speeds, 0.02 s apart, as the truth of a run, and the reduced mass [kg]."""
    from scipy.integrate import solve_ivp

    parameters = load_parameters()
    model, mass = build_model(parameters), reference_impact(parameters).mass
    law, columns = model.constants.contact, []
    for speed in SPEEDS:

        def force(z: np.ndarray, speed: float = speed) -> np.ndarray:
            return law.stiffness * np.maximum(z[0], 0.0) ** law.exponent * (1.0 + law.damping_factor * z[1] / speed)

        def move(_: float, z: np.ndarray, force: Any = force) -> list[float]:
            return [z[1], -float(force(z)) / mass]

        times_s = np.arange(round(0.02 * RATE_HZ)) / RATE_HZ
        # Contact begins between two rows.
        start = [-speed * 0.0100123, speed]
        z = solve_ivp(
            move, (0.0, 0.02), start, method="DOP853", rtol=1e-11, atol=1e-14, t_eval=times_s, max_step=1e-4
        ).y  # fmt: skip
        columns.append(np.stack([*z, force(z), np.full(len(times_s), speed)], axis=1))
    values = np.concatenate(columns)
    names = tuple(f"truth.{name}" for name in ("penetration", "penetration_rate", "normal_force", "onset_speed"))
    rows = np.arange(len(values))
    samples = Samples("", rows / RATE_HZ, rows, values, names, ("m", "m/s", "N", "m/s"), RATE_HZ)
    return replace(read_signals(samples), model=lambda: model), mass


def test_restitution_force_and_duration_are_those_of_the_reference_solution() -> None:
    signals, mass = build_impacts()
    law = signals.require_model("test").constants.contact
    axes, table = restitution(signals)
    assert len(table) == len(SPEEDS)
    for row, speed in enumerate(SPEEDS):
        expected = impact(
            mass=mass, speed=speed, stiffness=law.stiffness, exponent=law.exponent, factor=law.damping_factor,
            speed_floor=law.speed_floor,
        )  # fmt: skip
        assert table["approach"][row] == pytest.approx(speed, rel=1e-3)
        assert table["restitution"][row] == pytest.approx(expected.restitution, rel=1e-3)
        assert table["duration"][row] == pytest.approx(expected.duration, rel=1e-2)
        assert table["largest force"][row] == pytest.approx(expected.peak, rel=0.05), "the largest of six rows"
        assert table["time"][row] == pytest.approx(0.02 * row + 0.0100123, abs=1e-6)
    assert axes[0].lines[1].get_ydata() == pytest.approx(table["restitution"][0], rel=1e-3), "the law, at any speed"


def test_contact_force_is_that_of_the_law() -> None:
    signals, _ = build_impacts()
    (axes,), table = contact(signals)
    law = signals.require_model("test").constants.contact
    assert table["law"] == pytest.approx(table["force"], rel=1e-9)
    depth, force = axes.lines[1].get_xydata()[-1]
    assert depth == pytest.approx(1e6 * table["penetration"].max())
    assert force == pytest.approx(law.stiffness * (1e-6 * depth) ** law.exponent)
    assert np.isnan(axes.lines[0].get_xdata()).sum() == len(SPEEDS) - 1, "contacts are separate lines"


def test_an_impact_with_a_gap_has_no_restitution() -> None:
    signals, _ = build_impacts()
    cut = drop_rows(signals.read(*signals.channels), 0.0301, 0.0302)
    assert len(restitution(cut).table) == len(SPEEDS) - 1
    with pytest.raises(InputError, match=r"restitution must be drawn of data with impacts .*; received none, at 20000"):
        restitution(signals, to_s=0.005)
    with pytest.raises(InputError, match="contact must be in the data; received none"):
        contact(signals, to_s=0.005)
    with pytest.raises(InputError, match=r"contact must be drawn of data with truth.penetration, .*; received data"):
        build_samples(1.0, a=lambda times_s, _: times_s).plot.contact()


def test_rolling_shows_the_angles_of_a_known_whirl() -> None:
    parameters = load_parameters()
    clearance = 1e3 * parameters["ring.clearance"]
    law = -1e3 * parameters["shaft.radius"] / clearance
    samples = build_samples(
        2.0,
        ring_x=lambda times_s, angle: np.where(times_s < 1.0, 0.5, clearance) * np.cos(law * angle),
        ring_y=lambda times_s, angle: np.where(times_s < 1.0, 0.5, clearance) * np.sin(law * angle),
    )
    signals = replace(read_signals(samples), model=lambda: build_model(parameters), clearances={"ring_x": clearance})
    (path, angle), table = rolling(signals)
    assert table["contact"].tolist() == (samples.times_s >= 1.0).tolist()
    assert np.polyfit(table["rotation"], table["whirl"], 1)[0] == pytest.approx(law, rel=1e-3)
    assert float(angle.get_title(loc="left").split()[0].replace("−", "-")) == pytest.approx(law, rel=1e-3)
    assert angle.lines[2].get_label() == f"rolling: {law:.3f}".replace("-", "−")
    thick = path.lines[1].get_xydata()
    assert np.hypot(*thick[~np.isnan(thick).any(axis=1)].T) == pytest.approx(clearance)
    with pytest.raises(InputError, match="contact must be in the data; received none"):
        rolling(signals, to_s=0.9)
    with pytest.raises(InputError, match="rolling must be drawn of a pair of probes in a plane with a known clearance"):
        rolling(samples)


def test_a_recording_of_a_whirl_rolls(tmp_path: Path) -> None:
    with Recording.open(SESSION) as recording:
        axes, _ = recording.plot.rolling()
    title, label = axes[1].get_title(loc="left").replace("−", "-"), axes[1].lines[2].get_label().replace("−", "-")
    assert float(title.split()[0]) == pytest.approx(float(label.split()[1]), rel=0.01)
    assert rig_plot(SESSION, "-o", tmp_path / "out", "--only", "contact") == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"contact.png", "contact.csv"}
