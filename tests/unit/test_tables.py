"""Tables and lines: complete on a terminal of 80 columns, and one line per row in a pipe."""

from __future__ import annotations

import ast
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import rig.cli
from replays.studies.bench.engines import CASES
from replays.studies.stability.trials.cell import Cell
from rig.cli.commands.bench import cases_table
from rig.cli.commands.info import describe, events_table
from rig.cli.commands.stability import peers_table, trials_table
from rig.cli.output.display import fit_width
from rig.cli.output.tables import echo_json, fact_table, new_table
from rig.physics.engines import ENGINES
from tests.commands import check_legible, render_lines, run_captured, run_for_output

SESSIONS = Path(__file__).parents[2] / "replays" / "sessions"
HAMMER = SESSIONS / "hammer-6.2.mcap"

COMMANDS = [
    ["scenes"],
    *(["params", name] for name in ("corrected", "as-printed", "dtu-2019")),
    ["laws"],
    ["magnets"],
    ["keys"],
    ["can", "load"],
    ["can", "load", "--can-fd"],
    ["info", HAMMER],
    ["info", HAMMER, "--quick"],
    ["info", SESSIONS / "partial-rub.mcap"],
]
INCONCLUSIVE = COMMANDS[-1]
"""The rig warned in this recording that its own error is large."""


@pytest.mark.parametrize("arguments", COMMANDS, ids=lambda arguments: " ".join(map(str, arguments[:2])))
def test_command_prints_legible_tables(arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    expected = 3 if arguments is INCONCLUSIVE else 0
    status, printed, complaints = run_captured(capsys, *arguments)
    assert status == expected, complaints
    assert len(printed.splitlines()) > 4
    assert not any(mark in printed for mark in "…│┃─━\x1b")
    status, printed, _ = run_captured(capsys, *arguments, "--json")
    assert (status, bool(json.loads(printed))) == (expected, True)


def test_a_character_outside_the_encoding_is_escaped() -> None:
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    found = subprocess.run([sys.executable, "-m", "rig", "laws"], env=environment, capture_output=True, timeout=120)
    assert found.returncode == 0, found.stderr.decode()
    assert b"\\xb5" in found.stdout


def test_json_has_null_for_missing_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    echo_json({"a": math.nan, "b": [math.inf, 1.0], "c": ({"d": -math.inf},)})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1.0], "c": [{"d": None}]}


def test_a_pipe_ignores_the_width_of_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    printed = []
    for columns in ("30", "80", "500"):
        monkeypatch.setenv("COLUMNS", columns)
        printed.append(run_for_output(capsys, "params"))
    assert printed[0] == printed[1] == printed[2]
    assert run_for_output(capsys, "params", "--wide") == printed[0]
    (row,) = [line.split() for line in printed[0].splitlines() if line.startswith("contact.friction ")]
    assert row[1:3] == ["0.25", "1"]


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
def test_a_real_terminal_shows_whole_values() -> None:
    import fcntl
    import pty
    import struct
    import termios

    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    environment |= {"TERM": "xterm", "NO_COLOR": "1"}
    command = [sys.executable, "-m", "rig", "scenes"]
    subprocess.run(command, stdout=theirs, stderr=theirs, stdin=theirs, env=environment, check=True, timeout=120)
    os.close(theirs)
    text = b""
    try:
        while block := os.read(ours, 65536):
            text += block
    except OSError:  # Linux ends a terminal without a writer in this way
        pass
    os.close(ours)
    plain = [line.rstrip() for line in text.decode().replace("\x1b[1m", "").replace("\x1b[0m", "").splitlines()]
    assert plain == lines_of_scenes()


def lines_of_scenes() -> list[str]:
    from rig.run.scenes import load_scene, scene_names

    table = new_table("", "scene", ">seconds", "what happens", wrapped=["what happens"])
    for name in scene_names():
        table.add_row(name, f"{load_scene(name).duration_s:g}", load_scene(name).title)
    return render_lines(table)


def test_trials_are_legible() -> None:
    values = (0.0, -1.2345e-07, 1.6e240, float("inf"), float("nan"))
    cells = [
        Cell(f"case {number} of a long name", value, 1e-3, "because of what is known", expected, "m", trial, engine)
        for trial in ("T1", "T12")
        for engine in ENGINES
        for number, value in enumerate(values)
        for expected in (True, False, None)[number % 3 : number % 3 + 1]
    ]
    cells[3] = cells[3]._replace(skipped="not now")
    for table in (trials_table(cells, list(ENGINES)), peers_table(cells)):
        for width in (60, 80, 100, 200):
            check_legible(table, width=width)
        text = "\n".join(render_lines(table, width=80))
        assert "1.6e+240" in text
        assert "skipped" in text
    assert not any("without" in line for line in render_lines(trials_table(cells, list(ENGINES))))


def test_timed_cases_are_legible() -> None:
    row = {"median": 12345.67, "min": 0.1, "max": 99999.9, "ratio": 0.05, "error": 1.2e-11, "residual_share": -1e-9}
    cases = [{**row, "name": case.name, "goal": 300.0, "error_goal": 2e-3, "reached": False} for case in CASES]
    table = cases_table({"cases": cases, "peers": [{**row, "name": "scipy-dop853 1e-10"}]}, runs=5)
    check_legible(table)
    assert all(any(name in line for line in render_lines(table)) for name in ("12345.7", "300 at 2.0e-03", "NO"))


@pytest.mark.parametrize("width", [50, 79, 80, 120, 300])
def test_any_table_is_legible(width: int) -> None:
    table = new_table("a title", "name", "unit", *(f">quantity {n} [kN/m^1.5]" for n in range(9)), "said", "source",
                      wrapped=("said", "source"), spare=("source", "unit"), keys=1)  # fmt: skip
    for n in range(5):
        numbers = (f"{-(10.0**k):.4e}" for k in range(9))
        table.add_row(f"name_{n}", "m/s^2", *numbers, "words " * 20 * n, "somebody, some Journal 12 (1999) 345")
    table.add_row("all of them")
    check_legible(table, width=width)
    notes = [line for line in render_lines(table, width=width) if line.startswith("columns left out: ")]
    assert notes == ([] if width == 300 else ["columns left out: unit, source (shown with --wide)"])


def test_long_text_is_folded_and_not_cut() -> None:
    table, name = new_table("", "name", ">value"), "x" * 150
    table.add_row(name, "1.25")
    lines = render_lines(table)
    assert max(map(len, lines)) <= 80
    assert "".join(line.split()[0] for line in lines[1:]) == name
    assert "1.25" in lines[1]


def test_rows_must_fit_their_headings() -> None:
    with pytest.raises(ValueError, match="a row must be 1 or 2 cells"):
        new_table("", "a", "b").add_row("1", "2", "3")


def test_facts_have_no_heading() -> None:
    table = fact_table("rig", [("a", "b " * 60), ("longer", "c")])
    lines = render_lines(table)
    assert lines[0] == "rig"
    assert lines[1].startswith("a       b b")
    assert lines[-1] == "longer  c"
    check_legible(table)


@pytest.mark.parametrize("width", range(30, 60, 3))
def test_a_number_and_its_unit_stay_on_one_line(width: int) -> None:
    lines = render_lines(fact_table("so 3.5 kN", [("all", "it took 12.5 ms of 3 MB at 100 N s/m, " * 9)]), width=width)
    assert len(lines) > 5
    assert not any(line.endswith(("12.5", "3", "100", "100 N")) for line in lines), lines


@pytest.mark.parametrize("command", [["scenes"], ["keys", "--json"], ["-h"]])
def test_a_closed_pipe_only_sets_the_exit_status(command: list[str]) -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    found = subprocess.run([sys.executable, "-m", "rig", *command], stdout=theirs, stderr=subprocess.PIPE, timeout=120)
    os.close(theirs)
    assert (found.returncode, found.stderr) == (141, b"")


def test_a_status_line_is_one_line_of_whole_parts() -> None:
    parts = ["  599.99 of 600 s", "late p99 0.12 max 123.45 ms", "clients 2"]
    assert fit_width(parts, 80) == "  599.99 of 600 s  late p99 0.12 max 123.45 ms  clients 2"
    assert fit_width(parts, 50) == "  599.99 of 600 s  late p99 0.12 max 123.45 ms"
    assert fit_width(parts, 5) == parts[0]


def test_info_reports_an_impact_once_and_its_progress(capsys: pytest.CaptureFixture[str]) -> None:
    from recorder.reader import Recording

    parts: list[float] = []
    describe(Recording.open(HAMMER), quick=False, progress=parts.append)
    assert parts == sorted(parts)
    assert 0.0 < parts[0] <= parts[-1] <= 1.0
    assert len(parts) > 10
    assert sum("hammer: " in line for line in run_for_output(capsys, "info", HAMMER).splitlines()) == 1


def test_commands_are_reported_once_with_or_without_effect() -> None:
    def command(tick: int, name: str, number: int, **request: float) -> dict[str, Any]:
        event = {"event": "command", "id": number, "command": name, "request": request, "from": f"me {number}"}
        return {**event, "tick": tick, "time_s": tick / 1e6}

    effects = [{"event": "hammer", "tick": tick, "time_s": tick / 1e6, "force_n": 100.0} for tick in (5, 7)]
    events = [command(5, "hammer", 1, force_n=100.0), effects[0], command(7, "hammer", 2, force_n=100.0), effects[1]]
    events += [command(9, "stop", 3), {"event": "note", "text": "so", "tick": [], "time_s": None}]
    table = events_table(events)
    check_legible(table)
    assert [cells[1].plain for cells, _ in table.rows] == [
        "hammer: force_n 100.0, id 1, from me 1", "hammer: force_n 100.0, id 2, from me 2",
        "command: id 3, command stop, from me 3", "note: so",
    ]  # fmt: skip


def test_compilation_is_reported_while_it_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    from rig.cli.output import compiling
    from rig.cli.output.compiling import Compiling

    beside: list[str] = []

    class Process:
        def wait(self) -> None:
            beside.append("waited for")

    def start() -> Process:
        beside.append("started")
        return Process()

    monkeypatch.setattr(compiling, "start_second_process", start)
    begun: list[str] = []
    texts: list[str] = []
    listener = Compiling(begun.append, texts.append)

    def event(module: str) -> Any:
        return SimpleNamespace(data={"dispatcher": SimpleNamespace(py_func=SimpleNamespace(__module__=module))})

    for modules in (
        ["peers.cvode"],
        ["rig.physics.engines.split.method", "numba.np.arrayobj"],
        ["rig.physics.kernels.laws.contact"],
    ):
        for module in modules:
            listener.on_start(event(module))
        for module in modules:
            listener.on_end(event(module))
    assert [text.partition(" (")[0] for text in texts] == [
        "compiling split.method", "compiling in a second process", "", "compiling laws.contact", "",
    ]  # fmt: skip
    (first,) = begun
    assert first.startswith("compiling split.method (0 s of CPU; ")
    assert first.endswith("), once on this machine")
    assert beside == ["started", "waited for"]


def test_every_command_with_tables_has_the_same_options(capsys: pytest.CaptureFixture[str]) -> None:
    """Commands with a table have --wide and --json, except those that consist of two processes."""
    found = set()
    for path in sorted(Path(next(iter(rig.cli.__path__)), "commands").glob("*.py")):
        calls = {ast.unparse(node.func) for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)}
        if calls & {"new_table", "facts"}:
            found.add(path.stem)
    commands = {name: ["can", "load"] if name == "can" else [name.rstrip("_")] for name in sorted(found - {"demo"})}
    assert len(commands) >= 14
    for name, command in commands.items():
        _, usage, _ = run_captured(capsys, *command, "--help")
        assert "--wide" in usage, name
        assert "--json" in usage, name
