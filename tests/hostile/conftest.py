"""Checks around every test of this folder: no thread ends by an exception, and memory grows by less than a gigabyte."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from tests.hostile import memory_mb, reset_peak

MAX_GROWTH_MB = 1000


@pytest.fixture(autouse=True)
def bounded() -> Iterator[None]:
    died: list[Any] = []
    before, threading.excepthook = threading.excepthook, died.append
    reset_peak()
    start_mb = memory_mb("VmRSS")
    try:
        yield
    finally:
        threading.excepthook = before
    assert not died
    assert memory_mb("VmHWM") - start_mb < MAX_GROWTH_MB
