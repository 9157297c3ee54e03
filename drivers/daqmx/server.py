"""The server of the device, on 127.0.0.1."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import grpc
from nidaqmx._stubs.nidaqmx_pb2_grpc import add_NiDAQmxServicer_to_server  # noqa: PLC2701

from drivers.console import Console
from drivers.daqmx.hardware.device import Device
from drivers.daqmx.hardware.outputs import Outputs
from drivers.daqmx.rpc.samples import DaqmxServicer
from drivers.sources.rig import RigSource
from drivers.sources.stream import RigStream
from rig.base.files import Closing
from rig.serve.transport import Client

_END_S = 5.0
"""Longest wait for calls to end [s]."""
_MAX_CALLS = 64
"""Number of calls and events at a time; further ones are refused."""


class DaqmxServer(Closing):
    """Serves a rig as a device of NI-DAQmx; close it, or use it as a context manager.

    Args:
        client: Transport to the rig.
        port: Port on 127.0.0.1; 0: any free one.
        device: Name of the device.
        allow_commands: Whether outputs command the rig.
        secret: Required in the metadata of calls for outputs; None: they need none.
    """

    def __init__(
        self,
        client: Client,
        *,
        port: int = 0,
        device: str = "rig",
        allow_commands: bool = False,
        secret: str | None = None,
    ) -> None:
        stream = RigStream(client)
        self.device = Device(device, stream.table())
        """The device."""
        console = Console(client, name="rig daqmx", any_rig=True) if allow_commands else None
        outputs = Outputs(console, self.device.table.channels.get("speed"))
        self.task_started = threading.Event()
        """Set once a task has started to acquire."""

        def open_source() -> RigSource:
            self.task_started.set()
            return RigSource(client, stream=stream, counts=True)

        self._servicer = DaqmxServicer(self.device, outputs, open_source, secret)  # pyrefly: ignore[bad-instantiation]
        self._pool = ThreadPoolExecutor(_MAX_CALLS, thread_name_prefix="daqmx")
        self._server = grpc.server(
            self._pool,
            options=[("grpc.so_reuseport", 0), ("grpc.max_send_message_length", -1)],
            maximum_concurrent_rpcs=_MAX_CALLS,
        )
        add_NiDAQmxServicer_to_server(self._servicer, self._server)
        self.port: int = self._server.add_insecure_port(f"127.0.0.1:{port}")
        """Port on 127.0.0.1."""
        self._server.start()

    def close(self) -> None:
        """End all calls and tasks."""
        stopped = self._server.stop(grace=None)
        self._servicer.close()  # ends calls that wait for samples
        stopped.wait(timeout=_END_S)
        self._pool.shutdown(wait=False, cancel_futures=True)
