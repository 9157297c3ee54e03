"""pytest plugin: the fixtures `bench`, `dut`, `record` and `measure`, and campaigns in TOML as pytest tests.

Heavy modules are imported where they are used, because every pytest run in the environment loads this plugin.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from rig.base.outcome import InconclusiveError, Outcome

if TYPE_CHECKING:
    from replays.campaigns.equipment.bench import Bench
    from replays.campaigns.equipment.device import Device
    from replays.campaigns.equipment.record import Record
    from replays.campaigns.evidence import Trial
    from replays.campaigns.files.campaign import Case

_SUFFIX = ".campaign.toml"
_NODE_ID_FIELD = "_nodeid"
"""Field of a test's name, for which pytest has no public one."""
_TRIAL: pytest.StashKey[Trial] = pytest.StashKey()
_FAILED = pytest.StashKey[bool]()
_RUNS: pytest.StashKey[list[dict[str, list[str]]]] = pytest.StashKey()
"""Findings of the finished runs of a test in Python that is repeated; only its last run is reported."""
_MARKER = (
    'bench(scene="stable-run", pace="lockstep", block_ms=10, set={}, channels=[], faults=[], commands=[], '
    "duration_s=None, can=False, wait={}): the rig that a test is run on"
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of campaigns."""
    group = parser.getgroup("rig", "campaigns on a rotor-stator rig")
    group.addoption("--rig-results", metavar="FOLDER", help="write results.json, junit.xml, index.html and evidence/")
    group.addoption(
        "--rig-against", metavar="FOLDER", action="append", help="results of an earlier campaign to compare with"
    )
    group.addoption("--rig-force", action="store_true", help="replace results in a folder that no campaign wrote")
    group.addoption("--rig-repeat", metavar="N", type=int, default=1, help="number of runs of each case")
    group.addoption("--rig-url", metavar="URL", help="run on the rig there instead of on rigs of the tests' own")
    group.addoption("--rig-device", metavar="COMMAND", help="command line of the device under test in TOML campaigns")
    group.addoption("--rig-limit", metavar="NAME=QUANTITY", action="append", help="limit that replaces the file's")
    group.addoption("--rig-sheet", metavar="FILE", action="append", help="sheet to hand in, .html or .pdf")
    group.addoption("--rig-identity", metavar="NAME=TEXT", action="append", help="identity of the device, on the sheet")
    group.addoption("--rig-replay", metavar="FILE", help="run on a recording that is played")


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker and, on the controlling process, the results."""
    config.addinivalue_line("markers", _MARKER)
    folder, against, replay = config.option.rig_results, config.option.rig_against, config.option.rig_replay
    if hasattr(config, "workerinput") or not (folder or replay):
        return
    from replays.campaigns.equipment.bench import validate_replay
    from replays.campaigns.reporting.results import Results
    from rig.base.errors import DiskError, InputError

    try:
        if replay:
            validate_replay(Path(replay))
        if folder:
            earlier = [Path(each) for each in against or ()]
            results = Results(Path(folder), earlier, config, force=config.option.rig_force)
            config.pluginmanager.register(results, "rig-results")
    except (InputError, DiskError) as error:
        raise pytest.UsageError(str(error)) from None


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect a campaign file."""
    return CampaignFile.from_parent(parent, path=file_path) if file_path.name.endswith(_SUFFIX) else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Name the tests of a campaign with results by their files alone, so that results from any folder compare."""
    if config.option.rig_results:
        from replays.campaigns.reporting.file_names import name_files

        names = name_files({item.path for item in items})
        for item in items:
            setattr(item, _NODE_ID_FIELD, "::".join([names[item.path], *item.nodeid.split("::")[1:]]))


class CampaignFile(pytest.File):
    """A campaign file in TOML."""

    def collect(self) -> Iterator[pytest.Item]:
        """Yield the cases of the file."""
        from replays.campaigns.files.campaign import load_campaign
        from rig.base.errors import InputError

        try:
            campaign = load_campaign(self.path, self.config.option.rig_device, self.config.option.rig_limit or ())
        except InputError as error:
            raise self.CollectError(str(error)) from None
        for case in campaign.cases:
            about = {"about": campaign.about, "cases_in_file": len(campaign.cases)}
            yield CampaignItem.from_parent(self, name=case.id, case=case, about=about)


class CampaignItem(pytest.Item):
    """A case of a campaign in TOML."""

    def __init__(self, *, case: Case, about: dict[str, Any], **settings: Any) -> None:
        super().__init__(**settings)
        self.case = case
        self.setup_document = {**about, **case.describe()}

    def setup(self) -> None:
        """Create the trial of the case."""
        self.stash[_TRIAL] = _get_trial(self)

    def runtest(self) -> None:
        """Run the case."""
        from replays.campaigns.equipment.bench import UnsupportedError
        from replays.campaigns.files.run import run_repeatedly

        trial = self.stash[_TRIAL]
        try:
            run_repeatedly(self.case, trial, self.config.option.rig_repeat, lambda: _get_trial(self))
        except UnsupportedError as error:
            pytest.skip(str(error))
        finally:
            for measurement in trial.measurements:
                self.user_properties.extend(measurement.properties())

    def teardown(self) -> None:
        """End all processes, and keep the evidence of a failure."""
        if (trial := self.stash.get(_TRIAL, None)) is not None:
            trial.close(failed=self.stash.get(_FAILED, False))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Return one line for each measurement outside its limit, or the line of the error."""
        from replays.campaigns.equipment.bench import BenchError
        from replays.campaigns.evidence import MeasurementError
        from rig.base.errors import DiskError, InputError

        if isinstance(excinfo.value, BenchError | InputError | DiskError | ConnectionError | TimeoutError):
            return self.stash[_TRIAL].mask_addresses(str(excinfo.value))
        if isinstance(excinfo.value, MeasurementError | InconclusiveError):
            return "\n".join(each.line for each in self.stash[_TRIAL].measurements if not each.good)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return the location and title of the case."""
        return self.path, None, f"{self.case.title}: {self.name}"


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> None:
    """Run a test in Python with a rig several times before the run that pytest reports."""
    from replays.campaigns.reporting.results import find_reason

    if isinstance(item, CampaignItem) or "rig_trial" not in getattr(item, "fixturenames", ()):
        return
    runner: Any = item.config.pluginmanager.getplugin("runner")
    for number in range(1, item.config.option.rig_repeat):
        runs = item.stash.setdefault(_RUNS, [])
        # The parent as the next item ends the fixtures of this run only.
        reports = runner.runtestprotocol(item, log=False, nextitem=item.parent)
        if len(runs) < number:  # its setup failed, or it was skipped
            runs.append({"error": [find_reason(each) for each in reports if not each.passed]})
        item.stash[_FAILED] = False
        if _TRIAL in item.stash:
            del item.stash[_TRIAL]
        item.user_properties.clear()


def _is_reported(item: pytest.Item) -> bool:
    """Return whether the current run of a test is the one that is reported."""
    return len(item.stash.get(_RUNS, ())) >= item.config.option.rig_repeat - 1 or isinstance(item, CampaignItem)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, Any, Any]:
    """Raise the outcome of a trial's measurements after its test has ended without an error of its own."""
    trial, result, error = item.stash.get(_TRIAL, None), None, None
    try:
        result = yield
        if trial is not None and trial.devices and not isinstance(item, CampaignItem):
            _judge_devices(item, trial)
    except (Exception, pytest.fail.Exception) as caught:
        if _RUNS not in item.stash:
            raise
        error = caught
    if trial is not None:
        if _RUNS in item.stash:
            _compare_runs(item, trial, error)
        trial.raise_outcome()
    return result


def _compare_runs(item: pytest.Item, trial: Trial, error: BaseException | None) -> None:
    """Add the findings of a run, and compare all runs after the last one."""
    from replays.campaigns.files.run import compare_runs, list_findings

    is_last = _is_reported(item)
    item.stash[_RUNS].append(list_findings(trial, error))
    if is_last:
        compare_runs(trial, item.stash[_RUNS], error)
        item.user_properties.extend(trial.measurements[-1].properties())


def _judge_devices(item: pytest.Item, trial: Trial) -> None:
    """End the run of a test in Python and judge its devices, as for a campaign file."""
    from replays.campaigns.files.run import finish_run, note_early_ends

    measured = len(trial.measurements)
    note_early_ends(trial)
    try:
        finish_run(trial)
    finally:
        for measurement in trial.measurements[measured:]:
            item.user_properties.extend(measurement.properties())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """Note whether a test failed, and add the data of its trial to the report of its teardown."""
    report = yield
    if report.failed:
        item.stash[_FAILED] = True
        error = None if call.excinfo is None else call.excinfo.value
        if isinstance(error, InconclusiveError):
            # pytest reports a failure for the phase "call" and an error for every other phase.
            report.when, report.rig_inconclusive = "verdict", True
            report.longrepr = report.longrepr if isinstance(item, CampaignItem) else str(error)
    if report.when == "teardown" and (trial := item.stash.get(_TRIAL, None)) is not None:
        title = item.case.title if isinstance(item, CampaignItem) else item.path.name
        setup = {"setup": item.setup_document} if isinstance(item, CampaignItem) else {}
        report.rig = {"title": title, **setup, **trial.document()}
        if trial.kept:
            report.sections.append(("evidence", "\n".join(map(str, trial.kept))))
    return report


def pytest_report_teststatus(report: pytest.TestReport | pytest.CollectReport) -> tuple[str, str, str] | None:
    """Count an inconclusive test as an error."""
    return ("error", "I", "INCONCLUSIVE") if getattr(report, "rig_inconclusive", False) else None


def _get_trial(item: pytest.Item) -> Trial:
    from replays.campaigns.equipment.bench import Target
    from replays.campaigns.evidence import Trial

    options = item.config.option
    replay = None if options.rig_replay is None else Path(options.rig_replay).absolute()
    evidence = None if options.rig_results is None else Path(options.rig_results).absolute() / "evidence"
    return Trial(
        item.nodeid, evidence, Target(options.rig_url, replay), file=item.path, keeps_all=bool(options.rig_sheet)
    )


@pytest.fixture
def rig_trial(request: pytest.FixtureRequest) -> Iterator[Trial]:
    """Provide the state that the other fixtures share; end all processes afterwards."""
    item = request.node
    trial, is_reported = _get_trial(item), _is_reported(item)
    item.stash[_TRIAL], trial.keeps_all = trial, trial.keeps_all and is_reported
    yield trial
    trial.close(failed=item.stash.get(_FAILED, False) and is_reported)


@pytest.fixture
def bench(request: pytest.FixtureRequest, rig_trial: Trial) -> Bench:
    """Provide a rig for the test, in lockstep by default: see `@pytest.mark.bench(...)` and `bench.connect(...)`."""
    from replays.campaigns.equipment.bench import UnsupportedError
    from replays.campaigns.mark_arguments import read_settings

    marker = request.node.get_closest_marker("bench")
    try:
        started = rig_trial.start_bench(read_settings({} if marker is None else marker.kwargs))
    except UnsupportedError as error:
        pytest.skip(str(error))
    started.begin()
    return started


@pytest.fixture
def dut(record: Record, rig_trial: Trial, request: pytest.FixtureRequest) -> Callable[..., Device]:
    """Start a device under test: `dut("python protection.py {url} --name {name}", name="protection")`.

    The test fails if the device is lost, ends with a status other than 0, or ends before the test without `may_end`.
    """

    def start(
        command: str | Sequence[str], *, name: str = "device", joins: bool | None = None, may_end: bool = False
    ) -> Device:
        where = request.node.path.parent
        return rig_trial.start_device(command, name=name, where=where, joins=joins, may_end=may_end)

    return start


@pytest.fixture
def record(bench: Bench, rig_trial: Trial) -> Record:
    """Record the bench from the start of the test; `record.stop()` returns the recording."""
    return rig_trial.start_record()


@pytest.fixture
def measure(request: pytest.FixtureRequest, rig_trial: Trial) -> Callable[..., float]:
    """Compare a value with a limit, add it to all results, and raise an error if it fails."""

    def hold(
        name: str, value: float, unit: str, op: str, limit: Any, *, unit_of_limit: str | None = None, source: str = "",
        at_s: float | None = None, channels: Sequence[str] = (),
    ) -> float:  # fmt: skip
        __tracebackhide__ = True
        from replays.campaigns.measurement import judge_value

        fields = {"source": source, "resolution": rig_trial.resolution, "at_s": at_s, "channels": tuple(channels)}
        measurement = rig_trial.take(judge_value(name, value, unit, op, limit, unit_of_limit=unit_of_limit, **fields))
        request.node.user_properties.extend(measurement.properties())
        if measurement.outcome is Outcome.FAIL:
            raise rig_trial.failed(measurement.line)
        return value

    return hold
