"""Interrupts that a library swallows or turns into another error end a command as any other."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from typing import Any

import pytest

from rig.cli import app, signals
from tests.processes import ROOT
from tests.waiting import PATIENCE_S

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
    done = subprocess.run(
        [sys.executable, "-c", SWALLOWED], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted True\n", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_may_interrupt_code_that_holds_the_lock_of_its_event(number: int) -> None:
    """As `Event.wait` does for an instant: `Event.set` in the handler would wait for ever."""
    lock, ended = threading.Lock(), threading.Event()

    def stop() -> None:
        with lock:
            ended.set()

    with signals.stop_on_signals(stop):
        with lock:
            os.kill(os.getpid(), number)
            assert not ended.wait(0.01)
        assert ended.wait(PATIENCE_S)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


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
