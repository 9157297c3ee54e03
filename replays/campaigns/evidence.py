"""State and results of one test: its measurements and, after a failure, its evidence."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from replays.campaigns.equipment.bench import Bench, BenchSettings, LateRigError, Target
from replays.campaigns.equipment.device import Device, hash_files
from replays.campaigns.measurement import Measurement
from rig.base.errors import DiskError, InputError
from rig.base.outcome import InconclusiveError, Outcome

if TYPE_CHECKING:
    from recorder.reader import Recording
    from replays.campaigns.equipment.record import Record

EVENT_MARGIN_S = 1.0
"""Simulated time that the evidence covers before and after an event [s]."""

MAX_FILES = 10_000
"""Largest number of files that devices may leave in their folder."""
MAX_KEPT_BYTES = 100_000_000
"""Largest total size of the devices' files that are kept as evidence [bytes]."""


class MeasurementError(AssertionError):
    """Error of a measurement outside its limit; the message is one line."""


@dataclass
class Trial:
    """One running test and its results.

    Attributes:
        id: Name of the test.
        evidence: Folder for evidence; None leaves it where the test ran.
        target: Rig or recording that the test runs on.
        folder: Folder for the files of the devices under test, removed at the end.
        records: Folder for the recording and the logs, which no device is told; removed at the end unless it holds the
            evidence.
        settings: Settings of the bench.
        measurements: Judged values, in order.
        kept: Files of the evidence.
        floor_ms: Median and maximum round-trip time of a rig in real time [ms].
        file: File of the test, for its digest, which is computed at the start.
        keeps_all: Whether the evidence of a test that passes is kept too.
        digests: SHA-256 of the test's file, the programs of its devices before their start, and its recording, by name.
    """

    id: str
    evidence: Path | None = None
    target: Target = field(default_factory=Target)
    folder: Path = field(default_factory=lambda: Path(tempfile.mkdtemp(prefix="rig-")))
    records: Path = field(default_factory=lambda: Path(tempfile.mkdtemp(prefix="rig-")))
    settings: BenchSettings | None = None
    bench: Bench | None = None
    devices: list[Device] = field(default_factory=list)
    record: Record | None = None
    recording: Recording | None = None
    origin_s: float = 0.0
    measurements: list[Measurement] = field(default_factory=list)
    kept: list[Path] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)
    floor_ms: tuple[float, float] | None = None
    file: Path | None = None
    keeps_all: bool = False
    digests: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._folder_entry = self.folder.lstat()
        self.digests |= hash_files(() if self.file is None else [self.file])

    def has_folder(self) -> bool:
        """Return whether the folder of the devices was neither removed nor replaced."""
        with contextlib.suppress(OSError):
            return os.path.samestat(self.folder.lstat(), self._folder_entry)
        return False

    def find_files(self) -> Iterator[Path]:
        """Yield the entries of the devices' folder that are no folders, one more than is allowed at most."""
        found = 0
        for folder, _, names in os.walk(self.folder) if self.has_folder() else ():
            for name in sorted(names):
                yield Path(folder, name)
                found += 1
                if found > MAX_FILES:
                    return

    def start_bench(self, settings: BenchSettings) -> Bench:
        """Start the bench and return it."""
        self.settings = settings
        self.bench = Bench(settings, self.records, self.target)
        if self.bench.pace == "real-time":
            self.floor_ms = self.bench.floor_ms()
        return self.bench

    def start_device(
        self, command: str | Sequence[str], *, name: str, where: Path, joins: bool | None = None, may_end: bool = False
    ) -> Device:
        """Start a device under test and return it once it has joined lockstep, or else once it is connected.

        Args:
            command: Its command line.
            name: Its name.
            where: Working directory.
            joins: Whether it takes part in lockstep; None: yes if the bench runs in lockstep.
            may_end: Whether it may end before the run.

        Raises:
            BenchError: If it ends, or does not join in time.
        """
        assert self.bench is not None
        bench, before = self.bench, self.bench.links
        if not re.fullmatch(r"[\w.-]{1,50}", name) or name == "rig":
            raise InputError("name", "1 to 50 letters, digits, dots, dashes and underscores, and not rig", name)
        again = sum(each.name == name for each in self.devices)
        log = self.records / (f"{name}-{again + 1}.log" if again else f"{name}.log")
        device = Device(
            command, name=name, bench=bench, log=log, where=where, files=self.folder, may_end=may_end,
        )  # fmt: skip
        self.devices.append(device)
        self.digests |= device.digests
        device.joins = bench.pace == "lockstep" if joins is None else joins
        if device.joins:
            device.wait_until_joined()
        else:
            device.wait_until_linked(before)
        return device

    def start_record(self) -> Record:
        """Start a recording of the bench and return it."""
        from replays.campaigns.equipment.record import Record

        assert self.bench is not None
        self.record = Record(self.bench, self.records / "session.mcap")
        self.record.wait_until_connected()  # otherwise its connection would count as that of a device
        return self.record

    @property
    def resolution(self) -> str:
        """Resolution of reaction times, in words."""
        if self.bench is None:
            return ""
        outside = [device.name for device in self.devices if not device.joins and self.bench.pace == "lockstep"]
        return self.bench.resolution + (f", but not for {' and '.join(outside)}, which did not join" if outside else "")

    def take(self, measurement: Measurement) -> Measurement:
        """Add a measurement and return it with run-specific names replaced."""
        note, reason = self.mask_addresses(measurement.note), self.mask_addresses(measurement.open_reason)
        self.measurements.append(replace(measurement, note=note, open_reason=reason))
        return self.measurements[-1]

    def failed(self, line: str) -> MeasurementError | LateRigError:
        """Return the error for a failed limit: the device's, unless the rig fell behind real time."""
        late = 0 if self.bench is None else self.bench.late_blocks()
        if not late:
            return MeasurementError(line)
        return LateRigError(f"not judged because the rig was late in {late} blocks (use lockstep): {line}")

    def mask_addresses(self, text: str) -> str:
        """Replace the folders, ports and names of this run in a text, so that every run gives the same text."""
        masked = text.replace(str(self.folder), "{folder}").replace(str(self.records), "{records}")
        bench = self.bench
        urls = () if bench is None else (bench.can_url, bench.url)
        addresses = () if bench is None else (bench.socketcand_url, bench.slcan_path, bench.name)
        for address in filter(None, (*((url or "").partition(":")[2] for url in urls), *addresses)):
            masked = masked.replace(address, "{rig}")
        return masked

    def close(self, *, failed: bool) -> None:
        """End all processes; keep the evidence of a failure, and remove the rest."""
        with ExitStack() as stack:
            stack.callback(self._clean_up, failed)
            for device in self.devices:
                stack.callback(device.end)
            if self.bench is not None:
                stack.callback(self.bench.close)
            if self.record is not None and self.recording is None:
                with contextlib.suppress(RuntimeError, InputError, ConnectionError):
                    self.recording = self.record.stop()

    def _clean_up(self, failed: bool) -> None:
        if self.record is not None and self.record.sha256:
            self.digests[f"recording of {self.id}"] = self.record.sha256
        if failed or self.keeps_all:
            self._keep_evidence()
        for folder in (self.folder, *([self.records] if not failed or self.evidence is not None else ())):
            shutil.rmtree(folder, ignore_errors=True)

    def _keep_evidence(self) -> None:
        if self.settings is None:
            return
        folder = self.records if self.evidence is None else self.evidence / case_folder(self.id)
        folder.mkdir(parents=True, exist_ok=True)
        # Logs and files of devices; an excerpt replaces the recorded session.
        for log in sorted(self.records.glob("*.log")):
            if folder != self.records:
                shutil.copyfile(log, folder / log.name, follow_symlinks=False)
            self.kept.append(folder / log.name)
        self._keep_files(folder / "files")
        try:
            if self.recording is not None:
                self.kept += self._cut(self.recording, folder)
        except (InputError, DiskError, RuntimeError) as error:
            self.troubles.append(f"no evidence of the recording: {error}")

    def _keep_files(self, folder: Path) -> None:
        """Copy the devices' files up to a total size, and report what is not copied."""
        left_out, total = [], 0
        for number, file in enumerate(self.find_files()):
            entry = file.lstat()
            name = folder_name(str(file.relative_to(self.folder)))
            if not stat.S_ISREG(entry.st_mode) or total + entry.st_size > MAX_KEPT_BYTES or number >= MAX_FILES:
                left_out.append(name)
                continue
            folder.mkdir(exist_ok=True)
            copy = folder / (f"{number}-{name}" if (folder / name).exists() else name)
            try:
                shutil.copyfile(file, copy, follow_symlinks=False)
            except OSError as error:
                left_out.append(f"{name} ({error.strerror})")
                continue
            total += entry.st_size
            self.kept.append(copy)
        if left_out:
            what = f"more than {MAX_KEPT_BYTES / 1e6:g} MB in total, more than {MAX_FILES} files, or no plain file"
            names = ", ".join(left_out[:5]) + (", ..." if left_out[5:] else "")
            self.troubles.append(f"files of devices that were not kept ({what}): {len(left_out)}: {names}")

    def _cut(self, recording: Recording, folder: Path) -> list[Path]:
        from recorder.reader import Recording
        from recorder.rewrite import cut
        from replays.campaigns.reporting.picture import draw

        failed = [each for each in self.measurements if not each.good]
        span = recording.span_s or (0.0, 0.0)
        about = next((each.at_s + self.origin_s for each in failed if each.at_s is not None), span[1])
        from_s, to_s = max(span[0], about - EVENT_MARGIN_S), min(span[1] + 1e-3, about + EVENT_MARGIN_S)
        clip, picture = folder / "event.mcap", folder / "event.png"
        cut(recording, clip, from_s=from_s, to_s=to_s, force=True)
        judged = failed or [each for each in self.measurements if each.channels or each.at_s is not None]
        draw(Recording.open(clip), picture, judged, origin_s=self.origin_s, about_s=about)
        return [clip, picture]

    def document(self) -> dict[str, Any]:
        """Return the test's data for the report, in basic types only."""
        root = None if self.evidence is None else self.evidence.parent
        return {
            "measurements": [each.document() for each in self.measurements],
            "evidence": [str(each.relative_to(root) if root is not None else each) for each in self.kept],
            "bench": None if self.settings is None else self.settings.document(),
            "resolution": self.resolution,
            "troubles": self.troubles,
            "digests": self.digests,
            "late_blocks": 0 if self.bench is None else self.bench.late,
            "floor_ms": None if self.floor_ms is None else [round(each, 3) for each in self.floor_ms],
        }

    def raise_outcome(self) -> None:
        """Raise the outcome of the measurements; a failure takes precedence over an inconclusive one.

        Raises:
            MeasurementError: If a measurement fails; the line gives the first one and the number of others.
            InconclusiveError: If none fails and one is inconclusive, or if the rig fell behind real time.
        """
        for outcome, error in ((Outcome.FAIL, self.failed), (Outcome.INCONCLUSIVE, InconclusiveError)):
            if unmet := [each for each in self.measurements if each.outcome is outcome]:
                raise error(unmet[0].line + (f"; and {len(unmet) - 1} more" if unmet[1:] else ""))


def case_folder(name: str) -> str:
    """Return the folder name of a test, different from those of other tests."""
    folder = folder_name(name)
    if folder == re.sub(r"::|[\[\]]", "_", name):
        return folder
    return f"{folder[-140:]}-{hashlib.sha256(name.encode(errors='replace')).hexdigest()[:8]}"


def folder_name(name: str) -> str:
    """Return a text as the name of a file or folder."""
    return re.sub(r"[^\w.=,+-]+", "_", name)[-150:]
