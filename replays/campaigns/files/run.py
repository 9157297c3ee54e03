"""Run of one case of a campaign file: bench, device, steps, and evaluation of the recording."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from replays.campaigns.equipment.bench import UnsupportedError
from replays.campaigns.equipment.cleanup import KILLED, PATIENCE_S
from replays.campaigns.files.case_results import CaseRecording
from replays.campaigns.files.expectation import EventOf, expected_events
from replays.campaigns.measurement import Measurement, Must
from rig.base import wire
from rig.base.errors import RefusedError
from rig.run.commands.table import TimedCommand
from rig.serve.waiting import wait_until

if TYPE_CHECKING:
    from drivers.client import Rig
    from replays.campaigns.equipment.device import Device
    from replays.campaigns.evidence import Trial
    from replays.campaigns.files.campaign import Case, Step

_LAST_S = 5.0
"""Longest time for a device to end after the run [s]."""


def run_case(case: Case, trial: Trial) -> None:
    """Run a case and judge it; the trial keeps the measurements even if an error is raised.

    In lockstep, the rig receives all commands before it starts, and they take effect at their exact ticks. In real time
    and on an existing rig, the case begins once its device is connected, and each command is sent when it is due.

    Raises:
        BenchError: If the rig, the device or the recording fails.
        UnsupportedError: If the bench cannot do what the case needs.
    """
    settings, live, steps = case.bench, [step for step in case.steps if step.command is None], case.steps
    timed = tuple(step.command for step in steps if step.command is not None)
    if trial.target.owns_rig and settings.pace == "real-time":
        from rig.run.scenes import load_scene

        own = load_scene(settings.scene or "", dict(settings.set)).commands
        live = sorted([*map(_step, own), *steps], key=lambda step: step.at_s)
        settings = replace(settings, set={**settings.set, "commands": []}, duration_s=None)
    elif trial.target.url is not None:
        live = list(steps)
    else:
        settings = replace(settings, commands=timed, duration_s=case.duration_s)
    bench = trial.start_bench(settings)
    for each in case.devices if trial.target.replay is not None else ():
        if each.commands:
            raise UnsupportedError(f"a recording takes no commands of {each.name}")
    record = trial.start_record()
    record.wait_until_connected()
    for each in case.devices:
        joins, where = None if each.joins else False, case.file.parent / each.folder
        trial.start_device(each.command, name=each.name, where=where, joins=joins)
    trial.origin_s = bench.begin()
    with bench.connect(name="campaign", channels=()) as machine:
        for step in live:
            bench.advance_to(trial.origin_s + step.at_s)
            _send(machine, step)
        bench.advance_to(trial.origin_s + case.duration_s)
        if trial.target.owns_rig:
            bench.late_blocks()  # while the rig still responds
            _stop(machine)
            record.wait()
    trial.recording = record.stop()
    for device in trial.devices:
        end_device(device, trial)
    results = CaseRecording(trial.recording, trial.folder, trial.origin_s)
    _measure_device(results, trial)
    measure_end(results, trial, case)
    for expect in case.expects:
        for measurement in expect.measure(results, results.units):
            exact = measurement.resolution
            # Times that depend on the device have the resolution of its reaction.
            resolution = f"{exact}; {trial.resolution}" if exact and case.devices else exact
            trial.take(replace(measurement, resolution=resolution))


def _step(command: TimedCommand) -> Step:
    from replays.campaigns.files.campaign import Step

    return Step(command.at_s, command)


def _send(machine: Rig, step: Step) -> None:
    try:
        if step.command is None:
            machine.note(step.note, tags=list(step.tags))
            return
        request = step.command.request
        machine.send(request.command, **request.request())
    except RefusedError as error:
        if wire.ENDED in str(error):
            return  # `measure_end` judges the end of the run
        raise UnsupportedError(f"the rig refuses a step at {step.at_s:g} s: {error}") from None


def _stop(machine: Rig) -> None:
    try:
        machine.stop()
    except (RefusedError, ConnectionError):
        return  # the run has ended


def end_device(device: Device, trial: Trial) -> None:
    """Wait for a device to end after the run, and judge its exit status."""
    wait_until(lambda: device.program.status is not None or not trial.target.owns_rig, _LAST_S)
    status = device.program.status
    device.program.end()
    note = f"its last line: {device.program.last_line}" if status else ""
    if status is None and device.program.status == KILLED:
        status, note = KILLED, f"it had to be killed: it did not end within {PATIENCE_S:g} s of a SIGTERM"
    if status is not None:
        must = Must("==", 0.0, "1")
        trial.take(Measurement(f"exit status of {device.name}", float(status), must, note=note))


def measure_end(results: CaseRecording, trial: Trial, case: Case) -> None:
    """Add a failed measurement if the run was stopped early although no expectation allows it."""
    ended = next(((at_s, event) for at_s, event in results.events if event["event"] == "end"), None)
    if ended is None or ended[1].get("reason") == "completed" or ended[0] >= case.duration_s - 1e-6:
        return
    if not any(event.event == "end" or event.where.get("command") == "stop" for event in expected_events(case.expects)):
        at_s, event = ended
        by = next((event["from"] for _, event in results.events if event.get("command") == "stop"), "")
        note = f"{event.get('reason')}{f' by {by}' if by else ''}, before the case was over"
        trial.take(Measurement("end of the run", at_s, Must(">=", case.duration_s, "s"), note=note, at_s=at_s))


def _measure_device(results: CaseRecording, trial: Trial) -> None:
    """Add a measurement for each device in lockstep: it fails, with the rig's reason, if the device was lost."""
    for device in trial.devices:
        lost = EventOf(event="device", where={"device": device.rig_name, "state": "lost"})
        times_s = lost.times_s(results)
        if trial.bench is not None and trial.bench.pace == "lockstep":
            reasons = [
                str(event.get("reason", "")) for _, event in results.events
                if (event.get("event"), event.get("device"), event.get("state")) == ("device", device.rig_name, "lost")
            ]  # fmt: skip
            at_s = times_s[0] if times_s else None
            name = f"times that {device.name} was lost"
            trial.take(Measurement(name, float(len(times_s)), Must("==", 0.0, "1"), note="; ".join(reasons), at_s=at_s))
