"""Malformed TOML and logs of other systems, and names with control sequences for a terminal.

RIG_FUZZ_INPUTS sets the number of inputs of each test.
"""

from __future__ import annotations

import ast
import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rig.cli
from recorder.reader import Recording
from replays.recordings.formats.conversion import convert
from replays.recordings.formats.exporting.export import export
from replays.recordings.formats.exporting.selection import select
from replays.recordings.formats.guessing.template import example
from replays.recordings.formats.mapping import FileOptions, Mapping, load_mapping
from replays.recordings.formats.source import open_source
from replays.recordings.validation.criteria import DEFAULT, Criteria, load_criteria
from rig.base.checks import check, read_toml
from rig.base.errors import InputError
from rig.channels.table import TABLE, parse_table
from rig.cli.main import main
from rig.cli.output import tables
from rig.physics.parameters import SETS, load_parameters
from rig.run.scenes import SCENES, load_scene, parse_scene, read_value, scene_document, scene_names
from tests.hostile import InputTally, check_tallies, input_count
from tests.hostile.files import Layout, spoil_document, write_file
from tests.hostile.interfaces import spoil_toml


def test_any_toml_is_accepted_or_refused_in_one_line(tmp_path: Path) -> None:
    rng = np.random.default_rng([5, input_count(120)])

    def text(path: Path) -> str:
        return path.read_bytes().decode(errors="replace")

    kinds: dict[str, tuple[list[str], Callable[[Path], object]]] = {
        "scene": ([path.read_text() for path in SCENES.glob("*.toml")], lambda path: load_scene(path)),
        "set": ([path.read_text() for path in SETS.glob("*.toml")], lambda path: load_parameters(str(path))),
        "mapping": ([example()], load_mapping),
        "criteria": ([DEFAULT.read_text()], load_criteria),
        "channels": ([TABLE.read_text()], lambda path: parse_table(text(path))),
        "--set": (
            ["5.2", "[1, 2]", '"x"', "{a = 1}"],
            lambda path: read_value(text(path)),
        ),
    }
    tallies = {name: InputTally() for name in kinds}
    for number in range(input_count(120)):
        name = list(kinds)[number % len(kinds)]
        texts, load = kinds[name]
        path = tmp_path / f"x{name.strip('-')}.toml"
        path.write_bytes(data := spoil_toml(texts[int(rng.integers(0, len(texts)))], rng))
        with tallies[name].attempt(data[:200]):
            load(path)
    check_tallies(tallies)


def test_any_document_is_accepted_or_refused_in_one_line(tmp_path: Path) -> None:
    """The same TOML files as documents, with values of another type and values in place of tables."""
    (tmp_path / "m.toml").write_text(example())
    kinds: dict[str, tuple[list[Any], Callable[[Any], object]]] = {
        "scene": ([scene_document(load_scene(name)) for name in scene_names()], parse_scene),
        "scene file": ([read_toml(path) for path in SCENES.glob("*.toml")], lambda document: parse_scene(document)),
        "mapping": ([read_toml(tmp_path / "m.toml")], lambda document: check(Mapping, document, field="")),
        "criteria": ([read_toml(DEFAULT)], lambda document: check(Criteria, document, field="")),
    }
    rng = np.random.default_rng([7, input_count(200)])
    tallies = {name: InputTally() for name in kinds}
    for number in range(input_count(200)):
        name = list(kinds)[number % len(kinds)]
        documents, load = kinds[name]
        document = documents[int(rng.integers(0, len(documents)))]
        for _ in range(int(rng.integers(1, 4))):
            document = spoil_document(document, rng)
        if "\\ud800" in json.dumps(document, default=str):  # no file holds half a character
            continue
        with tallies[name].attempt(number):
            load(document)
    check_tallies(tallies)


@pytest.mark.parametrize(
    "text",
    ["9" * 5000, "-" + "9" * 30, "0x" + "f" * 5000, "[" * 5000, "[" * 40 + "]" * 40, "{a." + "a." * 200 + "a = 1}"],
)
def test_extreme_numbers_and_nesting_are_refused_in_one_line(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x.toml").write_text(f"seed = {text}\n")
    for arguments in (["params", "--set", f"contact.friction={text}"], ["scenes", str(tmp_path / "x.toml")]):
        with pytest.raises(SystemExit) as end:
            main(arguments)
        printed = capsys.readouterr()
        assert end.value.code == 2
        assert printed.err.count("\n") == 1
        assert "must be" in printed.err
        assert len(printed.err) < 400


def test_a_long_dotted_key_takes_no_time(tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text("a." * 200_000 + "a = 1\n")
    with pytest.raises(InputError, match="keys of at most 32 parts"):
        load_scene(tmp_path / "x.toml")
    (tmp_path / "y.toml").write_text("#" * (2 << 20))
    with pytest.raises(InputError, match="a readable file; received larger than 1 MB"):
        load_scene(tmp_path / "y.toml")


X = "[channels]\ndisk_x = { source = 'x', unit = 'mm' }\n"


@pytest.mark.parametrize(("method", "rate_hz"), [("linear", 1_000_000), ("polyphase", 1_000_000), ("none", None)])
def test_two_values_at_far_times_are_not_a_reason_for_a_terabyte(
    method: str, rate_hz: int | None, tmp_path: Path
) -> None:
    (tmp_path / "x.csv").write_text("time,x [mm]\n0,1\n1e9,2\n2e9,3\n")
    rate = "" if rate_hz is None else f"rate_hz = {rate_hz}\n"
    (tmp_path / "m.toml").write_text(f'{X}[resample]\nmethod = "{method}"\n{rate}')
    with pytest.raises(InputError, match=r"resample\.rate_hz must be"):
        convert([tmp_path / "x.csv"], load_mapping(tmp_path / "m.toml"))


NAMES = ("[/]", "[red]", "[bold", "\\[", "\x1b[2J\x1b[31m", "\u202eabc", "a\nrig: forged", "x" * 10_000, ":smile:")


def printed_safely(text: str) -> None:
    assert "Traceback" not in text
    for line in text.split("\n"):
        assert line.isprintable(), repr(line[:200])
        assert not line.startswith("rig: forged")


@pytest.mark.parametrize("name", NAMES)
def test_info_escapes_control_sequences_in_names(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    layout = Layout(Recording.open(write_file(tmp_path / "run.mcap")))
    text = json.dumps(name)[1:-1]
    for old in ('"disk_x"', '"hammer"', '"forces"'):
        for file in ("catalogue.json", "scene.json"):
            layout.attachments[file] = layout.attachments[file].replace(old.encode(), f'"{text}"'.encode())
            if file == "catalogue.json":
                layout.attachments[file] = layout.attachments[file].replace(b'"mm"', f'"{text}"'.encode())
            break
    layout.metadata["rig"]["scene"] = layout.metadata["rig"]["seed"] = name
    layout.metadata["end"]["reason"] = name
    layout.messages = [
        (topic, payload.replace(b"a note", text.encode()).replace(b"warned", text.encode()), time_ns)
        for topic, payload, time_ns in layout.messages
    ]
    path = layout.write(tmp_path / "x.mcap")
    for arguments in (
        ["info", str(path)],
        ["recover", str(path)],
        ["export", str(path), "-o", str(tmp_path / "o.csv")],
    ):
        with contextlib.suppress(SystemExit):
            main(arguments)
        printed = capsys.readouterr()
        printed_safely(printed.out + printed.err)


@pytest.mark.parametrize("name", [*NAMES[:7], 'a","b', "\n    -1\n    -1\n    58"])
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_names_do_not_change_the_format_of_exports(name: str, tmp_path: Path) -> None:
    layout = Layout(Recording.open(write_file(tmp_path / "run.mcap")))
    catalogue = json.loads(layout.attachments["catalogue.json"])
    for channel in catalogue["table"]["groups"]["probes"]["channels"][:1]:
        channel["name"] = channel["unit"] = channel["label"] = name
    layout.attachments["catalogue.json"] = json.dumps(catalogue).encode()
    recording = Recording.open(layout.write(tmp_path / "x.mcap"))
    for suffix in (".csv", ".uff"):
        export(select(recording, channels=["probes"], merged=suffix == ".csv"), tmp_path / f"out{suffix}")
        found = open_source(tmp_path / f"out{suffix}", FileOptions())
        assert [entry.rows for entry in found.entries] == [60] * 4
        for entry in found.entries:
            assert len(found.read(entry).values) == 60


@pytest.mark.parametrize("name", NAMES)
def test_status_and_validation_escape_control_sequences_in_names(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    from rig.cli.commands.status import status_table

    document = {
        "scene": name, "state": "running", "end_s": None, "time_s": 1.0, "tick": 5, "pace": name, "block_ms": 1.0,
        "real_time_factor": 1.0, "lateness_ms": {"p50": 0.0, "p99": 0.0, "max": 0.0, "last": 0.0}, "overruns": 0,
        "queue": {"depth": 0, "capacity": 1, "high_water": 0, "dropped": 0}, "spin_hz": 5.0,
        "energy": {"residual_j": 0.0, "dissipated_j": 0.0, "residual_share": 0.0},
        "engine": {"name": name, "step_us": 25}, "samples_published": 1, "commands": 0, "congestion": {name: 1.0},
        "clients": {name: {"lag_s": 0.0, "last_heard_s": 0.0, "lost": 0}}, "warnings": [name],
        "replay": {"rate": 1.0, "waiting_for": 0, "paused": False, "passes": None, "files": [name], "from_s": 0.0,
                   "to_s": 1.0, "pass": 1},
    }  # fmt: skip
    tables.table_console().print(status_table(document))
    for text in (name, f"scene {name}"):
        tables.echo(text.replace("\n", " "))
        with tables.table_console().status(tables.plain_text(text)):
            pass
        with tables.progress_bar() as bar:
            bar.add_task(text.replace("\n", " "), total=1)
        table = tables.new_table(text.replace("\n", " "), text.replace("\n", " "))
        table.add_row(text.replace("\n", " "))
        tables.table_console().print(table, text.replace("\n", " "))
    printed = capsys.readouterr()
    printed_safely(printed.out + printed.err)


@pytest.mark.parametrize("name", ["[/]", "[red]x", "\x1b[2J", "\u202e"])
def test_paths_with_such_names_end_no_command(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / name
    folder.mkdir(parents=True)
    write_file(folder / "run.mcap")
    (folder / "x.csv").write_text("time,x [mm]\n" + "\n".join(f"{k / 1000},{k}" for k in range(50)))
    (folder / "m.toml").write_text(X)
    for arguments in (
        ["info", f"{name}/run.mcap"],
        ["cut", f"{name}/run.mcap", "-o", f"{name}/cut.mcap"],
        ["recover", f"{name}/run.mcap", "--force"],
        ["export", f"{name}/run.mcap", "-o", f"{name}/out.csv", "--channels", "probes"],
        ["import", f"{name}/x.csv", "-m", f"{name}/m.toml", "-o", f"{name}/in.mcap"],
    ):
        with pytest.raises(SystemExit) as end:
            main(arguments)
        printed = capsys.readouterr()
        # The tests' recording contradicts itself, as its verdict reports.
        assert end.value.code == (1 if arguments[0] == "info" else 0), printed.err
        printed_safely(printed.out + printed.err)


@pytest.mark.parametrize("name", NAMES)
def test_a_path_with_control_sequences_can_be_recorded_to(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    from rig.cli.commands.record import run_session

    progress = SimpleNamespace(
        time_s=1.0, rows=5, lost=3, size_bytes=10, files=0, backlog_bytes=0, remarks=(name.replace("\n", " "),)
    )
    summary = SimpleNamespace(remarks=progress.remarks)

    def run(show: Callable[[Any], None]) -> Any:
        show(progress)
        return summary

    session = SimpleNamespace(path=Path(name), first_files=[Path(name)], run=run, stop=lambda _: None)
    assert run_session(session) is summary  # type: ignore[arg-type]
    printed_safely(capsys.readouterr().err)


def test_all_output_uses_the_common_module() -> None:
    """No command creates a console, a progress bar or a live display, or prints past the common module."""
    found = []
    for path in sorted(Path(next(iter(rig.cli.__path__))).glob("*.py")):
        if path.name in ("tables.py", "app.py", "main.py"):
            continue
        tree = ast.parse(path.read_text())
        typed = [
            branch for branch in tree.body if isinstance(branch, ast.If) and "TYPE_CHECKING" in ast.unparse(branch.test)
        ]
        only_typed = {id(node) for branch in typed for node in ast.walk(branch)}
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.ImportFrom)
                and (node.module or "").startswith("rich")
                and id(node) not in only_typed
            ):
                imported = {"Console", "Progress", "TextColumn"} & {alias.name for alias in node.names}
                found += [f"{path.name}: imports {name}" for name in imported]
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                if name in ("typer.echo", "print", "typer.secho", "rich.print", "sys.stdout.write", "sys.stderr.write"):
                    found.append(f"{path.name}:{node.lineno}: {name}")
                if name == "Live" and not any(keyword.arg == "console" for keyword in node.keywords):
                    found.append(f"{path.name}:{node.lineno}: a live display on a console of its own")
                if any(keyword.arg == "markup" for keyword in node.keywords) or name.endswith("from_markup"):
                    found.append(f"{path.name}:{node.lineno}: markup")
    sources = [ast.parse(path.read_text()) for path in Path(next(iter(rig.cli.__path__))).glob("*.py")]
    names = {alias.asname for tree in sources for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
             and (node.module or "").startswith("rich") for alias in node.names if alias.asname}  # fmt: skip
    assert not found
    assert not names, "nothing of rich under another name"
