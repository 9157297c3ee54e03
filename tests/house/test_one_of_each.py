"""Each mechanism of estimation has one home: the syntax tree shows a second one, and the failure names the first.

A module with a reason for its own is listed in `EXCEPTIONS`. Fits and intervals written out by hand, as a loop over
residuals, are not detected.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest

from tests.house.test_sizes import ROOT, is_generated, paths

HOMES = {
    "a Student t, normal or chi squared distribution": "replays/estimate/intervals.py",
    "a least-squares solution": "replays/estimate/least_squares.py",
    "a Welch spectrum or a Fourier transform": "replays/estimate/spectra.py",
}
T, SQUARES, SPECTRUM = HOMES
TRANSFORMS = (
    "fft",
    "ifft",
    "rfft",
    "irfft",
    "fft2",
    "fftn",
    "rfftn",
    "hfft",
    "fftfreq",
    "rfftfreq",
    "fftshift",
    "dct",
    "dst",
)
LIBRARY = {
    **dict.fromkeys((f"scipy.stats.{name}" for name in ("t", "norm", "chi2", "f", "multivariate_normal")), T),
    **dict.fromkeys((f"scipy.special.{name}" for name in ("stdtrit", "chdtri", "ndtri", "fdtri", "erfinv")), T),
    **dict.fromkeys((f"numpy.{name}" for name in ("linalg.lstsq", "linalg.pinv", "polyfit")), SQUARES),
    **dict.fromkeys((f"numpy.polynomial.{name}" for name in ("Polynomial.fit", "polynomial.polyfit")), SQUARES),
    **dict.fromkeys((f"scipy.linalg.{name}" for name in ("lstsq", "pinv")), SQUARES),
    **dict.fromkeys(
        (f"scipy.optimize.{name}" for name in ("least_squares", "leastsq", "curve_fit", "lsq_linear", "nnls")), SQUARES
    ),
    "scipy.stats.linregress": SQUARES,
    **dict.fromkeys(
        (f"scipy.signal.{name}" for name in ("welch", "csd", "coherence", "periodogram", "spectrogram", "stft")),
        SPECTRUM,
    ),
    **dict.fromkeys((f"{name}.{one}" for name in ("numpy.fft", "scipy.fft") for one in TRANSFORMS), SPECTRUM),
}
"""Names of a library that belong to each mechanism, with everything below them."""
NORMAL = "normal equations"
EXCEPTIONS = {
    ("recorder/health.py", SPECTRUM): "the recorder is below the replays and cannot import them",
    ("rig/channels/generators.py", SPECTRUM): "makes a signal of a given spectrum, and estimates nothing",
    ("rig/channels/orbit.py", SPECTRUM): "the one two-sided spectrum of an orbit, also for the recorder's viewer",
    ("rig/channels/orbit.py", SQUARES): "figures of an orbit, also for the recorder, which cannot import the replays",
    ("rig/ensemble/axes.py", T): "draws values of a distribution that the user declares, and estimates nothing",
    ("rig/physics/accuracy.py", SQUARES): "a closed form below the replays",
    ("rig/physics/magnets.py", SQUARES): "coefficients of a force law below the replays",
    ("replays/estimate/intervals.py", SPECTRUM): "a cosine transform of 256 sums, by which a slow wander is found",
    ("replays/recordings/identification/fit.py", SQUARES): "bounds and a robust loss, which Gauss and Newton's has not",
    (
        "replays/recordings/validation/explanations/channel_fit.py",
        SQUARES,
    ): "laws in closed form from many starts: MINPACK",
    ("replays/score/records/stimulus.py", SPECTRUM): "a filter by time and frequency, there and back",
}
"""Modules with their own implementation, each with the reason."""


def get_import_names(tree: ast.Module) -> dict[str, str]:
    """Return the full names of the imports of a module, by local name."""
    found: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for one in node.names:
                found[one.asname or one.name.split(".")[0]] = one.name if one.asname else one.name.split(".")[0]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {one.asname or one.name: f"{node.module}.{one.name}" for one in node.names}
    return found


def full_name(node: ast.AST, names: dict[str, str]) -> str:
    """Return the full name of an attribute or a name; "" for anything else."""
    if isinstance(node, ast.Attribute):
        return f"{before}.{node.attr}" if (before := full_name(node.value, names)) else ""
    return names.get(node.id, "") if isinstance(node, ast.Name) else ""


def is_normal(node: ast.AST, names: dict[str, str]) -> bool:
    """Return whether a call inverts or solves a product of a transposed matrix and a matrix."""
    return (
        isinstance(node, ast.Call)
        and full_name(node.func, names) in ("numpy.linalg.inv", "numpy.linalg.solve", "scipy.linalg.inv")
        and any(
            isinstance(part, ast.BinOp)
            and isinstance(part.op, ast.MatMult)
            and isinstance(part.left, ast.Attribute)
            and part.left.attr == "T"
            for part in ast.walk(node.args[0])
        )
    )


def find_mechanisms(tree: ast.Module) -> Iterator[tuple[int, str, str]]:
    """Yield uses of a library's mechanisms: line, mechanism, full name."""
    names = get_import_names(tree)
    for node in ast.walk(tree):
        name = full_name(node, names)
        yield from ((node.lineno, LIBRARY[one], name) for one in LIBRARY if f"{name}.".startswith(f"{one}."))
        if is_normal(node, names):
            yield node.lineno, SQUARES, NORMAL  # pyright: ignore[reportAttributeAccessIssue]


def find_second_homes() -> dict[tuple[str, str], str]:
    """Return mechanisms outside their homes: the first place, by path and mechanism."""
    found: dict[tuple[str, str], str] = {}
    for path in paths():
        if is_generated(path):
            continue
        for line, mechanism, name in find_mechanisms(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
            if path != HOMES[mechanism]:
                home = HOMES[mechanism]
                found.setdefault((path, mechanism), f"{path}:{line} has {mechanism} of its own ({name}): use {home}")
    return found


def test_each_mechanism_of_estimation_has_one_home() -> None:
    found = find_second_homes()
    wrong = [text for place, text in found.items() if place not in EXCEPTIONS]
    wrong += [
        f"{path} no longer has {mechanism}: take it off EXCEPTIONS" for path, mechanism in EXCEPTIONS.keys() - found
    ]
    assert not wrong, "\n".join(wrong)


def test_homes_contain_their_mechanism() -> None:
    for mechanism, home in HOMES.items():
        tree = ast.parse((ROOT / home).read_text(encoding="utf-8"))
        assert any(found == mechanism for _, found, _ in find_mechanisms(tree)), f"{home} has no {mechanism}"


@pytest.mark.parametrize(
    ("text", "mechanism"),
    [
        ("from scipy.stats import t\nt.ppf(0.975, 3)", T),
        ("from scipy.stats import t as students\nhalf = students.ppf", T),
        ("import scipy.stats\nscipy.stats.chi2.ppf(0.5, 2)", T),
        ("from scipy import stats\nstats.norm.ppf(0.975)", T),
        ("from scipy.special import stdtrit\nstdtrit(3, 0.975)", T),
        ("import numpy as np\nnp.linalg.lstsq(a, b)", SQUARES),
        ("from numpy import linalg\nlinalg.pinv(a)", SQUARES),
        ("import numpy\nnumpy.polynomial.Polynomial.fit(x, y, 1)", SQUARES),
        ("from numpy.polynomial import Polynomial\nPolynomial.fit(x, y, 1)", SQUARES),
        ("def f():\n    from scipy.optimize import curve_fit\n    return curve_fit", SQUARES),
        ("import numpy as np\nnp.linalg.inv(a.T @ a) @ (a.T @ b)", SQUARES),
        ("import numpy as np\nnp.linalg.solve(a.T @ a + c, a.T @ b)", SQUARES),
        ("from scipy.signal import welch\nwelch(x)", SPECTRUM),
        ("from scipy import signal\nsignal.periodogram(x)", SPECTRUM),
        ("import numpy as np\nnp.fft.rfftfreq(8, 1.0)", SPECTRUM),
        ("from numpy.fft import rfft\nrfft(x)", SPECTRUM),
        ("from scipy import fft\nfft.dct(x)", SPECTRUM),
    ],
)
def test_a_second_implementation_is_found_with_any_form_of_import(text: str, mechanism: str) -> None:
    assert {found for _, found, _ in find_mechanisms(ast.parse(text))} == {mechanism}


@pytest.mark.parametrize(
    "text",
    [
        "from scipy.stats import qmc\nqmc.Sobol(2)",
        "from scipy.fft import next_fast_len\nnext_fast_len(9)",
        "import numpy as np\nnp.linalg.inv(a)",
        "from rig.x import lstsq\nlstsq(a)",
        "t = 3.0\nt.ppf",
        "from scipy.signal import correlate\ncorrelate(a, b)",
    ],
)
def test_similar_code_is_not_reported(text: str) -> None:
    assert not list(find_mechanisms(ast.parse(text)))
