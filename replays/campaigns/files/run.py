"""Run of one case of a campaign file: bench, device, steps, and evaluation of the recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from replays.campaigns.equipment.bench import BenchError, UnsupportedError
from replays.campaigns.equipment.cleanup import KILLED
from replays.campaigns.evidence import MAX_FILES, MeasurementError
from replays.campaigns.files.case_results import CaseRecording
from replays.campaigns.files.expectation import expected_events
from replays.campaigns.measurement import Measurement, Must, with_unit
from rig.base import wire
from rig.base.errors import RefusedError
from rig.run.commands.table import TimedCommand
from rig.serve.waiting import wait_until

if TYPE_CHECKING:
    from drivers.client import Rig
    from replays.campaigns.equipment.device import Device
    from replays.campaigns.evidence import Trial
    from replays.campaigns.files.campaign import Case, Step
    from replays.campaigns.files.expectation import Expect

REPETITION_NAME = "runs alike"
"""Name of the measurement that counts the runs that are like the first one."""
_EQUIPMENT = ("step", "fault", "clear")
"""Commands of the test alone: a device that sends them changes what it is tested with."""
_MAX_DIFFERENCES = 4
"""Number of differences between runs that are listed."""


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
    trial.start_record()
    for each in case.devices:
        joins, where = None if each.joins else False, case.file.parent / each.folder
        trial.start_device(each.command, name=each.name, where=where, joins=joins, may_end=each.may_end)
    trial.origin_s = bench.begin()
    with bench.connect(name="campaign", channels=()) as machine:
        for step in live:
            bench.advance_to(trial.origin_s + step.at_s)
            send_step(machine, step, owns_rig=trial.target.owns_rig)
        end_s = trial.origin_s + case.duration_s
        # A device that needs the last block has not ended before it.
        bench.advance_to(end_s - 1e-3 * settings.block_ms)
        note_early_ends(trial)
        bench.advance_to(end_s)
        results = finish_run(trial, case.expects)
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


def send_step(machine: Rig, step: Step, *, owns_rig: bool) -> None:
    """Send the command or note of a step.

    Raises:
        BenchError: If the test's own rig refuses it.
        UnsupportedError: If another rig refuses it.
    """
    try:
        if step.command is None:
            machine.note(step.note, tags=list(step.tags))
            return
        request = step.command.request
        machine.send(request.command, **request.request())
    except RefusedError as error:
        if wire.ENDED in str(error):
            return  # `measure_end` judges the end of the run
        kind = BenchError if owns_rig else UnsupportedError  # a device may have changed the state of the test's own rig
        raise kind(f"the rig refuses a step at {step.at_s:g} s: {error}") from None


def finish_run(trial: Trial, expects: Sequence[Expect] | None = None) -> CaseRecording:
    """End the run, the devices and the recording, and judge the devices, for campaign files and tests in Python alike.

    Args:
        trial: The running test.
        expects: Expectations of a campaign file; None for a test in Python.

    Raises:
        BenchError: If the rig or the recording failed.
        ReplacedRecordingError: If the recording was removed, replaced or altered.
    """
    assert trial.bench is not None
    assert trial.record is not None
    lost = trial.bench.lost
    trial.bench.stop()
    if trial.target.owns_rig:
        trial.record.wait()
    for device in trial.devices:
        end_device(device, trial)
    trial.recording = trial.record.stop()  # no device can alter it any more
    names = {device.rig_name: device.name for device in trial.devices}
    results = CaseRecording(trial.recording, trial.folder, trial.origin_s, names)
    for device in trial.devices:
        _measure_device(device, results, trial, lost)
    measure_interference(results, trial, expects)
    if trial.devices and not trial.has_folder():
        trial.take(Measurement("times that {folder} was removed or replaced", 1.0, Must("==", 0.0, "1")))
    if (files := sum(1 for _ in trial.find_files())) > MAX_FILES:
        trial.take(Measurement("files in {folder}", float(files), Must("<=", float(MAX_FILES), "1"), note="or more"))
    return results


def note_early_ends(trial: Trial) -> None:
    """Note which devices have ended by now, before the end of the run."""
    for device in trial.devices:
        device.has_ended_early = not device.program.is_ended and device.program.status is not None


def end_device(device: Device, trial: Trial) -> None:
    """Wait for a device to end after the run, and judge its exit status and output unless the test has ended it."""
    program, wait = device.program, device.bench.settings.wait
    wait_until(lambda: program.status is not None or not trial.target.owns_rig, wait.end_s)
    status = program.status
    device.end()
    note = f"its last line: {program.last_line}" if status else ""
    if status is None and program.status == KILLED:
        status, note = KILLED, f"it had to be killed: it did not end within end_s = {wait.end_s:g} s of a SIGTERM"
    if status is not None and not device.is_ended_by_test:
        must = Must("==", 0.0, "1")
        trial.take(Measurement(f"exit status of {device.name}", float(status), must, note=note))
    if program.is_output_cut:
        must = Must("<=", program.max_output_bytes / 1e6, "MB")
        value = program.output_bytes / 1e6
        trial.take(Measurement(f"output of {device.name}", value, must, note=program.last_line))


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


def measure_interference(results: CaseRecording, trial: Trial, expects: Sequence[Expect] | None) -> None:
    """Add a failed measurement if a device changed the test: its faults or its steps.

    In a test in Python also if it stopped the run; `measure_end` judges that for a campaign file.
    """
    assert trial.bench is not None
    commands = {*_EQUIPMENT, *(() if expects is not None or any(each.may_end for each in trial.devices) else ("stop",))}
    for event in expected_events(expects or ()):
        commands -= {event.event, event.where.get("command")}
    for at_s, event in results.events if trial.devices and trial.target.owns_rig else ():
        command, sender = event.get("command"), event.get("from")
        if event["event"] == "command" and command in commands and sender not in trial.bench.client_names:
            name, note = f"commands {command} of devices", f"by {sender}; it is up to the test"
            trial.take(Measurement(name, 1.0, Must("==", 0.0, "1"), note=note, at_s=at_s))
            commands.discard(command)


def _measure_device(device: Device, results: CaseRecording, trial: Trial, lost: Mapping[str, str]) -> None:
    """Judge whether a device was lost in lockstep, with the rig's reasons, and whether it ended or left early.

    Args:
        device: The device.
        results: The recording.
        trial: The running test.
        lost: Devices that the rig listed as lost at the end of the test, which the recording may not cover.
    """
    states = [
        (at_s, str(event.get("state")), str(event.get("reason", ""))) for at_s, event in results.events
        if event["event"] == "device" and event.get("device") == device.rig_name
    ]  # fmt: skip
    ends_s = [at_s for at_s, event in results.events if event["event"] == "end"]
    losses = [(at_s, reason) for at_s, state, reason in states if state == "lost"]
    if not losses and device.rig_name in lost:
        losses = [(None, lost[device.rig_name])]
    if trial.bench is not None and trial.bench.pace == "lockstep" and (device.was_lost or not device.is_ended_by_test):
        at_s = losses[0][0] if losses else None
        note = "; ".join(reason for _, reason in losses)
        name = f"times that {device.name} was lost"
        trial.take(Measurement(name, float(len(losses)), Must("==", 0.0, "1"), note=note, at_s=at_s))
    if device.changed_digests:
        trial.digests |= {f"{name}, after the run": digest for name, digest in device.changed_digests.items()}
        name, count = f"changed program files of {device.name}", float(len(device.changed_digests))
        reason = f"changed during the run: {', '.join(device.changed_digests)}; output belongs in {{folder}}"
        trial.take(Measurement(name, count, Must("==", 0.0, "1"), open_reason=reason))
    left_s = [at_s for at_s, state, _ in states if state == "left" and ends_s and at_s < ends_s[0]]
    if (left_s or device.has_ended_early) and not (device.may_end or device.is_ended_by_test):
        note = f"it {'left lockstep' if left_s else 'ended'} before the run; may_end = true allows it"
        name, at_s = f"early ends of {device.name}", left_s[0] if left_s else None
        trial.take(Measurement(name, 1.0, Must("==", 0.0, "1"), note=note, at_s=at_s))


def run_repeatedly(case: Case, trial: Trial, count: int, new_trial: Callable[[], Trial]) -> None:
    """Run a case several times; what differs between the runs becomes inconclusive.

    Args:
        case: The case.
        trial: Trial of the first run, which keeps the measurements.
        count: Number of runs.
        new_trial: Makes the trials of the other runs.

    Raises:
        BenchError: If the rig, a device or the recording fails in the same way in every run.
        UnsupportedError: If the bench cannot do what the case needs.
    """
    if count == 1:
        run_case(case, trial)
        return
    runs: list[dict[str, list[str]]] = []
    errors: list[Exception] = []
    error: Exception | None
    for number in range(count):
        current, error = trial if number == 0 else new_trial(), None
        try:
            run_case(case, current)
        except (BenchError, ConnectionError, TimeoutError) as caught:
            errors.append(caught)
            error = caught
        finally:
            if current is not trial:
                current.close(failed=False)
        runs.append(list_findings(current, error))
    compare_runs(trial, runs, errors[0] if errors else None)


def compare_runs(trial: Trial, runs: Sequence[Mapping[str, list[str]]], error: BaseException | None) -> None:
    """Make measurements of a trial inconclusive that differ between its runs, and add the number of runs alike.

    Args:
        trial: Trial of one of the runs.
        runs: Findings of each run, see `list_findings`.
        error: Error of a run, raised if all runs are alike.
    """
    differences = {
        name: f"run {number}: {name} is {_show(run, name)}, not {_show(runs[0], name)}"
        for number, run in reversed(list(enumerate(runs[1:], 2)))
        for name in {**runs[0], **run} if run.get(name) != runs[0].get(name)
    }  # fmt: skip
    if error is not None and not differences and not isinstance(error, MeasurementError):
        raise error
    trial.measurements[:] = [
        replace(each, open_reason=each.open_reason or differences.get(each.name, "")) for each in trial.measurements
    ]
    alike, count, reason = runs.count(runs[0]), len(runs), "; ".join(list(differences.values())[:_MAX_DIFFERENCES])
    must, note = Must("==", float(count), "1"), f"{alike} of {count} alike"
    trial.take(Measurement(REPETITION_NAME, float(alike), must, note=note, open_reason=reason and f"{note}: {reason}"))


def list_findings(trial: Trial, error: BaseException | None = None) -> dict[str, list[str]]:
    """Return verdicts and, in lockstep, values by the name of the measurement, and the error that ended the run.

    An error of the test itself is listed by its type, as its text may have names and values of the run.
    """
    in_lockstep = trial.bench is not None and trial.bench.pace == "lockstep"
    found: dict[str, list[str]] = {}
    if error is not None and not isinstance(error, MeasurementError):
        is_of_bench = isinstance(error, BenchError | ConnectionError | TimeoutError)
        found["error"] = [trial.mask_addresses(str(error)) if is_of_bench else type(error).__name__]
    for each in trial.measurements:
        number = "nothing" if math.isnan(each.value) else with_unit(repr(each.value), each.must.unit)
        value = f"{number}, " if in_lockstep else ""
        found.setdefault(each.name, []).append(f"{value}{each.outcome.value}")
    return found


def _show(run: Mapping[str, list[str]], name: str) -> str:
    return " and ".join(run.get(name, ["missing"]))
