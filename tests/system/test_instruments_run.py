"""Drivers and the DAQ client on a real, short `rig run`, with `rig twins` in a separate process."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from drivers.console import Console
from drivers.daq import Daq
from drivers.instruments.accelerometer.driver import Accelerometer
from drivers.instruments.common.driver import Sampler
from drivers.instruments.drive.driver import Drive
from drivers.instruments.force.driver import Force
from drivers.instruments.hammer.driver import Hammer
from drivers.instruments.magnet.driver import Magnet
from drivers.instruments.proximity.driver import Proximity
from drivers.sources.samples import StreamEndedError
from rig.base.errors import RefusedError
from rig.serve.transport.zenoh import ZenohClient
from tests.processes import free_endpoint, running_rig
from tests.processes import start_rig as command
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.wallclock


@contextmanager
def start_twins(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, list[str]]]]:
    """Start `rig twins`; yield it, and its URLs by instrument."""
    links = sum(name in arguments for name in ("--zenoh", "--pty"))
    with command("twins", *arguments) as child:
        assert child.stdout is not None
        urls: dict[str, list[str]] = {}
        for _ in range(6 * links):
            name, _, url = child.stdout.readline().strip().partition(" ")
            urls.setdefault(name, []).append(url.strip())
        yield child, urls


def read_on(driver: Sampler) -> None:
    for _ in range(1000):
        driver.read()


def test_drivers_and_daq_show_the_same_rig() -> None:
    drivers: dict[str, type[Sampler]] = {
        "proximity": Proximity, "force": Force, "accelerometer": Accelerometer, "drive": Drive, "hammer": Hammer,
    }  # fmt: skip
    with (
        running_rig("hammer", "--seed", "3") as (rig, endpoint),
        ZenohClient(endpoint, wait_s=PATIENCE_S) as client,
    ):
        with start_twins("--zenoh", "--pty", "--listen", free_endpoint(), "--connect", endpoint) as (child, urls):
            assert set(urls) == {*drivers, "magnet"}
            assert all([url.partition(":")[0] for url in found] == ["zenoh", "pty"] for found in urls.values())
            with Daq.open(f"zenoh:{endpoint}") as daq:
                for name, kind in drivers.items():
                    over_zenoh, over_pty = (kind.open(url) for url in urls[name])
                    with over_zenoh, over_pty:
                        assert over_zenoh.identify() == over_pty.identify()
                        for driver in (over_zenoh, over_pty):
                            driver.configure()
                            driver.start()
                        rows = [driver.read(4000) for driver in (over_zenoh, over_pty)]
                    # On a loaded machine one may end before the other begins.
                    for each in sorted(rows, key=lambda each: each.index):
                        direct = daq.read(200)
                        while direct.index < each.index:
                            direct = daq.read(200)
                        assert (each.gap, each.rate_hz) == (0, 20_000.0)
                        columns = [direct.names.index(name) for name in each.names]
                        same = each.values[direct.index - each.index :][: len(direct)]
                        np.testing.assert_array_equal(same, direct.values[:, columns][: len(same)])
                        assert len(same) == len(direct)
                assert (daq.dropped, set(daq.lost.values())) == (0, {0})

            with Hammer.open(urls["hammer"][1]) as hammer, Daq.open(f"zenoh:{endpoint}", channels=["hammer"]) as daq:
                done = hammer.trigger(force_n=200.0, duration_ms=5.0, direction="y")
                impact = daq.read(20)
                force = [impact]
                while force[-1].times_s[-1] < done.time_s + 0.01:
                    force.append(daq.read(20))
                peak = max(each["hammer"].max() for each in force)
                assert peak == pytest.approx(200.0, rel=0.02)
                with pytest.raises(RefusedError, match=r"force_n must be .*1000.*; received 5000"):
                    hammer.trigger(force_n=5000.0)
            with Drive.open(urls["drive"][0]) as drive:
                assert drive.set_speed(5.0).time_s > done.time_s
                with pytest.raises(RefusedError, match="speed_hz"):
                    drive.set_speed(-1.0)
            with Magnet.open(urls["magnet"][1]) as magnet:
                assert magnet.identify().acts == ("Release",)
                assert magnet.release().tick > done.tick

            proximity = Proximity.open(urls["proximity"][1])
            proximity.start()
            child.send_signal(signal.SIGTERM)
            with pytest.raises((StreamEndedError, ConnectionError)):
                read_on(proximity)
            proximity.close()
            _, errors = child.communicate(timeout=PATIENCE_S)
            assert child.returncode == 0, errors
            assert "Traceback" not in errors
        status = Console(client, timeout_s=PATIENCE_S).status()
        assert (status["state"], status["queue"]["dropped"]) == ("running", 0)
        rig.send_signal(signal.SIGTERM)
        rig.communicate(timeout=PATIENCE_S)
        assert rig.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--connect", "127.0.0.1:1"), "rig: no rig answers at 127.0.0.1:1"),
        (("--pty", "--connect", "127.0.0.1:1"), "rig: no rig answers at 127.0.0.1:1"),
        (("--zenoh", "--connect", "nowhere"), "rig: --connect must be HOST:PORT"),
    ],
)
def test_errors_are_one_line(arguments: tuple[str, ...], message: str) -> None:
    with start_twins(*arguments) as (child, _):
        _, errors = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 2
    assert errors.startswith(message)
    assert errors.count("\n") == 1
