"""Many generated inputs for each interface, in one process: `python -m tests.hostile.generate [NAME ...]`.

It prints inputs, faults, hangs, peak memory and time. An input that failed is kept in tests/hostile/corpus, which the
suite replays (`test_corpus.py`). The process can end by a fault of a library in C: the input is then in the temporary
folder whose name was printed.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import logging
import resource
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.hostile import InputTally
from tests.hostile.interfaces import NAMES, Interface, Interfaces

CORPUS = Path(__file__).with_name("corpus")
MAX_KEPT_BYTES = 20_000
"""Largest input that is kept in the corpus."""
FULL = 200
"""Inputs of an interface up to which the usual share is put to long work; of more inputs, the same number [1]."""
_MAX_VIRTUAL = 16 << 30
"""Limit of the process's address space, so that an input cannot fill the computer's memory [bytes]."""


def try_file(interface: Interface, path: Path, tally: InputTally) -> None:
    """Pass one file to an interface; faults of other threads are those of this input."""
    died: list[Any] = []
    before, threading.excepthook = threading.excepthook, died.append
    known = set(tally.faults)
    try:
        with tally.attempt_within_limits(path.name), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            interface.use(path)
    finally:
        threading.excepthook = before
    for each in died:
        tally.faults.setdefault(f"thread ended: {each.exc_type.__name__}", str(each.exc_value)[:200])
    tally.fresh = bool(set(tally.faults) - known)


def try_generated(interfaces: Interfaces, name: str, inputs: int, seed: int, keep: Path | None) -> InputTally:
    """Pass generated inputs to an interface; keep those that fail in a folder."""
    interface, tally = interfaces[name], InputTally()
    interfaces.rare = max(1, inputs // FULL)
    # Libraries call gc.collect, which takes 0.1 s with all modules of the product.
    gc.collect()
    gc.freeze()
    for number in range(max(1, -(-inputs // interface.inputs))):
        suffix, data = interface.generate(np.random.default_rng([seed, zlib_number(name), number]))
        path = interfaces.folder / f"input{suffix}"
        path.write_bytes(data)
        try_file(interface, path, tally)
        if tally.fresh:
            digest = hashlib.sha256(data).hexdigest()[:8]
            print(f"{name} {number} ({digest}, {len(data)} bytes): {list(tally.faults.items())[-1]}", flush=True)
            if keep is not None and len(data) <= MAX_KEPT_BYTES:
                keep.mkdir(exist_ok=True)
                (keep / f"{name}-{digest}{suffix}").write_bytes(data)
    return tally


def zlib_number(name: str) -> int:
    """Return a number of a name, the same in every process."""
    return int.from_bytes(name.encode()[:7], "little")


def replay(interfaces: Interfaces) -> Iterator[tuple[str, InputTally]]:
    """Yield each kept input's name, and the tally of passing it to its interface."""
    interfaces.thorough = True
    for kept in sorted(CORPUS.iterdir()):
        tally = InputTally()
        suffix = kept.name.partition(".")[2]
        path = interfaces.folder / f"input.{suffix}"
        path.write_bytes(kept.read_bytes())
        try_file(interfaces[kept.name.partition("-")[0]], path, tally)
        yield kept.name, tally
    interfaces.thorough = False


def main() -> None:
    """Run the generated inputs and print the table; the status is 1 if an input failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.hostile.generate")
    parser.add_argument("names", nargs="*", metavar="NAME", help="interfaces, all by default")
    parser.add_argument("--inputs", type=int, default=20_000, help="inputs of each")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_VIRTUAL, _MAX_VIRTUAL))
    failed, peak_mb = False, 0.0
    with tempfile.TemporaryDirectory() as folder, Interfaces(Path(folder)) as interfaces:
        print(f"inputs in {folder}", flush=True)
        for name in given.names or NAMES:
            begin_s, cpu_s = time.monotonic(), time.process_time()
            tally = try_generated(interfaces, name, given.inputs, given.seed, CORPUS)
            hangs = sum(text.startswith(("hang", "too long")) for text in tally.faults)
            count = (tally.accepted + tally.refused) * interfaces[name].inputs
            peak_mb = max(peak_mb, tally.peak_mb)
            cpu_s, wall_s = time.process_time() - cpu_s, time.monotonic() - begin_s
            print(
                f"{name:<13} {count:>6} inputs ({tally.accepted} files accepted, {tally.refused} refused), "
                f"{len(tally.faults) - hangs} kinds of faults, {hangs} of hangs, {tally.peak_mb:.0f} MB, "
                f"{cpu_s:.0f} s of processor time, {wall_s:.0f} s",
                flush=True,
            )
            failed |= bool(tally.faults)
            interfaces.end(name)
    print(f"peak memory {peak_mb:.0f} MB")
    sys.exit(failed)


if __name__ == "__main__":
    main()
