"""A user's own contact law: as a formula in a parameter, and as a file for the commands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from replays.studies.common import law_scene
from replays.studies.common.law_scene import add_law_scene
from replays.studies.common.twelve_scenes import TWELVE_SCENES
from rig.base.errors import InputError
from rig.cli.main import main
from rig.physics.contacts import DAMPING, STIFFNESS, WORKING_FORCES, fit_power, restitution_factor, stiffness_law
from rig.physics.model import build_model, contact_pair
from rig.physics.parameters import load_parameters
from rig.run.law_file import read_law
from tests.commands import run_captured, run_for_output

LIU = "pi/2 * E * L * delta * sqrt(delta / (2 * (r0 + delta)))"
PAIR = contact_pair(load_parameters())
LAW = """
title = "Laboratory X"
stiffness = "1.7e10 * delta**1.5"
damping_factor = "0.75 * (1 - e**2)"
"""


def test_a_formula_of_a_known_law_is_that_law() -> None:
    for force in WORKING_FORCES:
        assert stiffness_law(LIU).depth(force, PAIR) == pytest.approx(STIFFNESS["liu-cylinder"].depth(force, PAIR))
    assert fit_power(LIU, PAIR) == pytest.approx(fit_power("liu-cylinder", PAIR), rel=1e-9)


def test_a_power_of_the_penetration_is_resolved_to_its_numbers() -> None:
    changed = {"contact.stiffness": "1.7e10 * delta**1.5", "contact.damping_factor": "1.5 * (1 - e)"}
    contact = build_model(load_parameters().override(changed)).constants.contact
    assert contact.stiffness == pytest.approx(1.7e10, rel=1e-9)
    assert contact.exponent == pytest.approx(1.5, rel=1e-9)
    hunt_crossley = DAMPING["hunt-crossley"].factor
    assert hunt_crossley is not None
    assert contact.damping_factor == pytest.approx(hunt_crossley(contact.restitution))
    assert contact.damping_factor != pytest.approx(restitution_factor(contact.restitution), rel=1e-3)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("damping_factor", "hunt-crosley", "or a formula of e; received 'hunt-crosley'"),
        ("damping_factor", "1.2 * (1 - x)", "contact.damping_factor must be a formula with .* received 'x'"),
        ("damping_factor", "1.2 * (1 - e", "contact.damping_factor must be a formula"),
        ("damping_factor", "200 * e", "contact.damping_factor must be from 0 to 100 at e = 0.9"),
        ("damping_factor", "0 / 0 * e", "contact.damping_factor must be from 0 to 100 at e = 0.9"),
        ("damping_factor", "__import__('os').system('x')", "contact.damping_factor must be a formula with .* received"),
        ("stiffness", "1e5 * delta", "contact.stiffness must be a force that passes .* N between penetrations of 0"),
        ("damping_factor", "1if 1else 2", "contact.damping_factor must be a formula with .* received '1if 1else 2'"),
        ("damping_factor", "e * 1e300", "contact.damping_factor must be a formula with numbers below 1e[+]300"),
        ("damping_factor", "e.real", "contact.damping_factor must be a formula with .* received 'e.real'"),
        ("damping_factor", " ", "or a formula of e; received ' '"),
        ("stiffness", "exp(delta * 1e6) - 1", "that K delta.n follows within 25% .* received exp.* 70%, with n = 4.27"),
        ("stiffness", "exp(delta * 1e9)", "must be a force that reaches 3000 N .* which reaches it at 0.008 µm"),
        ("stiffness", "1e6 * max(delta - 1e-5, 0)", "that K delta.n follows within 25% .* within 37%, with n = 1.21"),
        (
            "stiffness",
            "1e6 * sqrt(delta)",
            "that K delta.n follows .* n from 1 to 2.5; .* within 0%, with n = 0.5",
        ),
        ("stiffness", "1e12 * delta**3", "that K delta.n follows .* with n from 1 to 2.5; .* within 0%, with n = 3"),
        ("stiffness", "1e6 * abs(sin(1e9 * delta))", "must be a force that reaches 3000 N at .* at least 0.1 µm"),
        ("stiffness", "1e15 * delta", "must be a force that reaches 3000 N at .* which reaches it at 3e-06 µm"),
        ("stiffness", "2e6 * delta + 1e3 * sin(5e3 * delta)", "must be a force that increases with delta from 5 N"),
        ("stiffness", "1e8 * delta / (delta > 0)", "contact.stiffness must be a formula with"),
        ("stiffness", "1e8 * delta + 0 * log(abs(delta - 3e-5) - 1e-6)", "must be a force that passes .* N between"),
        ("stiffness", "1e8 * delta + 0 * log(abs(delta - 1e-5) - 1e-6)", "contact.stiffness must be a force that"),
        ("stiffness", "1e9 * x", "contact.stiffness must be a formula with .* received 'x'"),
        ("friction", "0.1 + 0.1", "contact.friction must be a number from 0 to"),
    ],
)
def test_an_invalid_law_formula_is_refused_in_one_line(key: str, value: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        build_model(load_parameters().override({f"contact.{key}": value}))


@pytest.mark.parametrize("formula", ["e", " e ", "e-e", "1-e", "e**1e9", "(e)"])
def test_a_formula_may_be_a_variable_alone(formula: str) -> None:
    assert build_model(load_parameters().override({"contact.damping_factor": formula}))


@pytest.mark.parametrize(
    ("formula", "exponent"), [("1e9 * delta", 1.0), ("2e12 * delta**2.5", 2.5), ("E*L*delta", 1.0)]
)
def test_a_power_at_the_limits_of_the_exponent_is_exact(formula: str, exponent: float) -> None:
    fit = fit_power(formula, PAIR)
    assert (fit.exponent, fit.error) == (exponent, 0.0)


def test_a_law_file_gives_parameters(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text(LAW)
    assert read_law(path).changes() == {
        "contact.stiffness": "1.7e10 * delta**1.5", "contact.damping_factor": "0.75 * (1 - e**2)",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('title = "a"', "must be a file with at least one of stiffness, exponent, damping_factor, viscous_damping"),
        ('title = "a"\nK = 1e9', "K"),
        ("stiffness = 1e9", "title"),
        ('title = "a"\nstiffness = true', "stiffness"),
        ('title = "a"\nstiffness = nan', "stiffness"),
        ("title", "x.toml"),
        ('title = "\\u001b[31m"\nstiffness = 1e9', "x.toml.title must be a line of 1 to 100 printable characters"),
        (f'title = "{"x" * 10000}"\nstiffness = 1e9', "x.toml.title must be a line of 1 to 100 printable characters"),
        (f'title = "x"\nstiffness = "{"delta*" * 2000}1"', "contact.stiffness must be a formula of at most 500"),
    ],
)
def test_a_wrong_law_file_is_refused_in_one_line(
    text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.toml"
    path.write_text(text)
    status, out, err = run_captured(capsys, "laws", "--law", str(path))
    assert (status, out) == (2, "")
    assert words in err
    assert err.count("\n") == 1


def test_laws_are_compared_with_the_file_s(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.toml"
    path.write_text(LAW)
    laws = {
        law["name"]: law for law in json.loads(run_for_output(capsys, "laws", "--law", str(path), "--json"))["damping"]
    }
    own, known = laws["0.75 * (1 - e**2)"], laws["lankarani-nikravesh"]
    assert (own["in_use"], known["in_use"]) == (True, False)
    for column in ("damping_factor", "returned", "peak_force_n", "contact_time_ms"):
        assert own[column] == pytest.approx(known[column])


def test_a_users_law_is_an_additional_scene_of_the_chart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(law_scene, "TWELVE_SCENES", scenes := dict(TWELVE_SCENES))
    path = tmp_path / "x.toml"
    path.write_text(LAW)
    name = add_law_scene(path)
    assert next(iter(scenes)) == name
    assert scenes[name].title == "law: Laboratory X"
    assert scenes[name].load().set["contact.stiffness"] == "1.7e10 * delta**1.5"
    path.write_text(LAW.replace("1.7e10", "1.8e10"))
    assert add_law_scene(path) != name, "a table must not take points of one law for those of another"


@pytest.mark.parametrize("command", ["chart", "stability"])
def test_charts_refuse_a_wrong_law_before_measuring(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.toml").write_text('title = "a"\nstiffness = "1 / delta"')
    with pytest.raises(SystemExit) as ended:
        main([command, "--law", "x.toml", *(["--scenes"] if command == "stability" else [])])
    assert ended.value.code == 2
    assert "contact.stiffness must be" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [tmp_path / "x.toml"]


@pytest.mark.parametrize(
    "others", [("--problem", "drop"), ("--add", "x.csv"), ("--panel", "exact"), ("--only", "whirl")]
)
def test_a_law_is_refused_where_a_chart_would_ignore_it(
    others: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(law_scene, "TWELVE_SCENES", dict(TWELVE_SCENES))
    (path := tmp_path / "x.toml").write_text(LAW)
    with pytest.raises(SystemExit) as ended:
        main(["chart", "--law", str(path), *others, "-o", str(tmp_path)])
    assert ended.value.code == 2
    assert "--law must be given with --panel scenes" in capsys.readouterr().err
