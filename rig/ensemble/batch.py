"""Many runs of one scene in one call: constants, initial states and schedules for the batch kernel, and its results.

Keys are those of `rig.ensemble.keys`. The kernel `rig.ensemble.lanes` has the scene's full model with compliant
contact, exact or no friction and the law's exponent 1.5. Other models, and runs that cannot be trusted, run one by one
with the scene's engine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from rig.base.errors import InputError, SimulationError, Words
from rig.ensemble import lanes as L
from rig.ensemble.keys import find_bounds, vary
from rig.physics.engines import ENGINES
from rig.physics.engines.common.memory import CONTACTS, PEAK_FORCE, STEPS
from rig.physics.kernels.frames.axis import axis_from_angles
from rig.physics.kernels.laws.contact import EXACT, NO_FRICTION
from rig.physics.kernels.laws.magnet import RIPPLED
from rig.physics.kernels.signals import COLUMN, STATE_SCALE
from rig.physics.model import Model, build_model
from rig.physics.parameters import SI
from rig.run.motion import WATCHED_S, initial_state
from rig.run.scenes import Scene, change_scene
from rig.run.simulation import TICK_RATE_HZ, Simulation
from rig.run.speed_target import ramp, segments

TOLERANCE = 1e-6
"""Scaled error per step of the batch kernel at the default engine.tolerance; a finer one makes it proportionally finer.
Half of all hammer runs then have an error below 1e-4 after 0.25 s."""
RESIDUAL_ALARM = 1e-3
"""Energy residual over dissipated energy above which a run is not trusted; typical are 1e-6."""
_LEAST_DISSIPATED_J = 1e-4
"""A run without contact dissipates less; the energy of 0.3 mm at the magnets."""
_CHECK_FACTOR = 1.0 / 30.0
_MIN_TOLERANCE = 1e-13
_WATCHED_SHARE = 0.25
"""Largest share of a run over whose end its outcome is determined."""
_CONTACT_SHARE = 0.95
_REPEAT_TOLERANCE = 1e-5
_FREE_MARGIN = 0.95
"""Share of the clearance that the sum of all amplitudes may reach in a run that stays free."""
_RESONANCE_MARGIN = 0.15
_OWN_SCALES = (1e-4, 3e-3)
"""Scales of time [s] and root of the penetration [m^0.5] in a step's error."""


class Quantity(NamedTuple):
    """Result of a run."""

    unit: str
    label: str
    kind: str = "number"


QUANTITIES = {
    "outcome": Quantity("", "Motion at the end of the run", "text"),
    "trusted": Quantity("", "Whether energy balance, and check if any, confirm the run", "truth"),
    "engine": Quantity("", "Engine of the run", "text"),
    "end_s": Quantity("s", "End of the run; before its duration if its outcome was certain"),
    "contacts": Quantity("1", "Number of contacts"),
    "first_contact_s": Quantity("s", "Start of the first contact; NaN without one"),
    "last_contact_s": Quantity("s", "End of the last contact; NaN without one"),
    "contact_fraction": Quantity("1", "Share of the run in contact"),
    "time_to_whirl_s": Quantity("s", "Start of the rolling that lasts to the end; NaN without one"),
    "whirl_hz": Quantity("Hz", "Whirl frequency at the end, forward positive; NaN unless it whirls"),
    "peak_force_n": Quantity("N", "Largest normal force"),
    "contact_impulse_ns": Quantity("N s", "Integral of the normal force"),
    "peak_radius_mm": Quantity("mm", "Largest distance of the disk from the ring's line"),
    "peak_reaction_x_n": Quantity("N", "Largest horizontal reaction, the difference of P_E and P_W"),
    "peak_reaction_y_n": Quantity("N", "Largest vertical reaction, the difference of P_N and P_S"),
    "energy_residual_j": Quantity("J", "Stored less supplied plus dissipated energy: 0 without error"),
    "dissipated_j": Quantity("J", "Dissipated energy"),
    "error_estimate": Quantity("1", "Largest relative difference from a finer run; NaN without check"),
    "steps": Quantity("1", "Number of steps"),
}
OUTCOMES = ("free", "impacts", "resting", "forward whirl", "backward whirl", "failed")
_COMPARED = ("peak_force_n", "peak_radius_mm", "peak_reaction_x_n", "peak_reaction_y_n")


class _Plan:
    """Inputs of a run over time, by letting the scene's commands take effect without an engine."""

    def __init__(self, scene: Scene, model: Model) -> None:
        self.tick, self.tick_rate_hz, self.model = 0, TICK_RATE_HZ, model
        self.inputs: dict[str, Any] = {
            "hammer_force": 0.0, "hammer_x": 1.0, "hammer_y": 0.0, "hammer_start": 0, "hammer_end": 0,
            "magnet_engaged": scene.initial.magnets,
        }  # fmt: skip
        self._segments = segments(scene.drive.profile or ((0.0, scene.drive.speed_hz),), TICK_RATE_HZ)
        self.speed = self._segments[0].speed
        commands = [(round(each.at_s * TICK_RATE_HZ), each.request) for each in scene.commands]
        pending = sorted((each for each in commands if each[1].MECHANICAL), key=lambda each: each[0])
        self.rows = []
        while True:
            while pending and pending[0][0] <= self.tick:
                pending.pop(0)[1].take_effect(self)  # type: ignore[arg-type]
            self.rows.append(self._row())
            later = [segment.tick for segment in self._segments] + [tick for tick, _ in pending[:1]]
            later = [tick for tick in [*later, self.inputs["hammer_end"]] if tick > self.tick]
            if not later:
                break
            self.tick = min(later)

    def ramp_to(self, speed_hz: float) -> None:
        """Ramp the drive to a speed at its ramp rate."""
        segment = next(each for each in reversed(self._segments) if each.tick <= self.tick)
        now = segment.speed + segment.slope * (self.tick - segment.tick) / TICK_RATE_HZ
        self._segments = ramp(self.tick, now, speed_hz, self.model.parameters["drive.ramp_rate"], TICK_RATE_HZ)

    def release_magnets(self) -> None:
        """Switch the magnets off."""
        self.inputs["magnet_engaged"] = False

    def _row(self) -> tuple[float, ...]:
        segment = next(each for each in reversed(self._segments) if each.tick <= self.tick)
        own, start = self.inputs, self.inputs["hammer_start"]
        length = own["hammer_end"] - start
        force = own["hammer_force"] if self.tick < own["hammer_end"] else 0.0
        return (
            self.tick / TICK_RATE_HZ, force, own["hammer_x"], own["hammer_y"], start / TICK_RATE_HZ,
            TICK_RATE_HZ / length if length else 1.0, segment.speed, segment.slope, segment.tick / TICK_RATE_HZ,
            float(own["magnet_engaged"]),
        )  # fmt: skip


def _constants_row(model: Model) -> np.ndarray:
    """Return the kernel's constants of a model, shape (N_CONSTANTS,), without those of the free motion."""
    k = model.constants
    shaft, magnet, contact, house = k.shaft, k.magnet, k.contact, k.house
    return np.array([
        shaft.arm_ring, shaft.arm_magnet, shaft.arm_disk, shaft.arm_centre * shaft.mass * shaft.gravity,
        1.0 / shaft.transverse_inertia, shaft.polar_inertia, 1.0 / shaft.polar_inertia, shaft.radius, shaft.unbalance,
        shaft.unbalance_phase, float(k.levels.euler), contact.stiffness, contact.damping_factor,
        contact.viscous_damping, contact.clearance, contact.offset_x, contact.offset_y,
        contact.friction if k.levels.friction == EXACT else 0.0, contact.speed_floor, magnet.stiffness, magnet.a3,
        magnet.a5, magnet.a7, magnet.damping_x, magnet.damping_y, 1.0 / house.inner_mass, 1.0 / house.outer_mass,
        house.inner_beam_stiffness, house.inner_beam_damping, house.outer_beam_stiffness, house.outer_beam_damping,
        house.pair_stiffness_vertical, house.pair_stiffness_horizontal, house.preload, k.torque_gain, 0.0, 0.0,
        model.sag / shaft.arm_ring, 0.0,
    ])  # fmt: skip


def _is_supported(scene: Scene, model: Model) -> bool:
    """Return whether the batch kernel has the model of a scene."""
    k = model.constants
    full = k.levels.inner_house and k.levels.outer_house and k.levels.compliant
    friction = k.levels.friction in (NO_FRICTION, EXACT)
    law = k.contact.exponent == 1.5 and k.contact.gap_counts_outer == 0.0 and k.magnet.terms != RIPPLED
    return full and friction and law and scene.drive.mode == "torque" and scene.engine.name == next(iter(ENGINES))


class _Prepared(NamedTuple):
    """Data of a run for the kernel."""

    scene: Scene
    constants: np.ndarray
    initial: np.ndarray
    schedule: list[tuple[float, ...]]
    supported: bool


def _prepare(scene: Scene, model: Model) -> _Prepared:
    """Prepare a run.

    Raises:
        InputError: The shaft would not be in the ring at the start.
    """
    plan = _Plan(scene, model)
    state = initial_state(model, scene.initial, None, spin=plan.speed)
    initial = np.zeros(L.N_START)
    initial[:4] = axis_from_angles(model.constants.levels.euler, *state[[0, 1, 7, 8]])
    initial[L.SPIN], initial[L.THETA] = state[9], state[2]
    return _Prepared(scene, _constants_row(model), initial, plan.rows, _is_supported(scene, model))


class Batch:
    """Runs of one scene that differ in the values of some keys.

    Args:
        scene: The scene.
        keys: Varied keys.
        early_end: Whether a run ends when its outcome is certain.

    Raises:
        InputError: A key cannot be varied, or the scene cannot start.

    Example:
        >>> import rig
        >>> from rig.ensemble.batch import Batch
        >>> table = Batch(rig.load_scene("hammer"), ["hammer.force_n"]).run([[20.0], [100.0]])
        >>> table["outcome"].tolist()
        ['free', 'backward whirl']
    """

    def __init__(self, scene: Scene, keys: Sequence[str], *, early_end: bool = True) -> None:
        scene.check_physics()
        self.scene, self.keys, self._early = scene, tuple(keys), early_end
        self._parameters = scene.load_parameters()
        self._model = build_model(self._parameters, scene.model)
        self._own = _prepare(scene, self._model)
        self._direct: dict[int, tuple[int, bool, float]] = {}
        self._indirect: list[int] = []
        # Other levels, starts and rules let a parameter be another constant, or none.
        entries = self._parameters.entries
        mixed = any(
            entries[key].rules or entries[key].formula if key in entries else key.split(".")[0] in _MIXING
            for key in self.keys
        )
        for position, key in enumerate(self.keys):
            if key in entries and not mixed and (direct := self._find_constant(key)) is not None:
                self._direct[position] = direct
            else:
                self._indirect.append(position)
        self._bounds = {key: find_bounds(scene, key) for key in self.keys}
        for key in self.keys:  # refuses a key of a command that the scene does not have
            if key in _PLAIN_FIELDS:
                vary(scene, {key: max(self._bounds[key].low, min(1.0, self._bounds[key].high))})
        # A batch of similar runs has few combinations of keys, or each of them once.
        self._build_model = lru_cache(maxsize=64)(self._model_of)
        self._prepare = lru_cache(maxsize=64)(self._prepare_run)

    def _find_constant(self, key: str) -> tuple[int, bool, float] | None:
        """Return constant, whether it is the reciprocal, and factor to SI of a parameter that is one constant."""
        entry = self._parameters.entries[key]
        # A ring's parameter also decides whether the shaft is in the ring at the start.
        if isinstance(entry.value, str) or entry.formula or entry.rules or entry.unit == "count" or key[:5] == "ring.":
            return None
        low, high = entry.range
        value = (
            entry.value * 1.0009765625
            if low <= entry.value * 1.0009765625 <= high and entry.value
            else 0.5 * (low + high)
        )
        try:
            other = _prepare(self.scene, build_model(self._parameters.override({key: value}), self.scene.model))
        except InputError:
            return None
        if other.schedule != self._own.schedule or (other.initial != self._own.initial).any():
            return None
        before, after = self._own.constants, other.constants
        changed, si = np.flatnonzero(before != after), value * SI[entry.unit]
        if len(changed) != 1 or after[changed[0]] not in (si, 1.0 / si):
            return None
        return int(changed[0]), bool(after[changed[0]] != si), SI[entry.unit]

    def _model_of(self, changes: tuple[tuple[str, Any], ...], levels: Any, name: str) -> Model:
        base = self._parameters
        if name != self.scene.parameters:
            base = self.scene.model_copy(update={"parameters": name}).load_parameters()
        return build_model(base.override(dict(changes)) if changes else base, levels)

    def _change_scene(self, changes: dict[str, Any]) -> Scene:
        """Return the scene with changed fields; plain numbers without the slow validation of the whole scene."""
        others, scene = {}, self.scene
        for key, value in changes.items():
            bounds = self._bounds[key]
            name = key.partition(".")[0]
            alone = sum(each.request.command == name for each in scene.commands) < 2  # else pulses may overlap
            if not isinstance(value, float) or not (
                alone and key in _PLAIN_FIELDS and bounds.low < value < bounds.high
            ):
                others[key] = value
            elif key == "drive.speed_hz":
                scene = scene.model_copy(
                    update={"drive": scene.drive.model_copy(update={"speed_hz": value, "profile": ()})}
                )
            else:
                place = next(i for i, each in enumerate(scene.commands) if each.request.command == name)
                old = scene.commands[place]
                new = old.model_copy(update={"request": old.request.model_copy(update={_PLAIN_FIELDS[key]: value})})
                scene = scene.model_copy(
                    update={"commands": (*scene.commands[:place], new, *scene.commands[place + 1 :])}
                )
        return vary(scene, others) if others else scene

    def _prepare_run(self, values: tuple[Any, ...]) -> _Prepared | None:
        """Prepare a run from the values of the keys that are not single constants; None if it cannot start."""
        changes = dict(zip([self.keys[position] for position in self._indirect], values, strict=True))
        parameters = {key: value for key, value in changes.items() if key in self._parameters.entries}
        try:
            scene = self._change_scene({key: value for key, value in changes.items() if key not in parameters})
            if parameters:
                scene = scene.model_copy(update={"set": {**scene.set, **parameters}})
            return _prepare(scene, self._build_model(tuple(parameters.items()), scene.model, scene.parameters))
        except InputError:
            for key, value in changes.items():
                vary(self.scene, {key: value})  # refuses a value that is wrong alone
            return None

    def run(
        self, values: Any, *, check: bool = False, repeat: bool = True, start: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        """Run the batch.

        Args:
            values: Values of the keys, shape (n, keys): numbers in the units of the scene or parameter, or texts.
            check: Whether to repeat each run with a finer tolerance, for `error_estimate`.
            repeat: Whether to repeat runs that cannot be trusted with the scene's engine.
            start: States in which the runs start, the `end` of other runs; default: those of the scene.

        Returns:
            Quantities by name, each of shape (n,), and the state at the `end`, shape (n, N_START). A run that the
            scene does not accept, as its shaft would not be in the ring, has failed.

        Raises:
            InputError: A value is not accepted.
        """
        rows = np.asarray(values, dtype=object if isinstance(values, list) else None)
        if rows.size and rows.shape[1:] != (len(self.keys),):
            raise InputError("values", f"an array of shape (runs, {len(self.keys)})", Words(f"shape {rows.shape}"))
        rows = rows.reshape(-1, len(self.keys))
        found = [self._prepare(tuple(row[self._indirect].tolist())) for row in rows]
        prepared = [each or self._own for each in found]
        table = self._run_lanes(rows, prepared, 1.0, start)
        if check and len(prepared):
            _compare(table, self._run_lanes(rows, prepared, _CHECK_FACTOR, start))
        for i, each in enumerate(found):
            if each is None:
                table["outcome"][i], table["trusted"][i] = "failed", False
                continue
            if each.supported and (table["trusted"][i] or not repeat or start is not None):
                continue
            direct = {self.keys[position]: rows[i, position] for position in self._direct}
            for name, value in self._run_engine(each.scene, direct, repeats=each.supported).items():
                table[name][i] = value
        return table

    def _run_lanes(
        self, rows: np.ndarray, prepared: list[_Prepared], share: float, start: np.ndarray | None
    ) -> dict[str, np.ndarray]:
        """Run all with the batch kernel, also those that it does not support, whose results are replaced.

        `share` multiplies the tolerance.
        """
        count = len(rows)
        constants = np.array([each.constants for each in prepared]).reshape(count, L.N_CONSTANTS)
        for position, (constant, reciprocal, factor) in self._direct.items():
            column = self._check_numbers(self.keys[position], rows[:, position])
            constants[:, constant] = 1.0 / (column * factor) if reciprocal else column * factor
        longest = max((len(each.schedule) for each in prepared), default=1)
        schedule = np.full((count, longest, 1 + L.N_INPUTS), math.inf)
        for i, each in enumerate(prepared):
            schedule[i, : len(each.schedule)] = each.schedule
        initial = np.array([each.initial for each in prepared]).reshape(count, L.N_START)
        ends = np.array([each.scene.duration_s for each in prepared])
        if start is not None:
            initial = np.array(start, dtype=float).reshape(count, L.N_START)
        _set_free_motion(constants, prepared)
        results = np.zeros((count, L.N_RESULTS))
        watched = np.minimum(WATCHED_S, _WATCHED_SHARE * ends)
        usual = next(iter(ENGINES.values())).tolerance
        tolerances = np.array([share * TOLERANCE * each.scene.engine.tolerance / usual for each in prepared])
        if count:
            batch = constants, initial, schedule, ends, watched, np.maximum(tolerances, _MIN_TOLERANCE)
            L.march(batch, _PER_SCALE, self._early, results)
        return _quantities(results)

    def _check_numbers(self, key: str, values: np.ndarray) -> np.ndarray:
        """Return the numbers of a parameter, after checking their range."""
        low, high = self._parameters.entries[key].range
        for value in values if values.dtype == object else ():
            if isinstance(value, bool | str):
                raise InputError(key, f"a number from {low:g} to {high:g}", value)
        column = values.astype(float)
        wrong = ~((column >= low) & (column <= high))
        if wrong.any():
            raise InputError(key, f"a number from {low:g} to {high:g}", float(column[wrong][0]))
        return column

    def _run_engine(self, scene: Scene, direct: dict[str, Any], *, repeats: bool) -> dict[str, Any]:
        """Return the quantities of a run with the scene's engine."""
        changes = {**direct, "engine.companion": False, "sensors.chain": "ideal"}
        if repeats and scene.engine.tolerance > _REPEAT_TOLERANCE:
            changes["engine.tolerance"] = _REPEAT_TOLERANCE
        scene = change_scene(scene, changes)
        simulation = Simulation(scene)
        parts = []
        try:
            while simulation.tick < simulation.end_tick:
                chunk = min(100 * simulation.block_ticks, simulation.end_tick - simulation.tick)
                parts.append(simulation.advance(chunk).rows[:, _COLUMNS].copy())
        except SimulationError:
            return {"outcome": "failed", "trusted": False, "engine": scene.engine.name}
        return _quantities_of_rows(simulation, np.concatenate(parts))


_PLAIN_FIELDS = {
    "drive.speed_hz": "", "hammer.force_n": "force_n", "hammer.duration_ms": "duration_ms",
    "hammer.angle_deg": "direction", "speed.speed_hz": "speed_hz",
}  # fmt: skip
"""Keys whose numbers depend on no other field of the scene, with the field of the command."""
_MIXING = ("model", "initial", "parameters")
"""First parts of keys that select equations, start or set."""
_COLUMNS = [
    COLUMN[name]
    for name in ("penetration", "ring_x", "ring_y", "disk_x", "disk_y", "P_E", "P_W", "P_N", "P_S", "sliding_speed")
]
_PER_SCALE = 1.0 / np.array([*STATE_SCALE[[1, 0, 8, 7, 9, 2, 3, 4, 5, 6, 10, 11, 12, 13]], *_OWN_SCALES])


def _set_free_motion(constants: np.ndarray, prepared: list[_Prepared]) -> None:
    """Set the constants that decide whether a run stays free, from the linear motion about the rest position.

    The magnets harden, so that their stiffness at the centre gives the lower frequency and the larger amplitude. The
    response to the unbalance counts twice, as a transient of the same size may be in phase with it.
    """
    c = constants.T
    frequency = np.sqrt(c[L.MAGNET] * c[L.PER_INERTIA]) * c[L.ARM_MAGNET]
    speed = np.array([each.schedule[-1][6] for each in prepared])
    distance = np.abs(speed**2 - frequency**2) / frequency**2
    response = c[L.ARM_RING] * c[L.UNBALANCE] * speed**2 * c[L.ARM_DISK] * c[L.PER_INERTIA]
    response /= np.maximum(distance, _RESONANCE_MARGIN) * frequency**2
    c[L.PER_FREQUENCY] = 1.0 / frequency
    off_centre = np.hypot(c[L.OFFSET_X], c[L.ARM_RING] * c[L.REST_Y] - c[L.OFFSET_Y])
    reach = _FREE_MARGIN * c[L.CLEARANCE] - off_centre - 2.0 * response
    steady = [each.schedule[-1][7] == 0.0 and each.schedule[-1][9] == 1.0 for each in prepared]
    c[L.FREE_RADIUS] = np.where(np.array(steady, dtype=bool) & (distance > _RESONANCE_MARGIN), reach, -1.0)


def _name_outcomes(touching: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Return outcomes from share of contact and angle [rad] of the watched time, as `rig.run.motion.MotionWatch`."""
    whirl = np.where(turned < 0.0, "backward whirl", "forward whirl")
    lasting = np.where(np.abs(turned) < math.pi, "resting", whirl)
    return np.where(touching >= _CONTACT_SHARE, lasting, np.where(touching > 0.0, "impacts", "free")).astype(object)


def _quantities(results: np.ndarray) -> dict[str, np.ndarray]:
    """Return the quantities of the kernel's results."""
    r = results.T
    status, watched_s = r[L.STATUS], r[L.END] - r[L.WATCHED]
    turned = r[L.TURNED] - r[L.WATCHED_TURN]
    per_s = 1.0 / np.where(watched_s > 0.0, watched_s, np.inf)
    outcome = _name_outcomes((r[L.CONTACT_TIME] - r[L.WATCHED_CONTACT]) * per_s, turned)
    outcome[status == L.STAYS_FREE] = "free"
    outcome[status == L.GIVEN_UP] = "failed"
    whirls = np.char.endswith(outcome.astype(str), "whirl")
    balanced = np.abs(r[L.RESIDUAL]) <= RESIDUAL_ALARM * np.maximum(r[L.DISSIPATED], _LEAST_DISSIPATED_J)
    return {
        "outcome": outcome,
        "trusted": balanced & (status != L.GIVEN_UP) & np.isfinite(r[L.RESIDUAL]),
        "engine": np.full(len(results), "lanes", dtype=object),
        "end_s": r[L.END].copy(),
        "contacts": r[L.CONTACTS].copy(),
        "first_contact_s": r[L.FIRST_CONTACT].copy(),
        "last_contact_s": r[L.LAST_CONTACT].copy(),
        "contact_fraction": r[L.CONTACT_TIME] / np.maximum(r[L.END], 1e-9),
        "time_to_whirl_s": np.where(whirls, r[L.WHIRL_TIME], np.nan),
        "whirl_hz": np.where(whirls, turned * per_s / (2.0 * math.pi), np.nan),
        "peak_force_n": r[L.PEAK_FORCE].copy(),
        "contact_impulse_ns": r[L.CONTACT_IMPULSE].copy(),
        "peak_radius_mm": r[L.PEAK_RADIUS] * 1e3,
        "peak_reaction_x_n": r[L.PEAK_X].copy(),
        "peak_reaction_y_n": r[L.PEAK_Y].copy(),
        "energy_residual_j": r[L.RESIDUAL].copy(),
        "dissipated_j": r[L.DISSIPATED].copy(),
        "error_estimate": np.full(len(results), np.nan),
        "steps": r[L.STEPS].copy(),
        "end": r[L.END_STATE :].T.copy(),
    }


def _compare(table: dict[str, np.ndarray], finer: dict[str, np.ndarray]) -> None:
    """Write the error estimate of each run from a finer one, and do not trust runs with another outcome."""
    errors = [np.abs(table[name] - finer[name]) / np.maximum(np.abs(finer[name]), 1e-9) for name in _COMPARED]
    same = table["outcome"] == finer["outcome"]
    table["error_estimate"] = np.where(same, np.nanmax([*errors, np.zeros(len(same))], axis=0), np.inf)
    table["trusted"] &= same


def _quantities_of_rows(simulation: Simulation, rows: np.ndarray) -> dict[str, Any]:
    """Return the quantities of a finished run from its rows."""
    health, memory = simulation.health(), simulation._motion.memory  # noqa: SLF001
    end_s, step_s = simulation.tick / TICK_RATE_HZ, simulation.row_ticks / TICK_RATE_HZ
    penetration, x, y, disk_x, disk_y, east, west, north, south, sliding = rows.T
    touching = penetration > 0.0
    times_s = np.flatnonzero(touching) * step_s
    watched = max(1, round(min(WATCHED_S, _WATCHED_SHARE * end_s) / step_s))
    angle = np.unwrap(np.arctan2(y[-watched:], x[-watched:]))
    turned = float(angle[-1] - angle[0]) * watched / max(watched - 1, 1)
    outcome = str(_name_outcomes(np.array([touching[-watched:].mean()]), np.array([turned]))[0])
    whirls = outcome.endswith("whirl")
    rolls = touching & (np.abs(sliding) < 1e-4)
    residual, dissipated = health["energy"]["residual_j"], health["energy"]["dissipated_j"]
    return {
        "outcome": outcome,
        "trusted": abs(residual) <= RESIDUAL_ALARM * max(dissipated, _LEAST_DISSIPATED_J),
        "engine": simulation.scene.engine.name,
        "end_s": end_s,
        "contacts": memory[CONTACTS],
        "first_contact_s": times_s[0] if len(times_s) else math.nan,
        "last_contact_s": times_s[-1] if len(times_s) else math.nan,
        "contact_fraction": touching.mean(),
        "time_to_whirl_s": (len(rolls) - np.argmin(rolls[::-1])) * step_s if whirls and not rolls.all() else math.nan,
        "whirl_hz": turned / (2.0 * math.pi) / (watched * step_s) if whirls else math.nan,
        "peak_force_n": memory[PEAK_FORCE],
        "contact_impulse_ns": simulation._motion.y[COLUMN["contact_impulse"]],  # noqa: SLF001
        "peak_radius_mm": float(np.hypot(disk_x, disk_y).max()) * 1e3,
        "peak_reaction_x_n": float(np.abs(east - west).max()),
        "peak_reaction_y_n": float(np.abs(north - south).max()),
        "energy_residual_j": residual,
        "dissipated_j": dissipated,
        "error_estimate": math.nan,
        "steps": memory[STEPS],
    }
