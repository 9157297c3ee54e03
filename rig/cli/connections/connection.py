"""Options for connections to a rig: --connect and --tls of clients, --listen and --expose of servers."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError, RefusedError, Words
from rig.cli.groups import panel
from rig.cli.output.display import display_status, exit_if_failed
from rig.cli.output.tables import echo, plain_text, table_console
from rig.cli.signals import stop_on_signals
from rig.serve.transport import DEFAULT_ENDPOINT, EXPOSED_PORT, NoReplyError

if TYPE_CHECKING:
    from drivers.console import Accepted, Console
    from rig.cli.connections.can_output import CanOutput
    from rig.serve.served_run import ServedRun
    from rig.serve.transport import Server
    from rig.serve.transport.zenoh import Exposure, ZenohClient, ZenohServer

_exposure = panel("For other computers")
SecretFile = Annotated[
    Path | None, typer.Option("--secret", metavar="FILE", help="Commands need the secret of this file, made if absent")
]
_TLS = "RIG_TLS"
_LINK_S = 1.0
"""Time limit for the connection to a rig that is running [s]."""


@dataclass(frozen=True)
class Connection:
    """The rig that a command connects to."""

    connect: Annotated[str, typer.Option(metavar="HOST:PORT|NAME", help="Address or name of the rig")] = (
        DEFAULT_ENDPOINT
    )
    tls: Annotated[
        Path | None,
        typer.Option(metavar="DIR", envvar=_TLS, help="Folder with the keys of a role, for an exposed rig"),
    ] = None
    wait_s: Annotated[float, typer.Option(metavar="S", min=0.0, help="Time to wait for the rig to start in s")] = 0.0

    @contextmanager
    def client(self) -> Iterator[ZenohClient]:
        """Yield a client of the rig, and close it afterwards.

        Raises:
            InputError: The keys do not exist.
            RefusedError: No rig answers, or access is denied.
        """
        from rig.base.wire import ALIVE
        from rig.serve.transport.zenoh import ZenohClient

        from_environment = self.tls is not None and os.environ.get(_TLS) == str(self.tls)
        try:
            with ExitStack() as stack:
                with self._show_waiting() if self.wait_s else nullcontext():
                    wait_s = max(_LINK_S, self.wait_s)
                    client = stack.enter_context(ZenohClient(self.connect, wait_s=wait_s, tls=self.tls))
                    client.await_token(ALIVE)
                yield client
        except NoReplyError as error:
            source = f" (the keys are those of {_TLS})" if from_environment and str(self.tls) in str(error) else ""
            raise RefusedError(f"{error}{source}") from None
        except InputError as error:
            if not from_environment or error.field != "--tls":
                raise
            raise InputError(_TLS, error.must, error.received) from None

    def read_secret(self, path: Path | None, *, allow_commands: bool) -> str | None:
        """Return the secret that a server of this rig requires for commands; None: it requires none.

        Args:
            path: The file of the secret.
            allow_commands: Whether the server accepts commands.

        Raises:
            InputError: The file is wrong, is given without commands, or is missing where the rig needs certificates.
        """
        from rig.serve.transport.exposure.secret import read_secret

        if path is None and allow_commands and self.tls is not None:
            must = "given with --secret FILE for a rig with certificates (--tls)"
            raise InputError("--allow-commands", must, Words("no --secret"))
        if path is not None and not allow_commands:
            raise InputError("--secret", "given with --allow-commands", Words("no --allow-commands"))
        return None if path is None else read_secret(path)

    def _show_waiting(self) -> Any:
        return table_console(stderr=True).status(plain_text(f"waiting for a rig at {self.connect}"))

    @contextmanager
    def console(self, command: str) -> Iterator[Console]:
        """Yield a console connected to the rig, and close it afterwards.

        Args:
            command: Name of the command, which identifies its requests.

        Raises:
            RefusedError: No rig answers, or access is denied.
        """
        from drivers.console import Console

        with self.client() as client:
            yield Console(client, name=f"rig {command} pid {os.getpid()}")


@dataclass(frozen=True)
class Serving:
    """The addresses of a rig that is served."""

    listen: Annotated[
        str,
        typer.Option("--listen", metavar="HOST:PORT", help="Address to listen on, on 127.0.0.1; port 0: any free port"),
    ] = DEFAULT_ENDPOINT
    name: Annotated[str | None, typer.Option(metavar="NAME", help="Name of the rig for --connect, for this user")] = (
        None
    )
    expose: Annotated[
        str | None,
        _exposure(
            "Also listen at this address, with --tls; default port 7463",
            metavar="HOST[:PORT]",
        ),
    ] = None
    tls: Annotated[Path | None, _exposure("Folder made by `rig keys init`: roles that may connect", metavar="DIR")] = (
        None
    )
    plaintext: Annotated[
        bool, _exposure("Instead of --tls: no encryption, full access for every client", "--plaintext")
    ] = False

    def check(self) -> None:
        """Check early that the addresses are free and the name is valid.

        Raises:
            InputError: An address is in use, or the name is invalid.
        """
        from rig.serve.transport.endpoint import check_free, parse_endpoint, parse_loopback
        from rig.serve.transport.names import check_name

        check_free(parse_loopback(self.listen, field="--listen", least=0), field="--listen")
        if (exposed := self.exposure()) is not None:
            check_free(parse_endpoint(exposed.endpoint, field="--expose"), field="--expose")
        if self.name is not None:
            check_name(self.name)

    def exposure(self) -> Exposure | None:
        """Return the address and keys for other computers, or None without --expose.

        Raises:
            InputError: Neither or both of --tls and --plaintext are given, or one without --expose.
        """
        if self.expose is None:
            if self.tls is not None or self.plaintext:
                option = "--tls" if self.tls is not None else "--plaintext"
                raise InputError(option, "given with --expose HOST", Words("no --expose"))
            return None
        if (self.tls is not None) == self.plaintext:
            hint = f"rig keys init DIR --host {self.expose.partition(':')[0]}"
            must = f"given with --tls DIR (create it: {hint}), or --plaintext"
            raise InputError("--expose", must, Words("both" if self.plaintext else "neither"))
        from rig.serve.transport.exposure.certificates import read_holder
        from rig.serve.transport.zenoh import Exposure

        endpoint = self.expose if ":" in self.expose else f"{self.expose}:{EXPOSED_PORT}"
        return Exposure(endpoint, None if self.tls is None else read_holder(self.tls, server=True))


def show(accepted: Accepted, what: str) -> None:
    """Print a line for a command that the rig accepted."""
    echo(f"{what} accepted: number {accepted.id}, at {accepted.time_s:.6f} s (tick {accepted.tick})")


def serve(
    create_run: Callable[[Server], ServedRun],
    words: Callable[[dict[str, Any]], list[str]],
    print_summary: Callable[[dict[str, Any]], None],
    *,
    serving: Serving,
    bus: CanOutput | None,
    paced: bool,
    wait: bool,
) -> None:
    """Serve a run to its end; exit status 1 if something failed without ending the run.

    Args:
        create_run: Creates the run on a server.
        words: Returns the parts of a progress line from a status.
        print_summary: Prints the summary.
        serving: Addresses to serve at.
        bus: CAN bus to serve on as well.
        paced: The run follows the wall clock.
        wait: The run waits for stalled clients.
    """
    from rig.serve.pacing import reduce_garbage_collections
    from rig.serve.transport.names import register_name
    from rig.serve.transport.zenoh import ZenohServer

    exposed = serving.exposure()
    with (
        ZenohServer(serving.listen, exposed=exposed, wait=wait) as server,
        nullcontext() if serving.name is None else register_name(serving.name, server.endpoint),
        bus or nullcontext(),
    ):
        with reduce_garbage_collections():
            run = create_run(server if bus is None else bus.join_server(server))
            run.prepare()
            if bus is not None:
                bus.start(paced=paced)
                echo(f"rig: {bus}", err=True)
        print_addresses(server, exposed, serving.name)
        with stop_on_signals(run.stop), display_status(run.status, words):
            summary = run.run()
    print_summary(summary)
    if bus is not None:
        echo(bus.summary())
    exit_if_failed(summary["troubles"])


def print_addresses(server: ZenohServer, exposed: Exposure | None, name: str | None = None) -> None:
    """Print the addresses of a rig and the access that they give."""
    from rig.serve.transport.exposure.access import ROLES, TRUTH

    if exposed is not None and exposed.holder is not None:
        own = f"{exposed.holder.name} until {exposed.holder.expires:%Y-%m-%d}"
        admitted = ", ".join(exposed.holder.allowed) or "nobody"
        echo(f"rig: exposed at {exposed.endpoint} to {admitted} (permissions: rig keys)", err=True)
        echo(f"rig: certificate of the rig: {own}", err=True)
    elif exposed is not None:
        permissions = ", ".join(permission.title for permission in (*ROLES["operator"], TRUTH))
        echo(f"rig: WARNING: {exposed.endpoint} is open to every client, unencrypted:", err=True)
        echo(f"rig: WARNING: {permissions}", err=True)
    name_text = "" if name is None else f" as {name}"
    echo(f"rig: listening on {server.endpoint}{name_text}; Ctrl-C or `rig stop` ends it", err=True)
