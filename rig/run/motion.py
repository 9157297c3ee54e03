"""Motion of a run: its initial state, its steps, and its energy ledger."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from rig.base.errors import InputError
from rig.physics.engines import Engine
from rig.physics.engines.common.memory import MEMORY
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import Constants, Inputs
from rig.physics.kernels.signals import COLUMN
from rig.physics.model import Model
from rig.run.scenes import Initial

STORED = ("kinetic_energy", "gravity_energy", "magnet_energy", "house_energy", "contact_energy")
SUPPLIED = ("drive_work", "hammer_work", "unbalance_work", "gap_work", "release_work")
DISSIPATED = ("bearing_loss", "house_loss", "contact_loss", "friction_loss")
WATCHED_S = 0.25
"""Time over which the kind of motion is determined [s]: three turns of backward whirl at a spin of 1 Hz."""
_CONTACT_SHARE = 0.95
"""Share of rows in contact from which the contact counts as lasting; losses of a few rows are waviness of the force."""
_WATCHED = [COLUMN[name] for name in ("penetration", "ring_x", "ring_y")]
BRANCH_ALARM = 1e-2
"""Energy residual over dissipated energy above which a run may have missed a contact or added a false one."""


class MotionStart(NamedTuple):
    """Start of a run that continues an earlier motion: the shaft in the ring, its housings at rest."""

    tick: int
    ring_x: float = 0.0  # [m]
    ring_y: float = 0.0
    vx: float = 0.0  # [m/s]
    vy: float = 0.0
    angle: float = 0.0  # theta [rad]
    state: tuple[float, ...] = ()
    """Whole state [SI], shape (N_STATE,), which replaces these values and the rest of the housings."""


def initial_state(model: Model, initial: Initial, begin: MotionStart | None, *, spin: float) -> np.ndarray:
    """Return state and integrals at the start of a run, shape (N_VECTOR,).

    Args:
        model: The model.
        initial: Initial state in the scene.
        begin: Start from an earlier motion; None: the scene's start.
        spin: Spin rate theta' [rad/s].

    Raises:
        InputError: The shaft would not be inside the ring.
    """
    contact, inside = model.constants.contact, "inside the ring (r0 = {:g} mm)".format
    if begin is not None:
        if begin.state:
            return np.concatenate([begin.state, np.zeros(S.N_VECTOR - S.N_STATE)])
        if math.hypot(begin.ring_x, begin.ring_y) >= contact.clearance:
            position = [begin.ring_x * 1e3, begin.ring_y * 1e3]
            raise InputError("begin", inside(contact.clearance * 1e3), position)
        return model.state(
            ring_x=begin.ring_x, ring_y=begin.ring_y, velocity=(begin.vx, begin.vy), spin=spin, angle=begin.angle
        )
    if initial.position == "equilibrium":
        sag = model.sag
        if math.hypot(contact.offset_x, sag - contact.offset_y) > contact.clearance:
            r0 = contact.clearance * 1e3
            position = f"within {r0:g} mm of the shaft at rest on its magnets, (0, {sag * 1e3:.4g}) mm"
            raise InputError("ring.offset", position, [contact.offset_x * 1e3, contact.offset_y * 1e3])
        return model.state(spin=spin)
    # Just inside the clearance, so that rounding does not cause a contact.
    radius = contact.clearance * (1.0 - 1e-12)
    positions = {
        "top": (0.0, radius),
        "bottom": (0.0, -radius),
        "given": (initial.x_mm * 1e-3, initial.y_mm * 1e-3),
    }
    x, y = positions[initial.position]
    if math.hypot(x, y) > contact.clearance:
        raise InputError("initial.position", inside(contact.clearance * 1e3), [initial.x_mm, initial.y_mm])
    return model.state(ring_x=x, ring_y=y, spin=spin)


class MotionWatch:
    """Kind of the shaft's motion in the ring, from the rows of the last `WATCHED_S`."""

    def __init__(self, row_rate_hz: float) -> None:
        """Start without rows."""
        self._row_rate_hz, self._most = row_rate_hz, round(WATCHED_S * row_rate_hz)
        self._blocks: deque[np.ndarray] = deque()
        self._count = 0

    def add(self, rows: np.ndarray) -> None:
        """Add the rows of a block, shape (n, N_ROW)."""
        self._blocks.append(rows[-self._most :, _WATCHED])
        self._count += len(self._blocks[-1])
        while self._count - len(self._blocks[0]) >= self._most:
            self._count -= len(self._blocks.popleft())

    def document(self) -> dict[str, Any] | None:
        """Return kind of motion, whirl frequency [Hz, forward positive] and impacts per second; None at the start."""
        if not self._blocks:
            return None
        # The same rows for any length of the blocks.
        penetration, x, y = np.concatenate(self._blocks)[-self._most :].T
        contact = penetration > 0.0
        touching, seconds = int(np.count_nonzero(contact)), len(contact) / self._row_rate_hz
        kind, whirl_hz, impacts_hz = "free", None, None
        if touching >= _CONTACT_SHARE * len(contact):
            angle = np.unwrap(np.arctan2(y, x))
            turned = float(angle[-1] - angle[0]) * len(angle) / max(len(angle) - 1, 1)
            if abs(turned) < math.pi:
                kind = "resting"
            else:
                kind = "backward whirl" if turned < 0.0 else "forward whirl"
                whirl_hz = turned / (2.0 * math.pi) / seconds
        elif touching:
            kind, impacts_hz = "impacts", int(np.count_nonzero(contact[1:] & ~contact[:-1])) / seconds
        return {"kind": kind, "whirl_hz": whirl_hz, "impacts_hz": impacts_hz}


@dataclass
class Motion:
    """State and integrals, memory of the engine, and the grid of observed rows.

    Attributes:
        y: State and integrals, shape (N_VECTOR,).
        step_ticks: Step of the engine [ticks].
        stride: Steps per row.
        tolerance: Tolerance of the engine.
        memory: Memory of the engine, shape (MEMORY,).
    """

    y: np.ndarray
    step_ticks: int
    stride: int
    tolerance: float
    memory: np.ndarray = field(default_factory=lambda: np.zeros(MEMORY))

    def begin(self, engine: Engine, constants: Constants, inputs: Inputs) -> None:
        """Start the engine on this state."""
        engine.start(constants, inputs, self.y, self.memory, float(self.step_ticks), self.tolerance)

    def warm_up(self, engine: Engine, constants: Constants, inputs: Inputs) -> None:
        """Compile the functions that the engine may call later than in its first steps."""
        if engine.warm_up is not None and len(self.memory) == engine.memory_size:
            engine.warm_up(constants, inputs)

    def run(
        self, engine: Engine, constants: Constants, inputs: Inputs, rows: np.ndarray, start: int, tick: int, stop: int
    ) -> None:
        """Advance from one tick to another with constant inputs.

        Commands act at any tick, rows only observe: off the grid of rows, steps are shortened to fit and no row is
        stored.

        Args:
            engine: The engine.
            constants: Constants of the model.
            inputs: Hammer, drive, magnets.
            rows: Output, one row every `stride` steps from the tick `start`, shape (n, N_ROW); if there is room, also
                the row at `stop`, before any change there.
            start: Tick of the first row.
            tick: Start of the advance.
            stop: End of the advance.
        """
        row_ticks = self.stride * self.step_ticks
        while tick < stop:
            row, remainder = divmod(tick - start, row_ticks)
            whole = 0 if remainder else (stop - tick) // row_ticks
            if whole:
                step, steps, stride = self.step_ticks, whole * self.stride, self.stride
                out = rows[row : row + whole + 1]
            else:
                ticks = min(stop - tick, row_ticks - remainder)
                step = math.gcd(ticks, self.step_ticks)
                stride = steps = ticks // step
                out = np.full((2, S.N_ROW), np.nan)
            engine.advance(constants, inputs, self.y, self.memory, tick, step, steps, stride, out)
            if not whole and not remainder:
                rows[row] = out[0]
            elif not whole and remainder + steps * step == row_ticks and row + 1 < len(rows):
                rows[row + 1] = out[1]
            tick += steps * step


def energy_balance(rows: np.ndarray, first: np.ndarray) -> dict[str, np.ndarray]:
    """Return the energy ledger of a run.

    Args:
        rows: Observed rows, shape (n, N_ROW).
        first: Row at the start of the run, shape (N_ROW,).

    Returns:
        stored (change since the start), supplied, dissipated, and residual = stored - supplied + dissipated [J], each
        of shape (n,).
    """

    def total(names: tuple[str, ...], table: np.ndarray) -> np.ndarray:
        return np.sum([table[..., COLUMN[name]] for name in names], axis=0)

    stored = total(STORED, rows) - total(STORED, first)
    supplied, dissipated = total(SUPPLIED, rows), total(DISSIPATED, rows)
    return {
        "stored": stored,
        "supplied": supplied,
        "dissipated": dissipated,
        "residual": stored - supplied + dissipated,
    }
