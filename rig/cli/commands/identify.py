"""`rig identify`: parameters of the rig from a recording, with confidence intervals."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.options import (
    Channels,
    Engine,
    Force,
    FromS,
    Parameters,
    RecordingFiles,
    ReportFile,
    RunOut,
    ToS,
    parse_pairs,
    split_names,
    subtract_run_out,
)
from rig.cli.output.progress import reporting
from rig.cli.output.provenance import recording_origin
from rig.cli.output.tables import Form, echo, echo_json, new_table

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from recorder.reader import Recording
    from replays.recordings.identification import Identification
    from replays.recordings.resimulation.experiment import Experiment


@dataclass(frozen=True)
class FitRequest:
    """Values to fit, and the part of the recording to use."""

    fit: Annotated[
        list[str],
        typer.Option(
            metavar="KEY,...",
            help="Values to fit: parameters, scene or impact (hammer.1.force_n)",
        ),
    ]
    start: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="Start value of the search; default: as recorded")
    ] = None
    bounds: Annotated[
        list[str] | None, typer.Option(metavar="KEY=LOW:HIGH", help="Lower and upper bound of a value")
    ] = None
    prior: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE+-SIGMA", help="Prior knowledge: mean and standard deviation"),
    ] = None
    from_s: FromS = None
    to_s: ToS = None
    channels: Channels = None
    parameters: Parameters = None
    scene: Annotated[
        str | None, typer.Option(metavar="SCENE", help="Scene, where the recording does not contain it")
    ] = None
    engine: Engine = None

    def run(
        self, recording: Recording, search: Search, *, exact: bool, progress: Callable[[str], None]
    ) -> tuple[Identification, list[str]]:
        """Return the fit, and the keys that were fitted in addition because an imported log does not contain them.

        Raises:
            InputError: The recording, its scene or the model lacks a requested value.
        """
        from replays.recordings.identification import ask
        from replays.recordings.identification import identify as identify_recording
        from replays.recordings.identification.log import identify_log
        from replays.recordings.identification.nuisance import find_free_nuisances, fit_initial_state
        from replays.recordings.identification.request import first_command_s
        from replays.recordings.resimulation.experiment import is_imported
        from replays.recordings.validation import load_criteria

        keys = [key for part in self.fit for key in split_names(part, "--fit")]
        experiment, along = self._experiment(recording), dict[str, tuple[float, float] | None]()
        prior_texts = parse_pairs("--prior", self.prior, "KEY=VALUE+-SIGMA")
        priors = {key: _parse_pair("prior", text, "+-") for key, text in prior_texts.items()}
        starts = {key: _number("start", text) for key, text in parse_pairs("--start", self.start, "KEY=VALUE").items()}
        limits = parse_pairs("--bounds", self.bounds, "KEY=LOW:HIGH")
        bounds = {key: _parse_pair("bounds", text, ":") for key, text in limits.items()}
        channels = split_names(self.channels, "--channels") or None
        setup: dict[str, Any] = {"start": starts, "bounds": bounds, "channels": channels}
        if is_imported(recording) and not exact:
            if first_command_s(experiment) > 0.0:
                search.check_unused(from_s=self.from_s)
                rules = load_criteria().imported
                identification = identify_log(
                    recording, experiment, keys, **setup, priors=priors, to_s=self.to_s, bandwidth=rules.bandwidth,
                    variants=[variant.set for variant in rules.variants], progress=progress,
                )  # fmt: skip
                return identification, [unknown.key for unknown in identification.question.unknowns if unknown.nuisance]
            experiment = fit_initial_state(recording, experiment)
            along = find_free_nuisances(experiment, keys)
            priors = {key: prior_value for key, prior_value in along.items() if prior_value is not None} | priors
        window = (self.from_s, self.to_s)
        question = ask(recording, experiment, [*keys, *along], **setup, priors=priors, nuisances=along, window=window)
        return identify_recording(question, **asdict(search), progress=progress), list(along)

    def _experiment(self, recording: Recording) -> Experiment:
        from replays.recordings.resimulation.experiment import Experiment
        from rig.run.scenes import load_scene

        experiment = (
            Experiment.from_recording(recording) if self.scene is None else Experiment(scene=load_scene(self.scene))
        )
        experiment.scene.check_physics()
        if self.parameters is not None:
            experiment = experiment.with_changes({"parameters": self.parameters, "set": {}})
        return experiment if self.engine is None else experiment.with_changes({"engine.name": self.engine})


@dataclass(frozen=True)
class Search:
    """Settings of the search."""

    precision: Annotated[
        float, typer.Option(min=1e-9, help="Relative half-width of the intervals at which to stop")
    ] = 1e-4
    spread: Annotated[float, typer.Option(min=1e-6, max=1.0, help="Relative uncertainty of the start values")] = 0.1
    robust: Annotated[bool, typer.Option("--robust", help="Reduce the weight of single outliers")] = False
    whole: Annotated[
        bool, typer.Option("--whole", help="Extend the window while the model stays linear, even without fit")
    ] = False

    def check_unused(self, *, from_s: float | None) -> None:
        """Raise an error for settings that a fit of another system's log does not use.

        Raises:
            InputError: Names the first such option.
        """
        from rig.base.errors import InputError

        options = {"--from": from_s, **{f"--{name}": value for name, value in asdict(self).items()}}
        usual = {"--from": None, **{f"--{name}": value for name, value in asdict(Search()).items()}}
        for option, value in options.items():
            if value != usual[option]:
                raise InputError(
                    option, "left out for a log of another system, which is fitted from its hammer pulse", value
                )


def identify(
    files: RecordingFiles,
    *,
    request: FitRequest,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.toml", help="Write the fitted parameter set")
    ] = None,
    runout: RunOut = None,
    report: ReportFile = None,
    search: Search,
    exact: Annotated[
        bool,
        typer.Option("--exact", help="Trust clock, shaft angle and impact of an imported log"),
    ] = False,
    form: Form,
    force: Force = False,
) -> None:
    """Fit parameters of the rig to a recording: values, 95 % intervals, and values that it cannot determine.

    Exit status 1, and no set is written, if the model does not explain the recording: then no value is a result.
    """
    from recorder.reader import join
    from replays.recordings.identification.document import check_set, format_set, identification_document, write_set
    from replays.recordings.identification.summary import make_report
    from replays.report import check_report, write_report

    if output is not None:
        check_set(output, force=force)
    if report is not None:
        check_report(report, force=force)
    (recording,) = subtract_run_out(runout, join(files), log=True, show=partial(echo, err=True))
    name = files[0].name if len(files) == 1 else f"{files[0].name} and {len(files) - 1} more"
    with reporting(compiles=True) as reporter:
        identification, along = request.run(recording, search, exact=exact, progress=reporter.step)
    fits = identification.judgement.fits
    if output is not None and fits:
        write_set(format_set(identification, recording=name), output)
    if report is not None:
        write_report(make_report(identification, recording=name, origin=recording_origin(name, recording)), report)
    if form.as_json:
        echo_json(identification_document(identification, recording=name))
    else:
        _show(identification, name, form.console())
        _print_files(along, output if fits else None, report)
    if not fits:
        if output is not None:
            echo(f"not written  {output}: the model does not explain the recording", err=True)
        raise typer.Exit(1)


def _print_files(along: list[str], output: Path | None, report: Path | None) -> None:
    if along:
        echo(f"also fitted, as an imported log does not contain them exactly: {', '.join(along)}")
    if output is not None:
        echo(f"written  {output}: a parameter set, as in `rig run hammer --parameters {output}`")
    if report is not None:
        echo(f"written  {report}")


def _number(option: str, text: str) -> float:
    from rig.base.errors import InputError

    try:
        return float(text)
    except ValueError:
        raise InputError(option, "a number", text) from None


def _parse_pair(option: str, text: str, between: str) -> tuple[float, float]:
    from rig.base.errors import InputError

    first, sign, second = text.partition(between)
    if not sign:
        raise InputError(option, f"two numbers with {between} between them", text)
    return _number(option, first), _number(option, second)


def _show(identification: Identification, name: str, console: Console) -> None:
    from replays.recordings.identification.summary import HEADINGS, cells, fit_line, spread_line, window_line

    numbers = ("start", "result", "95 % interval")
    headings = (f">{heading}" if heading in numbers else heading for heading in HEADINGS)
    table = new_table(f"{name}: fitted values", *headings, wrapped=HEADINGS[-1:])
    for finding in identification.judgement.findings:
        table.add_row(*cells(finding), style="" if finding.standing == "identified" else "yellow")
    console.print(table)
    positions = [place for place, unknown in enumerate(identification.question.unknowns) if not unknown.nuisance]
    keys = [identification.question.keys[place] for place in positions]
    if len(keys) > 1:
        table = new_table("correlation", "", *(f">{key}" for key in keys))
        for key, row in zip(keys, identification.judgement.correlation[positions][:, positions], strict=True):
            table.add_row(key, *("-" if value != value else f"{value:+.4f}" for value in row))
        console.print()
        console.print(table)
    console.print()
    console.print(window_line(identification))
    console.print(fit_line(identification))
    if identification.narrowed:
        console.print(spread_line(identification))
