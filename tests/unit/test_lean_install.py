"""Clients of a rig work without the extra `full`, and other commands report that they need it."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from rig.base.errors import FULL_PACKAGES, INSTALL_COMMAND
from tests.processes import ROOT

LEAN = """
import sys

sys.modules |= dict.fromkeys({full!r})  # neither imported nor found
"""
RECORDING = ROOT / "replays/sessions/hammer-5.2.mcap"
CLIENTS = (
    "drivers.daq", "drivers.console", "drivers.instruments.twins", "drivers.instruments.force.driver",
    "drivers.sources.can", "drivers.can.interface", "recorder.session", "recorder.reader", "recorder.rewrite",
    "replays.player",
    "rig.cli.commands.record", "rig.cli.commands.status", "rig.cli.commands.info", "rig.cli.commands.twins",
    "rig.serve.transport.zenoh",    "replays.recordings.formats.readers.delimited",
)  # fmt: skip


def run_lean(code: str) -> subprocess.CompletedProcess[str]:
    """Run a program as on a machine without the extra."""
    program = LEAN.format(full=set(FULL_PACKAGES)) + code
    return subprocess.run([sys.executable, "-c", program], cwd=ROOT, text=True, capture_output=True, timeout=120)


def test_the_message_names_the_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra = {re.split(r"[>=<\[]", line)[0] for line in project["optional-dependencies"]["full"]}
    assert {name.lower() for module in FULL_PACKAGES for name in packages_distributions()[module]} == extra


def test_clients_need_no_more_than_the_lean_install() -> None:
    done = run_lean("\n".join(f"import {module}" for module in CLIENTS))
    assert (done.returncode, done.stderr) == (0, "")


def test_commands_of_the_full_install_explain_how_to_get_it() -> None:
    done = run_lean("from rig.cli.main import main; main(['simulate', 'hammer', '-o', 'never.csv'])")
    need = r"numba, which comes with the whole rig: pip install 'rotor-stator-rig\[full\]'"
    assert done.returncode == 2
    assert re.fullmatch(f"rig: this needs {need}\n", done.stderr)
    assert re.search(f"rig.simulate needs {need}", run_lean("import rig; rig.simulate('hammer')").stderr)


FULL_ARGUMENTS = {
    "score": "{rec} --against {rec}", "compare": "{rec} {rec}",
    "import": "{rec} --template x.toml", "validate": "{rec}", "identify": "{rec} --fit contact.friction",
    "view": "{rec}", "sessions": "-o {folder}", "campaign": "hammer", "run": "hammer",
    "simulate": "hammer -o {folder}/x.mcap", "sweep": "x.toml -o {folder}/x", "map": "x.toml -o {folder}/x",
    "plot": "{rec} -o {folder}/plots",
    "can": "hub c0", "ladder": "hammer -q whirl_frequency -t 0.1", "paper": "-o {folder}/x.html",
}  # fmt: skip
"""Arguments of commands that need the extra."""


def test_the_help_names_the_commands_that_need_the_whole_rig(tmp_path: Path) -> None:
    from rig.cli.app import COMMANDS, NEED_FULL

    shown = " ".join(run_lean("from rig.cli.main import main; main(['-h'])").stdout.split())
    assert shown.endswith(f"{INSTALL_COMMAND}: {', '.join(NEED_FULL)}.")
    assert set(NEED_FULL) <= {name for commands in COMMANDS.values() for name in commands}
    given = {name: FULL_ARGUMENTS.get(name, "").format(rec=RECORDING, folder=tmp_path).split() for name in NEED_FULL}
    done = run_lean(
        f"from rig.cli.main import main\nfor name, rest in {given!r}.items():\n"
        "    try:\n        main([name, *rest])\n    except SystemExit as end:\n        print(name, end.code)"
    )
    assert done.stdout.split("\n")[:-1] == [f"{name} 2" for name in NEED_FULL], done.stderr
    assert len(re.findall("^rig: this needs .* comes with the whole rig", done.stderr, re.MULTILINE)) == len(NEED_FULL)
    assert list(tmp_path.iterdir()) == []


def test_the_lean_install_writes_the_same_csv(tmp_path: Path) -> None:
    from rig.cli.main import main

    for unit in ("engineering", "counts"):
        arguments = ["export", str(RECORDING), "--to", "0.05", "--unit", unit, "-o"]
        done = run_lean(f"from rig.cli.main import main; main({[*arguments, str(tmp_path / 'lean.csv'), '--force']!r})")
        assert (done.returncode, done.stderr) == (0, "")
        with pytest.raises(SystemExit) as end:
            main([*arguments, str(tmp_path / "whole.csv"), "--force"])
        assert end.value.code == 0
        ours, theirs = ((tmp_path / f"{name}.csv").read_text().splitlines() for name in ("lean", "whole"))
        assert ours[0] == theirs[0]
        assert [[*map(float, line.split(","))] for line in ours[1:]] == [
            [*map(float, line.split(","))] for line in theirs[1:]
        ]


OTHER_EXTRAS = {"asammdf", "nptdms", "pyuff", "soundfile", "pytest", "xdist", "mcap_ros2", "hypothesis"}
LEAN_ARGUMENTS = {
    "info": "{rec}", "info --json": "{rec}", "cut": "{rec} --from 0.1 --to 0.2 -o {folder}/cut.mcap",
    "recover": "{rec} --force -o {folder}/recovered.mcap", "export": "{rec} --to 0.1 -o {folder}/run.csv",
    "keys init": "{folder}/keys --host 127.0.0.1 --keep-authority", "keys add": "{folder}/keys daq1",
    "keys remove": "{folder}/keys daq1", "completion": "bash", "hammer": "-h", "speed": "-h", "release": "-h",
    "fault": "-h", "stop": "-h", "step": "-h", "status": "-h", "note": "-h", "twins": "-h", "daqmx": "-h",
    "modbus": "--map", "record": "-h",
    "replay": "-h", "pause": "-h", "resume": "-h", "seek": "-h", "rate": "-h",
}  # fmt: skip
"""Commands that docs/install.md promises without extras; for those of a running rig only the help is called."""


def test_each_promised_command_runs_without_any_extra(tmp_path: Path) -> None:
    given = [
        [*name.split(), *rest.format(rec=RECORDING, folder=tmp_path).split()] for name, rest in LEAN_ARGUMENTS.items()
    ]
    done = run_lean(
        f"sys.modules |= dict.fromkeys({OTHER_EXTRAS!r})\nfrom rig.cli.main import main\nfor words in {given!r}:\n"
        "    try:\n        main(words)\n    except SystemExit as end:\n        print('END', words[0], end.code)"
    )
    ends = re.findall("^END (.*)$", done.stdout, re.MULTILINE)
    assert ends == [f"{words[0]} 0" for words in given], done.stderr
    assert {each.name for each in tmp_path.iterdir()} >= {"cut.mcap", "recovered.mcap", "run.csv", "keys"}
