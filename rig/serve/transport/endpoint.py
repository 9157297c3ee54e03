"""Addresses to listen on, and the state of their links from the operating system."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
from pathlib import Path

from rig.base.errors import InputError
from rig.serve.transport import DEFAULT_ENDPOINT

LOOPBACK_HOSTS = ("127.0.0.1", "localhost")


def parse_endpoint(text: str, *, field: str = "endpoint", least: int = 1) -> tuple[str, int]:
    """Return host and port of HOST:PORT.

    Args:
        text: The address.
        field: Name of the option, for errors.
        least: Lowest port; 0 allows the system to choose a free one.

    Raises:
        InputError: The text has another form.
    """
    host, colon, port = text.rpartition(":")
    plain = "/" not in host and (":" not in host or host.startswith("["))
    if not colon or not host or not plain or not port.isdecimal() or not least <= int(port) <= 65535:
        raise InputError(field, f"HOST:PORT with a port of {least} to 65535, such as {DEFAULT_ENDPOINT}", text)
    return host, int(port)


def parse_loopback(text: str, *, field: str, least: int = 1) -> tuple[str, int]:
    """Return host and port of an address without access control, which must not be open to other computers.

    Arguments as of `parse_endpoint`.

    Raises:
        InputError: The text has another form, or is not on the loopback.
    """
    host, port = parse_endpoint(text, field=field, least=least)
    if host not in LOOPBACK_HOSTS:
        tunnel = f"ssh -L {port}:127.0.0.1:{port} USER@HOST"
        must = f"on 127.0.0.1, since there is no password; from another machine: {tunnel} (a rig also takes --expose)"
        raise InputError(field, must, text)
    return host, port


def choose_listen_address(text: str, *, field: str) -> tuple[str, int]:
    """Return host and port as `parse_loopback` does; port 0 is replaced by a free port.

    Raises:
        InputError: The text has another form, or is not on the loopback.
    """
    host, port = parse_loopback(text, field=field, least=0)
    return host, port or free_port()


def free_port() -> int:
    """Return a port of 127.0.0.1 that is currently free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def check_free(address: tuple[str, int], *, field: str) -> None:
    """Raise an error early for an address that cannot be listened on.

    Raises:
        InputError: The address is in use, or not of this computer.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
        except OSError as error:
            raise build_address_error(field, "{}:{}".format(*address), in_use=error.errno == errno.EADDRINUSE) from None


def build_address_error(field: str, endpoint: str, *, in_use: bool) -> InputError:
    """Return the error for an address that cannot be listened on."""
    must = "a free address (another rig runs there, or another program)"
    return InputError(field, must if in_use else "an address of this machine that can be listened on", endpoint)


def read_backlogs(port: int) -> dict[int, int]:
    """Return the bytes in flight of each link of a listening port, by the other side's port (Linux).

    Counts bytes that our socket has not sent and, if the other side is on this computer, those that it has not read.
    """
    backlogs: dict[int, int] = {}
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with contextlib.suppress(OSError):
            for row in Path(table).read_text().splitlines()[1:]:
                fields = row.split()
                if fields[3] != "01":  # established
                    continue
                local, remote = (int(fields[column].rpartition(":")[2], 16) for column in (1, 2))
                unsent, unread = (int(part, 16) for part in fields[4].split(":"))
                if local == port:
                    backlogs[remote] = backlogs.get(remote, 0) + unsent
                elif remote == port:
                    backlogs[local] = backlogs.get(local, 0) + unread
    return backlogs


def close_links(port: int, peers: set[int]) -> None:
    """Close the links of a listening port to some peer ports (Linux); data in transit still arrives."""
    for file in Path("/proc/self/fd").iterdir() if peers else ():
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(int(file.name))) as link:
            ends = link.getsockname(), link.getpeername()
            if all(isinstance(end, tuple) for end in ends) and ends[0][1] == port and ends[1][1] in peers:
                # Zenoh's close waits for unsent data, and our descriptor may be the last one to close.
                link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
                link.shutdown(socket.SHUT_RDWR)
