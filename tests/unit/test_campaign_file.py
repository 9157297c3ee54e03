"""Campaigns in TOML: their cases, and errors in one line with file and line number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from replays.campaigns.equipment.device import CAN_PLACES, fill_placeholders
from replays.campaigns.files.campaign import Campaign, campaign_path, find_shipped, load_campaign, read_title
from replays.campaigns.files.expectation import ExpectEvent
from replays.campaigns.files.line_numbers import number_lines
from replays.campaigns.files.scored import ExpectScore
from rig.base.errors import InputError
from tests.commands import run_captured

HEAD = 'title = "T"\nscene = "hammer"\n'
TWO = (
    '[[devices]]\ncommand = "python -m json.tool"\nname = "one"\n'
    '[[devices]]\ncommand = "python -m y.tool"\nname = "two"\n'
)
OUTSIDE = 'device = { command = "python -m json.tool", joins = false, name = "out" }\n'
PEAK = '[[expect]]\nsignal = "disk_x"\nmust = "<= 2 mm"\n'
EVENT = '[[expect]]\nevent = "{}"\nwhere = {{ {} }}\nappears = false\n'


def load(folder: Path, text: str) -> Campaign:
    file = folder / "x.campaign.toml"
    file.write_text(text, encoding="utf-8")
    return load_campaign(file)


WRONG = {
    "no TOML": (HEAD + "duration_s 3\n", 3, "must be TOML"),
    "unknown key": (
        HEAD + "durations_s = 3\n" + PEAK,
        3,
        "durations_s must be a known field, such as duration_s",
    ),
    "no title": ('scene = "hammer"\n' + PEAK, 1, "title must be given"),
    "unknown scene": ('title = "T"\nscene = "hamer"\n' + PEAK, 2, "scene must be one of"),
    "unknown parameter": (HEAD + '[set]\n"drive.sped_hz" = 3.0\n' + PEAK, 4, "such as drive.speed_hz"),
    "value out of its range": (HEAD + "[set]\nduration_s = -3\n" + PEAK, 4, "duration_s must be greater than 0"),
    "value of the matrix": (
        HEAD + '[matrix.set]\n"drive.speed_hz" = [\n  3.0,\n  900.0]\n' + PEAK,
        4,
        "at most drive.top_speed",
    ),
    "pace": (HEAD + 'pace = "fast"\n' + PEAK, 3, "pace must be"),
    "block": (HEAD + "block_ms = 0\n" + PEAK, 3, "block_ms must be"),
    "long block": (HEAD + "block_ms = 1000.5\n", 3, "block_ms must be less than or equal to 1000"),
    "nothing expected": (HEAD, 1, "expect must be"),
    "unknown signal": (
        HEAD + '[[expect]]\nmust = "<= 2 mm"\nsignal = "disk_z"\n',
        5,
        "expect.signal must be one of the channels, such as disk_",
    ),
    "unknown truth": (
        HEAD + PEAK + 'truth = "contacts"\n',
        6,
        "expect.truth must be one of the tables of the truth, such as contact",
    ),
    "unit of another quantity": (
        HEAD + PEAK.replace("mm", "N"),
        5,
        "must be in a unit of length, as peak of disk_x is in mm",
    ),
    "limit without unit": (HEAD + PEAK.replace(" mm", ""), 5, "must be with a unit, as peak of disk_x is in mm"),
    "unit of what has none": (
        HEAD + PEAK.replace("disk_x", "keyphasor"),
        5,
        "must be without a unit, as peak of keyphasor has none",
    ),
    "no comparison": (HEAD + PEAK.replace("<= 2", "under 2"), 5, "a comparison with a number and its unit"),
    "interval turned round": (HEAD + PEAK.replace("<= 2", "4 to 2"), 5, "from the lower number to the higher"),
    "step behind the end": (
        HEAD + '[[steps]]\ncommand = "hammer"\nat_s = 2.5\n' + PEAK,
        5,
        "steps.at_s must be before the case's end, 2 s",
    ),
    "step before the start": (
        HEAD + '[[steps]]\nat_s = -1.0\ncommand = "hammer"\n' + PEAK,
        4,
        "steps.at_s must be greater than or equal to 0",
    ),
    "window turned round": (HEAD + PEAK + "from_s = 1.5\nto_s = 1.0\n", 7, "expect.to_s must be after from_s, 1.5 s"),
    "window behind the end": (
        HEAD + PEAK + "from_s = 3.0\n",
        6,
        "expect.from_s must be within the case, which ends at 2 s",
    ),
    "unknown command": (HEAD + '[[steps]]\nat_s = 1.0\ncommand = "hit"\n' + PEAK, 5, "hammer"),
    "number of a command": (
        HEAD + '[[steps]]\nat_s = 1.0\ncommand = "hammer"\nforce_n = 5000.0\n' + PEAK,
        6,
        "steps.force_n must be less than or equal to 1000",
    ),
    "two pulses at once": (
        HEAD + '[[steps]]\nat_s = 0.021\ncommand = "hammer"\n' + PEAK,
        3,
        "steps.hammer must be idle",
    ),
    "fault of no channel": (
        HEAD + '[[steps]]\nat_s = 1.0\ncommand = "fault"\nchannel = "disk_z"\nkind = "stuck"\n' + PEAK,
        6,
        "one of the channels, or of their groups, such as disk_",
    ),
    "no such fault": (
        HEAD + '[matrix]\nfault = [\n  { id = "none" },\n  { channel = "disk_x", kind = "stuk" },\n]\n' + PEAK,
        6,
        "one of the kinds, such as stuck",
    ),
    "two cases of one name": (
        HEAD + '[matrix]\nscene = ["hammer", "hammer"]\n' + PEAK,
        3,
        "cases with different names",
    ),
    "missing program": (
        HEAD + '[device]\ncommand = "protction {url}"\n' + PEAK,
        4,
        "device.command must be a program in PATH, or a file relative to ",
    ),
    "missing script": (
        HEAD + '[device]\ncommand = "python protction.py"\n' + PEAK,
        4,
        "a program with a script that exists in ",
    ),
    "unknown place": (
        HEAD + '[device]\ncommand = "python -m json.tool {danger}"\n' + PEAK,
        4,
        "a text with known names in braces, such as",
    ),
    "misspelt place": (
        HEAD + '[limits]\ndanger = "2 mm"\n' + PEAK.replace("2 mm", "{dangr}"),
        7,
        "expect.must must be a text with known names in braces, such as danger; received",
    ),
    "limit that is a number": (
        HEAD + "[limits]\ndanger = 2\n" + PEAK,
        4,
        "limits.danger must be a number with its unit as a text, such as '0.2 mm'; received 2",
    ),
    "name of a device": (
        HEAD + '[device]\ncommand = "python -m json.tool"\nname = " "\n' + PEAK,
        5,
        "device.name must be 1 to 50 letters, digits, dots, dashes and underscores; received ' '",
    ),
    "place in another unit": (
        HEAD + '[limits]\ndanger = "2 mm"\n[device]\ncommand = "python -m json.tool {danger:N}"\n' + PEAK,
        6,
        "with danger in a unit of length",
    ),
    "limit that is none": (
        HEAD + '[limits]\ndanger = "much"\n' + PEAK,
        4,
        "limits.danger must be a number with its unit",
    ),
    "CAN without a bus": (
        HEAD + '[device]\ncommand = "python -m json.tool {can}"\n' + PEAK,
        4,
        "without {can} unless can = true",
    ),
    "socketcand without a bus": (
        HEAD + '[device]\ncommand = "python -m json.tool {socketcand}"\n' + PEAK,
        4,
        "without {socketcand} unless can = true",
    ),
    "SLCAN without a bus": (
        HEAD + '[device]\ncommand = "python -m json.tool {{{slcan}}}"\n' + PEAK,
        4,
        "without {slcan} unless can = true",
    ),
    "single brace": (
        HEAD + '[device]\ncommand = "awk \'{print}\' { x"\nname = "a"\n' + PEAK,
        4,
        "device.command must be a text with known names in braces",
    ),
    "brace of nothing": (
        HEAD + '[device]\ncommand = "python -m json.tool }"\n' + PEAK,
        4,
        "device.command must be a text with {url}, {can}, {socketcand}, {slcan}, {daqmx}, {name}, {folder}, and {{",
    ),
    "device and devices": (
        HEAD + TWO.replace("[[devices]]", "[device]", 1) + PEAK,
        6,
        "devices must be left out with [device]; received 1",
    ),
    "two devices of one name": (
        HEAD + TWO.replace('"two"', '"one"') + PEAK,
        8,
        "devices.name must be another name than rig and those of other devices; received 'one'",
    ),
    "a device named as the rig": (HEAD + TWO.replace('"one"', '"rig"') + PEAK, 5, "another name than rig"),
    "missing program of the second": (
        HEAD + TWO.replace("y.tool", "y.tool {urll}") + PEAK,
        7,
        "devices.command must be a text with known names in braces, such as url",
    ),
    "events of a device outside lockstep": (
        HEAD + OUTSIDE + '[[expect]]\nevent = "note"\nwhere = { tags = "trip", from = "out" }\n',
        4,
        "expect must be about events whose time is exact, not of out: the rig does not wait for it in lockstep (use "
        "joins = true, or pace = \"real-time\"); received 'note tags=trip from=out'",
    ),
    "no event of a device outside lockstep": (
        HEAD + OUTSIDE + '[[expect]]\nevent = "note"\nappears = false\n',
        4,
        "not of out",
    ),
    "order of events of a device outside lockstep": (
        HEAD + OUTSIDE + '[[expect]]\norder = [{ event = "hammer" }, { event = "note", where = { from = "CAN 7" } }]\n',
        4,
        "not of out",
    ),
    "time since an event of a device outside lockstep": (
        HEAD + OUTSIDE + '[[expect]]\nevent = "end"\nsince = { event = "note" }\nmust = "<= 1 s"\n',
        4,
        "not of out",
    ),
    "about nothing": (
        HEAD + '[[expect]]\nmust = "<= 2 mm"\n',
        3,
        "expect must be about one of signal, event, order, score",
    ),
    "about two things": (HEAD + PEAK + 'event = "hammer"\n', 3, "received signal and event"),
    "no level": (HEAD + PEAK + 'take = "first beyond"\n', 3, "expect.beyond must be given"),
    "orbit of two units": (
        HEAD + PEAK.replace('"disk_x"', '["disk_x", "P_E"]'),
        4,
        "two of one unit; received disk_x in mm and P_E in N",
    ),
    "when of no axis": (
        HEAD + PEAK + 'when = { vote = "1oo2" }\n',
        6,
        "expect.when.vote must be an axis of the matrix",
    ),
    "when of no value": (
        HEAD + PEAK + 'when = { scene = "drop" }\n[matrix]\nscene = ["hammer", "stable-run"]\n',
        6,
        "a value of scene in the matrix",
    ),
    "since nothing": (
        HEAD + '[[expect]]\nevent = "note"\nsince = {}\nmust = "<= 1 s"\n',
        5,
        "given by one of at_s, event and signal",
    ),
    "value of no number": (
        HEAD + '[[expect]]\nscore = "mapping"\nfile = "x.csv"\nmust = "== 1"\n',
        6,
        "expect.must must be left out where score is mapping",
    ),
    "unit of which channel": (
        HEAD + '[[expect]]\nscore = "noise"\nfile = "x.csv"\nmust = "<= 2 um"\n',
        3,
        "expect.channel must be one of the channels with must",
    ),
    "unit of a quantity": (
        HEAD + '[[expect]]\nscore = "corner"\nfile = "x.csv"\nmust = ">= 5"\n',
        6,
        "must be with a unit, as corner is in Hz",
    ),
    "misspelt field": (
        HEAD + EVENT.format("hammer", "force = 100.0"),
        5,
        "expect.where.force must be a field of the event hammer, such as force_n",
    ),
    "text for a number": (HEAD + EVENT.format("hammer", 'force_n = "100"'), 5, "where.force_n must be a valid number"),
    "value out of range": (HEAD + EVENT.format("hammer", "force_n = 1e4"), 5, "less than or equal to 1000"),
    "true for a number": (HEAD + EVENT.format("speed", "speed_hz = true"), 5, "must be a valid number; received True"),
    "not a number": (HEAD + EVENT.format("hammer", "force_n = nan"), 5, "must be a finite number"),
    "no such direction": (HEAD + EVENT.format("hammer", 'direction = "z"'), 5, "where.direction must be x, y, -x, -y"),
    "misspelt command": (
        HEAD + EVENT.format("command", 'command = "sped"'),
        5,
        "one of the known names, such as speed",
    ),
    "command without an event": (HEAD + EVENT.format("command", 'command = "join"'), 5, "where.command must be"),
    "field of another command": (
        HEAD + EVENT.format("command", 'command = "speed", "request.force_n" = 1.0'),
        5,
        "where.request.force_n must be a field of the event command, such as request.speed_hz",
    ),
    "field in a table": (
        HEAD + EVENT.format("command", 'command = "speed", request.speed_hz = "0"'),
        5,
        "where.request.speed_hz must be a valid number",
    ),
    "no such kind": (
        HEAD + EVENT.format("fault", '"what.kind" = "stuk"'),
        5,
        "where.what.kind must be one of the known names, such as stuck",
    ),
    "number of another kind": (
        HEAD + EVENT.format("fault", '"what.kind" = "gain", "what.rms_us" = 1.0'),
        5,
        "where.what.rms_us must be a field of the event fault, such as what.",
    ),
    "channel that is none": (HEAD + EVENT.format("fault", 'channels = "disk_z"'), 5, "a channel or a group, such as"),
    "no such state": (HEAD + EVENT.format("device", 'state = "joind"'), 5, "must be 'joined', 'left' or 'lost'"),
    "tags that are numbers": (HEAD + EVENT.format("note", "tags = 1"), 5, "where.tags must be a valid list"),
    "text of an event without one": (HEAD + EVENT.format("hammer", "") + 'text = "x"\n', 7, "hammer has no text"),
    "misspelt field in an order": (
        HEAD + '[[expect]]\norder = [{ event = "note" },\n  { event = "note", where = { form = "dut" } }]\n',
        5,
        "expect.order.where.form must be a field of the event note, such as from",
    ),
    "misspelt field of an origin": (
        HEAD + '[[expect]]\nevent = "note"\nmust = "<= 1 s"\nsince = { event = "note", where = { tag = "a" } }\n',
        6,
        "expect.since.where.tag must be a field of the event note, such as tags",
    ),
    "condition on no event": (
        HEAD + '[[expect]]\nevent = "note"\nmust = "<= 1 s"\nsince = { at_s = 0.1, where = { tags = "a" } }\n',
        6,
        "expect.since.where must be left out without event",
    ),
    "origin of a number": (
        HEAD + '[[expect]]\nevent = "note"\ntake = "count"\nmust = "== 1"\nsince = { at_s = 0.1 }\n',
        7,
        "expect.since must be left out where take is count",
    ),
    "origin behind the end": (
        HEAD + '[[expect]]\nevent = "note"\nmust = "<= 1 s"\nsince = { at_s = 2.0 }\n',
        6,
        "expect.since.at_s must be within the case, which ends at 2 s",
    ),
    "window from the end": (HEAD + PEAK + "from_s = 2.0\n", 6, "expect.from_s must be within the case"),
    "axis that nothing uses": (
        HEAD + PEAK + '[matrix.device]\nvote = ["1oo2", "2oo2"]\n',
        7,
        "matrix.device.vote must be used somewhere as {vote}",
    ),
    "limit that nothing uses": (
        HEAD + '[limits]\ndanger = "2 mm"\n' + PEAK,
        4,
        "limits.danger must be used somewhere as {danger}",
    ),
    "limits of the matrix that nothing uses": (
        HEAD + '[matrix.limits]\ndanger = ["2 mm"]\n' + PEAK,
        4,
        "matrix.limits.danger must be used",
    ),
    "axis without faults": (HEAD + "[matrix]\nfault = []\n" + PEAK, 4, "matrix.fault must be a value of at least 1"),
    "axis without scenes": (HEAD + "[matrix]\nscene = []\n" + PEAK, 4, "matrix.scene must be a value of at least 1"),
    "no steps": (HEAD + "steps = []\n" + PEAK, 3, "steps must be a value of at least 1"),
    "when of no values": (
        HEAD + PEAK + 'when = { scene = [] }\n[matrix]\nscene = ["hammer", "stable-run"]\n',
        6,
        "expect.when.scene must be a value or a list of values",
    ),
    "limit without end": (HEAD + PEAK.replace("2 mm", "1e999 mm"), 5, "must must be with finite numbers only"),
    "level without end": (
        HEAD + PEAK.replace("2 mm", "1 s") + 'take = "time beyond"\nbeyond = "1e999 mm"\n',
        7,
        "finite",
    ),
    "level below zero": (
        HEAD + PEAK.replace("2 mm", "1 s") + 'take = "first beyond"\nbeyond = "-1 mm"\n',
        7,
        "at least 0",
    ),
    "limit that all values meet": (
        HEAD + PEAK.replace("<= 2", ">= 0"),
        5,
        "a limit that decides, as peak of disk_x is",
    ),
    "limit that no value meets": (HEAD + PEAK.replace("<= 2", "<= -2"), 5, "a limit that decides"),
    "limit that all numbers meet": (
        HEAD + '[[expect]]\nevent = "note"\ntake = "count"\nmust = "!= 0.5"\n',
        6,
        "must be a limit that decides, as number of note is a whole number from 0 on",
    ),
    "window of a moment": (
        HEAD + PEAK + 'take = "value"\nat_s = 1.0\nto_s = 0.5\n',
        8,
        "expect.to_s must be left out with at_s",
    ),
    "window within a block": (
        HEAD + EVENT.format("note", "") + "from_s = 0.501\nto_s = 0.509\n",
        8,
        "expect.to_s must be after a multiple of block_ms since from_s",
    ),
    "text of two lines": (HEAD + EVENT.format("note", "") + 'text = "a\\nb"\n', 7, "expect.text must be a line"),
    "note of the campaign itself": (
        HEAD + 'steps = [{ at_s = 0.1, note = "go", tags = ["reset"] }]\n'
        '[[expect]]\nevent = "note"\nwhere = { tags = "reset" }\n',
        6,
        "expect.where must be given with from, as the step at 0.1 s is such a note too",
    ),
    "limit with the name of an axis": (
        HEAD + 'limits = { a = "2 mm" }\n[matrix.device]\na = ["9 mm"]\n' + PEAK.replace("2 mm", "{a}"),
        5,
        "matrix.device.a must be another name than those of placeholders",
    ),
    "no such quantity": (HEAD + '[[expect]]\nscore = "gian"\nfile = "x.csv"\n', 4, "such as gain"),
}


RIGHT = (
    ("hammer", "force_n = 100, direction = 'x'"), ("command", "command = 'stop', from = 'any'"),
    ("command", "'request.kind' = 'gain', 'request.factor' = 2.0"), ("note", "tags = ['a', 'b'], text = 'any'"),
    ("fault", "channel = 'probes', 'first_row.probes' = 0, what.kind = 'dropout'"), ("clear", "fault = 1, id = 1"),
    ("device", "device = 'any', state = 'lost', patience_s = 1"), ("end", "reason = 'any'"), ("warning", "text = 'x'"),
)  # fmt: skip


@pytest.mark.parametrize(("event", "where"), RIGHT)
def test_fields_that_events_have_are_accepted(event: str, where: str, tmp_path: Path) -> None:
    (case,) = load(tmp_path, HEAD + "block_ms = 1000\n" + EVENT.format(event, where)).cases
    (expect,) = case.expects
    assert isinstance(expect, ExpectEvent)
    assert not [value for value in expect.where.values() if isinstance(value, dict)]


def test_many_cases_need_a_confirmation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "x.campaign.toml"
    speeds = '[matrix.set]\n"drive.speed_hz" = {}\nseed = {}\n'
    file.write_text(HEAD + PEAK + speeds.format([3.0 + n / 10 for n in range(21)], list(range(50))), encoding="utf-8")
    status, _, err = run_captured(capsys, "campaign", file)
    assert status == 2
    assert err == f"rig: {file}:6: matrix must be at most 1,000 cases, unless --yes is given; received 1050\n"
    file.write_text(HEAD + PEAK, encoding="utf-8")
    other = tmp_path / "y.campaign.toml"
    for each in (file, other):
        each.write_text(HEAD + PEAK + speeds.format([3.0], list(range(501))), encoding="utf-8")
    status, _, err = run_captured(capsys, "campaign", file, other)
    assert (status, err) == (2, "rig: --yes must be given for more than 1,000 cases; received 1002 cases\n")
    status, _, err = run_captured(capsys, "campaign", file, "--repeat", 2)
    assert (status, err) == (2, "rig: --yes must be given for more than 1,000 cases; received 1002 cases\n")


@pytest.mark.parametrize("name", WRONG)
def test_errors_are_one_line_with_file_and_line_number(name: str, tmp_path: Path) -> None:
    text, line, says = WRONG[name]
    with pytest.raises(InputError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'x.campaign.toml'}:{line}: "), message
    assert says in message
    assert "\n" not in message


def test_the_command_prints_the_error_and_exits_with_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "x.campaign.toml"
    file.write_text(HEAD + PEAK.replace("mm", "N"), encoding="utf-8")
    status, out, err = run_captured(capsys, "campaign", file)
    assert (status, out) == (2, "")
    assert err.startswith(f"rig: {file}:5: expect.must must be in a unit of length")
    file.write_text(HEAD + PEAK, encoding="utf-8")
    for arguments, says in (
        ([f"{file}::y"], "FILE must be one of the cases"),
        ([tmp_path / "y.campaign.toml"], "file must be a file that can be read, such as"),
        ([tmp_path / "y.py"], "FILE must be a *.campaign.toml file, or tests of pytest, that exists"),
        ([file, "--url", "zenoh:127.0.0.1:1", "-j", "2"], "--jobs must be 1 with --url"),
        ([file, "--against", tmp_path], "results.json"),
    ):
        status, _, err = run_captured(capsys, "campaign", *arguments)
        assert (status, err.count("\n")) == (2, 1), err
        assert says in err


def test_device_and_limits_of_a_shipped_campaign_can_be_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").touch()
    (case,) = load_campaign(
        campaign_path("protection-trip"), "python mine.py {url} {delay:s} {danger}", ["delay=150 ms", "danger = 2 mm"]
    ).cases
    (found,) = case.devices
    assert (found.command, found.folder) == ("python mine.py {url} 0.15 2 mm", str(tmp_path))
    for name, device, limits, must in (
        ("hammer", "python mine.py", [], "^--device must be left out, as the campaign has 0 devices, not one"),
        (
            "protection-trip",
            "python other.py",
            [],
            "^--device must be a program with a script that exists in .*other.py",
        ),
        (
            "protection-trip",
            None,
            ["dely=1 ms"],
            "^--limit must be NAME=QUANTITY with a limit of the campaign, such as delay",
        ),
        ("protection-trip", None, ["delay"], "^--limit delay must be a number with its unit"),
        (
            "protection-trip",
            None,
            ["delay=150 kg"],
            "^--limit delay must be in a unit of time, as that of",
        ),
    ):
        with pytest.raises(InputError, match=must):
            load_campaign(campaign_path(name), device, limits)


def test_a_device_on_a_can_bus_replaces_the_device_of_any_campaign_with_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for place in CAN_PLACES:
        (case,) = load_campaign(campaign_path("protection-latch"), f"true {{{place}}}").cases
        assert case.bench.can
        assert case.devices[0].command == f"true {{{place}}}"
    (case,) = load_campaign(campaign_path("protection-latch"), "true {url}").cases
    assert not case.bench.can
    about = case.describe()
    assert about["settings"]["command line of protection"] == "true {url}"
    assert about["settings"]["alert"] == "500 um"
    assert about["stimuli"][0].startswith("0.3 s: fault channel=disk_x kind=gain factor=2.6")
    assert about["stimuli"][1] == "0.5 s: note acknowledged #reset"
    file = tmp_path / "x.campaign.toml"
    file.write_text(HEAD + '[[devices]]\ncommand = "true"\nname = "a"\n' + PEAK, encoding="utf-8")
    assert [case.devices[0].name for case in load_campaign(file, "true {slcan}").cases] == ["a"]
    file.write_text(HEAD + "".join(f'[[devices]]\ncommand = "true"\nname = "{n}"\n' for n in "ab") + PEAK, "utf-8")
    with pytest.raises(InputError, match="as the campaign has 2 devices, not one"):
        load_campaign(file, "true {url}")


SHIPPED = {
    "daq-acceptance": 5, "daq-loss": 2, "fault-endurance": 10, "hammer": 2, "protection-alarms": 2,
    "protection-filter": 2, "protection-inputs": 1, "protection-latch": 1, "protection-ok": 2, "protection-retrip": 1,
    "protection-speed": 2, "protection-stream": 6, "protection-trip": 2, "protection-values": 6,
    "protection-votes": 24, "protection-waveform": 2, "recorder-acceptance": 3,
}  # fmt: skip
"""Campaigns of the rig, and the number of their cases."""


def test_shipped_campaigns_are_listed_by_name_and_load(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(find_shipped()) == list(SHIPPED)
    status, out, err = run_captured(capsys, "campaign")
    assert (status, err) == (0, "")
    for name, count in SHIPPED.items():
        path = campaign_path(name)
        if path.suffix == ".py":
            assert path.read_text(encoding="utf-8").count("\ndef test_") == count
        else:
            assert len(load_campaign(path).cases) == count, name
        assert f"{name}: " in out
        assert read_title(path)[:30] in " ".join(out.split())
    with pytest.raises(InputError, match="a file or a shipped campaign, such as hammer"):
        campaign_path("hamer")


def test_shipped_campaigns_judge_what_the_device_leaves() -> None:
    for case in load_campaign(campaign_path("fault-endurance")).cases:
        assert any(isinstance(each, ExpectScore) and each.file == "daq.mcap" for each in case.expects), case.id
    for case in load_campaign(campaign_path("protection-trip")).cases:
        impact_s = case.steps[0].at_s
        early = [each for each in case.expects if isinstance(each, ExpectEvent) and each.to_s == impact_s]
        assert [each.appears for each in early] == [False], "a monitor that always trips would pass"


def test_the_cases_are_listed_with_their_number(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded: list[Any] = []

    def load(*arguments: Any, **settings: Any) -> Campaign:
        loaded.append(arguments)
        return load_campaign(*arguments, **settings)

    monkeypatch.setattr("replays.campaigns.files.campaign.load_campaign", load)
    status, out, err = run_captured(capsys, "campaign", "hammer", "recorder-acceptance", "--list")
    assert (status, err, len(loaded)) == (0, "", 1)
    assert "hammer.campaign.toml::speed_hz=5.2  0.6 s\nhammer.campaign.toml::speed_hz=6.2  0.6 s\n" in out
    assert "test_recorder_acceptance.py: tests of pytest" in " ".join(out.split())
    assert "\n2 cases, 1.2 s simulated\nestimate: 4 s of processor time (1.6 s for a case, 0.1 s for a" in out


def test_the_estimate_of_a_list_counts_cases_simulated_time_blocks_and_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def show(more: str, *words: object) -> str:
        file = tmp_path / "x.campaign.toml"
        file.write_text(f"{HEAD}duration_s = 50.0\n{more}\n{PEAK}", encoding="utf-8")
        status, out, _ = run_captured(capsys, "campaign", file, "--list", *words)
        assert status == 0
        return " ".join(out.split())

    assert "1 cases, 50 s simulated estimate: 19 s of" in show("block_ms = 10.0")  # 1.6 + 5 + 12
    assert "estimate: 127 s of" in show("block_ms = 1.0")
    assert "of processor time for 3 runs (1.6 s" in (out := show("block_ms = 10.0", "--repeat", 3))
    assert "estimate: 56 s of" in out
    assert "1 cases, 50 s simulated, of these 50 s in real time estimate" in show('pace = "real-time"')


MATRIX = """
title = "T"
about = "A device with two votes, sound and with a fault"
duration_s = 0.5
limits = { danger = "0.2 mm" }

[device]
command = "python -m json.tool {url} --danger-um {danger:um} --vote {vote} {name}"
name = "protection"

[matrix]
scene = ["hammer", "stable-run"]
fault = [{ id = "sound" }, { channel = "disk_x", kind = "stuck", at_s = 0.1, for_s = 0.2 }]

[matrix.device]
vote = ["1oo2", "2oo2"]

[matrix.limits]
danger = ["0.2 mm", "300 um"]

[[steps]]
at_s = 0.2
note = "danger is {danger}"

[[expect]]
signal = ["disk_x", "disk_y"]
take = "first beyond"
beyond = "{danger}"
must = "<= 400 ms"

[[expect]]
event = "note"
where = { from = "protection" }
when = { vote = "1oo2", fault = ["disk_x-stuck", "sound"], danger = "300um" }
"""


def test_a_matrix_is_the_product_of_its_axes(tmp_path: Path) -> None:
    campaign = load(tmp_path, MATRIX)
    assert len(campaign.cases) == 2 * 2 * 2 * 2
    case = {each.id: each for each in campaign.cases}["stable-run,disk_x-stuck,danger=300um,vote=1oo2"]
    (device,) = case.devices
    assert device.command == "python -m json.tool {url} --danger-um 300 --vote 1oo2 {name}"
    assert [(step.at_s, step.note or step.command.request.channel) for step in case.steps if step] == [
        (0.1, "disk_x"),
        (0.2, "danger is 300 um"),
    ]
    assert [len(each.expects) for each in campaign.cases] == [1, 1, 2, 1] * 4
    assert (case.bench.scene, case.duration_s) == ("stable-run", 0.5)


def test_line_numbers_inside_tables_lists_and_inline_tables() -> None:
    text = 'a.b = """\n x = 1\n"""\n[[c]]\nd = [1, # [\n  { "e.f" = "}" },\n]\n[c.g]\nh = 2\n[[c]]\ni = \'[\'\n'
    found = number_lines(text)
    assert found == {
        "a.b": 1, "c": 4, "c.0": 4, "c.0.d": 5, "c.0.d.0": 5, "c.0.d.1": 6, "c.0.d.1.e.f": 6, "c.0.g": 8, "c.0.g.h": 9,
        "c.1": 10, "c.1.i": 11,
    }  # fmt: skip


@pytest.mark.parametrize(
    "expect",
    [
        'event = "hammer"\n',
        'order = [{ event = "note" }, { event = "hammer" }]\n',
        'event = "note"\nwhere = { from = "campaign" }\n',
        'event = "command"\nwhere = { from = "in" }\n',
        'event = "speed"\n',
    ],
)
def test_a_device_outside_lockstep_leaves_other_events_to_the_campaign(expect: str, tmp_path: Path) -> None:
    devices = OUTSIDE.replace("device = ", "devices = [").strip() + ', { command = "python", name = "in" }]\n'
    steps = '[[steps]]\nat_s = 1.0\nnote = "now"\n'
    assert load(tmp_path, HEAD + devices + steps + "[[expect]]\n" + expect).cases
    if "from" not in expect:
        assert load(tmp_path, HEAD + OUTSIDE + steps + "[[expect]]\n" + expect).cases


def test_a_device_outside_lockstep_may_be_judged_in_real_time_and_by_its_file(tmp_path: Path) -> None:
    expect = '[[expect]]\nevent = "note"\nwhere = { from = "out" }\n'
    assert load(tmp_path, HEAD + 'pace = "real-time"\n' + OUTSIDE + expect).cases
    listens = OUTSIDE.replace("joins", "commands = false, joins")
    assert load(tmp_path, HEAD + listens + '[[expect]]\nevent = "command"\nappears = false\n').cases
    with pytest.raises(InputError, match="not of out"):
        load(tmp_path, HEAD + listens + expect)


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("{{word}} {url}", "{word} U"),
        ("{{{url}}}", "{U}"),
        ("{{{{", "{{"),
        ("{how} {{url}}", "{url} x {url}"),
        ('{{"a": {{"b": {number}}}}}', '{"a": {"b": 3}}'),
    ],
)
def test_two_braces_are_one_brace_of_the_text(text: str, command: str, tmp_path: Path) -> None:
    values = {"how": '["{url} x"]', "number": "[3]"}
    used = [f"{name} = {value}\n" for name, value in values.items() if f"{{{name}}}" in text]
    matrix = f"[matrix.device]\n{''.join(used)}"
    device = f"[device]\ncommand = 'python -m json.tool {text}'\n"
    (case,) = load(tmp_path, HEAD + device + matrix + PEAK).cases
    (found,) = case.devices
    assert fill_placeholders(found.command, {"url": "U"}, "command") == f"python -m json.tool {command}"
    note = '[[steps]]\nat_s = 0.1\nnote = "{{now}}"\n'
    assert load(tmp_path, HEAD + note + PEAK).cases[0].steps[0].note == "{now}"


def test_several_devices_start_in_order_and_share_the_values_of_the_matrix(tmp_path: Path) -> None:
    matrix = '[matrix.device]\nhow = ["a", "b"]\n'
    one, two = load(tmp_path, HEAD + TWO.replace("tool", "tool {how} {name}") + matrix + PEAK).cases
    assert [device.name for device in one.devices] == ["one", "two"]
    assert [device.command for device in two.devices] == [
        "python -m json.tool b {name}",
        "python -m y.tool b {name}",
    ]
