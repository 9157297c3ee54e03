"""`rig campaign`: scripted tests of a device in the loop, run by pytest; no knowledge of pytest is needed."""

from __future__ import annotations

import importlib.util
import os
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.outcome import Outcome
from rig.cli.options import Force
from rig.cli.output.folder import check_folder
from rig.cli.output.tables import echo, progress_bar

if TYPE_CHECKING:
    from replays.campaigns.files.campaign import Case

_INTERRUPTED = 130
_CASE_S, _SIMULATED_S, _BLOCK_S = 1.6, 0.1, 0.0024
"""Processor time of a case, of a simulated second and of a block, measured with the monitor that ships [s]."""
_EXTRA = "installed with its extra: pip install 'rotor-stator-rig[campaigns]'"


def campaign(
    files: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[FILE...]",
            help="*.campaign.toml file, name of a built-in campaign (hammer) or pytest tests; FILE::CASE: one case; "
            "none: list the built-in campaigns",
        ),
    ] = None,
    *,
    keyword: Annotated[
        str | None, typer.Option("--keyword", "-k", metavar="WORDS", help="Run only cases with these words in the name")
    ] = None,
    exit_first: Annotated[bool, typer.Option("--exit-first", "-x", help="Stop at the first case that fails")] = False,
    jobs: Annotated[int, typer.Option("--jobs", "-j", metavar="N", min=1, help="Number of parallel cases")] = 1,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Folder for results, reports and evidence")
    ] = None,
    force: Force = False,
    against: Annotated[
        list[Path] | None,
        typer.Option(metavar="FOLDER", help="Compare with an earlier campaign; repeatable, the oldest first"),
    ] = None,
    list_cases: Annotated[bool, typer.Option("--list", help="List the cases and their number; run nothing")] = False,
    device: Annotated[
        str | None,
        typer.Option(metavar="COMMAND", help="Command line of your device, with the file's placeholders ({url}, ...)"),
    ] = None,
    limit: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=QUANTITY", help="Replace a limit of the file, as in danger='500 um'; repeatable"),
    ] = None,
    sheet: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE", help="Write a sheet to hand in, .html or .pdf, with evidence of each case; repeatable"
        ),
    ] = None,
    identity: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=TEXT", help="Identity on the sheet: name, serial, firmware, operator; repeatable"),
    ] = None,
    repeat: Annotated[int, typer.Option(metavar="N", min=1, help="Run each case N times and compare the runs")] = 1,
    yes: Annotated[bool, typer.Option("--yes", help="Run more than 1,000 cases")] = False,
    url: Annotated[
        str | None, typer.Option(metavar="URL", help="Use the rig at this URL; skip cases that it cannot run")
    ] = None,
    replay: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="Use a replayed recording; skip cases that need commands")
    ] = None,
) -> None:
    """Run scripted tests of a device in the loop.

    Exit status: 0 pass; 1 a case failed; 2 wrong input or nothing to run; 3 inconclusive (no case failed, and one is
    inconclusive or all were skipped). Ctrl-C stops all processes and keeps the results of the finished cases.
    """
    if not files:
        _list()
        return
    if importlib.util.find_spec("pytest") is None:
        raise InputError("rig campaign", _EXTRA, Words("without pytest"))
    if jobs > 1 and importlib.util.find_spec("xdist") is None:
        raise InputError("--jobs", f"1, or {_EXTRA}", jobs)
    if url is not None and replay is not None:
        raise InputError("--url", "left out with --replay", url)
    if url is not None and jobs > 1:
        raise InputError("--jobs", "1 with --url, as the cases share one rig", jobs)
    if output is not None:
        from replays.campaigns.reporting.results import check_output

        check_folder(output, field="--output")
        check_output(output, force=force)
    if sheet:
        from replays.campaigns.reporting.sheet import check_sheet, parse_identity

        if output is None:
            raise InputError("--output", "given with --sheet", None)
        parse_identity(identity or [])
        for file in sheet:
            check_sheet(file)
    files, cases = _check_files(files, against or (), replay, device, limit or (), repeat, yes=yes or list_cases)
    if list_cases:
        _list_cases(files, cases, repeat)
        return
    plugin_options = {"--rig-results": output, "--rig-url": url, "--rig-replay": replay, "--rig-device": device}
    options = [word for name, value in plugin_options.items() if value is not None for word in (name, str(value))]
    options += ["-k", keyword] if keyword is not None else []
    options += [word for each in limit or () for word in ("--rig-limit", each)]
    options += [word for each in against or () for word in ("--rig-against", str(each))]
    options += ["--rig-force"] if force else []
    options += [word for each in sheet or () for word in ("--rig-sheet", str(each.absolute()))]
    options += [word for each in identity or () for word in ("--rig-identity", each)]
    options += ["-x"] if exit_first else []
    options += ["--rig-repeat", str(repeat)]
    options += ["-n", str(jobs)] if jobs > 1 else ["-n", "0"] if importlib.util.find_spec("xdist") else []
    status = _run(files, options, output)
    if status:
        raise typer.Exit(status)


def _list() -> None:
    from replays.campaigns.files.campaign import FOLDER, find_shipped, read_title

    for name, path in find_shipped().items():
        echo(textwrap.fill(f"{name}: {read_title(path)}", 80, subsequent_indent="  "))
    echo(f"files in {FOLDER}")


def _list_cases(files: list[str], cases: Sequence[Case], repeat: int) -> None:
    """Print the cases of campaign files, with an estimate of their time."""
    from replays.campaigns.files.campaign import SUFFIX

    for name in (file.partition("::")[0] for file in files):
        if not name.endswith(SUFFIX):
            echo(f"{name}: tests of pytest; list them by pytest --collect-only")
    for command in dict.fromkeys(command for case in cases for command in case.device_commands):
        echo(f"device: {' '.join(command.split())}")
    for case in cases:
        echo(f"{case.file.name}::{case.id}  {case.duration_s:g} s")
    simulated_s = sum(case.duration_s for case in cases)
    real_s = sum(case.duration_s for case in cases if case.bench.pace == "real-time")
    blocks = sum(1e3 * case.duration_s / case.bench.block_ms for case in cases)
    processor_s = repeat * (_CASE_S * len(cases) + _SIMULATED_S * simulated_s + _BLOCK_S * blocks)
    echo(f"{len(cases)} cases, {simulated_s:g} s simulated{f', of these {real_s:g} s in real time' if real_s else ''}")
    echo(
        f"estimate: {processor_s:.0f} s of processor time{f' for {repeat} runs' if repeat > 1 else ''} "
        f"({_CASE_S:g} s for a case, {_SIMULATED_S:g} s for a simulated second, {1e3 * _BLOCK_S:g} ms for a block); "
        "the first run also compiles"
    )


def _check_files(
    files: list[str],
    against: Sequence[Path],
    replay: Path | None,
    device: str | None,
    limits: Sequence[str],
    repeat: int,
    *,
    yes: bool,
) -> tuple[list[str], list[Case]]:
    """Return the paths and the cases of the files; raise an error for wrong files before anything runs."""
    from replays.campaigns.files.campaign import (
        MAX_CASES,
        MAX_UNCONFIRMED_CASES,
        SUFFIX,
        campaign_path,
        load_campaign,
    )  # fmt: skip
    from replays.campaigns.reporting.results import load_results

    paths, cases = [], []
    for file in files:
        name, colons, case = file.partition("::")
        name = str(campaign_path(name))
        paths.append(f"{name}{colons}{case}")
        if name.endswith(SUFFIX):
            max_cases = MAX_CASES if yes or colons else MAX_UNCONFIRMED_CASES
            known = {each.id: each for each in load_campaign(Path(name), device, limits, max_cases=max_cases).cases}
            if colons and case not in known:
                raise UnknownNameError("FILE", f"one of the cases of {name}", case, known)
            cases += [known[case]] if colons else known.values()
        elif not Path(name).exists():
            raise InputError("FILE", f"a *{SUFFIX} file, or tests of pytest, that exists", name)
        elif Path(name).is_file() and not name.endswith(".py"):
            raise InputError("FILE", f"a file that ends in {SUFFIX} or .py, or a folder", name)
    count = repeat * len(cases)
    if count > MAX_UNCONFIRMED_CASES and not yes:
        raise InputError("--yes", f"given for more than {MAX_UNCONFIRMED_CASES:,} cases", Words(f"{count} cases"))
    for each in against:
        load_results(each)
    if replay is not None:
        from replays.campaigns.equipment.bench import validate_replay

        validate_replay(replay)
    return paths, cases


def _run(files: list[str], options: list[str], output: Path | None) -> int:
    """Run the tests and return the exit status."""
    # An installed plugin is found by its entry point; in a checkout it must be named.
    from importlib.metadata import entry_points

    import pytest

    from rig.cli.output.campaign_progress import OUTCOME_WORDS, ProgressPlugin, bypass_capture

    module = "replays.campaigns.plugin"
    there = any(each.value == module for each in entry_points(group="pytest11"))
    plugins = ["-p", "no:cacheprovider", *([] if there else ["-p", module])]
    # Modules imported before pytest starts do not get rewritten asserts, which is intended.
    plugins += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
    # The configuration of a project around the files, such as its options and plugins, must not change a verdict.
    places = [Path(file.partition("::")[0]).absolute() for file in files]
    root = os.path.commonpath([place if place.is_dir() else place.parent for place in places])
    plugins += ["-c", os.devnull, "--rootdir", root]
    for name in ("PYTEST_ADDOPTS", "PYTEST_PLUGINS", "PYTEST_DISABLE_PLUGIN_AUTOLOAD"):
        os.environ.pop(name, None)  # nor must the environment
    with bypass_capture(progress_bar(transient=True)) as bar:
        progress = ProgressPlugin(bar)
        status = pytest.main([*plugins, *options, *files], plugins=[progress])
    if progress.is_reader_closed:
        raise BrokenPipeError
    if status == pytest.ExitCode.INTERNAL_ERROR:
        echo(progress.pytest_output.getvalue().strip(), err=True)
    counts = progress.counts
    summary = (
        ", ".join(f"{counts[outcome]} {outcome}" for outcome in OUTCOME_WORDS if counts[outcome]) or "nothing was run"
    )
    left = len(progress.planned) - sum(counts.values())
    echo(f"{summary}{f', {left} not run' if left > 0 else ''}")
    if output is not None and status != pytest.ExitCode.USAGE_ERROR:
        echo(f"written  {output / 'index.html'}, results.json, junit.xml")
    if status == pytest.ExitCode.INTERRUPTED and not progress.collecting_failed:
        return _INTERRUPTED
    if status in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        failed = bool(counts["failed"] or counts["error"])
        return Outcome.judge(
            failed=failed, has_evidence=bool(counts["passed"]) and not counts["inconclusive"]
        ).exit_status
    return 2
