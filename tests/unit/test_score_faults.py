"""Every fault of a channel makes its declared rows fail, on its own channels, and no others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.can.signals import messages_for
from recorder.reader import Recording
from replays.score.card.scorecard import FAIL, Scorecard
from replays.score.judgement import judge
from replays.sessions.session import FOLDER
from rig.channels.faults.defects import DEFECTS
from rig.channels.faults.kind import Setting
from rig.channels.sensors.conditioning import Conditioner
from rig.channels.table import default_table
from rig.physics.kernels.observe import EDGE_WIDTH, KEYPHASOR_WIDTH
from rig.physics.kernels.signals import COLUMN, N_ROW
from rig.run.commands.table import FaultCommand
from rig.run.fault_injection import FaultInjector
from tests.fault_cases import DEFECT_OF, SCORED, size_of
from tests.score_daqs import Tones, write_parquet, write_session

RATE_HZ, ROWS_HZ, SECONDS, TURN_HZ = 20_000, 100_000, 0.5, 15.0
GROUPS = [default_table().groups[name] for name in ("probes", "forces", "accelerations", "drive")]
CHANNELS = [channel for group in GROUPS for channel in group.channels if channel.name != "speed"]
REQUESTED_CHANNELS = [channel.name for channel in CHANNELS]


SIZED_KINDS = ("gain", "offset", "late", "clock", "jitter", "crosstalk")
"""Kinds with the size of a quantity of the scorecard."""
Sessions = dict[bool, tuple[Path, dict[str, np.ndarray]]]


class Rig:
    """Tones in place of the physics, fed through the sensors' chains."""

    def __init__(self) -> None:
        t = np.arange(round(SECONDS * ROWS_HZ) + 1) / ROWS_HZ
        self.rows = np.zeros((len(t), N_ROW))
        angle = self.rows[:, COLUMN["theta"]] = 2.0 * np.pi * TURN_HZ * t
        self.rows[:, COLUMN["theta_rate"]] = 2.0 * np.pi * TURN_HZ
        ahead = (angle + np.pi) % (2.0 * np.pi) - np.pi
        self.rows[:, COLUMN["keyphasor"]] = np.clip(
            0.5 + np.minimum(ahead, KEYPHASOR_WIDTH - ahead) / EDGE_WIDTH, 0.0, 1.0
        )
        tones = [c for group in GROUPS for c in group.channels if c.name != "keyphasor"]
        self.made = np.column_stack([
            Tones(n, c.si / abs(c.sensitivity_v), high_hz=2500.0, tones=80)(t) for n, c in enumerate(tones)
        ])  # fmt: skip
        places = {channel.name: N_ROW + n for n, channel in enumerate(tones)} | {"keyphasor": COLUMN["keyphasor"]}
        self.columns = [places[name] for group in GROUPS for name in group.names]

    def counts(self, faults: tuple[str, ...], *, noisy: bool) -> dict[str, np.ndarray]:
        """Return counts by group with faults from the beginning."""
        chain = Conditioner(GROUPS, row_rate_hz=ROWS_HZ, seed=2, noise=noisy, columns=self.columns)
        faulty = FaultInjector(default_table(), [chain], seed=2, row_ticks=10, setting=Setting())
        for kind in faults:
            command = {"channel": SCORED[kind].channel, "kind": kind, **SCORED[kind].numbers}
            faulty.begin(FaultCommand.model_validate(command), 0, [])
        return faulty.counts(self.rows, self.made, 0)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig()


@pytest.fixture(scope="module")
def sessions(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Sessions:
    """Sessions without faults, without noise and with it, and their counts."""
    folder, counts = tmp_path_factory.mktemp("sent"), {noisy: rig.counts((), noisy=noisy) for noisy in (False, True)}
    return {noisy: (write_session(folder / f"{noisy}.mcap", each), each) for noisy, each in counts.items()}


def red(card: Scorecard) -> set[tuple[str, str]]:
    return {(row.channel, row.quantity) for row in card.rows if row.verdict == FAIL}


def declared(kinds: tuple[str, ...], what: set[str] | None = None) -> set[tuple[str, str]]:
    return {(name, row) for kind in kinds for name in names_of(kind) for row in what or DEFECTS[DEFECT_OF[kind]].score}


def write_daq(
    path: Path, counts: dict[str, np.ndarray], change: Callable[[dict[str, np.ndarray]], Any] = lambda _: None
) -> Path:
    """Write a file of volts."""
    columns = {"time [s]": np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ}
    for group in GROUPS:
        for n, channel in enumerate(group.channels):
            if channel in CHANNELS:
                columns[f"{channel.name} [V]"] = counts[group.name][:, n] * channel.lsb_v
    change(columns)
    return write_parquet(path, columns)


def names_of(kind: str) -> set[str]:
    return {SCORED[kind].channel, SCORED[kind].numbers.get("other", SCORED[kind].channel)}


def group_kinds(most: int) -> list[tuple[str, ...]]:
    """Return sets of at most `most` kinds, no two of which are on one channel."""
    sets: list[tuple[str, ...]] = []
    for kind in SCORED:
        candidates = [
            n
            for n, each in enumerate(sets)
            if len(each) < most and names_of(kind).isdisjoint(set().union(*map(names_of, each)))
        ]
        if candidates:
            sets[candidates[0]] += (kind,)
        else:
            sets.append((kind,))
    return sets


@pytest.mark.parametrize("kinds", group_kinds(13), ids=len)
def test_a_daq_with_its_own_clock(kinds: tuple[str, ...], rig: Rig, sessions: Sessions, tmp_path: Path) -> None:
    card = judge(
        write_daq(tmp_path / "daq.parquet", rig.counts(kinds, noisy=True)),
        [sessions[False][0]],
        path="analogue",
        channels=REQUESTED_CHANNELS,
    )
    assert red(card) == declared(kinds)
    for kind in kinds:
        name, numbers = SCORED[kind]
        defect = DEFECTS[DEFECT_OF[kind]]
        if defect.score:
            assert DEFECT_OF[kind] in card.defects[name], f"{kind} of {name}"
            row, size = card.row(defect.score[0], name), size_of(kind, numbers, name)
            if size is not None and kind in SIZED_KINDS:
                size *= {("", "ppm"): 1e6, ("s", "ns"): 1e9}.get((defect.unit, row.unit), 1.0)
                size = -size if row.quantity == "skew" else size  # late samples show an earlier time
                assert row.low <= size <= row.high, f"{kind} of {name}"


@pytest.mark.parametrize("kinds", group_kinds(5), ids=len)
def test_a_daq_that_records_counts(kinds: tuple[str, ...], rig: Rig, sessions: Sessions, tmp_path: Path) -> None:
    card = judge(
        write_daq(tmp_path / "daq.parquet", rig.counts(kinds, noisy=True)),
        [sessions[True][0]],
        channels=REQUESTED_CHANNELS,
    )
    assert card.path == "digital"
    assert red(card) == declared(kinds, {"altered values"})


ROWS = np.arange(round(SECONDS * RATE_HZ))
LATE_BLOCK_ROWS = np.r_[ROWS[:4000], ROWS[4200:4400], ROWS[4000:4200], ROWS[4400:5000], 5001, 5000, ROWS[5002:]]


def swapped(columns: dict[str, np.ndarray]) -> None:
    columns["disk_y [V]"], columns["P_E [V]"] = columns["P_E [V]"], columns["disk_y [V]"]


def changed(name: str, times: float = 1.0, plus: Any = 0.0) -> Callable[[dict[str, np.ndarray]], None]:
    def change(columns: dict[str, np.ndarray]) -> None:
        columns[name] = times * columns[name] + plus

    return change


def picked(rows: np.ndarray) -> Callable[[dict[str, np.ndarray]], None]:
    def pick(columns: dict[str, np.ndarray]) -> None:
        columns.update({name: values[rows] for name, values in columns.items()})

    return pick


WRONG = (changed("disk_x [V]", 1.0005), changed("P_N [V]", plus=0.25), changed("P_S [V]", -1.0), swapped)
BACKWARD_STAMPS, ALL = ("all groups", "stamps that go back"), "all groups"
FILE_DEFECTS: dict[str, tuple[Callable[[dict[str, np.ndarray]], Any], set[tuple[str, str]]]] = {
    "sound": (lambda _: None, set()),
    "a row and a block lost": (picked(np.delete(ROWS, np.r_[4321, 6000:6200])), {(ALL, "missing rows")}),
    "a block twice": (picked(np.insert(ROWS, 4200, ROWS[4000:4200])), {(ALL, "doubled rows"), BACKWARD_STAMPS}),
    "a block late, and two rows swapped": (picked(LATE_BLOCK_ROWS), {(ALL, "swapped rows"), BACKWARD_STAMPS}),
    "wrong sensitivity, zero, sign and wires": (
        lambda columns: [change(columns) for change in WRONG],
        {("disk_x", "scale"), ("P_N", "offset"), ("P_S", "polarity"), ("disk_y", "mapping"), ("P_E", "mapping")},
    ),
    "a fast clock of the stamps": (changed("time [s]", 1.0003), {(ALL, "stamp rate")}),
    "stale stamps": (changed("time [s]", plus=-0.01 * (ROWS % 200 == 150)), {BACKWARD_STAMPS}),
}


@pytest.mark.parametrize(("suffix", "fd"), [(".log", True), (".asc", False), (".blf", True)])
def test_a_logger_of_a_can_bus(suffix: str, fd: bool, sessions: Sessions, tmp_path: Path) -> None:
    """Every n-th row, in classic frames of the upper 16 bits: the received rows are exact, and a lost frame is
    named.
    """
    import can

    session, counts = sessions[True]
    table = messages_for(default_table())
    message = next(each for each in (table.fd if fd else table.classic) if "disk_x" in str(each.signals))
    form, step = message.samples, 2 if fd else 20
    assert form is not None
    rows = counts["probes"][40::step][:, : len(form.channels)]
    first = np.arange(0, len(rows) - form.rows, form.rows)
    rows = rows[: len(first) * form.rows]
    with can.Logger(tmp_path / f"bus{suffix}") as log:
        for n, data in enumerate(
            form.pack(40 // (1 if fd else step) + first * (step if fd else 1), rows, message.length)
        ):
            if n != len(first) // 2:
                settings: Any = {
                    "is_fd": fd,
                    "is_extended_id": False,
                    "timestamp": 1e9 + n * form.rows * step / RATE_HZ,
                }
                log(can.Message(arbitration_id=message.identifier, data=data.tobytes(), **settings))
    card = judge(tmp_path / f"bus{suffix}", [session], channels=[channel.name for channel in form.channels])
    assert red(card) == {("probes", "missing rows")}
    lost = 40 + len(first) // 2 * form.rows * step
    assert card.runs == {"missing rows probes": [(lost, lost + (form.rows - 1) * step)]}


@pytest.mark.parametrize("defect", FILE_DEFECTS)
def test_defects_of_the_daqs_file(defect: str, sessions: Sessions, tmp_path: Path) -> None:
    (session, counts), (change, declares) = sessions[True], FILE_DEFECTS[defect]
    assert (
        red(judge(write_daq(tmp_path / "daq.parquet", counts, change), [session], channels=REQUESTED_CHANNELS))
        == declares
    )


def test_stamps_of_the_computers_clock_show_latency(sessions: Sessions, tmp_path: Path) -> None:
    session, counts = sessions[True]
    late_s = 3e-3 + 1e-4 * np.random.default_rng(3).standard_normal(len(ROWS))
    row = judge(write_daq(tmp_path / "daq.parquet", counts, changed("time [s]", plus=1.7e9 + late_s)), [session]).row(
        "latency", ALL
    )
    assert row.low < late_s.mean() < row.high < row.low + 2e-5


def test_a_recording_triggered_by_a_command_has_the_commands_row(tmp_path: Path) -> None:
    session = FOLDER / "hammer-3.2.mcap"
    with Recording.open(session) as recording:
        samples, (tick,) = recording.samples("forces"), [e["tick"] for e in recording.events if e["event"] == "hammer"]
    row = round(tick * 1e-6 * samples.rate_hz)
    columns = {f"{name} [N]": samples[name][row - 40 :] for name in samples}
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert card.row("trigger row", "forces").value == 40
