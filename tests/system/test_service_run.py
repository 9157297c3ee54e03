"""`rig run` on the real simulation, as a process."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from drivers.console import Console
from rig.base.errors import InputError
from rig.cli.options import SceneChanges
from rig.serve.transport.zenoh import ZenohClient
from tests.commands import run_captured
from tests.processes import COMPILE_S, free_endpoint, read_line, start_python
from tests.waiting import PATIENCE_S, until

PROGRAM = """
import sys, typer
from rig.cli.groups import expand_groups
from rig.cli.commands.run import run
from rig.base.errors import InputError
app = typer.Typer(add_completion=False)
app.command()(expand_groups(run))
try:
    app()
except InputError as error:
    sys.exit(f"InputError: {error}")
"""


@contextmanager
def rig_run(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    endpoint = free_endpoint()
    listen = [] if "--listen" in arguments else ["--listen", endpoint]
    with start_python("-c", PROGRAM, *arguments, *listen) as child:
        yield child, endpoint


@pytest.mark.wallclock
def test_a_free_run_ends_with_a_summary() -> None:
    with rig_run("hammer", "--pace", "free", "--duration-s", "0.5", "--seed", "7", "--set", "drive.speed_hz=5.2") as (
        child,
        _,
    ):
        output, errors = child.communicate(timeout=COMPILE_S)
    assert child.returncode == 0, errors
    assert output.startswith("scene hammer: completed at 0.500 s")
    assert "10000 samples per channel published, blocks dropped 0" in output
    assert "listening on 127.0.0.1" in errors


@pytest.mark.wallclock
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_the_run_in_good_order(number: signal.Signals) -> None:
    with rig_run("stable-run") as (child, endpoint):
        read_line(child, "listening on")  # compiled
        with ZenohClient(endpoint, wait_s=PATIENCE_S) as client:
            console = Console(client, timeout_s=PATIENCE_S)
            until(lambda: console.status()["tick"] > 0, of=child)
            child.send_signal(number)
            output, errors = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0, errors
    assert "scene stable-run: stopped at" in output
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("hammer", "--listen", "0.0.0.0:7999"),
            "--listen must be on 127.0.0.1, since",
        ),
        (("hammer", "--listen", "7999"), "--listen must be HOST:PORT"),
        (("hammer", "--block-ms", "0.3"), "--block-ms must be a positive whole multiple of"),
        (("hammer", "--block-ms", "nan"), "--block-ms must be a number; received nan"),
        (("hammer", "--block-ms", "-10"), "--block-ms must be a positive whole multiple of"),
        (("hammer", "--set", "drive.speed_hz"), "--set must be KEY=VALUE"),
        (("nowhere",), "scene must be one of"),
    ],
)
def test_malformed_options_are_refused_in_one_line(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, output, errors = run_captured(capsys, "run", *arguments)
    assert status == 2
    assert output == ""
    assert errors.startswith(f"rig: {message}")
    assert errors.count("\n") == 1


def test_options_become_changes_of_the_scene() -> None:
    assert SceneChanges(
        changes=["drive.speed_hz=5.2", " contact.friction = 0.3 ", "title=a=b"], seed=0, duration_s=1.5
    ).overrides() == {
        "drive.speed_hz": "5.2",
        "contact.friction": "0.3",
        "title": "a=b",
        "seed": "0",
        "duration_s": "1.5",
    }
    assert SceneChanges(parameters="as-printed", engine="rk4").overrides() == {
        "parameters": "as-printed",
        "engine.name": "rk4",
    }


@pytest.mark.parametrize("text", ["", "=", "key", "key=", "=1", "key= "])
def test_a_change_without_key_or_value_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--set must be KEY=VALUE"):
        SceneChanges(changes=[text]).overrides()
