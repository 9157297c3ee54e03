"""Addresses that are listened on, and what the operating system says of their links."""

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
    """Split HOST:PORT.

    Args:
        text: What stands there.
        field: What errors call it.
        least: Lowest port; with 0, whoever listens takes one that is free.

    Raises:
        InputError: It is not of that form.
    """
    host, colon, port = text.rpartition(":")
    plain = "/" not in host and (":" not in host or host.startswith("["))
    if not colon or not host or not plain or not port.isdecimal() or not least <= int(port) <= 65535:
        raise InputError(field, f"HOST:PORT with a port of {least} to 65535, such as {DEFAULT_ENDPOINT}", text)
    return host, int(port)


def parse_loopback(text: str, *, field: str, least: int = 1) -> tuple[str, int]:
    """Split HOST:PORT of a door that asks nobody who they are, and so is not open to other machines.

    Arguments as of `parse_endpoint`.

    Raises:
        InputError: It is not of that form, or not of this machine alone.
    """
    host, port = parse_endpoint(text, field=field, least=least)
    if host not in LOOPBACK_HOSTS:
        tunnel = f"ssh -L {port}:127.0.0.1:{port} USER@HOST"
        must = f"on 127.0.0.1, since there is no password; from another machine: {tunnel} (a rig also takes --expose)"
        raise InputError(field, must, text)
    return host, port


def place_to_listen(text: str, *, field: str) -> tuple[str, int]:
    """Split HOST:PORT as `parse_loopback` does; for port 0 one that is free now.

    Raises:
        InputError: It is not of that form, or not of this machine alone.
    """
    host, port = parse_loopback(text, field=field, least=0)
    return host, port or free_port()


def free_port() -> int:
    """A port of 127.0.0.1 that nobody listens on, as yet."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def check_free(place: tuple[str, int], *, field: str) -> None:
    """Find out early whether an address can be listened on; what takes it meanwhile is found when it is.

    Raises:
        InputError: It is in use, or none of this machine.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(place)
        except OSError as error:
            raise not_free(field, "{}:{}".format(*place), in_use=error.errno == errno.EADDRINUSE) from None


def not_free(field: str, endpoint: str, *, in_use: bool) -> InputError:
    """Why an address cannot be listened on."""
    must = "a free address (another rig runs there, or another program)"
    return InputError(field, must if in_use else "an address of this machine that can be listened on", endpoint)


def backlog_of(port: int) -> dict[int, int]:
    """Bytes on their way in each established link of a listening port, by the other side's port (Linux).

    Those that our socket has not sent, and, where the other side is a process of this machine, those it has not read.
    """
    found: dict[int, int] = {}
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with contextlib.suppress(OSError):
            for row in Path(table).read_text().splitlines()[1:]:
                fields = row.split()
                if fields[3] != "01":  # established
                    continue
                local, remote = (int(fields[n].rpartition(":")[2], 16) for n in (1, 2))
                unsent, unread = (int(part, 16) for part in fields[4].split(":"))
                if local == port:
                    found[remote] = found.get(remote, 0) + unsent
                elif remote == port:
                    found[local] = found.get(local, 0) + unread
    return found


def hang_up(port: int, peers: set[int]) -> None:
    """End the links of a listening port with some other sides' ports (Linux): what is on its way still arrives."""
    for file in Path("/proc/self/fd").iterdir() if peers else ():
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(int(file.name))) as link:
            ends = link.getsockname(), link.getpeername()
            if all(isinstance(end, tuple) for end in ends) and ends[0][1] == port and ends[1][1] in peers:
                # Zenoh lets closing wait for what was not sent, and ours may be the last to close.
                link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
                link.shutdown(socket.SHUT_RDWR)
