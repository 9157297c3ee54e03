"""All instrument twins of a running rig, on any number of links."""

from __future__ import annotations

from contextlib import ExitStack

from drivers.console import Console
from drivers.instruments.accelerometer.twin import AccelerometerTwin
from drivers.instruments.common.twin import Twin
from drivers.instruments.drive.twin import DriveTwin
from drivers.instruments.force.twin import ForceTwin
from drivers.instruments.hammer.twin import HammerTwin
from drivers.instruments.magnet.twin import MagnetTwin
from drivers.instruments.proximity.twin import ProximityTwin
from drivers.link import Port
from drivers.sources.stream import RigStream
from rig.base.files import Closing
from rig.serve.transport import Client

TWINS: tuple[type[Twin], ...] = (ProximityTwin, ForceTwin, AccelerometerTwin, HammerTwin, DriveTwin, MagnetTwin)


class Twins(Closing):
    """Serves the instruments of one rig; each link has its own, independent instruments.

    Args:
        client: Transport to the rig; its owner closes it.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._stream = RigStream(client)
        self._closing = ExitStack()
        self.twins: list[Twin] = []

    def serve(self, kind: type[Twin], port: Port) -> Twin:
        """Serve one instrument at a port; `close` closes the port."""
        twin = kind(self._stream, Console(self._client, name=f"{kind.CODEC.address.name} twin", any_rig=True), port)
        self._closing.callback(twin.close)
        self.twins.append(twin)
        return twin

    def serve_zenoh(self, endpoint: str) -> None:
        """Serve all instruments at one zenoh address.

        Raises:
            InputError: The address cannot be used, or can be reached from other computers.
        """
        from drivers.link.zenoh import ZenohPort
        from rig.serve.transport.zenoh import ZenohServer

        server = self._closing.enter_context(ZenohServer(endpoint))
        for kind in TWINS:
            self.serve(kind, ZenohPort(server, kind.CODEC.address, f"zenoh:{endpoint}"))

    def serve_pty(self) -> None:
        """Serve each instrument at its own pseudo-terminal."""
        from drivers.link.port import MessagePort
        from drivers.link.serial import open_pty

        for kind in TWINS:
            link, path = open_pty()
            self.serve(kind, MessagePort(link, f"pty:{path}"))

    def serve_can(self, spec: str, *, kinds: tuple[type[Twin], ...] = TWINS) -> None:
        """Serve instruments at one node of a CAN bus; their identifiers differ.

        Args:
            spec: INTERFACE:CHANNEL?NAME=VALUE&... of python-can's bus.
            kinds: Classes of the instruments; by default all.

        Raises:
            InputError: The bus does not exist.
        """
        from drivers.link.can import TO_INSTRUMENT, CanLink, CanNode
        from drivers.link.port import MessagePort

        node = CanNode(spec, [TO_INSTRUMENT + kind.CODEC.address.number for kind in kinds])
        self._closing.callback(node.close)
        for kind in kinds:
            link = CanLink(spec, kind.CODEC.address, node=node, instrument=True)
            self.serve(kind, MessagePort(link, f"can:{spec}"))

    def close(self) -> None:
        """Switch all instruments off; further calls have no effect."""
        self._closing.close()
