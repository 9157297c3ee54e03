"""What every command of `rig` has in common: its page of help, and that it is loaded only when it is called.

The page is plain text that fits 80 columns. To draw it as typer does would take longer than all else that a page needs,
and boxes do not go well through a pipe.
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
from rig.cli.groups import grouped

_PLAIN: dict[str, Any] = {"add_completion": False, "rich_markup_mode": None}
_SETTINGS = {"help_option_names": ["-h", "--help"]}
_NEGATIVE = re.compile(r"-\.?(\d|inf$|nan$)", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?[\d.]+|nan|inf")
_PLAINER = ((r"([^\s;[]+)<=x<=", r"\1 to "), (r"x>=(?=\S+\])", "at least "), (r"(\[default: )\((.+)\)", r"\1\2"))
"""What typer says of a value, and what a person would."""
_UNITS = {"s", "ms", "hz", "n", "mb"}
"""What the name of an option may end in, if its value has a unit."""


class _Page:
    """Options in sections under their panels' titles, arguments by their own names."""

    params: list[Any]
    get_params: Callable[[Any], list[Any]]

    def get_help_option(self, ctx: Any) -> Any:
        option = super().get_help_option(ctx)  # type: ignore[misc]
        option.default = False  # of None, typer would have pydantic make a truth value: a tenth of a second
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
                for typed, plain in _PLAINER:
                    says = re.sub(typed, plain, says)
                sections.setdefault(title, []).append((name, says))
        _write(sections, formatter)


def shown_name(param: Any) -> str:
    """What a person knows a parameter by."""
    options = [name for name in param.opts if name.startswith("-")]
    return max(options, key=len) if options else param.metavar or param.name.upper()


def _write(sections: Mapping[str, list[tuple[str, str]]], formatter: Any) -> None:
    for title, rows in sections.items():
        with formatter.section(title):
            formatter.write_dl(rows)


class _Command(_Page, TyperCommand):
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        # A negative number is a value, not an option: whoever gets it explains what is wrong with it.
        ctx.ignore_unknown_options = any(map(_NEGATIVE.match, args))
        ctx.allow_extra_args, escaped = True, "--" in args
        rest = super().parse_args(ctx, args)
        options = [name for param in self.params for name in param.opts if name.startswith("-")]
        values = {param.name: ctx.params[param.name] for param in self.params}
        given = {name: value if isinstance(value, list | tuple) else [value] for name, value in values.items()}
        # Which is what an option that there is none has been taken for, then.
        arguments = [each for param in self.params if param.param_type_name == "argument" for each in given[param.name]]
        for each in map(str, [*arguments, *rest]):
            if each.startswith("--") and not escaped:
                raise UnknownNameError("option", f"one of `{ctx.command_path} -h`", each, options)
        for param in self.params:
            for each in given[param.name]:
                # No comparison refuses it: it would be waited for, or counted to, without end.
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
            found = [named[field] for field in fields if field in named]
            if len(found) < len(fields) or all(ctx.params[param.name] in (None, []) for param in found):
                raise
            options = " and ".join(map(shown_name, found))
            must = re.sub(
                r"\b[a-z]+_\w+", lambda name: shown_name(named[name[0]]) if name[0] in named else name[0], error.must
            )
            raise InputError(options, must, error.received) from None

    def _by_field(self, *kinds: str) -> dict[str, Any]:
        """Arguments and options by what they are to whoever refuses their values: its fields."""
        return {
            name.lstrip("-").replace("-", "_"): param
            for param in self.params
            if param.param_type_name in kinds
            for name in (param.name, *param.opts)
        }


class Group(_Page, TyperGroup):
    """Commands by the titles that they stand under, each with its line of help; none is imported before it is called.

    Attributes:
        sections: Names and lines by title.
        load: Gives the command of a name.
    """

    sections: Mapping[str, Mapping[str, str]]
    load: Callable[[str], Any]

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of all commands, in the order of the help."""
        return [name for commands in self.sections.values() for name in commands]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of a name.

        Raises:
            UnknownNameError: There is none.
        """
        names = self.list_commands(ctx)
        if cmd_name in names:
            return self.load(cmd_name)
        raise UnknownNameError("command", f"one of `{ctx.command_path} -h`", cmd_name, names)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """The options, then the commands."""
        super().format_options(ctx, formatter)
        width = max(map(len, self.list_commands(ctx)))
        for title, commands in self.sections.items():
            _write({title: [(f"{name:{width}}", line) for name, line in commands.items()]}, formatter)


def load_command(module: str, name: str) -> Any:
    """The command that is the function of its name in a module, behind which an underscore stands if need be."""
    name, shown = name + "_" * iskeyword(name), name
    return made_command(getattr(import_module(f"rig.cli.commands.{module}{'_' * iskeyword(module)}"), name), shown)


def made_command(function: Callable[..., None], name: str) -> Any:
    """Return the command of a name that calls a function."""
    function = grouped(function)
    app = typer.Typer(**_PLAIN)
    app.command(name, cls=_Command, context_settings=_SETTINGS)(function)
    command = typer.main.get_command(app)
    for param in command.params:
        if param.metavar is None and param.param_type_name == "option" and not getattr(param, "is_flag", False):
            param.metavar = _metavar(str(param.name), get_args(function.__annotations__[param.name])[0])
    return command


def _metavar(name: str, hint: Any) -> str:
    """What the help calls the value of an option."""
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
    """A group of commands.

    Args:
        name: Its name.
        sections: As for `Group`.
        load: As for `Group`.
        callback: What is done before a command, and without one.
        help: Its text; without it, that of the callback.
    """
    app = typer.Typer(name=name, **_PLAIN)
    app.callback(cls=Group, help=help or callback.__doc__, invoke_without_command=True, context_settings=_SETTINGS)(
        grouped(callback)
    )
    group = typer.main.get_command(app)
    assert isinstance(group, Group)
    group.sections, group.load = sections, load
    return group


def usage_error(error: Any) -> str:
    """What was wrong with the options, in the form of every other wrong value where it has one."""
    page, kind = f"`{error.ctx.command_path if error.ctx is not None else 'rig'} -h`", type(error).__name__
    wrong = error.__cause__.errors()[0] if hasattr(error.__cause__, "errors") else None
    if kind == "NoSuchOption":
        known = [] if error.ctx is None else [name for param in error.ctx.command.params for name in param.opts]
        options = (name for name in known if name.startswith("-"))
        found: InputError = UnknownNameError("option", f"one of {page}", error.option_name, options)
    elif kind == "MissingParameter":
        says = (error.param.help or page).rstrip(".")
        found = InputError(shown_name(error.param), f"given: {says[0].lower()}{says[1:]}", None)
    elif kind == "BadOptionUsage":
        with_value = "requires" in error.message
        must = "followed by a value" if with_value else "given without a value"
        found = InputError(error.option_name, must, None if with_value else Words("one"))
    elif wrong is not None:
        received = Words(wrong["input"]) if _NUMBER.fullmatch(str(wrong["input"])) else wrong["input"]
        must = wrong["msg"].removeprefix("Input should be ").partition(", unable")[0]
        if "is not one of" in must:
            must = "one of " + must.partition(" is not one of ")[2].rstrip(".").replace("'", "")
        found = InputError(shown_name(error.param), must, received)
    else:
        return f"{error.format_message()} (see {page})"
    return str(found)
