"""The table of units: every quantity, the spellings in files, and names that are refused rather than assumed."""

import math
from pathlib import Path

import numpy as np
import pytest

from replays.score.card.limits import load_limits
from rig.base import units
from rig.base.errors import InputError
from rig.base.samples import Samples
from rig.channels.table import default_table

LB, IN, G = 4.4482216152605, 0.0254, 9.80665

SIZES = {
    "length": {"um": 1e-6, "mil": 25.4e-6, "thou": 25.4e-6, "nm": 1e-9, "ft": 0.3048, "in": IN, "cm": 0.01},
    "force": {"mN": 1e-3, "daN": 10.0, "kN": 1e3, "lbf": LB, "kip": 1e3 * LB, "kgf": G},
    "acceleration": {"mm/s^2": 1e-3, "cm/s^2": 0.01, "um/s^2": 1e-6, "g": G, "mg": 1e-3 * G, "in/s^2": IN},
    "velocity": {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6, "in/s": IN, "mil/s": 25.4e-6, "ft/s": 0.3048},
    "speed of rotation": {"Hz": 2 * math.pi, "rpm": math.pi / 30, "krpm": 100 * math.pi / 3, "deg/s": math.pi / 180},
    "angle": {"deg": math.pi / 180, "rev": 2 * math.pi, "mrad": 1e-3},
    "energy": {"J": 1.0, "kJ": 1e3, "mJ": 1e-3},
    "torque": {"N m": 1.0, "kN m": 1e3, "mN m": 1e-3, "N mm": 1e-3, "lbf ft": 1.3558179483314004,
               "lbf in": 0.1129848290276167, "daN m": 10.0, "kgf m": G},
    "pressure": {"Pa": 1.0, "hPa": 100.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "bar": 1e5, "mbar": 100.0,
                 "psi": 6894.757293168},
    "temperature": {"K": 1.0, "degC": 1.0, "degF": 5 / 9},
    "voltage": {"mV": 1e-3, "uV": 1e-6, "kV": 1e3},
    "current": {"A": 1.0, "mA": 1e-3, "uA": 1e-6},
    "time": {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0},
}  # fmt: skip

SPELLINGS = {
    "um": "UM µm μm micron Microns micrometre",
    "mil": "mils MIL MILS",
    "thou": "THOU Thou",
    "mm": "MM millimeter millimetres",
    "m": "metres METER",
    "in": 'IN inch inches "',
    "N": "newton Newtons",
    "daN": "DAN dan decanewton",
    "kN": "KN kn kilonewtons",
    "lbf": "LBF lb lbs",
    "kgf": "KGF kp",
    "g": "G gn g's gs",
    "m/s^2": "m/s2 M/S2 m/s² m/s**2 m/s/s m·s⁻² m*s^-2 m.s-2 (m/s²) m/sÂ²",
    "mm/s": "MM/S mm·s⁻¹ mm/sec [mm/s]",
    "in/s": "IPS ips in/sec",
    "rpm": "RPM 1/min U/min min-1 min⁻¹ min^-1 rev/min r/min cpm",
    "Hz": "HZ hz 1/s s-1 s⁻¹ rps",
    "deg": "° degrees DEG degree",
    "degC": "°C ℃ DEGC deg_C Celsius ˚C",
    "degF": "°F Fahrenheit",
    "N m": "Nm N·m N.m N*m N⋅m",
    "lbf in": "in-lb in·lbf lbf.in",
    "bar": "BAR Bar",
    "s": "S sec SEC seconds",
    "ms": "MS msec Msec milliseconds",
    "min": "MIN mins minutes Minute",
    "h": "H hr hrs hours",
    "d": "days Day D",
    "1": "- none [-] V/V",
}


@pytest.mark.parametrize(("quantity", "name", "size"), [(q, n, s) for q, row in SIZES.items() for n, s in row.items()])
def test_a_unit_has_its_quantity_and_its_size(quantity: str, name: str, size: float) -> None:
    assert units.get_quantity(name) == quantity
    assert units.size_si(name) == pytest.approx(size, rel=1e-12)
    assert units.parse(name, field="x") == name


def test_any_unambiguous_spelling_is_the_unit() -> None:
    wrong = {text: units.canonical(text) for name, row in SPELLINGS.items() for text in row.split()
             if units.canonical(text) != name}  # fmt: skip
    assert not wrong
    assert units.canonical("m s-2") == "m/s^2"
    assert units.canonical("u/  min") == "rpm"
    assert units.canonical(" N m ") == units.canonical("n-m") == "N m"
    assert units.canonical("") == "1"


def test_every_quantity_has_its_si_unit() -> None:
    si = {units.get_quantity(name): units.get_si_unit(name) for row in SIZES.values() for name in row}
    assert all(units.size_si(name) == 1.0 and units.get_si_unit(name) == (name, 1.0, 0.0) for name, _, _ in si.values())
    assert si["speed of rotation"][0] == "rad/s"
    assert set(si) == set(units.QUANTITIES) - {"number"}


def test_every_unit_of_the_table_is_found_by_its_own_name() -> None:
    for row in SIZES.values():
        assert [units.canonical(name) for name in row] == list(row)


@pytest.mark.parametrize(
    ("text", "choices"),
    [("M", "m or min"), ("MN", "mN or meganewton"), ("MV", "mV or megavolt"), ("MG", "mg or megagram"),
     ("C", "degC or coulomb"), ("F", "degF or farad"), ("NM", "N m or nm"), ("MPA", "MPa or mPa"), ("k", "K or kilo")],
)  # fmt: skip
def test_an_ambiguous_spelling_is_no_unit_and_the_choices_are_named(text: str, choices: str) -> None:
    assert not units.is_known(text)
    assert units.get_quantity(text) == ""
    with pytest.raises(InputError, match=f"x must be unambiguous: {choices}; received '{text}'"):
        units.parse(text, field="x")
    with pytest.raises(InputError, match="unambiguous"):
        units.factor(text, "mm", field="x")


@pytest.mark.parametrize(
    ("text", "unit"),
    [("mm/s rms", "mm/s"), ("mm/s (RMS)", "mm/s"), ("um pk-pk", "um"), ("mils pk-pk", "mil"), ("mil pp", "mil"),
     ("Vrms", "V"), ("grms", "g"), ("g pk", "g"), ("µm p-p", "um"), ("um 0-pk", "um"),
     ("mm peak to peak", "mm"), ("Vpp", "V")],
)  # fmt: skip
def test_a_detectors_suffix_must_be_explained_and_is_never_dropped(text: str, unit: str) -> None:
    assert not units.is_known(text)
    with pytest.raises(InputError, match=f"such as {unit} .* is the reading of a detector"):
        units.parse(text, field="x")
    with pytest.raises(InputError, match="detector"):
        units.factor(text, unit, field="x")


@pytest.mark.parametrize(
    "text", ["bananas", "counts", "%", "peak", "_", "*", "x", "kk", "dB", "bananas rms", "M pk-pk"]
)
def test_an_unknown_unit_is_refused_with_its_spelling(text: str) -> None:
    with pytest.raises(InputError, match=r"x must be a known unit.*received"):
        units.parse(text, field="x")


def test_temperatures_with_an_offset_are_not_scaled() -> None:
    assert units.factor("°C", "degC", field="x") == 1.0
    with pytest.raises(InputError, match="x must be degC, as degF counts from another zero"):
        units.factor("degF", "degC", field="x")
    rows = Samples(
        "t", np.zeros(1), np.zeros(1), np.array([[212.0, 100.0, 1.0]]), ("a", "b", "c"), ("degF", "degC", "mm"), 1
    )
    si = rows.to_si()
    assert si.units == ("K", "K", "m")
    np.testing.assert_allclose(si.values, [[373.15, 373.15, 1e-3]], rtol=1e-14)


def test_limits_apply_to_a_channel_of_velocity(tmp_path: Path) -> None:
    velocity = default_table().channels["inner_x"].model_copy(update={"unit": "mm/s"})
    bounds = load_limits("iso-20816").bounds("analogue", "gain", velocity)
    assert bounds is not None
    assert (bounds.low, bounds.high) == (-1e5, 1e5)
    path = tmp_path / "own.toml"
    text = 'title = "own"\n[analogue]\n"gain" = {{ high = 5.0, kind = "assumed", source = "own", measures = "{}" }}\n'
    path.write_text(text.format("velocity"), encoding="utf-8")
    limits = load_limits(path)
    expected = {"mm/s": True, "IPS": True, "m s-1": True, "mm": False, "m/s^2": False, "?": False}
    for unit, applies in expected.items():
        channel = velocity.model_copy(update={"unit": unit})
        assert (limits.bounds("analogue", "gain", channel) is not None) == applies, unit
    path.write_text(text.format("velocty"), encoding="utf-8")
    with pytest.raises(InputError, match=r"own.toml: analogue.gain.measures must be a kind of unit.* velocity"):
        load_limits(path)


@pytest.mark.parametrize(
    ("text", "target", "volts"),
    [("7.87 V/mm", "mm", 7.87), ("200 mV/mil", "mm", 200e-3 / 0.0254), ("-100 mV/g", "m/s^2", -0.1 / 9.80665),
     ("1e2mV/g", "g", 0.1), ("4 V/(in/s)", "mm/s", 4.0 / 25.4), (" 2.25 mV / N", "kN", 2.25)],
)  # fmt: skip
def test_a_sensitivity_is_in_volts_per_unit_of_the_channel(text: str, target: str, volts: float) -> None:
    assert units.sensitivity_v(text, target, field="x") == pytest.approx(volts, rel=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "7.87",
        "V/mm",
        "0 V/mm",
        "-0.0 mV/mm",
        "1e999 V/mm",
        "1e V/mm",
        "-+ V/mm",
        "3 mm/V",
        "2 A/mm",
        "2 bananas/mm",
    ],
)
def test_invalid_sensitivities_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r'x must be volts per unit, such as "7.87 V/mm"'):
        units.sensitivity_v(text, "mm", field="x")


def test_a_sensitivity_of_another_quantity_is_refused_with_valid_units() -> None:
    for text in ("1 V/N", "1 V/bananas", "1 V/M"):
        with pytest.raises(InputError, match=r"x must be volts per unit of length \(m, cm, .*thou.*\); received"):
            units.sensitivity_v(text, "mm", field="x")
    with pytest.raises(InputError, match="x must be volts per bananas; received"):
        units.sensitivity_v("1 V/mm", "bananas", field="x")
    with pytest.raises(InputError, match="x must be K, as degF counts from another zero"):
        units.sensitivity_v("10 mV/degF", "K", field="x")


def test_factors_between_units_are_ratios_of_their_sizes() -> None:
    scaled = {q: row for q, row in SIZES.items() if q != "temperature"}
    for row in scaled.values():
        for one, size in row.items():
            for other, another in row.items():
                assert units.factor(one, other, field="x") == pytest.approx(size / another, rel=1e-12), (one, other)
    assert units.factor("bananas", "bananas", field="x") == 1.0


def test_an_unconvertible_unit_is_refused_with_valid_ones() -> None:
    with pytest.raises(InputError, match="x must be bananas, the unit of the channel, which has no conversion"):
        units.factor("mm", "bananas", field="x")
    with pytest.raises(InputError, match=r"x must be a unit of length \(m, cm, [^)]*\); received 'N'"):
        units.factor("N", "mm", field="x")
    with pytest.raises(InputError, match=r"x must be a unit of length \(m, cm, [^)]*\), with a sensitivity; received"):
        units.factor("mV", "mm", field="x")
    with pytest.raises(InputError, match=r"one of m, cm, .*, or V or mV with a sensitivity \(such as thou\)"):
        units.factor("thou2", "mm", field="x")
    with pytest.raises(InputError, match=r"or V or mV with a sensitivity; received 'bananas'"):
        units.factor("bananas", "mm", field="x")


def test_a_plural_name_is_a_unit_but_not_a_plural_symbol() -> None:
    plurals = {"mils": "mil", "volts": "V", "Newtons": "N", "gs": "g", "lbs": "lbf", "hrs": "h", "metres": "m"}
    assert {text: units.canonical(text) for text in plurals} == plurals
    assert [text for text in ("Vs", "mVs", "as", "Ks", "HRSs") if units.is_known(text)] == []
