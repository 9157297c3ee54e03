"""`rig magnets`: the comparison as tables, JSON and a picture; refusals; the entry in `rig params`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from replays.studies.forces.magnets import compare, draw
from rig.cli.main import main
from rig.physics.model import build_model
from rig.physics.parameters import load_parameters
from tests.commands import run_for_output as run

FAMILY = ["linear", "far-field map", "far-field sum", "cylinder map", "exact cylinders"]


def document(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    return json.loads(run(capsys, "magnets", "--json", *arguments))


def read_numbers(lines: list[str], title: str) -> dict[str, list[float]]:
    """Return the rows of the table of forces under a title: the columns of numbers by model."""
    start = next(n for n, line in enumerate(lines) if line.startswith(title)) + 2
    rows = {name: lines[start + n] for n, name in enumerate(FAMILY)}
    assert all(line.strip().startswith(name) for name, line in rows.items())
    return {name: [float(text) for text in line.split()[-7:]] for name, line in rows.items()}


def test_document_contains_the_family_and_its_errors(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys)
    assert [model["name"] for model in found["models"]] == FAMILY
    assert found["displacement_mm"] == pytest.approx([1, 2, 4, 6, 8, 10])
    assert found["overstated"]["at_centre"] == pytest.approx(2.27, abs=0.01)
    assert found["overstated"]["toward_a_magnet"][-1] == pytest.approx(3.61, abs=0.01)
    assert found["quadrature_error"] < 1e-6
    for model in found["models"]:
        toward, between = model["force_toward_a_magnet_n"], model["force_between_two_n"]
        scale = found["stiffness_used_n_m"] / model["stiffness_n_m"]
        assert model["force_at_stiffness_used_n"] == pytest.approx([force * scale for force in toward])
        assert all(force > 0.0 for force in toward), "they repel"
        if model["name"] in ("far-field sum", "cylinder map", "exact cylinders"):
            assert toward[-1] > 1.05 * between[-1], "harder toward a magnet than between two"
        else:
            assert toward == pytest.approx(between), "round"
    assert len(found["errors"]) == 7
    assert all(0.0 < error["over_travel"] <= error["over_reach"] for error in found["errors"])


def test_tables_agree_with_the_document(capsys: pytest.CaptureFixture[str]) -> None:
    found, lines = document(capsys), run(capsys, "magnets").splitlines()
    same_magnets = read_numbers(lines, "force toward the centre, same magnets (corrected)")
    same_stiffness = read_numbers(lines, "force at 1.7 kN/m")
    for model in found["models"]:
        name = model["name"]
        assert same_magnets[name] == pytest.approx(
            [model["stiffness_n_m"] / 1e3, *model["force_toward_a_magnet_n"]], abs=5.1e-4
        )
        assert same_stiffness[name] == pytest.approx([1.7, *model["force_at_stiffness_used_n"]], abs=5.1e-4)
    text = " ".join(lines)
    # A unit in brackets is not markup.
    assert "K [kN/m]" in text
    assert "8 magnets of 16.9 mm: number and length are assumed" in text
    assert "no measured force is available" in text
    chain = next(line for line in lines if line.startswith("cylinder map") and "exact cylinders" in line)
    assert float(chain.split()[-1].rstrip("%")) < 0.2


def test_parameters_can_be_changed(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys, "--set", "magnet.count=12", "--set", "magnet.stiffness=cylinders")
    exact = found["models"][-1]
    assert found["geometry"]["number"] == 12
    assert found["stiffness_used_n_m"] == exact["stiffness_n_m"]
    assert exact["force_at_stiffness_used_n"] == pytest.approx(exact["force_toward_a_magnet_n"])


def test_tight_magnets_are_compared_over_their_clearance(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys, "--set", "magnet.bearing_radius=19")
    assert found["reach_mm"] == pytest.approx(0.92 * 5)
    assert found["displacement_mm"][-1] == pytest.approx(found["reach_mm"])


def test_picture_is_drawn_the_same_each_time(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    one, other = tmp_path / "one.svg", tmp_path / "other.svg"
    assert f"picture  {one}" in run(capsys, "magnets", "--plot", str(one))
    draw(build_model(load_parameters()), other)
    assert one.read_bytes() == other.read_bytes()
    assert one.stat().st_size > 10_000
    changed = build_model(load_parameters().override({"magnet.length": 10.0}))
    draw(changed, other)
    assert one.read_bytes() != other.read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--plot", "magnets.pdf"], "--plot must be a file name that ends in .png or .svg"),
        (["--set", "magnet.count=13"], "magnet.count must be at most 12, or the magnets would overlap"),
        (["--set", "magnet.stiffness=magpylib"], "or one of eq35, cylinders"),
        (["nowhere"], "parameters must be one of corrected"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["magnets", *arguments])
    captured = capsys.readouterr()
    assert end.value.code == 2
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert not list(tmp_path.iterdir())


def test_params_shows_the_errors(capsys: pytest.CaptureFixture[str]) -> None:
    found = " ".join(run(capsys, "params").split())
    assert "eq. 35 gives 1.659 kN/m at the centre, exact cylinders 0.735 kN/m" in found
    assert "follows the field sum within 6.5% over 10 mm and 0.2% in the range that the ring allows" in found
    assert "exact cylinders of equal stiffness within 57% and 10%" in found
    derived = json.loads(run(capsys, "params", "--json"))["derived"]
    model = build_model(load_parameters())
    assert derived["magnet_errors"] == compare(model)["errors"]


def test_command_is_listed_with_its_fellows(capsys: pytest.CaptureFixture[str]) -> None:
    assert "Compare the magnet models" in run(capsys, "--help")
