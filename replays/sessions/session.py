"""What the reference sessions are, and how one is made: the recording, and beside it its quantities as text.

The recording is what a validation is made against; the text is the part of a diff that people read. Both come from one
build: elsewhere the same command gives recordings that differ by rounding, and behind chaotic impacts by more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recorder.reader import Recording
from replays.recordings.export import McapRun
from replays.recordings.validation import validate
from replays.recordings.validation.outcome import Validation
from rig.base.errors import UnknownNameError
from rig.base.files import write_file
from rig.run.offline import frames
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

FOLDER = Path(__file__).parent
COMMAND = "rig sessions -o replays/sessions --force"
"""What makes the committed ones anew."""
_EPOCH_NS = 1_800_000_000 * 1_000_000_000
"""Wall time at which they begin, the same always: the same numbers give the same bytes."""
_SMALL_FILE_CHANGES = {"sensors.truth_rate_hz": 100}


@dataclass(frozen=True)
class ReferenceSession:
    """One reference session: a scene, cut short and sampled slowly."""

    name: str
    scene: str
    changes: dict[str, Any] = field(default_factory=dict)


SESSIONS = {
    session.name: session
    for session in (
        ReferenceSession("drop", "drop", {"duration_s": 0.4, "sensors.rate_hz": 5000}),
        ReferenceSession("stable-run", "stable-run", {"duration_s": 0.6, "sensors.rate_hz": 2000}),
        *(
            ReferenceSession(
                f"hammer-{hz}", "hammer", {"duration_s": 0.6, "sensors.rate_hz": 5000, "drive.speed_hz": hz}
            )
            for hz in (3.2, 4.2, 5.2, 6.2)
        ),
        ReferenceSession("partial-rub", "partial-rub", {"duration_s": 0.9, "sensors.rate_hz": 5000}),
    )
}


def open_session(name: str) -> Recording:
    """Open the recording of a reference session.

    Raises:
        UnknownNameError: There is no session of this name.

    Example:
        >>> import rig
        >>> rig.open_session("hammer-6.2").samples("forces")
        Samples(P_N, P_S, P_E, P_W [N]; 3000 rows at 5000 Hz, 0 to 0.5998 s)
    """
    if name not in SESSIONS:
        raise UnknownNameError("session", "a reference session", name, SESSIONS)
    return Recording.open(FOLDER / f"{name}.mcap")


def make(
    session: ReferenceSession, folder: Path, *, step: Callable[[str], None] = lambda _text: None
) -> tuple[Path, Path]:
    """Make one session: NAME.mcap and NAME.toml, each whole or not there; what stood there is replaced.

    Args:
        session: Which.
        folder: Where.
        step: Told what is being done.
    """
    recording, text = folder / f"{session.name}.mcap", folder / f"{session.name}.toml"
    step(session.name)
    _record(session, recording)
    validation = validate(Recording.open(recording), declared=True)
    write_file(text, quantities_text(session, validation))
    return recording, text


def _record(session: ReferenceSession, path: Path) -> None:
    simulation = Simulation(load_scene(session.scene, {**_SMALL_FILE_CHANGES, **session.changes}))
    with McapRun(path, simulation, force=True, view_rate_hz=0.0, epoch_ns=_EPOCH_NS) as writer:
        for frame in frames(simulation):
            writer.write(frame)


def quantities_text(session: ReferenceSession, validation: Validation) -> str:
    """Return the quantities of a session as TOML, by phase, as its sensors show them (energies: the truth)."""
    lines = [
        f"# Quantities of {session.name}.mcap, read off the recording; made with it by `{COMMAND}`.",
        f"# Scene {session.scene} with {', '.join(f'{key} = {value}' for key, value in session.changes.items())}.",
        "# Five digits are written: another machine may differ in the last ones, and more in a chaotic phase.",
    ]
    for number, phase in enumerate(validation.phases):
        lines += [
            "",
            "[[phases]]",
            f'name = "{phase.name}"',
            f"from_s = {phase.from_s:.5g}",
            f"to_s = {phase.to_s:.5g}",
        ]
        for one in validation.statistics:
            if one.number == number and not one.quantity.startswith("spectrum"):
                unit = f"  # {one.unit}" if one.unit else ""
                lines.append(f"{one.quantity} = {one.recorded:.5g}{unit}")
    return "\n".join(lines) + "\n"
