"""Sweeps: the same bytes for any workers, after kills, and on a Dask cluster; wrong plans are refused on one line."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rig
from rig.base.errors import InputError
from rig.cli.main import main
from rig.ensemble import plan as plans
from rig.ensemble.ensemble import local_workers
from rig.ensemble.sweep import Sweep
from tests.processes import free_port, read_line, start_python, start_rig
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.wallclock

PLAN = """
scene = "hammer"
title = "friction and force"
runs = 150
task_runs = 5
sampling = "sobol"

[set]
duration_s = 0.03

[over.contact.friction]
distribution = "normal"
mean = 0.2
std = 0.1

[over."hammer.force_n"]
distribution = "uniform"
from = 50.0
to = 500.0

[over."model.contact"]
values = ["compliant", "impact"]
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("plan") / "plan.toml"
    path.write_text(PLAN, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def parts(plan: Path) -> dict[str, bytes]:
    """Bytes of all parts, computed by one worker."""
    folder = plan.parent / "one"
    with Sweep(plans.read_plan(plan), folder) as sweep, local_workers(1) as workers:
        assert [report["done"] for report in sweep.run(workers)] == [*range(1, 31)]
    return read_parts(folder)


def read_parts(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("part-*"))}


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        main([*map(str, arguments)])
    printed = capsys.readouterr()
    return int(end.value.code or 0), printed.out, printed.err


def test_the_bytes_do_not_depend_on_the_number_of_workers(
    plan: Path, parts: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(parts) == 30
    status, out, err = call(capsys, "sweep", plan, "-o", tmp_path / "out", "--workers", 3, "--json")
    assert status == 0, err
    assert read_parts(tmp_path / "out") == parts
    reports = [json.loads(line) for line in out.splitlines()]
    assert sorted(report["task"] for report in reports) == [*range(30)]
    assert [report["done"] for report in reports] == [*range(1, 31)]
    assert all(report["runs"] == sum(report["outcomes"].values()) == 5 for report in reports)
    assert "150 runs in 30 tasks: about " in err
    status, out, _ = call(capsys, "sweep", "info", tmp_path / "out", "--json")
    state = json.loads(out)
    assert (status, state["tasks_done"], state["tasks"], state["runs_done"], state["runs"]) == (0, 30, 30, 150, 150)
    assert sum(state["outcomes"].values()) == 150
    assert state["worker_s"] > 0.0
    assert "runs       150 of 150" in call(capsys, "sweep", "info", tmp_path / "out")[1]


def test_the_runs_of_a_sweep_are_a_table_with_units(plan: Path, parts: dict[str, bytes]) -> None:
    runs = rig.open_sweep(plan.parent / "one")
    assert (len(runs), runs.unit("hammer.force_n"), runs.unit("peak_force_n")) == (150, "N", "N")
    assert np.array_equal(runs["run"], np.arange(150))
    assert set(runs["model.contact"]) == {"compliant", "impact"}
    assert {"outcome", "trusted", "engine", "seed"} <= set(runs)
    rerun = rig.ensemble(
        "hammer", {key: runs[key][40:43] for key in ("contact.friction",)},
        changes={"duration_s": 0.03, "model.contact": str(runs["model.contact"][40])},
    )  # fmt: skip
    assert len(rerun) == 3
    assert runs.to_arrow().schema.field("contact.friction").metadata == {b"unit": b""}
    assert len(rig.open_sweep(plan.parent / "one", ["run", "outcome"]).names) == 2


def test_a_sweep_that_is_killed_several_times_gives_the_same_bytes(
    plan: Path, parts: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, chance = tmp_path / "out", random.Random(os.getpid())
    for _ in range(3):
        with start_rig("sweep", str(plan), "-o", str(folder), "--resume", "--json") as child:
            assert child.stdout is not None
            for _ in range(chance.randint(1, 9)):
                child.stdout.readline()
            child.kill()
            child.wait()
        for name, content in read_parts(folder).items():
            assert content == parts.get(name) or name.endswith(".part")
    (folder / "part-00029.parquet.0123456789abcdef.part").write_bytes(b"PAR1")  # of a kill while it was written
    status, out, err = call(capsys, "sweep", plan, "-o", folder, "--resume")
    assert status == 0, err
    assert "runs       150 of 150" in out
    assert read_parts(folder) == parts


def test_ctrl_c_ends_a_sweep_and_keeps_its_parts(plan: Path, parts: dict[str, bytes], tmp_path: Path) -> None:
    with start_rig("sweep", str(plan), "-o", str(tmp_path / "out"), "--json") as child:
        assert child.stdout is not None
        child.stdout.readline()
        child.send_signal(signal.SIGINT)
        _, err = child.communicate(timeout=PATIENCE_S)
    assert (child.returncode, err.splitlines()[-1]) == (130, "rig: interrupted")
    left = read_parts(tmp_path / "out")
    assert left.items() <= parts.items()
    assert 1 <= len(left) < 30


INTERRUPTED = """
import itertools, random, signal
from rig.cli import signals
from rig.ensemble.ensemble import iterate_results, local_workers

signals.listen()  # an interrupt that a callback swallows comes again
signal.signal(signal.SIGALRM, signal.default_int_handler)
draw, ended = random.Random(1), 0
for _ in range(1000):
    try:
        with local_workers(2) as workers:
            signal.setitimer(signal.ITIMER_REAL, draw.uniform(1e-3, 4e-3))
            for _ in iterate_results(workers, itertools.count(), lambda number, stop: number):
                pass
    except KeyboardInterrupt:
        ended += 1
print(ended)
"""


def test_an_interrupt_at_any_moment_ends_all_workers() -> None:
    with start_python("-c", INTERRUPTED) as child:
        assert child.communicate(timeout=PATIENCE_S) == ("1000\n", "")
    assert child.returncode == 0


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[Any]]]:
    """Address and workers of a Dask cluster on the loopback."""
    port = free_port()
    with ExitStack() as stack:
        address = f"tcp://127.0.0.1:{port}"
        scheduler = ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port)]
        head = stack.enter_context(start_python(*scheduler, "--no-dashboard", cwd=tmp_path))
        worker = ["-m", "distributed.cli.dask_worker", address, "--host", "127.0.0.1", "--no-dashboard", "--no-nanny"]
        workers = [
            stack.enter_context(start_python(*worker, "--nthreads", "1", "--local-directory", str(tmp_path / name)))
            for name in ("a", "b")
        ]
        read_line(head, "Scheduler at")
        for child in workers:
            read_line(child, "Registered to")
        yield address, workers


def test_a_dask_cluster_gives_the_same_bytes(
    plan: Path, parts: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    cluster: tuple[str, list[Any]], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    address, workers = cluster
    command = ["sweep", plan, "--scheduler", address, "-o"]
    versions = plans.find_versions() | {"rotor-stator-rig": "9.9"}
    with monkeypatch.context() as patch:
        patch.setattr(plans, "find_versions", lambda: versions)
        status, _, err = call(capsys, *command, tmp_path / "other")
    assert status == 2
    assert "--scheduler must be a cluster whose workers have the rig's wheel" in err
    assert err.endswith(
        f"a worker with rotor-stator-rig {plans.find_versions.__wrapped__()['rotor-stator-rig']}, not 9.9\n"
    )
    workers[1].kill()  # the other one does its tasks
    status, _, err = call(capsys, *command, tmp_path / "out")
    assert status == 0, err
    assert read_parts(tmp_path / "out") == parts


def test_a_scheduler_that_is_not_there_is_one_line(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig.ensemble.cluster._WAIT_S", 0.3)
    for address, must in (
        (f"tcp://127.0.0.1:{free_port()}", "the address of a running Dask scheduler"),
        ("127.0.0.1", "the address of a Dask scheduler, tcp://HOST:PORT"),
    ):
        status, out, err = call(capsys, "sweep", plan, "-o", tmp_path / "out", "--scheduler", address)
        assert (status, out) == (2, "")
        assert err.splitlines()[-1].startswith(f"rig: --scheduler must be {must}; received ")


REFUSED_PLANS = {
    'scene = "hammer"': "over must be given; received nothing",
    'scene = "hamer"\n[over."contact.friction"]\nvalues = [0.1]': "scene must be one of ",
    'scene = "hammer"\nruns = "5"\n[over."contact.friction"]\nvalues = [0.1]': "runs must be a valid integer",
    'scene = "hammer"\nworkers = 5\n[over."contact.friction"]\nvalues = [0.1]': "workers must be a known field",
    'scene = "hammer"\ntask_runs = 0\n[over."contact.friction"]\nvalues = [0.1]': "task_runs must be greater than",
    'scene = "hammer"\nquantities = ["x"]\n[over."contact.friction"]\nvalues = [0.1]': "quantities must be names of",
    'scene = "hammer"\n[set]\n"contact.frction" = 1\n[over."contact.friction"]\nvalues = [0.1]': "contact.frction must",
    'scene = "hammer"\n[over."contact.friction"]\nvalues = []': "over.contact.friction.values must be a list of",
    'scene = "hammer"\n[over.contact.friction]\nvalues = [9]': "over.contact.friction must be a number",
    """scene = "hammer"
    over.contact.friction = [0.1]
    over."contact.friction" = [0.2]
    """: "over.contact.friction must be given once; received two tables",
    'scene = "hammer"\nruns = 1000000000\ntask_runs = 1\n[over]\nhammer.force_n = [1]': "task_runs must be at least",
    'scene = "hammer"\nearly_end = "no"\n[over]\nhammer.force_n = [1]': "early_end must be ",
    'scene = "hammer"\n[over.contact]\nfriction = [9]': "over.contact.friction must be a number from 0 to 2",
    'scene = "hammer"\n[over.magnet]\ncount = [2]': "over.magnet.count must be a whole number from 3 to 64; received 2",
    'scene = "test-quiet"\n[over."contact.friction"]\nvalues = [0.1]': "scene must be one of the physics",
    """scene = "hammer"
    [set]
    duration_s = 0.001
    [over]
    contact.friction = { from = 0.1, to = 0.2, count = 1000 }
    drive.speed_hz = { from = 5, to = 6, count = 1000 }
    hammer.force_n = { from = 50, to = 60, count = 1000 }
    """: "--yes must be given for so long a sweep; received 1000000000 runs in 500000 tasks: about ",
}  # fmt: skip


@pytest.mark.parametrize("text", REFUSED_PLANS, ids=lambda text: REFUSED_PLANS[text][:40])
def test_wrong_plans_are_refused_on_one_line(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan.toml").write_text(text, encoding="utf-8")
    status, out, err = call(capsys, "sweep", tmp_path / "plan.toml", "-o", tmp_path / "out")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"rig: {REFUSED_PLANS[text]}"), err
    assert not list(tmp_path.glob("out/*"))


def test_only_the_same_plan_and_versions_are_resumed(
    plan: Path, parts: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = plan.parent / "one"
    other = tmp_path / "plan.toml"
    other.write_text(PLAN.replace("mean = 0.2", "mean = 0.3"), encoding="utf-8")

    def refuse(path: Path, *, resume: bool) -> str:
        with pytest.raises(InputError) as caught:
            Sweep(plans.read_plan(path), folder, resume=resume)
        return str(caught.value)

    assert refuse(plan, resume=False).startswith("--output must be a new folder (--resume continues a sweep)")
    assert refuse(other, resume=True).endswith("received another over")
    versions = plans.find_versions() | {"numpy": "1.0"}
    monkeypatch.setattr(plans, "find_versions", lambda: versions)
    assert refuse(plan, resume=True).endswith(f"received numpy 1.0, not {np.__version__}")
    with pytest.raises(InputError, match="folder of `rig sweep`"):
        rig.open_sweep(tmp_path)


def test_two_sweeps_do_not_write_to_one_folder(plan: Path, tmp_path: Path) -> None:
    work = plans.read_plan(plan)
    with Sweep(work, tmp_path / "out") as first:
        assert len(first.missing) == 30
        with pytest.raises(InputError, match="no other running sweep writes to"):
            Sweep(work, tmp_path / "out", resume=True)
    Sweep(work, tmp_path / "out", resume=True).close()


def test_a_plan_needs_no_other_file_on_its_workers(tmp_path: Path) -> None:
    (tmp_path / "my.toml").write_text('base = "as-printed"\n[contact]\nfriction = 0.11\n', encoding="utf-8")
    (tmp_path / "own.toml").write_text(f'parameters = "{tmp_path / "my.toml"}"\nduration_s = 0.01\n', encoding="utf-8")
    (tmp_path / "plan.toml").write_text(
        'scene = "own.toml"\n[over."drive.speed_hz"]\nvalues = [5, 6]\n', encoding="utf-8"
    )
    work = plans.read_plan(tmp_path / "plan.toml")
    for path in tmp_path.glob("*.toml"):
        path.unlink()
    plans.load_work.cache_clear()
    ours = plans.load_work(work.text).scene.load_parameters()
    assert ours["contact.friction"] == 0.11
    assert ours.numbers() == rig.load_parameters("as-printed").override({"contact.friction": 0.11}).numbers()


def test_damaged_parts_are_reported_and_simulated_again(
    plan: Path, parts: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    shutil.copytree(plan.parent / "one", folder)
    (folder / "part-00003.parquet").write_bytes(parts["part-00003.parquet"][:500])
    status, _, err = call(capsys, "sweep", "info", folder)
    assert (status, err.count("\n")) == (2, 1)
    assert "with intact files (--resume mends parts); received" in err
    assert "part-00003.parquet is damaged" in err
    (folder / "part-00005.parquet").write_bytes(parts["part-00004.parquet"])  # runs of another task
    assert call(capsys, "sweep", plan, "-o", folder, "--resume")[0] == 0
    assert read_parts(folder) == parts
    (folder / "plan.json").write_text('{"task_runs": 0}', encoding="utf-8")
    with pytest.raises(InputError, match=r"^FOLDER must be a folder of `rig sweep` with intact files"):
        rig.open_sweep(folder)
    assert call(capsys, "sweep", "info", folder)[0] == 2
