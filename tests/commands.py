"""Commands of `rig`, run in this process."""

from __future__ import annotations

import pytest

from rig.cli.main import main


def run(*arguments: object) -> int:
    """The exit status of a command."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """The exit status of a command, what it printed and what it complained of."""
    status = run(*arguments)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def shown(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What a command prints that ends well."""
    status, output, complaints = said(capsys, *arguments)
    assert status == 0, complaints
    return output
