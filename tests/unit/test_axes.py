"""Axes and designs of ensembles: any slice equals the whole, and values have the declared distributions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rig.base.errors import InputError
from rig.ensemble.axes import Design, permute
from rig.run.scenes import load_scene

SCENE = load_scene("hammer", {"duration_s": 0.02})
OVER = {
    "contact.friction": {"distribution": "normal", "mean": 0.2, "std": 0.1},
    "hammer.force_n": {"distribution": "uniform", "from": 50.0, "to": 500.0, "scale": "log"},
    "drive.speed_hz": {"from": 5.0, "to": 7.0, "count": 9},
    "model.contact": ["compliant", "impact"],
}


def create(over: dict[str, Any], sampling: str | None = None, runs: int | None = None, seed: int = 1) -> Design:
    return Design.create(SCENE, over, runs=runs, sampling=sampling, seed=seed)


@pytest.mark.parametrize("sampling", ["random", "latin", "sobol", "halton"])
def test_any_slice_equals_the_whole(sampling: str) -> None:
    design = create(OVER, sampling, 1000)
    whole = design.values(0, 1000)
    assert whole.shape == (1000, 4)
    for first, last in ((0, 1), (1, 2), (0, 7), (130, 177), (511, 513), (999, 1000)):
        assert np.array_equal(design.values(first, last), whole[first:last])
        assert np.array_equal(design.seeds(first, last), design.seeds(0, 1000)[first:last])
    assert not np.array_equal(create(OVER, sampling, 1000, seed=2).values(0, 1000), whole)
    assert set(whole[:, 3]) == {"compliant", "impact"}
    assert set(whole[:, 2]) == set(np.linspace(5.0, 7.0, 9))


def test_a_slice_of_a_long_design_does_not_compute_the_rest() -> None:
    for sampling in ("random", "latin", "halton"):
        assert create(OVER, sampling, 2**30).values(2**30 - 3, 2**30).shape == (3, 4)


def test_seeds_differ() -> None:
    seeds = create(OVER, "random", 2000).seeds(0, 2000)
    assert seeds.dtype == np.int64
    assert len(set(seeds)) == 2000
    assert seeds.min() >= 0


def test_a_grid_has_each_combination_once() -> None:
    design = create({"contact.friction": [0.1, 0.3], "drive.speed_hz": {"from": 1.0, "to": 4.0, "count": 3,
                     "scale": "log"}})  # fmt: skip
    assert design.sampling == "grid"
    assert design.shape == (2, 3)
    assert np.allclose(design.values(0, 6), [[f, v] for f in (0.1, 0.3) for v in (1.0, 2.0, 4.0)])
    assert np.array_equal(design.values(4, 6), design.values(0, 6)[4:])


@pytest.mark.parametrize("runs", [1, 2, 3, 5, 64, 65, 1000])
def test_permutations_have_each_number_once(runs: int) -> None:
    keys = np.arange(8, dtype=np.uint64) * np.uint64(77)
    assert sorted(permute(np.arange(runs, dtype=np.uint64), runs, keys)) == list(range(runs))


def test_a_latin_hypercube_has_one_run_in_each_interval() -> None:
    over = {key: {"distribution": "uniform", "from": 0.0, "to": 1.0} for key in ("contact.friction", "drive.speed_hz")}
    values = create(over, "latin", 500).values(0, 500)
    for column in values.T:
        assert sorted((column * 500).astype(int)) == list(range(500))
    assert abs(np.corrcoef(values.T)[0, 1]) < 0.2


@pytest.mark.parametrize("sampling", ["sobol", "halton"])
def test_sequences_are_those_of_scipy(sampling: str) -> None:
    from scipy.stats import qmc

    over = {key: {"distribution": "uniform", "from": 0.0, "to": 1.0} for key in ("contact.friction", "drive.speed_hz")}
    engine: Any = {"sobol": qmc.Sobol, "halton": qmc.Halton}[sampling](2, seed=np.random.default_rng(1))
    assert np.allclose(create(over, sampling, 64).values(0, 64), engine.random(64), atol=2.0**-30)


def build_distributions() -> dict[str, Any]:
    """Return axes of the friction with the distribution that scipy has for them."""
    from scipy import stats

    width = np.sqrt(np.log1p(0.25))
    lognormal = {"distribution": "lognormal", "mean": 0.1, "std": 0.05}
    triangular = {"distribution": "triangular", "from": 0.1, "mode": 0.2, "to": 0.5}
    uniform = {"distribution": "uniform", "from": 0.1, "to": 0.5}
    normal = {"distribution": "normal", "mean": 0.2, "std": 0.3}
    return {
        "normal": (normal, stats.truncnorm((0.0 - 0.2) / 0.3, (2.0 - 0.2) / 0.3, 0.2, 0.3)),
        "uniform": (uniform, stats.uniform(0.1, 0.4)),
        "log": (uniform | {"scale": "log"}, stats.loguniform(0.1, 0.5)),
        "lognormal": (lognormal, stats.lognorm(width, scale=0.1 * np.exp(-0.5 * width**2))),
        "triangular": (triangular, stats.triang(0.25, 0.1, 0.4)),
        "scipy": (stats.beta(2.0, 5.0), stats.beta(2.0, 5.0)),
    }


@pytest.mark.parametrize("name", ["normal", "uniform", "log", "lognormal", "triangular", "scipy"])
def test_distributions_have_the_quantiles_of_scipy(name: str) -> None:
    from scipy import stats

    given, expected = build_distributions()[name]
    values = create({"contact.friction": given}, "latin", 4000).values(0, 4000)[:, 0]
    parts = np.array([0.01, 0.1, 0.5, 0.9, 0.99])
    assert np.allclose(np.quantile(values, parts), expected.ppf(parts), rtol=0.02)
    assert (
        stats.kstest(create({"contact.friction": given}, "random", 4000).values(0, 4000)[:, 0], expected.cdf).pvalue
        > 1e-3
    )
    assert values.min() >= 0.0


def test_a_lognormal_has_the_mean_and_deviation_that_are_given() -> None:
    values = create({"contact.friction": build_distributions()["lognormal"][0]}, "latin", 20000).values(0, 20000)
    assert (values.mean(), values.std()) == pytest.approx((0.1, 0.05), rel=0.01)


def test_distributions_are_truncated_at_their_own_limits_and_those_of_the_key() -> None:
    from scipy import stats

    wide = {"distribution": "normal", "mean": 6.0, "std": 50.0}
    speeds = create({"drive.speed_hz": wide}, "random", 500).values(0, 500)
    assert 0.0 <= speeds.min() < speeds.max() <= 15.0  # drive.top_speed
    speeds = create({"drive.speed_hz": {**wide, "from": 5.0, "to": 6.0}}, "random", 500).values(0, 500)
    assert 5.0 <= speeds.min() < speeds.max() <= 6.0
    counts = create({"magnet.count": stats.randint(1, 6)}, "random", 500).values(0, 500)
    assert set(counts[:, 0]) == {3.0, 4.0, 5.0}  # the model needs 3


REFUSED_AXES = [
    ({"contact.frction": [1.0]}, "over.contact.frction must be a field of a scene or a parameter, such as contact.fr"),
    ({"contact.friction": []}, "over.contact.friction.values must be a list of 1 to 1000000 numbers"),
    ({"contact.friction": range(10**9)}, "over.contact.friction.values must be a list of 1 to 1000000 numbers"),
    ({"contact.friction": [10**400]}, "over.contact.friction.values must be a list of 1 to 1000000 numbers"),
    ({"contact.friction": {"from": 0.1, "to": 0.2, "count": "3"}}, "over.contact.friction.count must be a valid int"),
    ({"contact.stiffness": ["1/0"]}, "over.contact.stiffness must be "),
    ({"hammer.direction": ["x"], "hammer.angle_deg": [9.0]}, "over.hammer.direction must be left out with hammer."),
    ({"contact.friction": [[1.0]]}, "over.contact.friction.values must be a list of 1 to 1000000 numbers"),
    ({"contact.friction": [float("nan")]}, "over.contact.friction.values must be a list of 1 to 1000000 numbers"),
    ({"contact.friction": ["0.3 mm"]}, "over.contact.friction must be a number from 0 to 2; received '0.3 mm'"),
    ({"contact.friction": [99.0]}, "over.contact.friction must be a number from 0 to 2; received 99.0"),
    ({"contact.friction": {"from": "0.1 mm", "to": 1, "count": 3}}, "over.contact.friction.from must be a valid"),
    ({"contact.friction": {"from": 0.1, "to": 9.0, "count": 300}}, "over.contact.friction must be a number from"),
    ({"contact.friction": {"from": 0.1, "count": 3}}, "over.contact.friction.to must be given with count"),
    ({"contact.friction": {"from": 0.1, "to": 0.1, "count": 3}}, "over.contact.friction.to must be greater than from"),
    ({"contact.friction": {"from": 0.0, "to": 0.1, "count": 3, "scale": "log"}},
     "over.contact.friction.from must be greater than 0 with scale log"),
    ({"contact.friction": {"from": 0.1}}, "over.contact.friction.values must be given alone"),
    ({"contact.friction": {"values": [0.1], "count": 3}}, "over.contact.friction.values and count must be given alone"),
    ({"contact.friction": {"values": [0.1], "mean": 3}}, "over.contact.friction.mean must be left out with values"),
    ({"contact.friction": {"fromm": 1}}, "over.contact.friction.fromm must be a known field, such as from"),
    ({"contact.friction": {"distribution": "gauss"}}, "over.contact.friction.distribution must be one of uniform"),
    ({"contact.friction": {"distribution": "normal", "mean": 1}}, "over.contact.friction.std must be given with"),
    ({"contact.friction": {"distribution": "normal", "mean": 900, "std": 1}},
     "over.contact.friction must be a distribution with values from 0 to 2"),
    ({"contact.friction": {"distribution": "uniform", "from": -1, "to": 1}},
     "over.contact.friction must be a number from 0 to 2; received -1.0"),
    ({"contact.friction": {"distribution": "normal", "mean": 1, "std": 1, "scale": "log"}},
     "over.contact.friction.scale must be left out with normal"),
    ({"magnet.count": {"distribution": "uniform", "from": 3, "to": 9}}, "over.magnet.count must be a whole number"),
    ({"hammer.foo": [1]}, "over.hammer.foo must be a known field, such as"),
    ({"hammer.force_n": [1e6]}, "over.hammer.force_n must be less than or equal to 1000"),
    ({"hammer.force_n": ["100 N"]}, "over.hammer.force_n must be a valid number; received '100 N'"),
    ({"hammer.at_s": [-1]}, "over.hammer.at_s must be a value that the scene accepts (commands.0.at_s must be"),
    ({"speed.speed_hz": [1]}, "over.speed.speed_hz must be a field of a command that the scene has, such as hammer"),
    ({}, "over must be a table of axes by key, not empty"),
]  # fmt: skip


@pytest.mark.parametrize(("over", "line"), REFUSED_AXES, ids=lambda each: str(each)[:60])
def test_wrong_axes_are_refused_by_name(over: dict[str, Any], line: str) -> None:
    runs = 10 if "distribution" in str(over) else None
    with pytest.raises(InputError) as caught:
        create(over, runs=runs)
    assert str(caught.value).startswith(line), caught.value
    assert "\n" not in str(caught.value)


def test_wrong_designs_are_refused() -> None:
    normal = {"drive.speed_hz": OVER["contact.friction"] | {"mean": 6.0}}
    for over, sampling, runs, line in (
        (normal, "grid", None, "over.drive.speed_hz must be values, or a grid with count"),
        (normal, None, None, "runs must be a whole number from 1 to"),
        (normal, "random", 2**31, "runs must be a whole number from 1 to"),
        (normal, "sobel", 5, "sampling must be one of grid, random, latin, sobol, halton; received 'sobel'"),
        ({"contact.friction": [0.1, 0.2]}, "grid", 3, "runs must be left out with sampling grid, which has 2"),
    ):
        with pytest.raises(InputError) as caught:
            create(over, sampling, runs)
        assert str(caught.value).startswith(line)


def test_a_frozen_distribution_is_of_one_finite_number() -> None:
    from scipy import stats

    for wrong in (stats.norm([0.1, 0.2], 0.1), stats.norm(0.2, -1.0)):
        with pytest.raises(InputError, match=r"^over\.contact\.friction\.distribution must be a distribution of one"):
            Design.create(load_scene("hammer"), {"contact.friction": wrong}, runs=4, sampling=None, seed=1)
