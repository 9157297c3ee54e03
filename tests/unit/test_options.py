"""Options that several commands share are the same everywhere, and their texts are read the same way."""

from __future__ import annotations

from typing import Any

import pytest
import typer

from rig.cli.app import app
from rig.cli.options import names_of, pairs
from rig.errors import InputError

SHARED = ("--from", "--to", "--force", "--report", "--connect")


def options() -> list[tuple[str, str, Any]]:
    """Command, flag and parameter of every option there is."""
    commands: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return [
        (name, flag, parameter)
        for name, command in commands.items()
        for parameter in command.params
        for flag in parameter.opts
        if flag.startswith("--")
    ]


@pytest.mark.parametrize("shared", SHARED)
def test_a_shared_option_is_worded_once(shared: str) -> None:
    found = [parameter for _, flag, parameter in options() if flag == shared]
    assert len(found) > 1
    assert len({(one.help, one.metavar, *one.opts, *one.secondary_opts) for one in found}) == 1


def test_the_same_thing_has_one_name() -> None:
    others = {"--from-s", "--to-s", "--window", "--channel", "--overwrite", "--out", "--html"}
    assert [(name, flag) for name, flag, _ in options() if flag in others] == []


def test_names_and_pairs() -> None:
    assert names_of(None) == names_of(" , ") == []
    assert names_of("a, b,,c") == ["a", "b", "c"]
    assert pairs("--set", None, "KEY=VALUE") == {}
    assert pairs("--set", ["a = 1", "b=c=d"], "KEY=VALUE") == {"a": "1", "b": "c=d"}
    for wrong in ("a", "=1", "a=", " = "):
        with pytest.raises(InputError, match="--set must be KEY=VALUE"):
            pairs("--set", [wrong], "KEY=VALUE")
    with pytest.raises(InputError, match="--set must be given once for a"):
        pairs("--set", ["a=1", "a=2"], "KEY=VALUE")
