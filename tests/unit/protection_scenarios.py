"""Requirements of a protection monitor as scenarios with hand-computed rows, for the real one and for mutants.

Rows are 1 ms apart. `make_swing` makes a signal with a peak-to-peak over two rows specified row by row: the times
above a set point are exact: if its amplitude steps at row n, the level is half way at n and complete at n + 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from drivers.protection import Settings
from drivers.sources.samples import Samples

RATE = 1000.0
SCENARIOS: dict[str, Callable[[Any], None]] = {}
"""Scenario by name: takes a device (`Protection`, `act`, `protect`), raises AssertionError if it is wrong."""


def scenario(function: Callable[[Any], None]) -> Callable[[Any], None]:
    SCENARIOS[function.__name__] = function
    return function


def settings(**changes: Any) -> Settings:
    base = {
        "alert_um": 500.0, "danger_um": 1000.0, "alert_delay_s": 0.0, "danger_delay_s": 0.0, "hysteresis": 0.0,
        "window_s": 0.002, "corner_hz": 1e-6, "ok_recovery_s": 0.5, "startup_s": 0.0,
    }  # fmt: skip
    return Settings(**{**base, **changes})


def make_swing(rows: int, *steps: tuple[int, float]) -> np.ndarray:
    """Return a signal [mm] with steps of its level, each a row and the level from there on [um]."""
    level = np.zeros(rows)
    for row, um in steps:
        level[row:] = um
    return 0.5e-3 * level * (-1.0) ** np.arange(rows)


def pulses(rows: int, *begins: int, length: int = 10) -> np.ndarray:
    signal = np.zeros(rows)
    for row in begins:
        signal[row : row + length] = 1.0
    return signal


def samples(first: int = 0, **channels: Any) -> Samples:
    rows = max(np.size(each) for each in channels.values())
    values = np.column_stack([np.broadcast_to(each, rows) for each in channels.values()]).astype(float)
    units = tuple("1" if name == "keyphasor" else "mm" for name in channels)
    return Samples(first, 1000 * first, RATE, 1e6, tuple(channels), units, values)


def run(device: Any, given: Settings, x: Any, y: Any = 0.0, **more: Any) -> tuple[Any, list[Any]]:
    monitor = device.Protection(given)
    return monitor, monitor.feed(samples(disk_x=x, disk_y=y, **more))


def told(actions: list[Any], *kinds: str) -> list[tuple[str, str, int]]:
    return [(each.kind, each.name, each.row) for each in actions if not kinds or each.kind in kinds]


@scenario
def a_sine_is_measured_from_peak_to_peak(device: Any) -> None:
    # 800 um at 10 Hz: after its peak the level is 800 (1 - sin); it passes 1000 where sin = -1/4, at 54.02 ms.
    x = 0.8 * np.sin(2.0 * math.pi * 10.0 * np.arange(200) / RATE)
    _, actions = run(device, settings(window_s=0.1), x)
    assert told(actions, "danger") == [("danger", "disk_x", 55)]
    danger = next(each for each in actions if each.kind == "danger")
    assert (danger.tick, danger.time_s) == (55_000, 0.055)
    assert abs(danger.value - 800.0 * (1.0 - math.sin(2.0 * math.pi * 0.55))) < 0.1


@scenario
def set_points_are_in_micrometres(device: Any) -> None:
    _, actions = run(device, settings(), make_swing(300, (100, 490.0), (200, 510.0)))
    assert told(actions) == [("alert", "disk_x", 201)]


@scenario
def each_probe_has_its_own_alarm(device: Any) -> None:
    _, actions = run(device, settings(), 0.0, make_swing(200, (100, 1200.0)))
    assert told(actions, "alert", "danger") == [("alert", "disk_y", 100), ("danger", "disk_y", 101)]


@scenario
def an_orbit_is_measured_from_its_mean(device: Any) -> None:
    # A circle of 510 um, 700 um off the centre: after a high-pass of 1 Hz, 510 / sqrt(1 + 0.1^2) = 507.5 um.
    turn = 2.0 * math.pi * 10.0 * np.arange(8000) / RATE
    for radius, expected in ((0.51, ["disk_x", "disk_y"]), (0.49, [])):
        x, y = 0.7 + radius * np.cos(turn), 0.2 + radius * np.sin(turn)
        given = settings(measure="smax", window_s=0.1, corner_hz=1.0, startup_s=5.0)
        _, actions = run(device, given, x, y)
        assert [each.name for each in actions] == expected
        assert all(abs(each.value - 507.5) < 2.0 for each in actions)


@scenario
def the_high_pass_has_minus_3_db_at_its_corner(device: Any) -> None:
    x = 0.5 * np.sin(2.0 * math.pi * 2.0 * np.arange(6000) / RATE)
    for part, expected in ((0.69, 2), (0.725, 0)):
        given = settings(alert_um=1000.0 * part, danger_um=1e6, window_s=0.5, corner_hz=2.0, startup_s=4.0)
        assert len(run(device, given, x, x)[1]) == expected


@scenario
def an_alarm_comes_after_its_delay(device: Any) -> None:
    # Above 500 at row 100, above 1000 at row 101.
    _, actions = run(device, settings(alert_delay_s=0.02, danger_delay_s=0.0495), make_swing(300, (100, 1200.0)))
    assert told(actions, "alert", "danger") == [("alert", "disk_x", 120), ("danger", "disk_x", 151)]
    _, actions = run(device, settings(danger_delay_s=0.05), make_swing(300, (100, 1200.0), (150, 0.0)))
    assert told(actions, "danger") == [], "it lasted from row 101 to 149"


@scenario
def a_delay_restarts_after_an_interruption(device: Any) -> None:
    x = make_swing(300, (100, 1200.0), (130, 0.0), (140, 1200.0))
    _, actions = run(device, settings(danger_delay_s=0.05), x)
    assert told(actions, "danger") == [("danger", "disk_x", 191)]


@scenario
def only_a_danger_is_latched(device: Any) -> None:
    monitor, actions = run(device, settings(), make_swing(400, (100, 1200.0), (200, 0.0)))
    assert told(actions, "clear") == [("clear", "alert disk_x", 201)]
    assert set(monitor.active) == {("danger", "disk_x"), ("trip", "")}
    _, actions = run(device, settings(latch_alert=True, latch_danger=False), make_swing(400, (100, 1200.0), (200, 0.0)))
    assert told(actions, "clear") == [("clear", "danger disk_x", 200)]


@scenario
def a_reset_ends_past_alarms(device: Any) -> None:
    monitor, _ = run(device, settings(), make_swing(300, (100, 1200.0), (200, 0.0)))
    monitor.reset()
    actions = monitor.feed(samples(300, disk_x=make_swing(100, (50, 1200.0)), disk_y=0.0))
    assert told(actions) == [
        ("reset", "danger disk_x", 300), ("reset", "trip", 300), ("alert", "disk_x", 350), ("danger", "disk_x", 351),
        ("trip", "danger disk_x", 351),
    ]  # fmt: skip
    assert told(monitor.feed(samples(400, disk_x=np.zeros(100), disk_y=0.0)), "reset") == [], "it is used once"


@scenario
def no_reset_while_the_cause_exists(device: Any) -> None:
    monitor, actions = run(device, settings(), make_swing(200, (100, 1200.0)))
    assert monitor.tripped
    before = dict(monitor.active)
    monitor.reset()
    assert monitor.feed(samples(200, disk_x=make_swing(100, (0, 1200.0)), disk_y=0.0)) == []
    assert monitor.active == before
    assert monitor.tripped
    assert len(told(actions, "trip")) == 1


@scenario
def an_alarm_ends_below_its_set_point_by_the_hysteresis(device: Any) -> None:
    x = make_swing(400, (100, 600.0), (200, 460.0), (300, 430.0))
    _, actions = run(device, settings(hysteresis=0.1), x)
    assert told(actions) == [("alert", "disk_x", 101), ("clear", "alert disk_x", 300)]


@scenario
def a_probe_beyond_its_ok_limits_is_not_ok(device: Any) -> None:
    # The output is -10 V + 3.94 V/mm: -2.5 V is 1.9036 mm, -17.5 V is -1.9036 mm. Out from row 100 to 199.
    for end_mm in (1.91, -1.91):
        x = np.zeros(1000)
        x[100:200] = end_mm
        _, actions = run(device, settings(danger_um=1e6, alert_um=1e6), x)
        assert told(actions) == [("not-ok", "disk_x", 100), ("clear", "not-ok disk_x", 700)]
        assert abs(actions[0].value - (-10.0 + 3.94 * end_mm)) < 1e-9
    assert run(device, settings(danger_um=1e6, alert_um=1e6), 1.90 * pulses(1000, 100))[1] == []


@scenario
def ok_returns_after_an_uninterrupted_time(device: Any) -> None:
    x = np.zeros(1500)
    x[100:200] = x[400] = 2.5
    _, actions = run(device, settings(danger_um=1e6, alert_um=1e6), x)
    assert told(actions) == [("not-ok", "disk_x", 100), ("clear", "not-ok disk_x", 901)]


@scenario
def a_probe_that_is_not_ok_raises_no_alarm(device: Any) -> None:
    x = make_swing(900, (150, 1200.0), (250, 0.0))
    x[100] = 2.5
    _, actions = run(device, settings(), x)
    assert told(actions) == [("not-ok", "disk_x", 100), ("clear", "not-ok disk_x", 601)]


@scenario
def two_out_of_two_need_both(device: Any) -> None:
    both = make_swing(300, (100, 1200.0)), make_swing(300, (150, 1200.0))
    assert told(run(device, settings(vote="2oo2"), *both)[1], "trip") == [("trip", "danger disk_x", 151)]
    assert told(run(device, settings(vote="2oo2"), both[0])[1], "trip") == []


@scenario
def one_out_of_two_needs_one(device: Any) -> None:
    both = make_swing(300, (150, 1200.0)), make_swing(300, (100, 1200.0))
    assert told(run(device, settings(vote="1oo2"), *both)[1], "trip") == [("trip", "danger disk_y", 101)]


VOTES = {
    # vote, rule: trips with (x in danger, y NOT OK), (x in danger, y bypassed), (both NOT OK), (y NOT OK alone)
    ("1oo2", "leaves"): (True, True, False, False),
    ("1oo2", "against"): (True, True, False, False),
    ("1oo2", "for"): (True, True, True, True),
    ("2oo2", "leaves"): (True, True, False, False),
    ("2oo2", "against"): (False, False, False, False),
    ("2oo2", "for"): (True, True, True, False),
}


@scenario
def a_probe_that_is_not_ok_votes_by_the_rule(device: Any) -> None:
    danger, broken, still = make_swing(300, (100, 1200.0)), 2.5 * (np.arange(300) >= 50), np.zeros(300)
    for (vote, rule), expected in VOTES.items():
        given = {"vote": vote, "not_ok": rule}
        found = (
            run(device, settings(**given), danger, broken)[0].tripped,
            run(device, settings(**given, bypass=("disk_y",)), danger, broken)[0].tripped,
            run(device, settings(**given), broken, broken)[0].tripped,
            run(device, settings(**given), still, broken)[0].tripped,
        )
        assert found == expected, (vote, rule)


@scenario
def a_bypassed_channel_raises_no_alarm(device: Any) -> None:
    x = make_swing(300, (100, 1200.0))
    assert run(device, settings(bypass=("disk_x",)), x)[1] == []
    monitor = device.Protection(settings())
    monitor.bypassed.add("disk_x")
    assert monitor.feed(samples(disk_x=x, disk_y=0.0)) == []
    monitor.bypassed.clear()
    assert told(monitor.feed(samples(300, disk_x=-x[:1] + x[-10:], disk_y=0.0)), "danger") == [
        ("danger", "disk_x", 300)
    ]


@scenario
def a_trip_multiply_raises_the_set_points(device: Any) -> None:
    monitor = device.Protection(settings())
    monitor.multiply = 3.0
    assert told(monitor.feed(samples(disk_x=make_swing(300, (100, 1400.0), (200, 1600.0)), disk_y=0.0))) == [
        ("alert", "disk_x", 201)
    ]


@scenario
def overspeed_trips(device: Any) -> None:
    given = settings(overspeed_hz=9.0, overspeed_turns=3)
    # Turns of 125 ms, then, from row 425, of 100 ms: the third ends at row 725.
    key = pulses(1500, 50, 175, 300, 425, 525, 625, 725, 825)
    monitor, actions = run(device, given, 0.0, keyphasor=key)
    assert told(actions) == [("overspeed", "keyphasor", 725), ("trip", "overspeed keyphasor", 725)]
    assert abs(actions[0].value - 10.0) < 1e-9
    monitor.reset()
    assert told(monitor.feed(samples(1500, disk_x=0.0, disk_y=0.0, keyphasor=0.0)), "reset") != [], "it stands"
    one_more = pulses(1500, *range(50, 1500, 125), 50 + 3 * 125 + 60)
    assert run(device, given, 0.0, keyphasor=one_more)[1] == [], "a pulse too many makes two turns that are too fast"


@scenario
def a_pulse_is_counted_once(device: Any) -> None:
    # Noise about the threshold as a pulse rises and falls.
    key = pulses(1500, *range(50, 1500, 125))
    for row in range(50, 1475, 125):
        key[row - 3 : row + 2] = (0.45, 0.55, 0.45, 0.7, 0.55)
        key[row + 9 : row + 12] = (0.45, 0.55, 0.3)
    for turns in (1, 2):
        assert run(device, settings(overspeed_hz=9.0, overspeed_turns=turns), 0.0, keyphasor=key)[1] == []


@scenario
def missing_pulses_are_an_alarm(device: Any) -> None:
    monitor, actions = run(device, settings(speed_lost_s=0.2), 0.0, keyphasor=pulses(900, 50, 150, 250, 700))
    assert told(actions) == [
        ("speed-lost", "keyphasor", 450), ("clear", "speed-lost keyphasor", 700), ("speed-lost", "keyphasor", 900)
    ][:2]  # fmt: skip
    assert not monitor.tripped


@scenario
def a_reverse_orbit_is_an_alarm(device: Any) -> None:
    # Turns of 100 ms; the orbit of 60 um reverses at row 500, in a turn. One of 50 um is too small.
    turn, sense = 2.0 * math.pi * 10.0 * np.arange(1000) / RATE, np.where(np.arange(1000) < 500, 1.0, -1.0)
    for diameter_mm, expected in ((0.06, [("reverse", "keyphasor", 750)]), (0.05, [])):
        x, y = 0.5 * diameter_mm * np.cos(turn), 0.5 * diameter_mm * sense * np.sin(turn)
        given = settings(reverse_turns=2, window_s=0.1, alert_um=550.0)
        _, actions = run(device, given, x, y, keyphasor=pulses(1000, *range(50, 1000, 100)))
        assert told(actions) == expected


@scenario
def notes_are_contacts(device: Any) -> None:
    monitor = device.Protection(settings())
    for tags, text, bypassed, multiply in (
        (["bypass"], "disk_x", {"disk_x"}, 1.0), (["bypass"], "P_N", {"disk_x"}, 1.0),
        (["bypass-off", "multiply"], "disk_x", set(), 1.0), (["multiply"], "2.5", set(), 2.5),
        (["multiply"], "9", set(), 2.5), (["multiply"], "nan", set(), 2.5), (["multiply"], "1", set(), 1.0),
    ):  # fmt: skip
        device.take_input(monitor, tags, text)
        assert (monitor.bypassed, monitor.multiply) == (bypassed, multiply), (tags, text)


@scenario
def the_first_alarm_is_marked(device: Any) -> None:
    monitor, actions = run(
        device, settings(), make_swing(300, (110, 1200.0)), make_swing(300, (100, 1200.0), (250, 0.0))
    )
    order = [("alert", "disk_y"), ("danger", "disk_y"), ("alert", "disk_x"), ("danger", "disk_x")]
    assert monitor.first_out == order
    assert told(actions, "trip") == [("trip", "danger disk_y", 101)]
    monitor.reset()
    monitor.feed(samples(300, disk_x=make_swing(10, (0, 1200.0)), disk_y=0.0))
    assert monitor.first_out == order[2:]


@scenario
def no_alarm_during_start_up(device: Any) -> None:
    given = settings(startup_s=0.3, danger_delay_s=0.05, speed_lost_s=0.1)
    _, actions = run(device, given, make_swing(600, (0, 1200.0)), keyphasor=0.0)
    assert told(actions) == [
        ("alert", "disk_x", 300), ("danger", "disk_x", 350), ("trip", "danger disk_x", 350),
        ("speed-lost", "keyphasor", 400),
    ]  # fmt: skip
    # The hysteresis does not hold an alarm that was above a set point only then.
    assert run(device, settings(startup_s=0.3, hysteresis=0.1), make_swing(600, (0, 600.0), (100, 470.0)))[1] == []


@scenario
def a_monitor_trips_once(device: Any) -> None:
    x = make_swing(500, (100, 1200.0), (200, 0.0), (300, 1200.0))
    _, actions = run(device, settings(latch_danger=False), x)
    assert told(actions, "danger", "trip") == [
        ("danger", "disk_x", 101), ("trip", "danger disk_x", 101), ("danger", "disk_x", 301)
    ]  # fmt: skip


class FakeMachine:
    """A rig that stores requests."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, Any]] = []

    def speed(self, hz: float) -> None:
        self.asked.append(("speed", hz))

    def stop(self) -> None:
        self.asked.append(("stop", None))

    def note(self, text: str, *, tags: list[str]) -> None:
        self.asked.append(("note", tags))


@scenario
def a_trip_is_sent_once_after_its_report(device: Any) -> None:
    notes = [("note", ["protection", kind]) for kind in ("alert", "danger", "trip")]
    for trip, expected in (("speed 0", [*notes, ("speed", 0.0)]), ("stop", [*notes, ("stop", None)])):
        given, machine, lines = settings(trip=trip), FakeMachine(), []
        monitor = device.Protection(given)
        for first in (0, 200, 400):
            x = make_swing(200, (100 if first == 0 else 0, 1200.0))
            device.act(machine, given, monitor.feed(samples(first, disk_x=x, disk_y=0.0)), lines.append)
        assert machine.asked == expected
        assert lines[1] == "0.101000 s  danger  disk_x  1200"


class EventRig(FakeMachine):
    """A rig with blocks, and events between them."""

    def __init__(self, *blocks: tuple[list[dict[str, Any]], Samples]) -> None:
        super().__init__()
        self.parts, self.events = blocks, []

    def blocks(self) -> Iterator[Samples]:
        for events, rows in self.parts:
            self.events += events
            yield rows

    def event(self, _: Any, *, timeout_s: float) -> dict[str, Any]:
        if not self.events:
            raise TimeoutError
        return self.events.pop(0)


@scenario
def a_note_of_others_resets_alarms(device: Any) -> None:
    impact, still = make_swing(200, (100, 1200.0), (150, 0.0)), np.zeros(200)
    command = {"event": "speed", "speed_hz": 1.0}
    for tags, expected in ((["reset"], ["reset", "reset"]), (["protection", "reset"], []), (["again"], [])):
        machine = EventRig(
            ([], samples(disk_x=impact, disk_y=0.0)),
            ([command, {"event": "note", "tags": tags}], samples(200, disk_x=still, disk_y=0.0)),
            ([], samples(400, disk_x=still, disk_y=0.0)),
        )
        device.protect(machine, device.Protection(settings(alert_um=1000.0)), lambda _: None)
        notes = [tags[1] for what, tags in machine.asked if what == "note"]
        assert notes == ["alert", "danger", "trip", "clear", *expected]


def make_eventful_rows(rows: int = 6000) -> tuple[Settings, Samples]:
    """Return rows in which most cases occur."""
    rng = np.random.default_rng(1)
    x = 0.3 * np.sin(2.0 * math.pi * 10.0 * np.arange(rows) / RATE) * np.repeat(rng.uniform(0.2, 3.0, rows // 300), 300)
    y = 0.6 * x[::-1] + 0.02 * rng.standard_normal(rows)
    x[2500:2520] = 2.6
    key = pulses(rows, *np.cumsum(rng.integers(90, 140, rows // 150)))
    key[:] += 0.02 * rng.standard_normal(rows)
    given = settings(
        window_s=0.12, corner_hz=0.5, hysteresis=0.05, danger_delay_s=0.033, alert_delay_s=0.1, startup_s=0.4,
        overspeed_hz=9.0, overspeed_turns=2, speed_lost_s=0.13, latch_danger=False, danger_um=1200.0,
        reverse_turns=1,
    )  # fmt: skip
    return given, samples(disk_x=x, disk_y=y, keyphasor=key)


@scenario
def the_division_into_blocks_has_no_effect(device: Any) -> None:
    given, rows = make_eventful_rows()
    whole = device.Protection(given).feed(rows)
    kinds = {"alert", "danger", "trip", "clear", "not-ok", "overspeed", "speed-lost", "reverse"}
    assert {each.kind for each in whole} == kinds
    rng = np.random.default_rng(2)
    by_chance = np.sort(rng.integers(0, 6000, 40))
    for cuts in (np.arange(0, 6001, 20), np.arange(0, 6000, 37), by_chance, np.arange(2400, 2900)):
        monitor, found = device.Protection(given), []
        for begin, end in zip([0, *cuts], [*cuts, 6000], strict=True):
            found += monitor.feed(rows.rows(int(begin), int(end)))
        assert found == whole


@scenario
def missing_rows_are_replaced_by_the_last(device: Any) -> None:
    given, x = settings(window_s=0.1, danger_delay_s=0.05), np.zeros(400)
    x[100:300] = 1.2
    parts = [samples(0, disk_x=x[:120], disk_y=0.0), samples(180, disk_x=x[180:], disk_y=0.0)]
    monitor = device.Protection(given)
    actions = [each for part in parts for each in monitor.feed(part)]
    # The step is in the window from row 100 to 199; danger after 50 rows, in the middle of the gap.
    assert told(actions, "rows-lost", "danger") == [("rows-lost", "", 180), ("danger", "disk_x", 150)]
    assert actions[-1].kind == "clear"


@scenario
def repeated_rows_count_once(device: Any) -> None:
    given, rows = make_eventful_rows()
    whole, monitor = device.Protection(given).feed(rows), device.Protection(given)
    parts = [rows.rows(begin, begin + 100) for begin in range(0, 6000, 100)]
    # Row 0 again would be that of another run.
    again = [part for number, part in enumerate(parts) for part in (part, parts[max(1, number - 3)])][2:]
    assert [each for part in (parts[0], *again) for each in monitor.feed(part)] == whole


@scenario
def too_many_missing_rows_make_all_probes_not_ok(device: Any) -> None:
    for first in (900, 0):
        monitor, _ = run(device, settings(window_s=0.1), np.zeros(400))
        actions = monitor.feed(samples(first, disk_x=make_swing(700, (100, 1200.0), (300, 0.0)), disk_y=0.0))
        assert told(actions) == [
            ("rows-lost", "", first), ("not-ok", "disk_x", first), ("not-ok", "disk_y", first),
            ("clear", "not-ok disk_x", first + 500), ("clear", "not-ok disk_y", first + 500),
        ]  # fmt: skip


def sound() -> Any:
    from drivers.protection import Protection
    from drivers.protection.__main__ import act, protect, take_input

    return SimpleNamespace(Protection=Protection, act=act, protect=protect, take_input=take_input)
