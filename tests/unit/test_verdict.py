"""The verdict on hammer recordings: good on a good one, not on one that was rotated, cut or thinned; and the
picture.
"""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from recorder.writer import RecordingWriter
from replays.recordings.export import write_run
from replays.recordings.picture import draw
from replays.recordings.verdict import Verdict, hammer_time_s, judge
from replays.recordings.whirl import parameter_si, whirl_figures
from replays.report.canvas import DPI, WIDTH
from rig.base import wire
from rig.base.errors import InputError
from rig.cli.commands.demo import verdict_table
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation
from tests.commands import check_legible

Change = Callable[[str, bytes], Iterable[bytes]]
"""Payloads to write for one payload of a key: none, itself, others."""


def simulated(path: Path, scene: str = "hammer", **changes: Any) -> Recording:
    simulation = Simulation(load_scene(scene, {key.replace("__", "."): value for key, value in changes.items()}))
    write_run(simulation, path)
    return Recording.open(path)


def unchanged(key: str, payload: bytes) -> list[bytes]:
    return [payload]


def rewrite(
    good: Recording,
    path: Path,
    change: Change = unchanged,
    *,
    catalogue: dict[str, Any] | None = None,
    status: bytes | None = None,
) -> Recording:
    """Write the same recording with some payloads changed, with another channel table, or with a status at its end."""
    writer = RecordingWriter(
        path, catalogue=catalogue or good.catalogue, parameters=good.parameters, scene=good.scene, view_rate_hz=0.0
    )
    for key in good.messages:
        if not key.startswith("rig/"):
            continue
        for _, payload in good.payloads(key):
            for kept in change(key, payload):
                writer.write(key, kept, 1_700_000_000_000_000_000)
    if status is not None:
        writer.write(wire.STATUS, status, 1_700_000_000_000_000_000)
    writer.finish("completed")
    return Recording.open(path)


def bad(verdict: Verdict) -> set[str]:
    return {row.quantity for row in verdict.rows if row.good is False}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The hammer scene, two seconds of it."""
    return simulated(tmp_path_factory.mktemp("verdict") / "hammer.mcap")


WHIRL = {"whirl frequency, ring probes", "whirl frequency, disk probes", "sense of rotation"}


def test_a_simulated_hammer_run_passes(good: Recording) -> None:
    verdict = judge(good)
    assert verdict.good, verdict.rows
    rows = {row.quantity: row for row in verdict.rows}
    assert set(rows) >= WHIRL | {
        "orbit in the ring",
        "against the paper's Fig. 14",
        "reaction E/W, whirl",
        "samples lost",
        "recording",
    }
    assert rows["sense of rotation"].measured == "backward"
    assert rows["recording"].measured == "completed"
    assert all(row.good for row in verdict.rows if row.quantity in WHIRL), "asked for, not merely shown"


def test_figures_are_those_of_the_model(good: Recording) -> None:
    figures = whirl_figures(good, 0.6, 2.0)
    truth, contact = good.truth("state"), good.truth("contact")
    settled = truth.times_s >= 0.6
    spin_hz = truth["theta_rate"][settled].mean() / (2 * math.pi)
    assert figures.spin_hz == pytest.approx(spin_hz, rel=2e-3)
    radius = parameter_si(good, "ring.clearance") + contact["penetration"][settled].mean()
    assert figures.radius_m == pytest.approx(radius, rel=2e-3)
    assert figures.frequency_hz == pytest.approx(
        -figures.spin_hz * parameter_si(good, "shaft.radius") / radius, rel=5e-3
    )
    forces = good.truth("forces")
    pair = forces["P_E"][settled] - forces["P_W"][settled]
    assert figures.reaction_x_n == pytest.approx(np.ptp(pair) / 2, rel=0.1)


def test_a_rewritten_recording_passes(good: Recording, tmp_path: Path) -> None:
    assert judge(rewrite(good, tmp_path / "again.mcap")) == judge(good)


def test_probes_with_a_wrong_sign_of_y_do_not_pass(good: Recording, tmp_path: Path) -> None:
    catalogue = copy.deepcopy(good.catalogue)
    flipped = 0
    for channel in catalogue["table"]["groups"]["probes"]["channels"]:
        if channel["name"].endswith("_y"):
            channel["sensitivity_v"] *= -1.0
            flipped += 1
    assert flipped == 2
    verdict = judge(rewrite(good, tmp_path / "flipped.mcap", catalogue=catalogue))
    assert not verdict.good
    assert bad(verdict) >= WHIRL
    assert {row.measured for row in verdict.rows if row.quantity == "sense of rotation"} == {"forward"}


def changed_block(payload: bytes, key: str, change: Callable[[np.ndarray], np.ndarray]) -> bytes:
    block = wire.decode_block(payload, wire.get_schema(key) or "")
    return wire.encode_block(dataclasses.replace(block, values=change(block.values)))


def test_probes_with_crossed_cables_do_not_pass(good: Recording, tmp_path: Path) -> None:
    def crossed(key: str, payload: bytes) -> list[bytes]:
        if key != wire.sensor_key("probes"):
            return [payload]
        return [changed_block(payload, key, lambda values: values[:, [1, 0, 3, 2]])]

    assert bad(judge(rewrite(good, tmp_path / "crossed.mcap", crossed))) >= WHIRL


def test_a_single_wrong_probe_pair_is_found(good: Recording, tmp_path: Path) -> None:
    def crossed(key: str, payload: bytes) -> list[bytes]:
        if key != wire.sensor_key("probes"):
            return [payload]
        return [changed_block(payload, key, lambda values: values[:, [1, 0, 2, 3]])]

    assert bad(judge(rewrite(good, tmp_path / "disk.mcap", crossed))) == {"whirl frequency, disk probes"}


def test_a_lost_block_does_not_pass(good: Recording, tmp_path: Path) -> None:
    count = {"blocks": 0}

    def lossy(key: str, payload: bytes) -> list[bytes]:
        if key != wire.sensor_key("forces"):
            return [payload]
        count["blocks"] += 1
        return [] if count["blocks"] == 7 else [payload]

    verdict = judge(rewrite(good, tmp_path / "lossy.mcap", lossy))
    assert bad(verdict) == {"samples lost"}
    # Blocks of 0.1 s.
    assert next(row.measured for row in verdict.rows if row.quantity == "samples lost").startswith("2000 of ")


def test_a_truncated_recording_does_not_pass(good: Recording, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    data = good.path.read_bytes()
    path.write_bytes(data[: len(data) - 200])
    assert bad(judge(Recording.open(path))) == {"recording"}


def status(**changes: Any) -> bytes:
    document = {
        "lateness_ms": {"p50": 0.1, "p99": 1.0, "max": 3.0},
        "block_ms": 10.0,
        "real_time_factor": 1.0,
        "energy": {"residual_j": 1e-12, "dissipated_j": 0.5},
    }
    return wire.encode_document(document | changes)


LATENESS_MS = {"p50": 0.1, "p99": 10.5, "max": 30.0}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, set()),
        ({"lateness_ms": LATENESS_MS}, set()),
        ({"lateness_ms": LATENESS_MS, "real_time_factor": 0.9}, set()),
        ({"lateness_ms": LATENESS_MS, "real_time_factor": 1.1}, {"real-time factor"}),
        ({"real_time_factor": 0.99}, {"real-time factor"}),
        ({"energy": {"residual_j": 1e-3, "dissipated_j": 0.5}}, {"energy residual"}),
    ],
)
def test_warnings_of_the_rig_affect_the_verdict(
    good: Recording, tmp_path: Path, changes: dict[str, Any], expected: set[str]
) -> None:
    verdict = judge(rewrite(good, tmp_path / "status.mcap", status=status(**changes)))
    assert bad(verdict) == expected
    # A run without a clock has an energy figure, and no pace.
    assert len(verdict.rows) == len(judge(good).rows) + 2
    # A busy machine does not affect the verdict, but is reported.
    assert ("busy" in verdict.remark) == ("lateness_ms" in changes)
    check_legible(verdict_table(verdict))


def test_a_recording_without_a_hammer_pulse_is_refused(tmp_path: Path) -> None:
    quiet = simulated(tmp_path / "quiet.mcap", "stable-run", duration_s=0.2)
    for use in (hammer_time_s, judge, lambda recording: draw(recording, tmp_path / "quiet.png")):
        with pytest.raises(InputError, match=r"^recording must be one with a hammer pulse"):
            use(quiet)
    assert not (tmp_path / "quiet.png").exists()


@pytest.mark.parametrize("duration_s", [0.03, 0.4, 0.9])
def test_a_short_recording_is_refused(tmp_path: Path, duration_s: float) -> None:
    short = simulated(tmp_path / "short.mcap", duration_s=duration_s)
    with pytest.raises(InputError, match=r"^recording must be long enough for a whirl"):
        judge(short)


@pytest.mark.parametrize("groups", [["drive", "hammer"], ["probes", "drive"], ["probes", "forces"]])
def test_a_recording_without_the_instruments_is_refused(tmp_path: Path, groups: list[str]) -> None:
    with pytest.raises(InputError, match=" must be "):
        judge(simulated(tmp_path / "few.mcap", sensors__groups=groups, duration_s=0.1))


def test_a_decaying_response_does_not_pass(tmp_path: Path) -> None:
    command = '[{ at_s = 0.02, command = "hammer", duration_ms = 2.0 }]'
    verdict = judge(simulated(tmp_path / "weak.mcap", commands=command))
    assert bad(verdict) >= {"whirl frequency, ring probes", "orbit in the ring"}


def test_picture_is_drawn(good: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.figure import Figure
    from matplotlib.image import imread

    drawn: list[Figure] = []
    original = Figure.draw

    def kept(figure: Figure, renderer: Any) -> None:
        drawn.append(figure)
        original(figure, renderer)

    monkeypatch.setattr(Figure, "draw", kept)
    path = tmp_path / "hammer.png"
    draw(good, path)
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">I", data[16:20]) == (WIDTH * DPI,)
    assert len(data) > 50_000
    assert imread(path)[..., :3].std() > 0.1
    panels = [panel for panel in drawn[0].axes if panel.get_title("left")]
    assert len(panels) == 9
    for panel in panels:
        assert panel.has_data(), panel.get_title("left")
        for label in (panel.get_xlabel(), panel.get_ylabel()):
            assert re.match(r"\w[\w ]* \[", label), "a quantity, with its unit"
