"""Guesses for a population of logs of another simulator, drawn by seed.

By default one log each of a few families; `GUESS_LOGS=4 pytest tests/unit/test_guess_population.py -s` draws that many
of every family and prints a line per family.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from replays.recordings.formats.guessing.guess import Guess, guess_channels
from replays.recordings.formats.guessing.template import CHECK, guess_mapping, write_text
from replays.recordings.formats.source import Source
from tests import log_population
from tests.log_population import BARE, HELD_OUT_NAMES, KNOWN, Log

PER_FAMILY = int(os.environ.get("GUESS_LOGS", "1"))
QUICK = ("american", "short", "dutch", "bare")


def guess_log(log: Log) -> tuple[Source, list[Guess]]:
    stored = {id(entry): signal for entry, signal in zip(log.entries, log.signals, strict=True)}
    source = Source(Path("log.csv"), "text", tuple(log.entries), lambda entry: stored[id(entry)])
    return source, guess_channels([source])


@pytest.fixture(scope="module")
def population() -> list[tuple[Log, Source, list[Guess]]]:
    motions = log_population.simulate_motions(1 if PER_FAMILY == 1 else 3)
    families = QUICK if PER_FAMILY == 1 else [*KNOWN, *HELD_OUT_NAMES]
    logs = [log_population.draw_log(motions, family, seed) for family in families for seed in range(PER_FAMILY)]
    return [(log, *guess_log(log)) for log in logs]


def test_most_channels_of_a_population_are_right_and_none_is_wrong_and_sure(
    population: list[tuple[Log, Source, list[Guess]]],
) -> None:
    counts: dict[str, np.ndarray] = {}
    for log, _, guesses in population:
        for channel, each in zip(log.truth, guesses, strict=True):
            right, sure = each.channel == channel, each.confidence == "sure"
            assert right or not sure, (log.family, each.entry.name, channel, each.channel, each.why)
            row = counts.setdefault(log.family, np.zeros(3, dtype=int))
            row += [1, right, right and sure]
    for family, (whole, right, sure) in counts.items():
        print(f"{family:12s} {right} of {whole} right, {sure} of them sure")
    groups = {
        "named": [row for family, row in counts.items() if family not in BARE],
        "held out": [row for family, row in counts.items() if family in HELD_OUT_NAMES and family not in BARE],
        "bare": [row for family, row in counts.items() if family in BARE],
    }
    for group, rows in groups.items():
        whole, right, sure = np.sum(rows, axis=0)
        print(f"{group}: {right / whole:.1%} right, {sure / right:.1%} of these sure")
        assert right >= 0.9 * whole, group
    whole, right, sure = np.sum(list(counts.values()), axis=0)
    print(f"all: {right / whole:.1%} right, {sure / right:.1%} of these sure")
    assert sure >= 0.6 * right


def test_a_mapping_asks_at_most_ten_questions(population: list[tuple[Log, Source, list[Guess]]]) -> None:
    from replays.recordings.formats.guessing.attachments import Attachments

    for log, source, guesses in population:
        text = write_text([source], {source.path: Attachments()}, guesses)
        assert 1 <= text.count(CHECK) <= 10, log.family
        if log.family in BARE:  # a mirrored rig gives the same signals
            assert "[channels.disk_x]    # PLEASE CHECK: or disk_y; the name has no axis" in text or "or ring_" in text


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> None:
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", comments="", fmt="%.9f",
               header=",".join(columns))  # fmt: skip


T = np.arange(4000) / 2000
TURN = 2.0 * np.pi * 6.0 * T


@pytest.mark.parametrize(
    ("head", "scale", "unit", "confidence", "question"),
    [
        ("disk_x [UM]", 1e3, None, "sure", ""),
        ("disk_x [mm]", 1e3, None, "likely", "800 mm is not plausible: the ring's clearance is 0.93 mm"),
        ("disk_x", 1e3, "um", "likely", "the file has none"),
        ("probe_dx_mil", 1e3 / 25.4, "mil", "sure", ""),
        ("disk_x [mil pp]", 2e3 / 25.4, "mil", "likely", "pp is the reading of a detector; samples may need a factor"),
        ("disk_x [furlong]", 1.0, "mm", "likely", "the file says 'furlong'"),
    ],
)
def test_a_unit_that_is_not_understood_or_implausible_is_asked(
    head: str, scale: float, unit: str | None, confidence: str, question: str, tmp_path: Path
) -> None:
    write_csv(tmp_path / "x.csv", {"time [s]": T, head: 0.8 * scale * np.cos(TURN)})
    _, (found,) = guess_mapping([tmp_path / "x.csv"])
    assert (found.channel, found.confidence) == ("disk_x", confidence)
    assert found.asks.get("unit", "") == question
    if unit is not None:
        assert found.own_unit == unit


@pytest.mark.parametrize(("head", "scale", "sure"), [("P_E [daN]", 0.1, True), ("P_E [kN]", 1.0, False)])
def test_a_preload_of_any_unit_must_be_plausible(head: str, scale: float, sure: bool, tmp_path: Path) -> None:
    write_csv(tmp_path / "x.csv", {"time [s]": T, head: scale * (3000.0 + np.cos(TURN))})
    _, (found,) = guess_mapping([tmp_path / "x.csv"])
    assert (found.channel, found.confidence == "sure", "unit" in found.asks) == ("P_E", sure, not sure)


def test_the_mean_is_taken_off_both_probes_or_neither_and_never_surely(tmp_path: Path) -> None:
    write_csv(tmp_path / "x.csv", {
        "time [s]": T, "disk_x [mm]": 0.7 + 0.1 * np.cos(TURN), "disk_y [mm]": -0.3 + 0.1 * np.sin(TURN),
        "ring_x [mm]": 0.1 + 0.1 * np.cos(TURN), "ring_y [mm]": 0.1 * np.sin(TURN),
    })  # fmt: skip
    text, guesses = guess_mapping([tmp_path / "x.csv"])
    assert [each.bias for each in guesses] == ["mean", "mean", None, None]
    assert [each.confidence for each in guesses] == ["likely", "likely", "sure", "sure"]
    assert text.count(f'bias = "mean"    # {CHECK}: the zero of the disk\'s probes is not known') == 1


def test_a_speed_that_dips_is_no_keyphasor_and_a_tach_with_even_pulses_is(tmp_path: Path) -> None:
    dips = np.where((T > 0.8) & (T < 0.83) | (T > 1.1) & (T < 1.13), 5.2, 6.0)
    write_csv(tmp_path / "x.csv", {"time [s]": T, "SPEED": dips, "TACH": (TURN % (2 * np.pi) < 0.2).astype(float)})
    _, guesses = guess_mapping([tmp_path / "x.csv"])
    assert [each.channel for each in guesses] == ["speed", "keyphasor"]
