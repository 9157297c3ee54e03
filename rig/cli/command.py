"""The base of every command: a plain-text help page, and import on first use.

The page fits 80 columns. Typer's own rendering takes longer than everything else that a page needs, and its boxes do
not suit a pipe.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from enum import Enum
from importlib import import_module
from keyword import iskeyword
from pathlib import Path
from typing import Any, get_args

import typer
from typer.core import TyperCommand, TyperGroup

from rig.base.errors import InputError, RefusedError, UnknownNameError, Words
from rig.cli.groups import expand_groups

_APP_OPTIONS: dict[str, Any] = {"add_completion": False, "rich_markup_mode": None}
_SETTINGS = {"help_option_names": ["-h", "--help"]}
_NEGATIVE = re.compile(r"-\.?(\d|inf$|nan$)", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?[\d.]+|nan|inf")
_VALUE_TEXTS = ((r"([^\s;[]+)<=x<=", r"\1 to "), (r"x>=(?=\S+\])", "at least "), (r"(\[default: )\((.+)\)", r"\1\2"))
"""Replacements in typer's description of a value: ranges and defaults in plain words."""
_UNITS = {"s", "ms", "hz", "n", "mb"}
"""Unit suffixes of option names; the unit becomes the metavar."""


class _Page:
    """Help page with options under the titles of their panels, and arguments by name."""

    params: list[Any]
    get_params: Callable[[Any], list[Any]]

    def get_help_option(self, ctx: Any) -> Any:
        option = super().get_help_option(ctx)  # type: ignore[misc]
        option.default = False  # typer would convert None by pydantic, which takes 0.1 s
        return option

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        tail = ["COMMAND ..."] if isinstance(self, TyperGroup) else []
        return [
            "[OPTIONS]",
            *(shown_name(param) for param in self.params if param.param_type_name == "argument"),
            *tail,
        ]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        sections: dict[str, list[tuple[str, str]]] = {}
        for param in sorted(self.get_params(ctx), key=lambda param: param.param_type_name != "argument"):
            if (record := param.get_help_record(ctx)) is not None:
                title = getattr(param, "rich_help_panel", None) or f"{param.param_type_name.capitalize()}s"
                name = shown_name(param) if param.param_type_name == "argument" else record[0]
                says = record[1]
                for typed, plain in _VALUE_TEXTS:
                    says = re.sub(typed, plain, says)
                sections.setdefault(title, []).append((name, says))
        _write(sections, formatter)


def shown_name(param: Any) -> str:
    """Return the name of a parameter as the user types it."""
    options = [name for name in param.opts if name.startswith("-")]
    return max(options, key=len) if options else param.metavar or param.name.upper()


def _write(sections: Mapping[str, list[tuple[str, str]]], formatter: Any) -> None:
    for title, rows in sections.items():
        with formatter.section(title):
            formatter.write_dl(rows)


class _Command(_Page, TyperCommand):
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        # A negative number is a value, not an option; the command explains what is wrong with it.
        ctx.ignore_unknown_options = any(map(_NEGATIVE.match, args))
        ctx.allow_extra_args, escaped = True, "--" in args
        rest = super().parse_args(ctx, args)
        options = [name for param in self.params for name in param.opts if name.startswith("-")]
        values = {param.name: ctx.params[param.name] for param in self.params}
        lists = {name: value if isinstance(value, list | tuple) else [value] for name, value in values.items()}
        # An unknown option is parsed as an argument.
        arguments = [each for param in self.params if param.param_type_name == "argument" for each in lists[param.name]]
        for each in map(str, [*arguments, *rest]):
            if each.startswith("--") and not escaped:
                raise UnknownNameError("option", f"one of `{ctx.command_path} -h`", each, options)
        for param in self.params:
            for each in lists[param.name]:
                # Comparisons with NaN never fail, so a NaN would wait or count without end.
                if isinstance(each, float) and each != each:
                    raise InputError(shown_name(param), "a number", Words("nan"))
                if str(each) in options:
                    raise InputError(shown_name(param), "followed by a value", str(each))
        if rest:
            raise InputError("argument", f"one that `{ctx.command_path}` takes (see -h)", rest[0])
        return rest

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except RefusedError as error:
            field, _, must = str(error).partition(" must be ")
            named = self._by_field("argument", "option").get(field.removeprefix(f"{ctx.info_name}."))
            if named is None or "." not in field:
                raise
            raise RefusedError(f"{shown_name(named)} must be {must}") from None
        except InputError as error:
            named = self._by_field("option")
            fields = [field.replace("-", "_").removesuffix(".name") for field in error.field.split(" and ")]
            params = [named[field] for field in fields if field in named]
            if len(params) < len(fields) or all(ctx.params[param.name] in (None, []) for param in params):
                raise
            options = " and ".join(map(shown_name, params))
            must = re.sub(
                r"\b[a-z]+_\w+", lambda name: shown_name(named[name[0]]) if name[0] in named else name[0], error.must
            )
            raise InputError(options, must, error.received) from None

    def _by_field(self, *kinds: str) -> dict[str, Any]:
        """Return arguments and options by their field name, as used in errors about their values."""
        return {
            name.lstrip("-").replace("-", "_"): param
            for param in self.params
            if param.param_type_name in kinds
            for name in (param.name, *param.opts)
        }


class Group(_Page, TyperGroup):
    """Commands listed under headings, each with its help line; a command is imported when it is called.

    Attributes:
        sections: Help lines by heading and command name.
        load: Returns the command of a name.
    """

    sections: Mapping[str, Mapping[str, str]]
    load: Callable[[str], Any]

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, in the order of the help."""
        return [name for commands in self.sections.values() for name in commands]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command of a name.

        Raises:
            UnknownNameError: The command does not exist.
        """
        names = self.list_commands(ctx)
        if cmd_name in names:
            return self.load(cmd_name)
        raise UnknownNameError("command", f"one of `{ctx.command_path} -h`", cmd_name, names)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options, then the commands."""
        super().format_options(ctx, formatter)
        width = max(map(len, self.list_commands(ctx)))
        for title, commands in self.sections.items():
            _write({title: [(f"{name:{width}}", line) for name, line in commands.items()]}, formatter)


def load_command(module: str, name: str) -> Any:
    """Return the command `name` of a module. A Python keyword has an underscore appended in module and function."""
    name, shown = name + "_" * iskeyword(name), name
    return make_command(getattr(import_module(f"rig.cli.commands.{module}{'_' * iskeyword(module)}"), name), shown)


def make_command(function: Callable[..., None], name: str) -> Any:
    """Return a command that calls a function."""
    function = expand_groups(function)
    app = typer.Typer(**_APP_OPTIONS)
    app.command(name, cls=_Command, context_settings=_SETTINGS)(function)
    command = typer.main.get_command(app)
    for param in command.params:
        if param.metavar is None and param.param_type_name == "option" and not getattr(param, "is_flag", False):
            param.metavar = _metavar(str(param.name), get_args(function.__annotations__[param.name])[0])
    return command


def _metavar(name: str, hint: Any) -> str:
    """Return the placeholder for an option's value in the help."""
    kinds = get_args(hint) or (hint,)
    if isinstance(kinds[0], type) and issubclass(kinds[0], Enum):
        return "|".join(each.value for each in kinds[0])
    if Path in kinds:
        return "FILE"
    if (unit := name.rpartition("_")[2]) in _UNITS:
        return unit.upper()
    return "NUMBER" if {int, float} & {*kinds} else "TEXT"


def make_group(
    name: str,
    sections: Mapping[str, Mapping[str, str]],
    load: Callable[[str], Any],
    callback: Callable[..., None],
    help: str | None = None,
) -> Group:
    """Return a group of commands.

    Args:
        name: Name of the group.
        sections: See `Group`.
        load: See `Group`.
        callback: Called before a command, and without one.
        help: Help text; by default the callback's docstring.
    """
    app = typer.Typer(name=name, **_APP_OPTIONS)
    app.callback(cls=Group, help=help or callback.__doc__, invoke_without_command=True, context_settings=_SETTINGS)(
        expand_groups(callback)
    )
    group = typer.main.get_command(app)
    assert isinstance(group, Group)
    group.sections, group.load = sections, load
    return group


def usage_error(error: Any) -> str:
    """Return the message for wrong options, as "X must be Y; received Z" where possible."""
    page, kind = f"`{error.ctx.command_path if error.ctx is not None else 'rig'} -h`", type(error).__name__
    wrong = error.__cause__.errors()[0] if hasattr(error.__cause__, "errors") else None
    if kind == "NoSuchOption":
        all_options = [] if error.ctx is None else [name for param in error.ctx.command.params for name in param.opts]
        options = (name for name in all_options if name.startswith("-"))
        message: InputError = UnknownNameError("option", f"one of {page}", error.option_name, options)
    elif kind == "MissingParameter":
        says = (error.param.help or page).rstrip(".")
        message = InputError(shown_name(error.param), f"given: {says[0].lower()}{says[1:]}", None)
    elif kind == "BadOptionUsage":
        with_value = "requires" in error.message
        must = "followed by a value" if with_value else "given without a value"
        message = InputError(error.option_name, must, None if with_value else Words("one"))
    elif wrong is not None:
        received = Words(wrong["input"]) if _NUMBER.fullmatch(str(wrong["input"])) else wrong["input"]
        must = wrong["msg"].removeprefix("Input should be ").partition(", unable")[0]
        if "is not one of" in must:
            must = "one of " + must.partition(" is not one of ")[2].rstrip(".").replace("'", "")
        message = InputError(shown_name(error.param), must, received)
    else:
        return f"{error.format_message()} (see {page})"
    return str(message)
