"""Replacements of engine, sensors and keyphasor in scenes of test signals (`rig.channels.generators`)."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from typing import Any

import numpy as np

from rig.channels.faults import At, Kind, connect_swaps
from rig.channels.faults.delivery import Active
from rig.channels.generators import Instants, VoltageSource, exact
from rig.channels.sampling import TICKS_HZ
from rig.channels.sensors.keyphasor import FRACTIONS
from rig.channels.sensors.noise import noise_streams
from rig.channels.table import Group
from rig.physics.engines import Engine
from rig.physics.kernels.constants import Constants, Inputs
from rig.physics.kernels.signals import SPIN_RATE, THETA_RATE
from rig.run.scenes import Scene


def _stand_still(
    constants: Constants, inputs: Inputs, y: Any, memory: Any, tick: int, step: int, steps: int, stride: int, rows: Any
) -> None:
    """Fill rows without motion, at the nominal speed of the shaft."""
    rows[:] = 0.0
    rows[:, THETA_RATE] = rows[:, SPIN_RATE] = inputs.speed


STILL = Engine(start=lambda *_: None, advance=_stand_still, order=0)
"""Engine of scenes without physics."""


class Calibrator:
    """Source of the counts of all channels: volts of generators, noise, converter.

    Replaces the conditioning of sensors.

    Args:
        groups: The channel groups.
        sources: Signal at the converter of each channel.
        seed: Seed of the noise, which is that of the sensors: a separate stream for every channel.
        noise: Whether to add noise.
        row_ticks: Ticks per row.
        tick: Tick of the first row.
    """

    def __init__(
        self,
        groups: Iterable[Group],
        sources: dict[str, VoltageSource],
        *,
        seed: int,
        noise: bool,
        row_ticks: int,
        tick: int = 0,
    ) -> None:
        self.groups = tuple(groups)
        self._sources, self._row_ticks, self._tick = sources, row_ticks, tick
        self._waves = {name: source.wave for name, source in sources.items()}
        names = [name for group in self.groups for name in group.names]
        self._noise = dict(zip(names, map(_normal, noise_streams(names, seed)), strict=True)) if noise else {}

    def __deepcopy__(self, memo: dict[int, Any]) -> Calibrator:
        """Return a copy with a separate noise state; constant parts are shared."""
        other = copy.copy(self)
        other.__dict__["_noise"] = copy.deepcopy(self._noise)
        return other

    @property
    def columns(self) -> np.ndarray:
        """Column of each channel's signal in the rows: none, shape (0,)."""
        return np.empty(0, int)

    def volts(self, name: str, instants: Instants) -> np.ndarray:
        """Return the voltage at the converter of a channel at any instants [V], shape (n,)."""
        source = self._sources[name]
        return source.to_volts(source.compute_wave(instants))

    def counts(
        self, rows: np.ndarray, formula_values: np.ndarray | None = None, faults: GeneratedFaults | None = None
    ) -> dict[str, np.ndarray]:
        """Return the samples from the first of these rows up to the last fault.

        Args:
            rows: Rows that follow those of the previous call, shape (n, N_ROW); only their number is used.
            formula_values: Ignored.
            faults: Changes of volts and counts on faulty channels.

        Returns:
            ADC counts by group, int32, shape (samples, channels).
        """
        start, self._tick = self._tick, self._tick + (len(rows) - 1) * self._row_ticks
        counts_by_group, shapes = {}, dict[tuple[int, Any], np.ndarray]()
        for group in self.groups:
            rate = group.rate_hz
            first, end = (-(-tick * rate // TICKS_HZ) for tick in (start, self._tick))
            n = np.arange(first, end)
            instants = Instants.from_samples(n, rate)
            counts = counts_by_group[group.name] = np.empty((end - first, len(group.channels)), np.int32)
            for c, channel in enumerate(group.channels):
                source, key = self._sources[channel.name], (rate, self._waves[channel.name])
                if key not in shapes:
                    shapes[key] = source.compute_wave(instants)
                volts = source.to_volts(shapes[key])
                if faults is not None and (changed := faults.volts(channel.name, n)) is not None:
                    volts = changed
                if self._noise:
                    volts = volts + channel.noise_v * self._noise[channel.name].standard_normal(end - first)
                half = 2.0 ** (channel.adc_bits - 1)
                whole = np.rint(volts / channel.lsb_v)
                if faults is not None:
                    whole = faults.counts(channel.name, n, whole)
                counts[:, c] = np.clip(whole, -half, half - 1.0)
        return counts_by_group


class GeneratedFaults:
    """Faults of test signals: changes of the volts at the exact instants of samples, and of the counts.

    Args:
        calibrator: Source of the healthy signals.
        faults: Faults of each faulty channel, by name.
    """

    def __init__(self, calibrator: Calibrator, faults: Mapping[str, list[Active]]) -> None:
        self._calibrator, self._faults = calibrator, faults
        swaps = {one.id: one for faults_here in faults.values() for one in faults_here}
        self._plugs = connect_swaps(swaps[number] for number in sorted(swaps))
        self._channels = {channel.name: channel for group in calibrator.groups for channel in group.channels}

    def _iterate_faults(self, name: str, n: np.ndarray) -> Iterator[tuple[Kind, At]]:
        channel = self._channels[name]
        none = np.empty(0)
        for fault in self._faults.get(name, []):
            t = n / channel.rate_hz - fault.begin / TICKS_HZ
            draw, kept = fault.draws[name], fault.kept
            yield (
                fault.what,
                At(t, n, channel, draw, kept, lambda x: self._other_volts(x, n, name), none, none, lambda x: x),
            )

    def _sensor_volts(self, name: str, instants: Instants, faults_at: Iterable[tuple[Kind, At]]) -> np.ndarray:
        """Return the output of a sensor with the faults of its transducer [V]."""
        channel = self._channels[name]
        x = (self._calibrator.volts(name, instants) - channel.bias_v) / channel.sensitivity_v
        for what, at in faults_at:
            x = what.signal(x, at)
        return channel.bias_v + channel.sensitivity_v * x

    def _other_volts(self, name: str, n: np.ndarray, at: str) -> np.ndarray:
        channel = self._channels[name]
        instants = Instants.from_samples(n, self._channels[at].rate_hz)
        return self._sensor_volts(name, instants, ()) - channel.bias_v

    def volts(self, name: str, n: np.ndarray) -> np.ndarray | None:
        """Return the volts at the converter in the samples of these numbers, shape (n,); None for a healthy channel."""
        if name not in self._faults or not len(n):
            return None
        faults_at, late_s = list(self._iterate_faults(name, n)), np.zeros(len(n))
        for what, at in faults_at:
            late_s += np.minimum(what.late_s(at), at.t)  # not before the fault
        source = self._plugs.get(name, name)
        instants = Instants.from_samples(n, self._channels[name].rate_hz).delay(late_s)
        volts = self._sensor_volts(source, instants, faults_at if source == name else self._iterate_faults(source, n))
        for what, at in faults_at:
            volts = what.volts(volts, at)
        return volts

    def counts(self, name: str, n: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Return the counts with the faults of the converter, before limiting, shape (n,)."""
        for what, at in self._iterate_faults(name, n):
            counts = what.counts(counts, at) if len(n) else counts
        return counts


def _normal(stream: np.ndarray) -> np.random.Generator:
    """Return the generator of one of the sensors' noise streams."""
    bits = np.random.SFC64(0)
    state = bits.state
    state["state"]["state"] = stream
    bits.state = state
    return np.random.Generator(bits)


class NominalKeyphasor:
    """Replacement of the keyphasor: edges at the whole turns of a nominal speed, none at speed 0.

    Args:
        speed_hz: The speed [Hz].
        tick: Tick of the first row.
    """

    def __init__(self, speed_hz: float, tick: int = 0) -> None:
        self.edges_seen = 0
        self._speed, self._tick = exact(speed_hz), tick

    def edges(self, rows: np.ndarray, row_ticks: int) -> np.ndarray:
        """Return the edges from the first of these rows up to the row after the last.

        Args:
            rows: Rows that follow those of the previous call, shape (n, N_ROW); only their number is used.
            row_ticks: Ticks per row.

        Returns:
            Instants in ticks from the first of these rows, with fractions, shape (edges,).
        """
        start, self._tick = self._tick, self._tick + len(rows) * row_ticks
        if not self._speed:
            return np.empty(0)
        turn = TICKS_HZ / self._speed
        first, end = (-(-Fraction(tick) // turn) for tick in (max(start, 1), self._tick))
        self.edges_seen += end - first
        return np.array([(round(n * turn * FRACTIONS) - start * FRACTIONS) / FRACTIONS for n in range(first, end)])


def build_replacements(scene: Scene, *, row_ticks: int, tick: int) -> tuple[list[Any], Any]:
    """Return the replacements of the conditioners and of the keyphasor for a scene with a generator.

    Args:
        scene: The scene.
        row_ticks: Ticks per row.
        tick: Tick of the first row.
    """
    sensors = scene.sensors
    noise = sensors.noise and sensors.chain == "full"
    groups = scene.table.groups.values()
    calibrator = Calibrator(groups, scene.sources(), seed=scene.seed, noise=noise, row_ticks=row_ticks, tick=tick)
    return [calibrator], NominalKeyphasor(scene.drive.speed_hz, tick)


def health(scene: Scene) -> dict[str, Any]:
    """Return the health of a run with a generator: nominal speed, and channels driven beyond the converter."""
    sources = scene.sources().items()
    limited = [name for name, source in sources if source.max_abs_v > source.channel.adc_v + source.channel.lsb_v]
    warning = f"driven beyond the converter, which limits: {', '.join(limited)}"
    return {"spin_hz": scene.drive.speed_hz, "contacts": 0, "warnings": [warning] if limited else []}
