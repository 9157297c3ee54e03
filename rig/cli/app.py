"""Composition of the `rig` command: which subcommands there are, and how errors reach the user."""

from __future__ import annotations

import errno
import sys
from functools import partial
from typing import Annotated, Any, NoReturn

import typer

from rig.base.errors import WHOLE_RIG, DiskError, InputError, SimulationError, lacks_full, need_of_full
from rig.cli.command import Group, load_command, made_command, make_group, usage_error
from rig.cli.output import provenance
from rig.cli.output.tables import echo
from rig.run.commands import SUMMARIES

# Wrong options and arguments; typer names only these two of its own exceptions, which have moved between its versions.
_UsageError: Any = typer.BadParameter.__base__

_NO_READER = 141
"""What a shell makes of a program that SIGPIPE has ended."""
_INTERRUPTED = 130
"""What typer makes of Ctrl-C, and shells expect."""

COMMANDS = {
    "Start here": {
        "demo": "Start the service, record, hit, let it whirl, stop",
        "scenes": "List the scenes that come with the rig, or show one",
        "params": "Show a parameter set: value, unit, source and kind of each",
        "laws": "Compare all normal contact laws",
        "magnets": "Compare the magnet models",
        "keys": "Show every key, message and unit of the rig's streams",
        "completion": "Complete commands, options and names in a shell",
    },
    "The rig as a service": {
        "run": "Run a scene in real time and publish its sensors",
        **{name: line for name, line in SUMMARIES.items() if line},
        "step": "Let a rig that runs with --pace lockstep simulate TICKS more",
        "note": "Put a note into every recording that is being made of a rig",
        "status": "Show how a running rig is doing: time, pace, lateness, losses",
        "stop": "End the run of a rig; recordings of it close",
        "twins": "Serve the instruments of a running rig to their drivers",
        "can": "Run virtual CAN buses, and show what the rig sends on one",
    },
    "A recording as the rig": {
        "replay": "Play a recording to whoever listens, as if it were the rig",
        "pause": "Hold the replay of a recording",
        "resume": "Let the replay of a recording go on",
        "seek": "Let the replay of a recording go on from another position",
        "rate": "Set how fast the replay of a recording goes",
    },
    "Recordings": {
        "record": "Record all streams of a running rig to FILE.mcap, losslessly",
        "view": "View a recording, or the running rig, in rerun",
        "info": "Show what a recording holds: calibration, gaps, health, events",
        "cut": "Cut a recording, or join several files of one run",
        "recover": "Make finished recordings of files that were cut off or damaged",
        "import": "Turn logs of a real rig into a recording",
        "export": "Write a recording as MDF4, TDMS, UFF58b, CSV, Parquet or WAV",
    },
    "Recordings against the model": {
        "validate": "Do a recording again and hold it against the model",
        "identify": "Fit numbers of the rig to a recording",
        "score": "Judge a DAQ by what it recorded, against what the rig sent",
        "campaign": "Run scripted tests of a device in the loop, and judge them",
        "sessions": "Make the reference sessions anew",
    },
    "Without a clock": {
        "simulate": "Simulate a scene as fast as it goes and write it to a file",
        "bench": "Measure simulated over processor time with the error beside it",
        "ladder": "Find the cheapest model, engine and step that are good enough",
        "chart": "Chart speed against error",
        "stability": "Test where integration methods fail",
        "paper": "Make the paper's figures, tables and claims again",
    },
}
"""What the help says of each command, which is what its own text begins with; the command itself is the function of its
name in the module of its name, or in that of the requests, and is imported when it is called."""

_REQUESTS = ("step", "note", "stop", "pause", "resume", "seek", "rate")
"""Requests to a running rig or replay that are no scene commands."""
_MODULES = ("fault",)
"""Scene commands whose command line is more than their fields, in a module of its own."""

GROUPS = {
    "can": {
        "hub": "Run virtual CAN buses of their own, without a rig, until Ctrl-C",
        "dbc": "Show the DBC of the rig's messages, made from the channel table",
        "load": "Show every message of the rig with its period, share of the bus",
    },
    "keys": {"init": "Make the certificates of a rig that is exposed"},
}
"""The commands of those that are groups, whose own function is what they do without one."""


NEED_FULL = (
    "demo", "scenes", "params", "laws", "magnets", "keys", "run", "can", "view", "import", "validate", "identify",
    "score", "campaign", "sessions", "simulate", "bench", "ladder", "chart", "stability", "paper",
)  # fmt: skip
"""The commands that a lean install does without; of `keys` it has `init`."""


def rig() -> Group:
    """The command line."""
    about = "A virtual rotor-stator test rig: simulate, serve, hit, record, view and judge it."
    group = make_group("rig", COMMANDS, _load, _rig, about)
    if lacks_full():
        group.epilog = f"These need the whole rig, {WHOLE_RIG}: {', '.join(NEED_FULL)}."
    return group


def _load(name: str) -> Any:
    if name not in GROUPS:
        if name in SUMMARIES and name not in _MODULES:
            from rig.cli.commands.requests import scene_command

            return made_command(scene_command(name), name)
        return load_command("requests" if name in _REQUESTS else name, name)
    from importlib import import_module

    function = getattr(import_module(f"rig.cli.commands.{name}"), name)
    return make_group(name, {"Commands": GROUPS[name]}, partial(load_command, name), function)


def _rig(
    context: typer.Context,
    *,
    version: Annotated[bool, typer.Option("--version", is_eager=True, help="Show the version and end.")] = False,
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
    provenance.given[:] = sys.argv[1:] if arguments is None else arguments
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
    except ModuleNotFoundError as error:
        if not (need := need_of_full(error)):
            raise
        _fail(f"this {need}")
    except (BrokenPipeError, SystemExit) as error:
        # The reader of our output has gone (`rig params | head`), of which rich and typer make a status of their own.
        if not isinstance(error, BrokenPipeError) and not isinstance(error.__context__, BrokenPipeError):
            raise
        sys.stderr.close()
        sys.exit(_NO_READER)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            _fail(str(InputError("file name", "one that the system accepts", error.filename)))
        # A disk that is full, a file system that refuses: not a fault of the program.
        _fail(f"{error.filename or 'the system'}: {error.strerror or error}", status=1)
    if code == _INTERRUPTED:
        print("rig: interrupted", file=sys.stderr)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str, *, status: int = 2) -> NoReturn:
    echo("rig: " + " ".join(message.split()), err=True)
    sys.exit(status)
