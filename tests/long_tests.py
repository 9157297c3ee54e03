"""The tests that `pytest` without a file or folder leaves out, because ten minutes on two cores are too short for all.

`tests/long_tests.txt` lists them. It is made from a measurement: with RIG_TEST_COSTS=FILE, `pytest -n 3 tests` appends
the processor time of each test to FILE, and `python -m tests.long_tests FILE > tests/long_tests.txt` writes the list.
"""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

LIST = Path(__file__).with_suffix(".txt")
TIME_LIMIT_S = 0.8
"""Longest processor time of a test in a run of ten minutes [s]."""
WHOLE_MODULES = ("tests/unit/test_paper.py",)
"""Modules whose tests share a result that takes a minute."""
KEPT_TESTS = (
    "tests/house/test_tools.py::test_pyrefly_reports_nothing",
    "tests/physics/test_identification.py::test_truth_is_recovered_from_a_hammer_recording[split]",
    "tests/system/test_can_run.py::test_a_valid_hammer_frame_causes_whirl_and_invalid_ones_nothing",
    "tests/system/test_client.py::test_a_program_reads_the_rows_of_the_model",
    "tests/system/test_doors.py::test_rows_are_those_of_the_recording[CAN-False]",
    "tests/system/test_doors.py::test_rows_are_those_of_the_recording[zenoh-False]",
    "tests/system/test_lockstep.py::test_devices_over_zenoh_and_can_react_at_the_same_ticks_at_any_speed",
    "tests/system/test_pages.py::test_commands_and_code_of_a_page_run[README]",
    "tests/system/test_protection.py::test_a_monitor_whose_trip_is_refused_reports_it_and_monitors_to_the_end[zenoh]",
    "tests/system/test_recorder_processes.py::test_a_whole_run_arrives_without_loss[True]",
    "tests/system/test_sweeps.py::test_the_bytes_do_not_depend_on_the_number_of_workers",
    "tests/unit/test_nuisance.py::test_an_aligned_log_passes",
    "tests/unit/test_validation.py::test_few_channels_and_no_truth_are_enough",
)
"""Longer tests that are not left out: one for each main task of the product."""


def read_list() -> list[str]:
    """Return the names of the long tests; a name without parameters, or of a module, stands for all of them."""
    return [line for line in LIST.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]


def split(items: Iterable[pytest.Item]) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """Split tests into short and long ones."""
    short, long, names = list[pytest.Item](), list[pytest.Item](), set(read_list())
    for item in items:
        is_long = not names.isdisjoint({item.nodeid, _function(item.nodeid), _module(item.nodeid)})
        (long if is_long else short).append(item)
    return short, long


def processor_time_s() -> float:
    """Return the processor time of this process and its ended children [s]."""
    return sum(os.times()[:4])


def append_cost(path: Path, nodeid: str, seconds: float) -> None:
    """Append one measurement to a file that several processes write."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps([nodeid, round(seconds, 2)]) + "\n")


def choose(costs: Iterable[tuple[str, float]]) -> list[str]:
    """Return the names to leave out.

    Args:
        costs: Name and processor time [s] of each test; of several measurements of a test the longest counts.
    """
    longest = Counter[str]()
    for nodeid, seconds in costs:
        longest[nodeid] = max(longest[nodeid], seconds)
    single = [each for each in longest if _module(each) not in WHOLE_MODULES]
    long = [each for each in single if longest[each] > TIME_LIMIT_S and each not in KEPT_TESTS]
    number, long_number = Counter(map(_function, single)), Counter(map(_function, long))
    whole = {name for name, count in long_number.items() if count == number[name]}
    return sorted({*WHOLE_MODULES, *whole, *(each for each in long if _function(each) not in whole)})


def _module(nodeid: str) -> str:
    return nodeid.partition("::")[0]


def _function(nodeid: str) -> str:
    return nodeid.partition("[")[0]


if __name__ == "__main__":
    texts = [Path(name).read_text(encoding="utf-8") for name in sys.argv[1:]]
    names = choose(json.loads(line) for text in texts for line in text.splitlines())
    print("# Made by `python -m tests.long_tests` from a measured run: see tests/long_tests.py.", *names, sep="\n")
