"""The ends of a connection to a rig: --connect and --tls of those who use one, --expose of those who serve."""

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
from rig.cli.output.display import end_with, showing
from rig.cli.output.tables import echo, plain, table_console
from rig.cli.signals import stopping_on_signals
from rig.serve.transport import DEFAULT_ENDPOINT, EXPOSED_PORT, NoReplyError

if TYPE_CHECKING:
    from drivers.console import Accepted, Console
    from rig.cli.connections.can_output import CanOutput
    from rig.serve.served_run import ServedRun
    from rig.serve.transport import Server
    from rig.serve.transport.zenoh import Exposure, ZenohClient, ZenohServer

_exposure = panel("For other computers")
_TLS = "RIG_TLS"
_LINK_S = 1.0
"""Time that the connection to a rig that is there may take [s]."""


@dataclass(frozen=True)
class Connection:
    """Which rig a command is for."""

    connect: Annotated[str, typer.Option(metavar="HOST:PORT|NAME", help="Where the rig listens, or its name.")] = (
        DEFAULT_ENDPOINT
    )
    tls: Annotated[
        Path | None,
        typer.Option(metavar="DIR", envvar=_TLS, help="Folder with the keys of a role, for a rig that is exposed."),
    ] = None
    wait_s: Annotated[
        float, typer.Option(metavar="S", min=0.0, help="Wait that long for the rig to be there, in s.")
    ] = 0.0

    @contextmanager
    def client(self) -> Iterator[ZenohClient]:
        """A client of the rig, closed afterwards.

        Raises:
            InputError: There are no such keys.
            RefusedError: No rig answers there, or it denies this.
        """
        from rig.base.wire import ALIVE
        from rig.serve.transport.zenoh import ZenohClient
        from rig.serve.waiting import Deadline

        by_environment = self.tls is not None and os.environ.get(_TLS) == str(self.tls)
        deadline = Deadline(self.wait_s)
        try:
            with ExitStack() as stack:
                with self._waiting() if self.wait_s else nullcontext():
                    wait_s = max(_LINK_S, self.wait_s)
                    client = stack.enter_context(ZenohClient(self.connect, wait_s=wait_s, tls=self.tls))
                    # One that is being prepared listens already.
                    any(client.tokens(ALIVE) for _ in deadline.polls(0.1))
                yield client
        except NoReplyError as error:
            source = f" (the keys are those of {_TLS})" if by_environment and str(self.tls) in str(error) else ""
            raise RefusedError(f"{error}{source}") from None
        except InputError as error:
            if not by_environment or error.field != "--tls":
                raise
            raise InputError(_TLS, error.must, error.received) from None

    def _waiting(self) -> Any:
        return table_console(stderr=True).status(plain(f"waiting for a rig at {self.connect}"))

    @contextmanager
    def console(self, command: str) -> Iterator[Console]:
        """A console connected to the rig, closed afterwards.

        Args:
            command: Name of the command, which signs its requests.

        Raises:
            RefusedError: No rig answers there, or it denies this.
        """
        from drivers.console import Console

        with self.client() as client:
            yield Console(client, name=f"rig {command} pid {os.getpid()}")


@dataclass(frozen=True)
class Serving:
    """Where a rig is served."""

    listen: Annotated[
        str,
        typer.Option("--listen", metavar="HOST:PORT", help="Where to listen, on 127.0.0.1; port 0 takes a free one."),
    ] = DEFAULT_ENDPOINT
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name by which commands and clients of this user find the rig.")
    ] = None
    expose: Annotated[
        str | None,
        _exposure(
            "Listen at this address of this computer as well, with --tls; port 7463 unless given.",
            metavar="HOST[:PORT]",
        ),
    ] = None
    tls: Annotated[Path | None, _exposure("Made by `rig keys init`: who may connect, and do what.", metavar="DIR")] = (
        None
    )
    plaintext: Annotated[
        bool, _exposure("Instead of --tls: let everybody in, and do everything, unencrypted.", "--plaintext")
    ] = False

    def check(self) -> None:
        """Find out early whether it can be served there, and under that name.

        Raises:
            InputError: It cannot.
        """
        from rig.serve.transport.endpoint import check_free, parse_endpoint, parse_loopback
        from rig.serve.transport.names import check_name

        check_free(parse_loopback(self.listen, field="--listen", least=0), field="--listen")
        if (exposed := self.exposure()) is not None:
            check_free(parse_endpoint(exposed.endpoint, field="--expose"), field="--expose")
        if self.name is not None:
            check_name(self.name)

    def exposure(self) -> Exposure | None:
        """Where a rig is to listen beyond the loopback, if anywhere.

        Raises:
            InputError: It is not said who may connect there, or that without a place.
        """
        if self.expose is None:
            if self.tls is not None or self.plaintext:
                option = "--tls" if self.tls is not None else "--plaintext"
                raise InputError(option, "given with --expose HOST", Words("it alone"))
            return None
        if (self.tls is not None) == self.plaintext:
            made = f"rig keys init DIR --host {self.expose.partition(':')[0]}"
            must = f"given with --tls DIR (made by: {made}), or --plaintext"
            raise InputError("--expose", must, Words("both" if self.plaintext else "neither"))
        from rig.serve.transport.exposure.certificates import holder_in
        from rig.serve.transport.zenoh import Exposure

        endpoint = self.expose if ":" in self.expose else f"{self.expose}:{EXPOSED_PORT}"
        return Exposure(endpoint, None if self.tls is None else holder_in(self.tls, server=True))


def show(accepted: Accepted, what: str) -> None:
    """One line for a command that the rig took."""
    echo(f"{what} accepted: number {accepted.id}, at {accepted.time_s:.6f} s (tick {accepted.tick})")


def serve(
    make: Callable[[Server], ServedRun],
    words: Callable[[dict[str, Any]], list[str]],
    tell: Callable[[dict[str, Any]], None],
    *,
    serving: Serving,
    bus: CanOutput | None,
    paced: bool,
    wait: bool,
) -> None:
    """Serve a run to its end, with exit status 1 where something failed that did not end it.

    Args:
        make: Makes the run, given the transports that it is served on.
        words: What a line of progress says of a status.
        tell: Prints the summary.
        serving: Where it is served.
        bus: A CAN bus that it is served on as well.
        paced: The run goes by the wall clock.
        wait: Whether it waits for clients that stall.
    """
    from rig.serve.pacing import rare_collections
    from rig.serve.transport.names import registered
    from rig.serve.transport.zenoh import ZenohServer

    exposed = serving.exposure()
    with (
        ZenohServer(serving.listen, exposed=exposed, wait=wait) as server,
        nullcontext() if serving.name is None else registered(serving.name, server.endpoint),
        bus or nullcontext(),
    ):
        with rare_collections():
            run = make(server if bus is None else bus.beside(server))
            run.prepare()
            if bus is not None:
                bus.start(paced=paced)
                echo(f"rig: {bus}", err=True)
        tell_where(server, exposed, serving.name)
        with stopping_on_signals(run.stop), showing(run.status, words):
            summary = run.run()
    tell(summary)
    if bus is not None:
        echo(bus.summary())
    end_with(summary["troubles"])


def tell_where(server: ZenohServer, exposed: Exposure | None, name: str | None = None) -> None:
    """Where a rig listens, and who may do what there."""
    from rig.serve.transport.exposure.access import ROLES, TRUTH

    if exposed is not None and exposed.holder is not None:
        own = f"{exposed.holder.name} until {exposed.holder.expires:%Y-%m-%d}"
        echo(f"rig: exposed at {exposed.endpoint} to holders of certificates (who may do what: rig keys)", err=True)
        echo(f"rig: its own certificate is for {own}", err=True)
    elif exposed is not None:
        doors = ", ".join(door.what for door in (*ROLES["operator"], TRUTH))
        echo(f"rig: WARNING: {exposed.endpoint} is open to everybody who reaches it, unencrypted:", err=True)
        echo(f"rig: WARNING: {doors}", err=True)
    called = "" if name is None else f" as {name}"
    echo(f"rig: listening on {server.endpoint}{called}; Ctrl-C or `rig stop` ends it", err=True)
