"""What comes of one test: its measurements, and where it failed the evidence of that."""

from __future__ import annotations

import contextlib
import re
import shutil
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from replays.campaigns.equipment.bench import BehindError, Bench, BenchSettings, Target
from replays.campaigns.equipment.device import Device
from replays.campaigns.measurement import Measurement
from rig.base.errors import DiskError, InputError
from rig.base.outcome import InconclusiveError, Outcome

if TYPE_CHECKING:
    from recorder.reader import Recording
    from replays.campaigns.equipment.record import Record

AROUND_S = 1.0
"""Simulated time that is kept before and after an event [s]."""

_LARGE_BYTES = 100 << 20
"""A file that a device has left is kept as evidence if it is smaller."""


class MeasurementError(AssertionError):
    """A value is not as it must be; one line."""


@dataclass
class Trial:
    """One test while it runs, and what it leaves.

    Attributes:
        id: The test's.
        evidence: Folder that evidence goes to; None: it stays where the test ran.
        target: On what it runs.
        folder: Where it runs, removed at the end unless the evidence stays there.
        settings: Of its bench.
        measurements: What was judged, in order.
        kept: Files of the evidence.
        floor_ms: Round trips to a rig in real time: median and longest [ms].
    """

    id: str
    evidence: Path | None = None
    target: Target = field(default_factory=Target)
    folder: Path = field(default_factory=lambda: Path(tempfile.mkdtemp(prefix="rig-")))
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

    def start_bench(self, settings: BenchSettings) -> Bench:
        """The bench, begun."""
        self.settings = settings
        self.bench = Bench(settings, self.folder, self.target)
        if self.bench.pace == "real-time":
            self.floor_ms = self.bench.floor_ms()
        return self.bench

    def start_device(
        self, command: str | Sequence[str], *, name: str, where: Path, joins: bool | None = None
    ) -> Device:
        """The program under test, begun; in lockstep once it takes part, if it is to, else once it has a link.

        Raises:
            BenchError: It ended, or did not take part in time.
        """
        assert self.bench is not None
        bench, before = self.bench, self.bench.links
        device = Device(
            command, name=name, bench=bench, log=self.folder / f"{name}.log", where=where, files=self.folder
        )
        self.devices.append(device)
        if bench.pace == "lockstep" if joins is None else joins:
            device.wait_until_joined()
        else:
            device.wait_until_linked(before)
        return device

    def start_record(self) -> Record:
        """The recording of the bench, begun."""
        from replays.campaigns.equipment.record import Record

        assert self.bench is not None
        self.record = Record(self.bench, self.folder / "session.mcap")
        return self.record

    @property
    def resolution(self) -> str:
        """What reactions are exact to."""
        return "" if self.bench is None else self.bench.resolution

    def take(self, measurement: Measurement) -> Measurement:
        """Keep a measurement, whatever comes of it."""
        note, reason = self.lasting(measurement.note), self.lasting(measurement.open_reason)
        self.measurements.append(replace(measurement, note=note, open_reason=reason))
        return self.measurements[-1]

    def failed(self, line: str) -> MeasurementError | BehindError:
        """What a measurement that is not as it must be raises: of the device, unless the rig was behind meanwhile."""
        late = 0 if self.bench is None else self.bench.late_blocks()
        if not late:
            return MeasurementError(line)
        return BehindError(f"not judged, as the rig fell behind real time in {late} blocks (lockstep cannot): {line}")

    def lasting(self, text: str) -> str:
        """A text of this run without what is another in the next: folders, ports and names."""
        found = text.replace(str(self.folder), "{folder}")
        for address in () if self.bench is None else (self.bench.can_url, self.bench.url, self.bench.name):
            found = found.replace(address.partition(":")[2] or address, "{rig}") if address else found
        return found

    def close(self, *, failed: bool) -> None:
        """End all that runs; keep the evidence of a failure, and remove the rest."""
        with ExitStack() as stack:
            stack.callback(self._tidy, failed)
            if self.record is not None and self.recording is None:
                with contextlib.suppress(RuntimeError, InputError):
                    self.recording = self.record.stop()
            for device in self.devices:
                stack.callback(device.program.end)
            if self.bench is not None:
                stack.callback(self.bench.close)

    def _tidy(self, failed: bool) -> None:
        if failed:
            self._keep_evidence()
        if not failed or self.evidence is not None:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _keep_evidence(self) -> None:
        if self.settings is None:
            return
        folder = self.folder if self.evidence is None else self.evidence / plain(self.id)
        folder.mkdir(parents=True, exist_ok=True)
        # Logs, and what devices have left; of the session that was recorded a piece is enough.
        for left in sorted(self.folder.iterdir()):
            if left.is_file() and left.suffix != ".mcap" and left.stat().st_size < _LARGE_BYTES:
                if folder != self.folder:
                    shutil.copyfile(left, folder / left.name)
                self.kept.append(folder / left.name)
        try:
            if self.recording is not None:
                self.kept += self._cut(self.recording, folder)
        except (InputError, DiskError, RuntimeError) as error:
            self.troubles.append(f"no evidence of the recording: {error}")

    def _cut(self, recording: Recording, folder: Path) -> list[Path]:
        from recorder.reader import Recording
        from recorder.rewrite import cut
        from replays.campaigns.reporting.picture import draw

        failed = [each for each in self.measurements if not each.good]
        span = recording.span_s or (0.0, 0.0)
        about = next((each.at_s + self.origin_s for each in failed if each.at_s is not None), span[1])
        from_s, to_s = max(span[0], about - AROUND_S), min(span[1] + 1e-3, about + AROUND_S)
        made, picture = folder / "event.mcap", folder / "event.png"
        cut(recording, made, from_s=from_s, to_s=to_s, force=True)
        channels = dict.fromkeys(name for each in failed for name in each.channels)
        draw(Recording.open(made), picture, failed, origin_s=self.origin_s, channels=list(channels), about_s=about)
        return [made, picture]

    def document(self) -> dict[str, Any]:
        """What a report of this test carries: basic types alone."""
        root = None if self.evidence is None else self.evidence.parent
        return {
            "measurements": [each.document() for each in self.measurements],
            "evidence": [str(each.relative_to(root) if root is not None else each) for each in self.kept],
            "bench": None if self.settings is None else self.settings.document(),
            "resolution": self.resolution,
            "troubles": self.troubles,
            "floor_ms": None if self.floor_ms is None else [round(each, 3) for each in self.floor_ms],
        }

    def raise_outcome(self) -> None:
        """Raise what became of the measurements, a failure before an inconclusive one; nothing where all pass.

        Raises:
            MeasurementError: A measurement fails; the line has the first and the number of others.
            InconclusiveError: None fails, and one is inconclusive; or the rig was behind real time meanwhile.
        """
        for outcome, error in ((Outcome.FAIL, self.failed), (Outcome.INCONCLUSIVE, InconclusiveError)):
            if found := [each for each in self.measurements if each.outcome is outcome]:
                raise error(found[0].line + (f"; and {len(found) - 1} more" if found[1:] else ""))


def plain(name: str) -> str:
    """A test's name as that of a folder."""
    return re.sub(r"[^\w.=,+-]+", "_", name)[-150:]
