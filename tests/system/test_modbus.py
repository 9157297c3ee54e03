"""`rig modbus` for a rig in another process: registers, commands by coils, and a rig that is killed and restarted."""

from __future__ import annotations

import signal
import subprocess

import pytest

import rig
from tests import processes
from tests.unit.modbus_client import ModbusClient, ModbusError
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock

OK_OF_P_N = 4 + 4 * 4  # the fifth channel


def test_a_killed_rig_clears_the_bits_and_a_restarted_one_sets_them_again() -> None:
    endpoint, port = processes.free_endpoint(), processes.free_port()
    run = ("run", "stable-run", "--listen", endpoint, "--duration-s", "86400")
    with processes.start_rig(*run, stdout=subprocess.DEVNULL) as first:
        processes.read_line(first, "listening on")
        options = ("--connect", endpoint, "--listen", f"127.0.0.1:{port}", "--allow-commands")
        with processes.start_rig("modbus", *options, stdout=subprocess.DEVNULL) as gateway:
            processes.read_line(gateway, "Ctrl-C ends it")
            with ModbusClient(port) as client:
                until(lambda: client.bits(0, 1) == [True] and client.bits(OK_OF_P_N, 1) == [True], of=gateway)
                before = client.registers(0, 1)
                until(lambda: client.registers(0, 1) != before, of=gateway)
                with rig.connect(f"zenoh:{endpoint}", wait_s=PATIENCE_S) as machine:
                    client.write_coil(0)
                    assert machine.event("speed", timeout_s=PATIENCE_S)["speed_hz"] == 0.0
                first.kill()
                first.wait()
                until(lambda: not any(client.bits(0, 60)), of=gateway)
                with pytest.raises(ModbusError, match="11"):
                    client.write_coil(0)
                with processes.start_rig(*run, stdout=subprocess.DEVNULL) as second:
                    processes.read_line(second, "listening on")
                    until(lambda: client.bits(0, 1) == [True] and client.bits(OK_OF_P_N, 1) == [True], of=gateway)
                    client.write_coil(1)
                    assert second.wait(timeout=PATIENCE_S) == 0
                until(lambda: not any(client.bits(0, 60)), of=gateway)
            gateway.send_signal(signal.SIGINT)
            assert gateway.wait(timeout=PATIENCE_S) == 0
            assert gateway.stderr is not None
            assert "Traceback" not in gateway.stderr.read()
