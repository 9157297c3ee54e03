"""Sixty defects of a protection monitor (docs/monitor-defects.md), each tested by a shipped campaign.

`python -m tests.monitor_defects [WORDS]` runs `rig campaign` for the sound monitor and for each defect (those with the
words in their name) and prints which case detects it; ten minutes on two cores. A defect is a text of the monitor's
source with its replacement. A defect counts as detected only if a case fails by a measurement, not by an error.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import drivers.protection
from replays.campaigns.files.campaign import find_shipped
from tests.mutants import replace_once

SOURCES = Path(drivers.protection.__file__).parent
_DEVICE = "python -m drivers.protection"
_MIN_DETECTED = 57


class Defect(NamedTuple):
    """A defect, the campaign of its function, and a text of a source file with its replacement."""

    name: str
    campaign: str
    text: str
    replacement: str
    file: str = "monitor.py"


_DELAY_TEST = "above) > self._rows(delay_s)"
_RUN = "causes[kind, name] = self._run((kind, name), above) >"
_PEAK_TO_PEAK = "_sliding_extreme(np.fmax, rows, self._window) - _sliding_extreme(np.fmin, rows, self._window)"
_INSIDE = "(volts >= settings.ok_low_v) & (volts <= settings.ok_high_v)"
_KEEP_RUN = "self._runs[alarm] = int(run[-1])"
DEFECTS = [
    # set points
    Defect("no alert", "alarms", '("alert", settings.alert_um', '("alert", 1e9'),
    Defect("no danger", "alarms", '("danger", settings.danger_um', '("danger", 1e9'),
    Defect("set points 2 % high", "alarms", "high = self.multiply * set_um", "high = 1.02 * self.multiply * set_um"),
    Defect("set points 2 % low", "alarms", "high = self.multiply * set_um", "high = 0.98 * self.multiply * set_um"),
    Defect(
        "peak taken for peak-to-peak", "alarms", _PEAK_TO_PEAK, "_sliding_extreme(np.fmax, abs(rows), self._window)",
    ),
    Defect("the second probe is not monitored", "alarms", "okay & armed &", "okay & armed & (name == settings.x) &"),
    Defect(
        "alarms name the other probe", "alarms", "zip(probes, levels, good,", "zip(probes, levels[::-1], good[::-1],",
    ),
    # delays
    Defect("delays ignored", "alarms", _DELAY_TEST, "above) > 0"),
    Defect("delays 10 ms short", "alarms", _DELAY_TEST, "above) > self._rows(delay_s - 0.01)"),
    Defect("delays 10 ms long", "alarms", _DELAY_TEST, "above) > self._rows(delay_s + 0.01)"),
    Defect(
        "a delay continues after an interruption", "alarms", _RUN,
        "self._runs[kind, name] = self._runs.get((kind, name), 0) + int(above.sum()); "
        "causes[kind, name] = np.full(len(level), self._runs[kind, name]) >",
    ),
    Defect(
        "the alert's delay used for danger", "alarms", "settings.danger_um, settings.danger_delay_s",
        "settings.danger_um, settings.alert_delay_s",
    ),
    # trip
    Defect("an alert trips", "alarms", 'states["danger", name][0]', 'states["alert", name][0]'),
    Defect("a danger does not trip", "alarms", "        machine.stop()", "        pass", "__main__.py"),
    Defect("trips again without a reset", "retrip", "np.logical_or.accumulate(trip) | self.tripped", "trip"),
    Defect(
        "trips without a report", "alarms", 'report(machine, str(action), action.kind, show)',
        'action.kind == "trip" or report(machine, str(action), action.kind, show)', "__main__.py",
    ),
    # latch and reset
    Defect("danger does not latch", "latch", '{"danger", "overspeed"} if', '{"overspeed"} if'),
    Defect("every alert latches", "latch", " if settings.latch_alert else set()", ""),
    Defect("a reset does nothing", "latch", "self._to_reset = True", "self._to_reset = False"),
    Defect(
        "a reset ends an alarm that still exists", "latch",
        "alarm != TRIP and not self._causes[alarm]]", "alarm != TRIP]",
    ),
    Defect(
        "no alarm after the first reset", "latch", "self._to_reset = False\n        cleared",
        "self._to_reset, self._armed = False, 10**12\n        cleared",
    ),
    Defect(
        "its own reports reset it", "latch", 'if "protection" not in (tags := event.get("tags", ())):',
        'if tags := ["reset"] * (event["event"] == "note"):', "__main__.py",
    ),
    # hysteresis, first-out
    Defect("no hysteresis", "latch", "(1.0 - settings.hysteresis)", "1.0"),
    Defect("five times the hysteresis", "latch", "(1.0 - settings.hysteresis)", "(1.0 - 5.0 * settings.hysteresis)"),
    Defect(
        "reports the last alarm as first-out", "latch",
        "for each in self.first_out if each[0]", "for each in self.first_out[::-1] if each[0]",
    ),
    # OK limits
    Defect("no lower OK limit", "ok", _INSIDE, "volts <= settings.ok_high_v"),
    Defect("no upper OK limit", "ok", _INSIDE, "volts >= settings.ok_low_v"),
    Defect("OK limits off by 0.2 V", "ok", "settings.bias_v + 1e-3", "settings.bias_v + 0.2 + 1e-3"),
    Defect("OK at once", "ok", "each) > recovery for", "each) > 0 for"),
    Defect("never OK again", "ok", _KEEP_RUN, f'{_KEEP_RUN} or (-(10**9) if alarm[0] == "ok" else 0)'),
    Defect(
        "the recovery adds up over interruptions", "ok", _KEEP_RUN,
        f"count = self._runs.get(alarm, 0)\n        {_KEEP_RUN} or "
        '(count if alarm[0] == "ok" and count <= self._rows(self.settings.ok_recovery_s) else 0)',
    ),
    Defect("a probe that is not OK raises alarms", "ok", "okay & armed &", "armed &"),
    Defect(
        "not OK is not reported", "ok", '("not-ok", name): (~good[place],', '("not-ok", name): (good[place] & False,',
    ),
    # votes
    Defect("2oo2 as 1oo2", "votes", 'if self.settings.vote == "1oo2":', "if True:"),
    Defect("1oo2 as 2oo2", "votes", 'if self.settings.vote == "1oo2":', "if False:"),
    Defect(
        "a probe that is not OK votes against", "votes", "np.logical_and(*(votes | out)) & ~np.logical_and(*out)",
        "np.logical_and(*votes)",
    ),
    # bypass, multiply
    Defect("bypass ignored", "inputs", "armed & (name not in self.bypassed)", "armed"),
    Defect(
        "bypass of one probe bypasses both", "inputs",
        "armed & (name not in self.bypassed)", "armed & (not self.bypassed)",
    ),
    Defect("multiply ignored", "inputs", "self.multiply * set_um", "set_um"),
    Defect("multiply stays on", "inputs", "= factor if", "= max(factor, protection.multiply) if", "__main__.py"),
    Defect(
        "only danger is multiplied", "inputs",
        "self.multiply * set_um", '(self.multiply if kind == "danger" else 1.0) * set_um',
    ),
    # measurement
    Defect("DC gap not removed", "filter", "return probes - np.array(means)[:, 1:]", "return probes"),
    Defect(
        "corner frequency too high", "filter",
        "-2.0 * math.pi * settings.corner_hz", "-4.0 * math.pi * settings.corner_hz",
    ),
    Defect(
        "window of half the length", "waveform",
        "self._rows(settings.window_s))", "self._rows(0.5 * settings.window_s))",
    ),
    Defect(
        "RMS times 2.83 instead of peak-to-peak", "waveform", _PEAK_TO_PEAK,
        "8.0**0.5 * np.sqrt(np.lib.stride_tricks.sliding_window_view(rows**2, self._window, axis=1).mean(-1))",
    ),
    Defect(
        "only every eighth sample is used", "values", "self._remove_gap(signals[:2])",
        "self._remove_gap(signals[:2, np.arange(signals.shape[1]) // 8 * 8])",
    ),
    # speed
    Defect("overspeed ignored", "speed", "(over & enabled &", "(over & ~enabled &"),
    Defect("one fast turn trips", "speed", "fast >= settings.overspeed_turns", "fast >= 1"),
    Defect("speed limit 3 % high", "speed", "self._speed_hz > settings", "self._speed_hz > 1.03 * settings"),
    Defect("every pulse counts twice", "speed", " if high[row]]", "]"),
    Defect("lost speed not reported", "speed", "(lost & enabled &", "(lost & ~enabled &"),
    Defect(
        "lost speed trips", "speed", 'trip |= states["overspeed", settings.keyphasor][0]',
        'trip |= states["overspeed", settings.keyphasor][0] | states["speed-lost", settings.keyphasor][0]',
    ),
    Defect("reverse rotation not reported", "speed", "(backward, reverse)", "(backward & False, reverse)"),
    Defect(
        "every orbit is reverse", "speed", "area[row] - self._turn_area < -_circle_area(",
        "abs(area[row] - self._turn_area) > _circle_area(",
    ),
    # stream, power-up
    Defect("lost blocks shorten the time", "stream", "elif missing:", "elif False:"),
    Defect("alarms right after a long gap", "stream", "0 if started else self._rows", "self._rows"),
    Defect(
        "doubled blocks count twice", "stream", "follow(self._received, samples) if len(samples) else None", "samples",
    ),
    Defect(
        "lost blocks not reported", "stream",
        "samples.index, missing)] if missing else []", "samples.index, missing)][:0]",
    ),
    Defect("no start-up time", "stream", "first + self._rows(settings.startup_s)", "first"),
    Defect("start-up never ends", "stream", "index >= self._armed", "index >= 10**9"),
]  # fmt: skip


def run(defect: Defect | None, campaign: str) -> tuple[int, str]:
    """Run the campaign `protection-CAMPAIGN` with a defect, or the sound monitor; return status and first failure."""
    file = find_shipped()[f"protection-{campaign}"]
    command = " ".join(tomllib.loads(file.read_text("utf-8"))["device"]["command"].split())
    assert _DEVICE in command, file
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "monitor_under_test"
        package.mkdir()
        for source in SOURCES.glob("*.py"):
            text = source.read_text("utf-8")
            if defect is not None and source.name == defect.file:
                text = replace_once(text, defect.text, defect.replacement, defect.name)
            (package / source.name).write_text(text.replace("drivers.protection", package.name), "utf-8")
        device = command.replace(_DEVICE, f"python -m {package.name}")
        paths = os.pathsep.join(filter(None, (folder, os.environ.get("PYTHONPATH"))))
        done = subprocess.run(
            [sys.executable, "-m", "rig", "campaign", str(file), "-x", "--device", device],
            env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=False,
        )  # fmt: skip
    lines = done.stdout.splitlines()
    failed = next(
        (line.partition("::")[2] for line in lines if re.match("FAIL|error", line)), done.stderr.strip()[-300:]
    )
    return done.returncode, failed


def main(words: str) -> int:
    """Print a line for each defect, and return the exit status."""
    chosen = [each for each in DEFECTS if words in each.name]
    campaigns = dict.fromkeys(each.campaign for each in chosen)
    with ThreadPoolExecutor(2) as pool:
        sound = {campaign: pool.submit(run, None, campaign) for campaign in campaigns}
        found = [(each, pool.submit(run, each, each.campaign)) for each in chosen]
        for campaign, future in sound.items():
            status, text = future.result()
            print(
                f"{'passes' if status == 0 else 'FAILS'}  the sound monitor: protection-{campaign}  {text}", flush=True
            )
        detected = 0
        for defect, future in found:
            status, text = future.result()
            # The line of a failed measurement states its limit; that of an error does not.
            killed = status == 1 and " must be " in text and "exit status" not in text
            detected += killed
            print(
                f"{'detected' if killed else 'MISSED'}  {defect.name}: protection-{defect.campaign}  {text}", flush=True
            )
    print(f"{detected} of {len(chosen)} defects detected")
    passed = all(future.result()[0] == 0 for future in sound.values())
    return 0 if passed and detected >= min(_MIN_DETECTED, len(chosen)) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if sys.argv[1:] else ""))
