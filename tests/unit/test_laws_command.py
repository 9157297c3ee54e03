"""`rig laws`: the comparison as a table, as JSON and as a picture; refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from replays.studies.forces.laws import compare, draw, restitution_curves
from rig.cli.main import main
from rig.physics.contacts import DAMPING, KELVIN_VOIGT, STIFFNESS
from rig.physics.parameters import load_parameters
from tests.commands import run_for_output

DEFAULT = load_parameters()


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    return run_for_output(capsys, "laws", *arguments)


def document(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    return json.loads(run(capsys, "--json", *arguments))


def test_table_names_every_law_and_marks_those_in_use(capsys: pytest.CaptureFixture[str]) -> None:
    lines = run(capsys, "as-printed").splitlines()
    for name in (*DAMPING, *STIFFNESS):
        assert any(line.startswith(f"{name} ") for line in lines), name
    marked = [line.split()[0] for line in lines if "  yes  " in line]
    assert marked == ["lankarani-nikravesh", "internal-sphere"]
    # A unit in brackets is not markup.
    assert "contact [ms]" in lines[1]
    assert "returns 0.913 for 0.9 requested" in lines[-1]


def test_document_contains_both_families(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys)
    assert [law["name"] for law in found["damping"]] == list(DAMPING)
    assert [law["name"] for law in found["stiffness"]] == list(STIFFNESS)
    assert found["wanted"][0] == 0.05
    assert found["wanted"][-1] == 1.0
    assert all(len(values) == len(found["wanted"]) for values in found["returned"].values())
    assert all(len(values) == len(found["speed"]) for values in found["returned_over_speed"].values())
    assert found["returned"]["exact"] == pytest.approx(found["wanted"], abs=1e-9)
    assert found["impact"]["reduced_mass_kg"] == pytest.approx(0.9161, abs=1e-4)
    assert [law["name"] for law in found["damping"] + found["stiffness"] if law["in_use"]] == [
        "exact",
        "internal-sphere",
    ]


def test_restitution_can_be_selected(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys, "--restitution", "0.5")
    assert found["restitution"] == 0.5
    returned = {law["name"]: law["returned"] for law in found["damping"]}
    assert returned["exact"] == pytest.approx(0.5, abs=1e-6)
    assert returned[KELVIN_VOIGT] == pytest.approx(0.5, abs=1e-6)
    assert returned["lankarani-nikravesh"] == pytest.approx(0.725, abs=5e-4)


def test_parameters_can_be_changed(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys, "--set", "ring.width=20", "--set", "contact.stiffness=johnson-cylinder")
    assert found["in_use"]["stiffness_law"] == "johnson-cylinder"
    assert found["lean"]["over_width_um"] == pytest.approx(94.0, abs=0.1)
    entry = next(law for law in found["stiffness"] if law["name"] == "johnson-cylinder")
    assert found["in_use"]["fit_error"] == entry["fit_error"] > 0.0


def test_given_numbers_are_compared_at_equal_depth(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys, "--set", "contact.stiffness=2e10", "--set", "contact.damping_factor=0.3")
    assert found["in_use"]["stiffness_law"] is None
    assert not any(law["in_use"] for law in found["damping"] + found["stiffness"])
    linear = next(law for law in found["damping"] if law["name"] == KELVIN_VOIGT)
    hertz = next(law for law in found["damping"] if law["name"] == "none")
    assert linear["exponent"] == 1.0
    assert linear["depth_um"] == pytest.approx(hertz["depth_um"], rel=0.1)


def test_an_inapplicable_law_is_marked(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys, "--set", "ring.clearance=15")
    refused = {law["name"]: law["refused"] for law in found["stiffness"] if law["refused"]}
    assert list(refused) == ["pereira-cylinder"]
    assert "ring.clearance" in refused["pereira-cylinder"]
    assert "ring.clearance" in run(capsys, "--set", "ring.clearance=15")


def test_only_memory_of_v0_and_linear_laws_forget_the_speed() -> None:
    over = restitution_curves(DEFAULT, [1e-4, 1e-2, 0.145, 1.0])
    assert over["memory of v0 (exact)"][1:] == pytest.approx([0.9] * 3, abs=1e-9)
    assert over["memory of v0 (exact)"][0] > 0.98
    assert over["Kelvin-Voigt"] == pytest.approx([0.9] * 4, abs=1e-6)
    constant = over["constant D on Hertz"]
    assert constant[2] == pytest.approx(0.9, abs=1e-5)
    assert constant == sorted(constant)
    assert constant[0] < 0.7


def test_picture_is_drawn_the_same_each_time(tmp_path: Path) -> None:
    first, second = tmp_path / "laws.svg", tmp_path / "again-laws.svg"
    draw(DEFAULT, first)
    draw(DEFAULT, second)
    assert first.read_bytes().startswith(b"<?xml")
    assert first.read_bytes() == second.read_bytes()


def test_picture_labels_every_axis_and_law(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    monkeypatch.setattr("replays.studies.forces.laws.save", lambda figure, _: drawn.append(figure))
    draw(DEFAULT.override({"contact.restitution": 1.0}), tmp_path / "laws.png")
    panels = drawn[0].axes
    assert all("[" in axes.get_xlabel() and "[" in axes.get_ylabel() and axes.get_title("left") for axes in panels)
    legends = [{text.get_text() for text in legend.get_texts()} for axes in panels if (legend := axes.get_legend())]
    assert set(DAMPING) in legends
    assert any(set(STIFFNESS) < legend for legend in legends)
    styles = [
        (line.get_color(), line.get_linestyle(), line._unscaled_dash_pattern)  # noqa: SLF001 (no public function distinguishes the dashes)
        for line in panels[0].lines[: len(DAMPING)]
    ]
    assert len(set(map(str, styles))) == len(DAMPING)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--restitution", "0.01"], "contact.restitution must be"),
        (["--set", "contact.damping_factor=hertz"], "contact.damping_factor must be"),
        (["--set", "contact.exponent=1.5", "--set", "contact.damping_factor=kelvin-voigt"], "contact.exponent must be"),
        (["--plot", "laws.pdf"], "--plot must be a file name that ends in .png or .svg"),
        (["nonsense"], "parameters must be one of"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["laws", *arguments])
    assert end.value.code == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"rig: {message}")
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_params_shows_the_error_of_the_fit(capsys: pytest.CaptureFixture[str]) -> None:
    output = run_for_output(capsys, "params", "--set", "contact.stiffness=johnson-cylinder")
    rows = {line.split()[0]: line.split() for line in output.splitlines() if line.startswith("contact.")}
    assert rows["contact.stiffness"][1].startswith("8.91")
    assert rows["contact.stiffness"][4] == "johnson-cylinder"
    assert "within 3.3% of its force" in output
    assert rows["contact.exponent"][1].startswith("1.118")
    assert rows["contact.exponent"][4] == "law"


def test_compare_needs_no_terminal_and_is_json() -> None:
    found = compare(load_parameters("dtu-2019"))
    assert json.loads(json.dumps(found, allow_nan=False)) == found
