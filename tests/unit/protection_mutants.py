"""Broken monitors, each with a scenario that must detect it; `python -m tests.unit.protection_mutants` has the matrix.

A mutant is the source of the monitor, or of its actuation, with one text replaced.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from drivers.protection import __main__ as runner
from drivers.protection import monitor
from tests.mutants import replace_once
from tests.unit.protection_scenarios import SCENARIOS, sound


@dataclass(frozen=True)
class Mutant:
    """The defect, the scenario that detects it, and a text with its replacement."""

    name: str
    told_by: str
    text: str
    instead: str
    source: ModuleType = monitor

    def device(self) -> Any:
        """Return the mutant as a device for a scenario."""
        assert self.source.__file__ is not None
        source = Path(self.source.__file__).read_text(encoding="utf-8")
        text = replace_once(source, self.text, self.instead, self.name)
        module = ModuleType(self.source.__name__)
        exec(compile(text, self.name, "exec"), module.__dict__)
        members = {name: getattr(module, name) for name in vars(sound()) if hasattr(module, name)}
        return SimpleNamespace(**{**vars(sound()), **members})

    def fails(self, scenario: str) -> bool:
        """Return whether a scenario detects it: its result is wrong; an exception in the mutant does not count."""
        try:
            SCENARIOS[scenario](self.device())
        except AssertionError:
            return True
        return False


_LATCHED = "np.logical_or.accumulate(on) | (alarm in self.active) if alarm[0] in self._latching else on, value"
MUTANTS = [
    Mutant("delay ignored", "an_alarm_comes_after_its_delay", "above) > self._rows(delay_s)", "above) > 0"),
    Mutant(
        "a row early", "an_alarm_comes_after_its_delay",
        "above) > self._rows(delay_s)", "above) >= max(1, self._rows(delay_s))",
    ),
    Mutant(
        "delay rounded down", "an_alarm_comes_after_its_delay",
        "math.ceil(duration_s * self._rate_hz - 1e-6)",
        "math.floor(duration_s * self._rate_hz + 1e-6)",
    ),
    Mutant(
        "delay goes on after a break", "a_delay_restarts_after_an_interruption", "= self._run((kind, name), above)",
        "= np.cumsum(above) + 0 * self._run((kind, name), above)",
    ),
    Mutant("latch lost", "only_a_danger_is_latched", _LATCHED, "on, value"),
    Mutant("all latched", "only_a_danger_is_latched", _LATCHED.partition(" if ")[2], "True else on, value"),
    Mutant("reset during the alarm", "no_reset_while_the_cause_exists", "and not self._causes[alarm]]", "]"),
    Mutant("reset does nothing", "a_reset_ends_past_alarms", "self._to_reset = True", "self._to_reset = False"),
    Mutant(
        "OK limits ignored", "a_probe_beyond_its_ok_limits_is_not_ok",
        "(volts >= settings.ok_low_v) & (volts <= settings.ok_high_v)", "volts > -1e9",
    ),
    Mutant(
        "upper OK limit alone", "a_probe_beyond_its_ok_limits_is_not_ok",
        "(volts >= settings.ok_low_v) & (volts <= settings.ok_high_v)", "volts <= settings.ok_high_v",
    ),
    Mutant(
        "OK again at once", "ok_returns_after_an_uninterrupted_time", "each) > recovery for", "each) > 0 for",
    ),
    Mutant(
        "alarm of a probe that is NOT OK", "a_probe_that_is_not_ok_raises_no_alarm",
        "okay & armed &", "armed &",
    ),
    Mutant(
        "NOT OK stays in the vote", "a_probe_that_is_not_ok_votes_by_the_rule", "np.array(dangers), off | bad",
        "np.array(dangers), off & bad",
    ),
    Mutant("2oo2 as 1oo2", "two_out_of_two_need_both", 'if self.settings.vote == "1oo2":', "if True:"),
    Mutant("1oo2 as 2oo2", "one_out_of_two_needs_one", 'if self.settings.vote == "1oo2":', "if False:"),
    Mutant(
        "peak instead of peak-to-peak", "a_sine_is_measured_from_peak_to_peak",
        "_sliding_extreme(np.fmax, rows, self._window) - _sliding_extreme(np.fmin, rows, self._window)",
        "_sliding_extreme(np.fmax, abs(rows), self._window)",
    ),
    Mutant(
        "gap not taken away", "an_orbit_is_measured_from_its_mean", "probes - np.array(means)[:, 1:]",
        "probes - 0.0 * np.array(means)[:, 1:]",
    ),
    Mutant(
        "corner in rad/s", "the_high_pass_has_minus_3_db_at_its_corner", "-2.0 * math.pi * settings.corner_hz",
        "-settings.corner_hz",
    ),
    Mutant(
        "wrong axis", "each_probe_has_its_own_alarm",
        "zip(probes, levels, good", "zip(probes, levels[::-1], good",
    ),
    Mutant("a thousandth of a unit", "set_points_are_in_micrometres", '"um", field=', '"mm", field='),
    Mutant(
        "no hysteresis", "an_alarm_ends_below_its_set_point_by_the_hysteresis",
        "high * (1.0 - settings.hysteresis)", "high",
    ),
    Mutant(
        "overspeed the wrong way", "overspeed_trips", "self._speed_hz > settings.overspeed_hz",
        "0.0 < self._speed_hz < settings.overspeed_hz",
    ),
    Mutant(
        "overspeed of one turn", "overspeed_trips", "fast >= settings.overspeed_turns", "fast >= 1",
    ),
    Mutant(
        "edges counted twice", "a_pulse_is_counted_once",
        " if high[row]]", "]",
    ),
    Mutant("pulse without hysteresis", "a_pulse_is_counted_once", "_PULSE = (0.6, 0.4)", "_PULSE = (0.5, 0.5)"),
    Mutant(
        "speed lost is not told", "missing_pulses_are_an_alarm", "(lost & enabled", "(lost & ~enabled",
    ),
    Mutant(
        "reverse the wrong way", "a_reverse_orbit_is_an_alarm",
        "row] - self._turn_area < -", "row] - self._turn_area > ",
    ),
    Mutant("area of each block", "the_division_into_blocks_has_no_effect", "self._area = float(area[-1])", "pass"),
    Mutant("one reverse turn", "a_reverse_orbit_is_an_alarm", "reverse >= settings.reverse_turns", "reverse >= 1"),
    Mutant(
        "bypass stays", "notes_are_contacts", "protection.bypassed -= {text}", "protection.bypassed -= set()", runner,
    ),
    Mutant(
        "multiply without limit", "notes_are_contacts",
        "if 1.0 <= (factor := float(text)) <= 3.0 else", "if (factor := float(text)) else", runner,
    ),
    Mutant("bypass ignored", "a_bypassed_channel_raises_no_alarm", " & (name not in self.bypassed)", ""),
    Mutant("multiply ignored", "a_trip_multiply_raises_the_set_points", "self.multiply * set_um", "set_um"),
    Mutant(
        "first-out lost", "the_first_alarm_is_marked", "self.first_out.append(alarm)",
        "self.first_out = sorted([*self.first_out, alarm])",
    ),
    Mutant("start-up for ever", "no_alarm_during_start_up", "index >= self._armed", "index >= 10**9"),
    Mutant("no start-up", "no_alarm_during_start_up", "first + self._rows(settings.startup_s)", "first"),
    Mutant("trips again and again", "a_monitor_trips_once", "np.logical_or.accumulate(trip) | self.tripped", "trip"),
    Mutant(
        "trip not sent", "a_trip_is_sent_once_after_its_report", "                machine.speed(0.0)",
        "                pass", runner,
    ),
    Mutant(
        "trip sent with each note", "a_trip_is_sent_once_after_its_report", "        show(str(action))",
        "        show(str(action))\n        machine.speed(0.0)", runner,
    ),
    Mutant(
        "trip sent by each danger", "a_trip_is_sent_once_after_its_report", 'if action.kind == "trip"]',
        'if action.kind != "alert"]', runner,
    ),
    Mutant(
        "own notes reset it", "a_note_of_others_resets_alarms",
        'if "protection" not in (tags := event.get("tags", ())):', 'if tags := event.get("tags", ()):', runner,
    ),
    Mutant(
        "state of each block", "the_division_into_blocks_has_no_effect",
        "if not started or not 0 <= missing", "if missing == 0 or not 0 <= missing",
    ),
    Mutant(
        "delay of each block", "the_division_into_blocks_has_no_effect",
        "-1 - self._runs.get(alarm, 0)", '-1 - self._runs.get(alarm, 0) * (alarm[0] == "ok")',
    ),
    Mutant(
        "window of each block", "the_division_into_blocks_has_no_effect",
        "rows[:, rows.shape[1] - self._window + 1 :]", "0 * self._tail",
    ),
    Mutant(
        "a row off in all blocks but the first", "the_division_into_blocks_has_no_effect",
        "first = samples.index + len(samples) - signals.shape[1]",
        "first = samples.index + len(samples) - signals.shape[1] + (samples.index > 0)",
    ),
    Mutant("missing rows left out", "missing_rows_are_replaced_by_the_last", "elif missing:", "elif False:"),
    Mutant(
        "rows that come twice", "repeated_rows_count_once", "fresh = follow(self._received, samples)",
        "fresh = samples",
    ),
    Mutant(
        "OK where rows are lost", "too_many_missing_rows_make_all_probes_not_ok", "0 if started else self._rows",
        "self._rows",
    ),
]  # fmt: skip


def compute_matrix() -> dict[str, list[str]]:
    """Return the scenarios that detect each mutant."""
    return {mutant.name: [name for name in SCENARIOS if mutant.fails(name)] for mutant in MUTANTS}


if __name__ == "__main__":
    found = compute_matrix()
    for mutant in MUTANTS:
        others = [name for name in found[mutant.name] if name != mutant.told_by]
        mark = "killed" if mutant.told_by in found[mutant.name] else "LIVES"
        print(f"{mark}  {mutant.name}: {mutant.told_by}; and {len(others)} more: {', '.join(others) or '-'}")
    killed = sum(mutant.told_by in found[mutant.name] for mutant in MUTANTS)
    print(f"{killed} of {len(MUTANTS)} killed by the scenario that is meant")
    sys.exit(killed < len(MUTANTS))
