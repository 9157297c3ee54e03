"""Interrupts that a library swallows or turns into another error end a command as any other."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from rig.cli import app, signals
from tests.processes import ROOT

pytestmark = pytest.mark.wallclock

SWALLOWED = """
import ctypes, os, signal, time
from rig.cli import signals

signals.listen()

@ctypes.CFUNCTYPE(None)
def callback():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)  # the exception is raised here

try:
    callback()
    time.sleep(30.0)
except KeyboardInterrupt:
    print("interrupted", signals.is_interrupted())
"""


def test_an_interrupt_that_a_callback_swallows_is_sent_again() -> None:
    done = subprocess.run([sys.executable, "-c", SWALLOWED], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted True\n", "")


@pytest.mark.parametrize("received", [[], [2]])
def test_an_error_after_an_interrupt_is_reported_as_the_interrupt(
    received: list[int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Broken:
        def main(self, *_: Any, **_more: Any) -> None:
            raise RuntimeError("no compiled object yet")

    monkeypatch.setattr(app, "rig", Broken)
    monkeypatch.setattr(signals, "_received", received)
    with pytest.raises(SystemExit if received else RuntimeError) as end:
        app.start(["params"])
    if isinstance(end.value, SystemExit):
        assert end.value.code == 130
        assert capsys.readouterr().err == "rig: interrupted\n"
