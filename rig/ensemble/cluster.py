"""Workers of a Dask cluster: the tasks of a sweep on other processes and machines."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import Any

from rig.base.checks import describe_error, read_json
from rig.base.errors import InputError, SimulationError, Words, require_package
from rig.ensemble.ensemble import Workers
from rig.ensemble.plan import find_versions
from rig.ensemble.sweep import simulate_task

_WAIT_S = 5.0
"""Time to connect, and for the first worker."""
_VERSIONS = "a cluster whose workers have the rig's wheel with its extra `full`, in the versions of this machine"


@contextmanager
def cluster_workers(address: str) -> Iterator[Workers]:
    """Yield the workers of an existing Dask cluster; they may join and leave at any time.

    Args:
        address: Address of the scheduler, tcp://HOST:PORT.

    Raises:
        InputError: There is no scheduler or no worker, or a worker has other versions.
        SimulationError: The scheduler or the workers ended.
    """
    distributed = require_package("distributed", "dask")
    if not re.fullmatch(r"(tcp|tls)://[^\s/]+:\d+", address):
        raise InputError("--scheduler", "the address of a Dask scheduler, tcp://HOST:PORT", address)
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the command reports what is wrong
    try:
        client = distributed.Client(address, timeout=_WAIT_S, set_as_default=False)
    except (OSError, ValueError, RuntimeError) as error:
        received = Words(f"{address} ({describe_error(error)})")
        raise InputError("--scheduler", "the address of a running Dask scheduler", received) from None
    try:
        try:
            client.wait_for_workers(1, timeout=_WAIT_S)
        except TimeoutError:
            raise InputError("--scheduler", "a cluster with workers", Words(f"{address}, which has none")) from None
        executor = client.get_executor(pure=False)
        yield executor.submit, lambda: 2 * sum(client.ncores().values())
    except ImportError as error:
        raise InputError("--scheduler", _VERSIONS, Words(describe_error(error))) from None
    except (CancelledError, distributed.KilledWorker, distributed.comm.CommClosedError) as error:
        line = f"the Dask cluster gave up ({describe_error(error)}); the finished parts are kept, --resume continues"
        raise SimulationError(line) from None
    finally:
        client.close(timeout=_WAIT_S)


def simulate_remotely(text: str, task: int) -> tuple[bytes, dict[str, Any]]:
    """Do `simulate_task` on a worker with the same versions as the client.

    Raises:
        ImportError: The worker has other versions.
    """
    own = find_versions()
    if own != (wanted := read_json(text.encode())["versions"]):
        name = next(name for name in wanted if own.get(name) != wanted[name])
        raise ImportError(f"a worker with {name} {own.get(name)}, not {wanted[name]}")
    return simulate_task(text, task)
