"""Checks around every test of this folder: no thread ends by an exception, and memory grows by less than a gigabyte."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

MAX_GROWTH_MB = 1000


def _memory_mb(name: str) -> float:
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


@pytest.fixture(autouse=True)
def bounded() -> Iterator[None]:
    died: list[Any] = []
    before, threading.excepthook = threading.excepthook, died.append
    tells = Path("/proc/self/clear_refs").exists()  # Linux
    if tells:
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # reset the peak
    start_mb = _memory_mb("VmRSS") if tells else 0.0
    try:
        yield
    finally:
        threading.excepthook = before
    assert not died
    if tells:
        assert _memory_mb("VmHWM") - start_mb < MAX_GROWTH_MB
