"""Simulation of a scene: returns frames of samples and truth, accepts commands. No clock, threads or I/O.

`Simulation.advance` is the single stepper for all ways to run the rig: free, in lockstep, or in real time. Time is an
integer tick of 1 us. Splitting a run into calls changes no bit of the result.
"""

from __future__ import annotations

import copy
import math
from bisect import insort
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from rig.base.errors import InputError, SimulationError, Words
from rig.base.wire import ROOT, Block
from rig.channels.faults.delivery import Frame
from rig.channels.formula import check_computed, find_names
from rig.channels.sensors.conditioning import Conditioner
from rig.channels.sensors.keyphasor import Keyphasor
from rig.channels.table import ChannelTable
from rig.physics.accuracy import Accuracy, choose_companion
from rig.physics.engine_choice import load_chosen_engine
from rig.physics.engines import ENGINES
from rig.physics.engines.common.memory import CEILING, CLAMPS, CONTACTS, FLOORED, MEMORY, PEAK_FORCE, ROLLED_S, STEPS
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import Inputs
from rig.physics.kernels.laws.magnet import magnet_force
from rig.physics.kernels.signals import COLUMN
from rig.physics.model import build_model, describe
from rig.run import calibrator
from rig.run.commands.command import SceneCommand
from rig.run.commands.table import check_command
from rig.run.fault_injection import FaultInjector
from rig.run.motion import BRANCH_ALARM, Motion, MotionStart, MotionWatch, energy_balance, initial_state
from rig.run.scenes import Scene, load_scene, scene_document
from rig.run.speed_target import Segment, ramp, segments

TICK_RATE_HZ = 1_000_000


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of a run at one tick, for `Simulation.restore`."""

    scene: Scene
    state: dict[str, Any] = field(repr=False)


_STATE_FIELDS = (
    "tick", "first_row", "_segments", "inputs", "pending", "_motion", "_companion", "_accuracy", "_last", "_watch",
    "_conditioners", "_keyphasor", "_edge_count", "faults",
)  # fmt: skip


class Simulation:
    """A run of a scene.

    Attributes:
        scene: The scene.
        model: Its model.
        table: Channel table of the active sensors.
        tick: Current time [ticks].
        tick_rate_hz: Ticks per second.
        block_ticks: `advance` takes whole multiples of this [ticks].
        end_tick: End of the scene [ticks].
        row_ticks: Ticks between observed rows.
        begin: Position and speed of the shaft from which the run starts; None: those of the scene.
        rows_per_kept_row: Rows from one sample instant to the next; 1 if some samples fall between rows.
        command_result: Result of the last command, except its tick: a fault's number, channels and first faulty rows.
        inputs: Inputs of the kernels that commands set.
        pending: Waiting commands with their ticks, in order.
        faults: Faults of the channels.

    Example:
        >>> import rig
        >>> simulation = rig.Simulation("hammer")  # or a scene of `rig.load_scene`
        >>> frame = simulation.advance(100 * simulation.block_ticks)
        >>> simulation, frame.samples["probes"].values.shape, frame.rows.shape  # ADC counts; the model's signals [SI]
        (Simulation(hammer: at 0.05 of 2 s), (1000, 4), (2000, 66))
    """

    def __init__(self, scene: Scene | str | Path, *, begin: MotionStart | None = None) -> None:
        self.scene = scene = load_scene(scene)
        self.begin = begin
        self.tick_rate_hz = TICK_RATE_HZ
        self._warm = False
        self.model = build_model(scene.load_parameters(), scene.model)
        self._engines = [calibrator.STILL if scene.generator else load_chosen_engine(scene.engine.name)]
        self._method = ENGINES[scene.engine.name]
        sensors, self.row_ticks = scene.sensors, scene.row_ticks
        # The longest step that ends on the rows.
        self._step_ticks = next(
            ticks for ticks in range(min(scene.engine.step_us, self.row_ticks), 0, -1) if self.row_ticks % ticks == 0
        )
        self._stride = self.row_ticks // self._step_ticks
        self.table: ChannelTable = scene.table
        groups = self.table.groups.values()
        periods = [TICK_RATE_HZ // group.rate_hz for group in groups if TICK_RATE_HZ % group.rate_hz == 0]
        self.rows_per_kept_row = math.gcd(*periods) // self.row_ticks if len(periods) == len(groups) else 1
        self.block_ticks = math.lcm(self.row_ticks, TICK_RATE_HZ // sensors.truth_rate_hz)
        self.end_tick = math.ceil(max(1, round(scene.duration_s * TICK_RATE_HZ)) / self.block_ticks) * self.block_ticks
        self._formulas = scene.formulas()
        self._conditioners = [
            Conditioner(
                [group for group in groups if group.rate_hz == rate],
                row_rate_hz=TICK_RATE_HZ // self.row_ticks,
                seed=scene.seed,
                noise=sensors.noise,
                ideal=sensors.chain == "ideal",
                columns=self._formulas.columns(group for group in groups if group.rate_hz == rate),
            )
            for rate in dict.fromkeys(group.rate_hz for group in groups if scene.generator is None)
        ]
        marked = any(channel.signal == "keyphasor" for channel in self.table.channels.values())
        self._keyphasor = Keyphasor() if marked else None
        self._edge_count = 0
        if scene.generator is not None:
            tick = 0 if begin is None else begin.tick
            self._conditioners, turns = calibrator.build_replacements(scene, row_ticks=self.row_ticks, tick=tick)
            self._keyphasor = turns if marked else None
        self.faults = FaultInjector(
            self.table, self._conditioners, seed=scene.seed, row_ticks=self.row_ticks, setting=scene.setting
        )
        self._truth_every = TICK_RATE_HZ // sensors.truth_rate_hz // self.row_ticks
        self._truth_columns = np.array([COLUMN[column] for columns in S.TRUTH.values() for column in columns])
        ends = accumulate(len(columns) for columns in S.TRUTH.values())
        self._truth_parts = {
            name: slice(end - len(columns), end)
            for (name, columns), end in zip(S.TRUTH.items(), ends, strict=True)
            if scene.generator is None  # without the model there is no truth
        }

        self.command_result: dict[str, Any] = {}
        self.tick = self._start = 0 if begin is None else begin.tick
        if self.tick % self.block_ticks:
            raise InputError("begin.tick", f"a multiple of {self.block_ticks}", self.tick)
        self._segments = segments(scene.drive.profile or ((0.0, scene.drive.speed_hz),), TICK_RATE_HZ)
        self.inputs: dict[str, Any] = {
            "hammer_force": 0.0, "hammer_x": 1.0, "hammer_y": 0.0, "hammer_start": 0, "hammer_end": 0,
            "magnet_engaged": scene.initial.magnets,
        }  # fmt: skip
        scheduled = ((round(timed.at_s * TICK_RATE_HZ), timed.request) for timed in scene.commands)
        self.pending: list[tuple[int, SceneCommand]] = sorted(scheduled, key=lambda entry: entry[0])
        self.faults.check_all(self.pending)
        choice, initial = scene.engine, initial_state(self.model, scene.initial, begin, spin=self._speed())
        memory = np.zeros(self._engines[0].memory_size if choice.rolling == "collocation" else MEMORY)
        self._motion = Motion(initial, self._step_ticks, self._stride, choice.tolerance, memory)
        self._companion: Motion | None = None
        if choice.companion:
            name, finer = choose_companion(choice.name, choice.tolerance, scene.model.friction)
            self._engines.append(
                self._engines[0] if scene.generator or name == choice.name else load_chosen_engine(name)
            )
            stride = self.block_ticks // self._step_ticks
            self._companion = Motion(initial.copy(), self._step_ticks, stride, finer, np.zeros_like(memory))
        clearance = self.model.constants.contact.clearance
        block_s, limits = self.block_ticks / TICK_RATE_HZ, choice.limits.by_quantity()
        self._accuracy = Accuracy(choice.tolerance, clearance, block_s, limits)
        self._rows = np.full((0, S.N_ROW), np.nan)
        self._last: np.ndarray | None = None
        self._watch = MotionWatch(TICK_RATE_HZ / self.row_ticks)

    def __repr__(self) -> str:
        return f"Simulation({self.scene.name}: at {self.tick / self.tick_rate_hz:g} of {self.scene.duration_s:g} s)"

    @cached_property
    def first_row(self) -> np.ndarray:
        """Observed row at time zero, shape (N_ROW,). The first access starts the engine, and so compiles it."""
        row, constants, inputs = np.full((1, S.N_ROW), np.nan), self.model.constants, self._inputs()
        for motion, engine in zip(self._motions(), self._engines, strict=True):
            motion.begin(engine, constants, inputs)
        moved = copy.deepcopy(self._motion)
        moved.run(self._engines[0], constants, inputs, row, self.tick, self.tick, self.tick + 1)
        if np.isfinite(moved.y).all():
            return row[0]
        raise SimulationError(f"the state is not finite at its start; {self._method.advice}")

    @cached_property
    def computed(self) -> tuple[str, ...]:
        """Names of the model's signals that this run computes: those that are not NaN at time zero.

        Raises:
            InputError: A channel or a truth table needs a signal that is not computed.
        """
        if self.scene.generator is not None:
            return tuple(COLUMN)
        needed = {f"channel {name}.signal": find_names(each.signal) for name, each in self.table.channels.items()}
        needed |= {f"truth table {name}": S.TRUTH[name] for name in self._truth_parts}
        return check_computed(needed, self.first_row, engine=self.scene.engine.name)

    def _motions(self) -> list[Motion]:
        return [self._motion] if self._companion is None else [self._motion, self._companion]

    def advance(self, ticks: int) -> Frame:
        """Advance by `ticks`.

        Raises:
            InputError: `ticks` is not a positive whole multiple of `block_ticks`.
            SimulationError: The state has become non-finite.
        """
        if ticks <= 0 or ticks % self.block_ticks:
            raise InputError("ticks", f"a positive multiple of {self.block_ticks}", ticks)
        _ = self.computed  # starts the engine
        start, end = self.tick, self.tick + ticks
        n = ticks // self.row_ticks
        if len(self._rows) <= n:
            self._rows = np.full((n + 1, S.N_ROW), np.nan)
        rows, done = self._rows[: n + 1], 0
        outputs = [rows]
        if self._companion is not None:
            outputs.append(np.full((ticks // self.block_ticks, S.N_ROW), np.nan))
        events: list[dict[str, Any]] = []
        counts: list[dict[str, np.ndarray]] = []
        while self.tick < end:
            self._take_effect(events)
            stop, inputs = min(end, self._next_change()), self._inputs()
            for motion, engine, out in zip(self._motions(), self._engines, outputs, strict=True):
                motion.run(engine, self.model.constants, inputs, out, start, self.tick, stop)
            self.tick = stop
            # A change at a row takes effect after it: sensors receive the row before the change, then the one after it.
            row, remainder = divmod(stop - start, self.row_ticks)
            if not remainder:
                counts.append(self._condition(rows[done : row + 1], start + done * self.row_ticks))
                done = row
        rows = rows[:n]
        self._last = rows[-1].copy()
        self._watch.add(rows)
        if not all(map(math.isfinite, self._motion.y.tolist())):
            at_s = self._find_divergence_s(rows, start)
            raise SimulationError(f"the state is no longer finite at {at_s:.6f} s; {self._method.advice}")
        if self._companion is not None:
            events = sorted(events + self._compare_companion(rows, outputs[1], start), key=lambda event: event["tick"])
        samples, edges, truth = self._sample(counts, start), self._edges(rows, start), self._truth(rows, start)
        frame = Frame(start, ticks, samples, edges, truth, events, rows)
        return self.faults.sending.pass_on(frame, last=self.tick >= self.end_tick)

    def _find_divergence_s(self, rows: np.ndarray, start: int) -> float:
        finite = np.isfinite(rows[:, : S.N_STATE]).all(axis=1)
        row = len(rows) if finite.all() else int(np.argmin(finite))
        return (start + row * self.row_ticks) / TICK_RATE_HZ

    def _compare_companion(self, rows: np.ndarray, companion: np.ndarray, start: int) -> list[dict[str, Any]]:
        every = self.block_ticks // self.row_ticks
        times_s = (start + self.block_ticks * np.arange(len(companion))) / TICK_RATE_HZ
        warnings = self._accuracy.compare(rows[::every], companion, times_s)
        return [
            {"event": "warning", "tick": round(time_s * TICK_RATE_HZ), "time_s": time_s, "text": text}
            for time_s, text in warnings
        ]

    def submit(self, name: str, request: dict[str, Any]) -> int:
        """Check a command and schedule it for the current tick.

        Returns:
            The tick at which it takes effect.

        Raises:
            InputError: It is unknown, malformed, out of range, or not possible now.
        """
        command, self.command_result = check_command(name, request), {}
        if command.MECHANICAL and self.scene.generator is not None:
            raise InputError(name, "left out: signals of a [generator] replace the physics", Words("a command to it"))
        if not command.is_implemented():
            raise command.refusal()
        self.command_result = command.check(self, [other for tick, other in self.pending if tick <= self.tick])
        insort(self.pending, (self.tick, command), key=lambda entry: entry[0])
        return self.tick

    def set_transports(self, transports: tuple[str, ...]) -> None:
        """Set the transports of the rig.

        Raises:
            InputError: The scene has a fault of a transport that does not exist.
        """
        self.faults.transports = transports
        self.faults.check_all(self.pending)

    def warm_up(self) -> None:
        """Compile (or load) every kernel that `advance` will call, without advancing."""
        if not self._warm:
            twin = Simulation(self.scene, begin=self.begin)
            twin.advance(twin.block_ticks)
            twin._motion.warm_up(twin._engines[0], twin.model.constants, twin._inputs())
            self._warm = True

    def health(self) -> dict[str, Any]:
        """Return spin, energy ledger, warnings and remarks at the current tick, for the status.

        Warnings are reasons to doubt the run; remarks report states of the model, such as a contact law held at 0.
        """
        if self.scene.generator is not None:
            return calibrator.health(self.scene)
        first = self.first_row
        last = first if self._last is None else self._last
        balance = energy_balance(last[None, :], first)
        residual, dissipated = float(balance["residual"][0]), float(balance["dissipated"][0])
        memory, warnings, remarks = self._motion.memory, list[str](), list[str]()
        share = min(float(memory[ROLLED_S]) * TICK_RATE_HZ / max(self.tick - self._start, 1), 1.0)
        choice = {**self.scene.engine.model_dump(), "step_us": self._step_ticks, "rolling_share": share}
        accuracy = self._accuracy.copy_completed()
        if text := accuracy.warning():
            warnings.append(text)
        # Scale of the residual: the larger of the dissipated and the stored energy.
        turned_over = max(dissipated, abs(float(balance["stored"][0])), 1e-6)
        if abs(residual) > self._method.energy * turned_over:
            text = f"energy residual {residual:.2e} J is above {self._method.energy:g} of the converted energy"
            if abs(residual) > BRANCH_ALARM * turned_over and memory[CONTACTS] > 1:
                text += "; after contacts, a wrong branch is suspected"
            warnings.append(text)
        if memory[CLAMPS]:
            remarks.append(f"the contact law would have pulled at {memory[CLAMPS]:.0f} steps and was held at 0")
        late_commands = sum(tick >= self.end_tick for tick, _ in self.pending)
        if late_commands:
            warnings.append(f"{late_commands} commands of the scene lie after its end and will not be executed")
        if memory[CEILING]:
            warnings.append(
                f"{memory[CEILING]:.0f} steps with events that piled up, or above engine.tolerance at least size"
            )
        if memory[FLOORED]:
            remarks.append(f"{memory[FLOORED]:.0f} contacts began slower than contact.speed_floor")
        return {
            "spin_hz": float(last[COLUMN["theta_rate"]]) / (2.0 * math.pi),
            "energy": {
                "residual_j": residual,
                "dissipated_j": dissipated,
                "residual_share": residual / max(dissipated, 1e-6),
                "alarm_share": self._method.energy,
            },
            "accuracy": None if self._companion is None else accuracy.document(),
            "engine": {**choice, "levels": self.scene.model.model_dump()},
            "motion": self._watch.document(),
            "contacts": int(memory[CONTACTS]),
            "peak_normal_force_n": float(memory[PEAK_FORCE]),
            "steps": int(memory[STEPS]),
            "warnings": warnings,
            "remarks": remarks,
        }

    def snapshot(self) -> Snapshot:
        """Return the whole changing state of a run; `restore` continues from it bit for bit, with the same build."""
        _ = self.first_row
        return Snapshot(scene=self.scene, state=copy.deepcopy({name: self.__dict__[name] for name in _STATE_FIELDS}))

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of the same scene; at the start, also from one of the scene without commands.

        Until its first command, a run is identical to a run without commands.

        Raises:
            InputError: The snapshot is of another scene, or after the first command.
        """
        state = copy.deepcopy(snapshot.state)
        if snapshot.scene != self.scene:
            first_tick = min((tick for tick, _ in self.pending), default=state["tick"])
            same_scene = snapshot.scene == self.scene.model_copy(update={"commands": ()})
            if self.tick > self._start or first_tick < state["tick"] or not same_scene:
                raise InputError("snapshot", f"one of this scene, {self.scene.name}", snapshot.scene.name)
            state["pending"] = self.pending
        self.__dict__.update(state)

    def catalogue(self) -> dict[str, Any]:
        """Return the channel table with calibrations, and the columns of the truth tables, as a JSON document."""
        signals = {signal.name: signal for signal in S.ROW}
        return {
            "root": ROOT,
            "tick_rate_hz": TICK_RATE_HZ,
            "table": self.table.model_dump(mode="json"),
            "truth": {
                name: {
                    "rate_hz": self.scene.sensors.truth_rate_hz,
                    "columns": [signals[column]._asdict() for column in S.TRUTH[name]],
                }
                for name in self._truth_parts
            },
        }

    def parameters_document(self) -> dict[str, Any]:
        """Return the parameters as a JSON document."""
        return describe(self.model)

    def scene_document(self) -> dict[str, Any]:
        """Return the scene as a JSON document."""
        return {"name": self.scene.name, "seed": self.scene.seed, "scene": scene_document(self.scene)}

    def _segment(self) -> Segment:
        return next(segment for segment in reversed(self._segments) if segment.tick <= self.tick)

    def _speed(self) -> float:
        """Return the current speed target of the drive [rad/s]."""
        segment = self._segment()
        return segment.speed + segment.slope * (self.tick - segment.tick) / TICK_RATE_HZ

    def _take_effect(self, events: list[dict[str, Any]]) -> None:
        while self.pending and self.pending[0][0] <= self.tick:
            command = self.pending.pop(0)[1]
            event: dict[str, Any] = {"event": command.command, "tick": self.tick, "time_s": self.tick / TICK_RATE_HZ}
            event |= command.model_dump(exclude={"command"})
            events += [event | more for more in command.take_effect(self)]

    def ramp_to(self, speed_hz: float) -> None:
        """Ramp the drive to a speed at its ramp rate."""
        rate = self.model.parameters["drive.ramp_rate"]
        self._segments = ramp(self.tick, self._speed(), speed_hz, rate, TICK_RATE_HZ)

    def release_magnets(self) -> None:
        """Switch the magnets off."""
        # The energy stored in the magnets is lost: it is booked, so that the ledger closes. The magnets may already be
        # released by a client when the scene's release follows.
        if not self.inputs["magnet_engaged"]:
            return
        shaft, magnet = self.model.constants.shaft, self.model.constants.magnet
        for motion in self._motions():
            gamma, beta = motion.y[0], motion.y[1]
            x, y = beta, -gamma
            if self.model.constants.levels.euler:
                x, y = math.sin(beta), -math.sin(gamma) * math.cos(beta)
            _, _, stored = magnet_force(shaft.arm_magnet * x, shaft.arm_magnet * y, magnet)
            motion.y[S.RELEASE_WORK] -= stored
        self.inputs["magnet_engaged"] = False

    def _next_change(self) -> int:
        ticks = [segment.tick for segment in self._segments if segment.tick > self.tick]
        ticks += [tick for tick, _ in self.pending]
        if self.inputs["hammer_end"] > self.tick:
            ticks.append(self.inputs["hammer_end"])
        return min(ticks, default=2**62)

    def _inputs(self) -> Inputs:
        segment = self._segment()
        return Inputs(
            tick_s=1.0 / TICK_RATE_HZ,
            speed=segment.speed,
            speed_slope=segment.slope,
            speed_tick=segment.tick,
            ideal_drive=self.scene.drive.mode == "ideal",
            **self.inputs,
        )

    def _condition(self, rows: np.ndarray, tick: int) -> dict[str, np.ndarray]:
        return self.faults.counts(rows, self._formulas.values(rows), tick)

    def _sample(self, counts: list[dict[str, np.ndarray]], start: int) -> dict[str, Block]:
        blocks = {}
        for name, group in self.table.groups.items():
            values = counts[0][name] if len(counts) == 1 else np.concatenate([part[name] for part in counts])
            # The first sample at or after the start, to the nearest tick.
            index = -(-start * group.rate_hz // TICK_RATE_HZ)
            tick = round(index * TICK_RATE_HZ / group.rate_hz)
            blocks[name] = self._block(tick, index, group.rate_hz, values)
        return blocks

    def _edges(self, rows: np.ndarray, start: int) -> Block | None:
        if self._keyphasor is None:
            return None
        edges = self._keyphasor.edges(rows, self.row_ticks)
        edges = self.faults.edges(edges, rows, start)
        index, self._edge_count = self._edge_count, self._edge_count + len(edges)
        return self._block(start, index, 0, edges[:, None]) if len(edges) else None

    def _truth(self, rows: np.ndarray, start: int) -> dict[str, Block]:
        rate = self.scene.sensors.truth_rate_hz
        kept = rows[:: self._truth_every, self._truth_columns]
        index = start * rate // TICK_RATE_HZ
        return {name: self._block(start, index, rate, kept[:, part]) for name, part in self._truth_parts.items()}

    def _block(self, tick: int, index: int, rate_hz: int, values: np.ndarray) -> Block:
        return Block(tick, index, float(rate_hz), float(TICK_RATE_HZ), values)
