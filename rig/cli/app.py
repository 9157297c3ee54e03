"""Composition of the `rig` command: which subcommands there are, and how errors reach the user."""

from __future__ import annotations

import errno
import sys
from importlib import import_module
from keyword import iskeyword
from typing import Annotated, Any, NoReturn

import typer

from rig.cli import can, can_messages, keys, origin
from rig.cli.groups import grouped
from rig.errors import DiskError, InputError, SimulationError
from rig.text import printable

# Wrong options and arguments; typer names only these two of its own exceptions, which have moved between its versions.
_UsageError: Any = typer.BadParameter.__base__

_INTERRUPTED = 130
"""What typer makes of Ctrl-C, and shells expect."""

app = typer.Typer(
    name="rig",
    help="A virtual rotor-stator test rig: simulate, serve, hit, record, view and judge it.",
    invoke_without_command=True,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_PANELS = {
    "Start here": ("demo", "scenes", "params", "laws", "magnets"),
    "The rig as a service": ("run", "hammer", "speed", "release", "step", "note", "status", "stop", "twins"),
    "A recording as the rig": ("replay", "pause", "resume", "seek", "rate"),
    "Recordings": ("record", "view", "info", "cut", "recover", "import", "export"),
    "Recordings against the model": ("validate", "identify", "sessions"),
    "Without a clock": ("simulate", "bench", "ladder", "chart", "stability", "paper"),
}
"""Each command is the function of its name in the module of its name, behind which an underscore stands if need be."""


@app.callback()
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


for _panel, _names in _PANELS.items():
    for _name in _names:
        _module = _name + "_" * iskeyword(_name)
        _function = grouped(getattr(import_module(f"rig.cli.{_module}"), _module))
        # A negative value such as `rig speed -1` is a value, not an option: the rig explains what is wrong with it.
        _settings = {"ignore_unknown_options": True} if _name in ("speed", "rate", "seek", "step") else {}
        app.command(_name, rich_help_panel=_panel, context_settings=_settings)(_function)

app.add_typer(keys.app, name="keys", rich_help_panel="Start here")
can.app.command()(can_messages.dbc)
can.app.command()(grouped(can_messages.load))
app.add_typer(can.app, name="can", rich_help_panel="The rig as a service")


def start(arguments: list[str] | None = None) -> None:
    """Run the command and end the process with its exit status."""
    origin.given[:] = sys.argv[1:] if arguments is None else arguments
    try:
        code = app(args=arguments, standalone_mode=False)
    except InputError as error:
        _fail(str(error))
    except (SimulationError, DiskError) as error:
        _fail(str(error), status=1)
    except typer.BadParameter as error:
        _fail(error.format_message() if error.param is None else _wrong_value(error))
    except _UsageError as error:
        command = error.ctx.command_path if error.ctx is not None else "rig"
        _fail(f"{error.format_message()} (see `{command} --help`)")
    except (typer.Abort, KeyboardInterrupt):
        _fail("interrupted", status=_INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output has gone (`rig params | head`): nothing is wrong.
        sys.stderr.close()
        sys.exit(141)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            _fail(str(InputError("file name", "one that the system accepts", error.filename)))
        # A disk that is full, a file system that refuses: not a fault of the program.
        _fail(f"{error.filename or 'the system'}: {error.strerror or error}", status=1)
    if code == _INTERRUPTED:
        print("rig: interrupted", file=sys.stderr)
    sys.exit(code if isinstance(code, int) else 0)


def _wrong_value(error: Any) -> str:
    """A value of another type, in the form of every other wrong value."""
    from pydantic import ValidationError

    options = [name for name in error.param.opts if name.startswith("-")]
    field = max(options, key=len) if options else error.param.metavar or error.param.name
    if not isinstance(error.__cause__, ValidationError):
        return f"{error.format_message()} (see `{error.ctx.command_path if error.ctx else 'rig'} --help`)"
    first = error.__cause__.errors()[0]
    must = first["msg"].removeprefix("Input should be ").partition(", unable")[0]
    return str(InputError(field, must, first["input"]))


def _fail(message: str, *, status: int = 2) -> NoReturn:
    print("rig: " + printable(" ".join(message.split())), file=sys.stderr)
    sys.exit(status)
