"""Composition of the `rig` command: the list of subcommands, and the reporting of errors to the user."""

from __future__ import annotations

import errno
import re
import sys
from functools import partial
from typing import Annotated, Any, NoReturn

import typer

from rig.base.errors import (
    INSTALL_COMMAND,
    DiskError,
    InputError,
    MissingPackageError,
    SimulationError,
    describe_missing_package,
    is_full_missing,
)
from rig.base.text import printable
from rig.cli.command import Group, load_command, make_command, make_group, usage_error
from rig.cli.output import provenance
from rig.cli.output.tables import echo
from rig.cli.signals import is_interrupted
from rig.run.commands import SUMMARIES

# The base class of typer's errors for wrong options and arguments. typer exports only this subclass of it.
_UsageError: Any = typer.BadParameter.__base__

_NO_READER = 141
"""Exit status that a shell reports for a program ended by SIGPIPE."""
_INTERRUPTED = 130
"""Exit status that shells expect, and typer returns, after Ctrl-C."""

COMMANDS = {
    "Start here": {
        "demo": "Start the service, record an impact and the whirl, stop",
        "scenes": "List the built-in scenes, or show one",
        "params": "Show a parameter set: values, units, sources and kinds",
        "laws": "Compare all normal contact laws",
        "magnets": "Compare the magnet models",
        "keys": "Show every key, message and unit of the rig's streams",
        "completion": "Complete commands, options and names in a shell",
    },
    "Serve the rig": {
        "run": "Run a scene in real time and publish its sensors",
        **{name: line for name, line in SUMMARIES.items() if line},
        "step": "Advance a lockstep run or a paused replay by TICKS",
        "note": "Add a note to every recording of a running rig",
        "status": "Show the time, pace, lateness and losses of a running rig",
        "stop": "End the run of a rig and close its recordings",
        "twins": "Serve the simulated instruments of a running rig",
        "daqmx": "Serve a running rig to programs that use nidaqmx, over gRPC",
        "foxglove": "Serve a running rig, or a recording, to the Foxglove app",
        "can": "Run virtual CAN buses, and list the CAN messages of the rig",
        "modbus": "Serve a running rig to Modbus TCP clients as a protection rack",
    },
    "Replay a recording": {
        "replay": "Publish a recording as a running rig would",
        "pause": "Pause a replay",
        "resume": "Resume a replay",
        "seek": "Move a replay to another time",
        "rate": "Set the speed of a replay",
    },
    "Recordings": {
        "record": "Record all streams of a running rig to FILE.mcap, without loss",
        "view": "View a recording, or the running rig, in rerun",
        "plot": "Draw orbit, spectra, Bode plot and others of a recording",
        "info": "Show the calibration, gaps, health and events of a recording",
        "cut": "Cut a part from a recording, or join the files of a run",
        "recover": "Recover recordings that were cut off or damaged",
        "import": "Convert logs of a real rig to a recording",
        "export": "Write a recording as MDF4, TDMS, UFF58b, CSV, Parquet or WAV",
    },
    "Compare recordings with the model": {
        "validate": "Simulate a recording again and compare it with the model",
        "compare": "Show what changed between two recordings, by phase and channel",
        "identify": "Fit parameters of the rig to a recording",
        "score": "Score a DAQ by comparing its recording with what the rig sent",
        "campaign": "Run scripted tests of a device in the loop",
        "sessions": "List or record again the reference sessions",
    },
    "Simulate offline": {
        "simulate": "Simulate a scene at full speed and write it to a file",
        "sweep": "Simulate a scene many times with varied values",
        "map": "Map the outcome of a scene over two of its values, with the borders found",
        "bench": "Measure speed and error of the engines on this machine",
        "ladder": "Find the cheapest model, engine and step within a tolerance",
        "chart": "Chart speed against error",
        "stability": "Find where integration methods fail",
        "paper": "Reproduce the figures, tables and claims of the paper",
    },
}
"""Help line by command and heading; each command's docstring begins with its line. The command is the function of that
name in the module of that name, or in `requests`, and is imported when it is called."""

_REQUESTS = ("step", "note", "stop", "pause", "resume", "seek", "rate")
"""Requests to a running rig or replay that are not scene commands."""
_MODULES = ("fault",)
"""Scene commands with options beyond their fields, each in a separate module."""

GROUPS = {
    "can": {
        "hub": "Run virtual CAN buses without a rig, until Ctrl-C",
        "dbc": "Show the DBC of the rig's messages",
        "load": "Show period and bus load of every message of the rig",
    },
    "keys": {
        "init": "Create the certificates for an exposed rig",
        "add": "Add the certificate of one device, which is bound to its name",
        "remove": "Withdraw the certificate of a device or a role",
    },
}
"""Subcommands by group. Without a subcommand, the function of the group's own name runs."""


NEED_FULL = (
    "demo", "scenes", "params", "laws", "magnets", "keys", "run", "can", "view", "import", "validate", "compare",
    "identify", "score", "plot", "campaign", "sessions", "simulate", "sweep", "map", "bench", "ladder", "chart",
    "stability", "paper",
)  # fmt: skip
"""Commands that a lean install lacks; of `keys` it has the subcommands."""


def rig() -> Group:
    """Return the command line."""
    about = "A virtual rotor-stator test rig: simulate, serve, command, record, view and validate it."
    group = make_group("rig", COMMANDS, _load, _rig, about)
    if is_full_missing():
        group.epilog = f"These need the whole rig, {INSTALL_COMMAND}: {', '.join(NEED_FULL)}."
    return group


_SHORTAGES = {
    "little memory": r"MemoryError|failed to map segment|[Cc]annot allocate memory|without (setting an )?exception",
    "few threads": r"start new thread|spawn thread|Resource temporarily unavailable",
    "few open files": "Too many open files",
}
"""Patterns of errors of Python and of libraries, by what the system did not grant."""


def _load(name: str) -> Any:
    if name not in GROUPS:
        if name in SUMMARIES and name not in _MODULES:
            from rig.cli.commands.requests import scene_command

            return make_command(scene_command(name), name)
        return load_command("requests" if name in _REQUESTS else name, name)
    from importlib import import_module

    function = getattr(import_module(f"rig.cli.commands.{name}"), name)
    return make_group(name, {"Commands": GROUPS[name]}, partial(load_command, name), function)


def _rig(
    context: typer.Context,
    *,
    version: Annotated[bool, typer.Option("--version", is_eager=True, help="Show the version and exit")] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed

        typer.echo(f"rig {installed('rotor-stator-rig')}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def start(arguments: list[str] | None = None) -> None:
    """Run the command and end the process with its exit status."""
    if arguments is None and sys.argv[1:2] == ["__complete"] and len(sys.argv) == 4:
        from rig.cli.commands.completion import complete

        sys.stdout.write("".join(f"{line}\n" for line in complete(rig(), *sys.argv[2:])))
        return
    provenance.arguments[:] = sys.argv[1:] if arguments is None else arguments
    try:
        code = rig().main(arguments, prog_name="rig", standalone_mode=False)
    except InputError as error:
        _fail(str(error))
    except (SimulationError, DiskError) as error:
        _fail(str(error), status=1)
    except _UsageError as error:
        _fail(usage_error(error))
    except (typer.Abort, KeyboardInterrupt):
        _fail("interrupted", status=_INTERRUPTED)
    except MissingPackageError as error:
        _fail(str(error))
    except ModuleNotFoundError as error:
        if not (need := describe_missing_package(error)):
            raise
        _fail(f"this {need}")
    except (BrokenPipeError, SystemExit) as error:
        # The reader of the output has exited (`rig params | head`); rich and typer report another status.
        if not isinstance(error, BrokenPipeError) and not isinstance(error.__context__, BrokenPipeError):
            raise
        sys.stderr.close()
        sys.exit(_NO_READER)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            _fail(str(InputError("file name", "one that the system accepts", error.filename)))
        # A full disk or a refusal by the file system is not a program error.
        _fail(f"{error.filename or 'the system'}: {error.strerror or error}", status=1)
    except BaseException as error:  # a library written in Rust may raise what is no Exception
        if is_interrupted():
            _fail("interrupted", status=_INTERRUPTED)
        if (shortage := describe_shortage(error)) is None:
            raise
        _fail(shortage, status=1)
    if code == _INTERRUPTED:
        print("rig: interrupted", file=sys.stderr)
    sys.exit(code if isinstance(code, int) else 0)


def describe_shortage(error: BaseException | None) -> str | None:
    """Return a line about memory, threads or files that the system did not grant; None for any other error."""
    while error is not None:
        for what, sign in _SHORTAGES.items():
            if re.search(sign, f"{type(error).__name__}: {error}"):
                return f"the system has too {what} for this command ({printable(str(error), 200) or 'out of memory'})"
        error = error.__cause__ or error.__context__
    return None


def _fail(message: str, *, status: int = 2) -> NoReturn:
    echo("rig: " + " ".join(message.split()), err=True)
    sys.exit(status)
