"""Test signals: the `[generator]` of a scene replaces the physics on the channels.

A generator acts as a calibrator at the converter's input. Its voltage is computed at the exact sampling instants,
without model, sensor, range, anti-alias filter or AC coupling. The channel's noise is added if the scene has noise on,
and its converter rounds and limits. The voltage of a channel is

    v(t) = bias_v + offset + amplitude w(t - delay)

with the wave `w` of one of the `KINDS` below, |w| <= 1. Amplitude and offset are in volts (`amplitude_v`, `offset_v`)
or in the channel's unit. `[generator.channels.NAME]` overrides single channels. Time is split into whole seconds and
remainder, and frequencies are taken as exact decimal fractions: phases are as exact after hours as at the start, and
depend only on the instant. A jump is located to within 1e-9 of its period.

If the scene has a `drive.speed_hz`, the exact edges and the channels of the signals `keyphasor` (a pulse over the first
10 degrees) and `spin_rate` follow this nominal speed; otherwise these channels are like all others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, field_validator

from rig.base.checks import Written
from rig.base.errors import InputError, UnknownNameError, Words
from rig.channels.table import Channel, ChannelTable
from rig.channels.waveform import Waveform, exact, read_waveform

_WRAP_TOLERANCE = 1e-11
"""Rounding tolerance of a phase below a whole period [periods]."""
_EDGE_TOL = 1e-9
"""Tolerance by which an instant before an edge counts as after it [steps or chips]."""
_PULSE_LENGTH = Fraction(10, 360)
"""Length of a pulse [periods]: that of the keyphasor mark."""
_MAX_TONES, _MAX_LINE = 256, 4096
"""Largest number of tones, and largest multiple of their common base frequency."""

_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Hz = Annotated[_Number, Field(ge=1e-6, le=1e6)]
_Kind = Literal["sine", "two-tone", "chirp", "step", "pulse", "prbs", "multisine", "ramp", "quiet", "recorded"]


class Instants(NamedTuple):
    """Instants as whole seconds, int64, and remainder, 0 to 1 s, both shape (n,)."""

    seconds: np.ndarray
    fraction: np.ndarray

    @classmethod
    def from_samples(cls, index: np.ndarray, rate_hz: int) -> Instants:
        """Return the instants of samples from their numbers and rate [Hz]."""
        seconds, fraction = np.divmod(index, rate_hz)
        return cls(seconds, fraction / rate_hz)

    @classmethod
    def from_times(cls, times_s: np.ndarray) -> Instants:
        """Return the instants of arbitrary times [s]."""
        seconds = np.floor(times_s)
        return cls(seconds.astype(np.int64), times_s - seconds)

    def delay(self, delay_s: float | np.ndarray) -> Instants:
        """Return the instants reduced by a delay [s], a number or one per instant, shape (n,)."""
        fraction = self.fraction - delay_s
        carry = np.floor(fraction)
        return Instants(self.seconds + carry.astype(np.int64), fraction - carry)

    def cycles(self, frequency: Fraction, phase_lead: float = 0.0) -> np.ndarray:
        """Return the phase in periods, 0 to 1, shape (n,).

        Args:
            frequency: Periods per second [Hz].
            phase_lead: Phase at time zero [periods].
        """
        if not len(self.seconds):
            return np.empty(0)
        first = int(self.seconds.min())
        start_phases = np.array([float(frequency * second % 1) for second in range(first, int(self.seconds.max()) + 1)])
        turns = start_phases[self.seconds - first] + float(frequency) * self.fraction + phase_lead
        turns -= np.floor(turns)
        turns[turns > 1.0 - _WRAP_TOLERANCE] = 0.0
        return turns


class Signal(Written):
    """Signal of a generator, or the overrides for one channel; omitted fields have the kind's default, or 0."""

    kind: _Kind | None = None
    amplitude: Annotated[_Number, Field(ge=-1e9, le=1e9)] | None = None
    """Peak [unit of the channel]."""
    amplitude_v: Annotated[_Number, Field(ge=-1e3, le=1e3)] | None = None
    """Peak [V]; a ramp without one spans the range of the converter."""
    offset: Annotated[_Number, Field(ge=-1e9, le=1e9)] | None = None
    """Mean level, relative to the value at the bias voltage [unit of the channel]."""
    offset_v: Annotated[_Number, Field(ge=-1e3, le=1e3)] | None = None
    """Mean level, relative to the bias voltage [V]."""
    phase_deg: Annotated[_Number, Field(ge=-360.0, le=360.0)] | None = None
    """Phase lead, in periods, sweeps or sequences of 360 degrees; for a PRBS rounded to whole chips [degrees]."""
    delay_us: Annotated[_Number, Field(ge=-1e6, le=1e6)] | None = None
    """Delay [us]."""
    frequency_hz: _Hz | None = None
    """Frequency of a sine or of pulses; chip rate of a PRBS [Hz]."""
    frequencies: Annotated[tuple[_Hz, ...], Field(min_length=2, max_length=_MAX_TONES)] | None = None
    """Frequencies of the tones; start and end of a chirp [Hz]."""
    period_s: Annotated[_Number, Field(ge=1e-5, le=1000.0)] | None = None
    """Period of steps, ramp or sweep [s]."""
    order: Annotated[int, Field(ge=3, le=20)] | None = None
    """Length of the shift register; a PRBS has 2^order - 1 chips."""
    seed: Annotated[int, Field(ge=1, lt=2**20)] | None = None
    """Initial state of the shift register."""
    crest: Annotated[_Number, Field(ge=1.0, le=30.0)] | None = None
    """Ratio of peak to RMS; omitted, that of Schroeder's phases."""


class Generator(Signal):
    """Signal of all channels, with overrides for single channels."""

    apart: bool = False
    """Spread the phases of the channels evenly over a period, so that each channel can be identified."""
    file: Waveform | None = None
    """CSV file in the format of `rig export`, for kind recorded."""
    channels: dict[str, Signal] = Field(default={})

    @field_validator("file", mode="before")
    @classmethod
    def _read(cls, file: Any) -> Any:
        return read_waveform(Path(file)) if isinstance(file, str | Path) else file


@dataclass(frozen=True, eq=False)
class VoltageSource:
    """Voltage source at the converter of one channel.

    Attributes:
        channel: The channel.
        signal: Signal with all fields of its kind.
        amplitude_v: Peak [V].
        middle_v: Bias plus offset [V].
        phase_lead: Phase at time zero [periods].
        waveform: Period and spline of a recorded waveform [unit of the channel]; None for other kinds.
    """

    channel: Channel
    signal: Signal
    amplitude_v: float
    middle_v: float
    phase_lead: float
    waveform: tuple[Fraction, np.ndarray] | None = None

    @property
    def max_abs_v(self) -> float:
        """Largest magnitude of the voltage [V]."""
        top = 1.0 if self.waveform is None else max(map(abs, self.waveform[1][3].tolist()))
        return abs(self.middle_v) + abs(self.amplitude_v) * (top if self.signal.kind != "quiet" else 0.0)

    @property
    def wave(self) -> tuple[Any, ...]:
        """Key that is equal for channels with equal waves."""
        signal = self.signal
        differing = {"amplitude", "amplitude_v", "offset", "offset_v", "phase_deg", "delay_us"}
        shape = () if self.waveform is None else (self.channel.name,)
        return (signal.model_dump_json(exclude=differing), signal.delay_us, self.phase_lead, *shape)

    def compute_wave(self, instants: Instants) -> np.ndarray:
        """Return the wave w, shape (n,)."""
        signal = self.signal
        return KINDS[signal.kind or "quiet"].wave(self, instants.delay((signal.delay_us or 0.0) * 1e-6))

    def volts(self, times_s: np.ndarray) -> np.ndarray:
        """Return the voltage at the converter, before noise and limits [V], shape (n,).

        Args:
            times_s: Instants [s], shape (n,).
        """
        return self.to_volts(self.compute_wave(Instants.from_times(np.asarray(times_s, float))))

    def to_volts(self, wave: np.ndarray) -> np.ndarray:
        """Return the voltage for a wave [V]."""
        return self.middle_v + self.amplitude_v * wave


def _sine(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return a sine: w = sin(2 pi (f t + phase/360))."""
    return np.sin(2.0 * np.pi * instants.cycles(_frequency(source), source.phase_lead))


def _two_tone(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return two tones: w = (sin(2 pi (f1 t + phase/360)) + sin(2 pi (f2 t + phase/360))) / 2, at most 1."""
    tones = [instants.cycles(exact(hz), source.phase_lead) for hz in source.signal.frequencies or ()]
    return np.sum([0.5 * np.sin(2.0 * np.pi * turns) for turns in tones], axis=0)


def _chirp(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return repeated linear sweeps from f1 to f2: w = sin(2 pi (f1 s + (f2 - f1) s^2 / (2 T))), s = t mod T."""
    low, high = source.signal.frequencies or (0.0, 0.0)
    part, period_s = instants.cycles(1 / _period(source), source.phase_lead), float(_period(source))
    turns = period_s * part * (low + 0.5 * (high - low) * part)
    return np.sin(2.0 * np.pi * (turns - np.floor(turns)))


def _step(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return steps: w = -1 in the first half of each period, 1 in the second."""
    return np.where(
        np.floor(2.0 * instants.cycles(1 / _period(source), source.phase_lead) + _EDGE_TOL) == 1.0, 1.0, -1.0
    )


def _pulse(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return pulses: w = 1 in the first 10/360 of each period, else 0."""
    return np.where(instants.cycles(_frequency(source), source.phase_lead) + _EDGE_TOL < float(_PULSE_LENGTH), 1.0, 0.0)


def _prbs(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return a pseudo-random binary sequence: w = 1 or -1, chip floor(f t) modulo 2^order - 1 (see `chips`)."""
    sequence = chips(source.signal.order or 0, source.signal.seed or 1)
    length = len(sequence)
    turns = instants.cycles(_frequency(source) / length, round(source.phase_lead * length) / length)
    return sequence[np.floor(turns * length + _EDGE_TOL).astype(np.int64) % length]


def _multisine(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return a multisine: w = sum cos(2 pi (f_k t + phase/360) - s pi k^2 / N) / peak, k = 0..N-1, s by the crest."""
    frequencies = source.signal.frequencies or ()
    phases, peak = multisine_phases(frequencies, source.signal.crest)
    total = np.zeros(len(instants.seconds))
    for hz, phase in zip(frequencies, phases.tolist(), strict=True):
        total += np.cos(2.0 * np.pi * instants.cycles(exact(hz), source.phase_lead) + phase)
    return total / peak


def _ramp(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return a ramp: w = 2 ((t/T) mod 1) - 1; without an amplitude, it passes every code of the converter."""
    return 2.0 * instants.cycles(1 / _period(source), source.phase_lead) - 1.0


def _quiet(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return w = 0, which leaves bias, offset and noise."""
    return np.zeros(len(instants.seconds))


def _recorded(source: VoltageSource, instants: Instants) -> np.ndarray:
    """Return a repeated recording: w = periodic cubic spline through the waveform's values, in the channel's unit."""
    assert source.waveform is not None
    period, pieces = source.waveform
    rows = pieces.shape[1]
    position = instants.cycles(1 / period, source.phase_lead) * rows
    piece = np.minimum(position.astype(np.int64), rows - 1)
    remainder, (a, b, c, d) = position - piece, pieces[:, piece]
    return ((a * remainder + b) * remainder + c) * remainder + d


class SignalKind(NamedTuple):
    """Kind of signal: wave, required fields, and optional fields other than phase, delay and offset."""

    wave: Callable[[VoltageSource, Instants], np.ndarray]
    required: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    amplitude: bool | None = True
    """Amplitude: required (True), optional (None) or not allowed (False)."""


KINDS: dict[str, SignalKind] = {
    "sine": SignalKind(_sine, ("frequency_hz",)),
    "two-tone": SignalKind(_two_tone, ("frequencies",)),
    "chirp": SignalKind(_chirp, ("frequencies", "period_s")),
    "step": SignalKind(_step, ("period_s",)),
    "pulse": SignalKind(_pulse, ("frequency_hz",)),
    "prbs": SignalKind(_prbs, ("frequency_hz", "order"), ("seed",)),
    "multisine": SignalKind(_multisine, ("frequencies",), ("crest",)),
    "ramp": SignalKind(_ramp, ("period_s",), amplitude=None),
    "quiet": SignalKind(_quiet, amplitude=False),
    "recorded": SignalKind(_recorded, amplitude=False),
}
"""All kinds by name; the docstring of each wave states its equation."""
_OFFSETS, _AMPLITUDES, _SHIFTS = ("offset", "offset_v"), ("amplitude", "amplitude_v"), ("phase_deg", "delay_us")


def sources(generator: Generator, table: ChannelTable, speed_hz: float = 0.0) -> dict[str, VoltageSource]:
    """Return the source of every channel.

    Args:
        generator: Generator of the scene.
        table: Channel table.
        speed_hz: Nominal speed [Hz]; 0 for none.

    Raises:
        InputError: The generator is invalid; the message names the first wrong field.
    """
    for name in generator.channels:
        if name not in table.channels:
            raise UnknownNameError("generator.channels", "names of channels", name, table.channels)
    recorded = "recorded" in (generator.kind, *(own.kind for own in generator.channels.values()))
    if (generator.file is not None) != recorded:
        received = None if recorded else Words(f"one with kind {generator.kind}")
        raise InputError("generator.file", "given with kind recorded, and with no other", received)
    return {
        name: _source(generator, channel, number / len(table.channels), speed_hz)
        for number, (name, channel) in enumerate(table.channels.items())
    }


def _source(generator: Generator, channel: Channel, position: float, speed_hz: float) -> VoltageSource:
    own = generator.channels.get(channel.name)
    if own is None and speed_hz > 0.0:
        if channel.signal == "keyphasor":
            generator = Generator(kind="pulse", frequency_hz=speed_hz, amplitude=1.0 / channel.si)
        elif channel.signal == "spin_rate":
            generator = Generator(kind="quiet", offset=2.0 * math.pi * speed_hz / channel.si)
    signal = _merge_fields(generator, {}, generator.kind, "generator")
    if own is not None:
        signal = _merge_fields(own, signal, own.kind or generator.kind, f"generator.channels.{channel.name}")
    merged = Signal(**signal)
    field = "generator" if own is None else f"generator.channels.{channel.name}"
    _check_rate(merged, channel, field)
    gain, phase_lead = channel.sensitivity_v, (merged.phase_deg or 0.0) / 360.0 + (position if generator.apart else 0.0)
    offset_v = merged.offset_v if merged.offset_v is not None else (merged.offset or 0.0) * gain
    peak_v = merged.amplitude_v if merged.amplitude_v is not None else (merged.amplitude or 0.0) * gain
    source = VoltageSource(channel, merged, peak_v, channel.bias_v + offset_v, phase_lead)
    if merged.kind == "ramp" and not {*_AMPLITUDES} & {*signal}:
        source = replace(source, amplitude_v=channel.adc_v, middle_v=offset_v)
    if merged.kind == "recorded":
        file = generator.file
        if file is None or file.units.get(channel.name) != channel.unit:
            must = f"with a column `{channel.name} [{channel.unit}]` (or another kind for this channel)"
            raise InputError("generator.file", must, sorted(file.values) if file else None)
        source = replace(source, amplitude_v=gain, waveform=(file.period, file.spline(channel.name)))
    return source


def _merge_fields(signal: Signal, base: dict[str, Any], kind: str | None, field: str) -> dict[str, Any]:
    """Return the fields of a signal merged over those of another, limited to those of its kind.

    Raises:
        InputError: A field is not used by the kind, is missing, or is stated twice.
    """
    if kind is None:
        raise InputError(f"{field}.kind", f"one of {', '.join(KINDS)}", None)
    rule = KINDS[kind]
    accepted = {*rule.required, *rule.optional, *_OFFSETS, *(_AMPLITUDES if rule.amplitude is not False else ())}
    accepted |= {*_SHIFTS} if kind != "quiet" else set()
    own = {name: value for name in Signal.model_fields if (value := getattr(signal, name)) is not None}
    for name in own:
        if name != "kind" and name not in accepted:
            raise InputError(f"{field}.{name}", f"left out with kind {kind}", own[name])
    for pair in (_OFFSETS, _AMPLITUDES):
        if {*pair} <= {*own}:
            raise InputError(f"{field}.{pair[0]}", f"left out where {pair[1]} is given", own[pair[0]])
    restated = {name for pair in (_OFFSETS, _AMPLITUDES) if {*pair} & {*own} for name in pair}
    merged = {name: value for name, value in base.items() if name in accepted - restated} | own | {"kind": kind}
    for name in (*rule.required, *(("amplitude_v",) if rule.amplitude and not {*_AMPLITUDES} & {*merged} else ())):
        if name not in merged:
            raise InputError(f"{field}.{name}", f"given with kind {kind}", None)
    if kind in ("two-tone", "chirp") and len(merged["frequencies"]) != 2:
        raise InputError(f"{field}.frequencies", f"two with kind {kind}", list(merged["frequencies"]))
    if kind == "multisine":
        try:
            multisine_phases(merged["frequencies"], merged.get("crest"))
        except InputError as error:
            raise InputError(f"{field}.{error.field}", error.must, error.received) from None
    return merged


def _check_rate(signal: Signal, channel: Channel, field: str) -> None:
    """Refuse frequencies above the limit of the channel's rate; there is no filter before the converter."""
    for name in ("frequency_hz", "frequencies", "period_s"):
        value = getattr(signal, name)
        if value is None:
            continue
        highest = 1.0 / value if name == "period_s" else max(value if isinstance(value, tuple) else (value,))
        # A chip lasts at least one sample.
        limit = channel.rate_hz / (1.0 if signal.kind == "prbs" else 2.0)
        if highest > limit or (highest == limit and signal.kind != "prbs"):
            must = f"at most {limit:g} Hz" if signal.kind == "prbs" else f"below {limit:g} Hz, half of the rate"
            raise InputError(f"{field}.{name}", f"{must} of {channel.name}, whose converter has no filter", value)


def _frequency(source: VoltageSource) -> Fraction:
    return exact(source.signal.frequency_hz or 1.0)


def _period(source: VoltageSource) -> Fraction:
    return exact(source.signal.period_s or 1.0)


_TAPS = {
    3: 2, 4: 3, 5: 3, 6: 5, 7: 6, 8: (6, 5, 4), 9: 5, 10: 7, 11: 9, 12: (11, 10, 4), 13: (12, 11, 8),
    14: (13, 12, 2), 15: 14, 16: (15, 13, 4), 17: 14, 18: 11, 19: (18, 17, 14), 20: 17,
}  # fmt: skip
"""Taps in addition to the last one: primitive polynomials (P. Alfke, Xilinx XAPP052, 1996, and older tables)."""


@cache
def chips(order: int, seed: int) -> np.ndarray:
    """Return one period of a shift register's sequence: 1 and -1, shape (2^order - 1,).

    The register starts with the lowest bits of the seed (1 if these are all zero). Each chip is the last bit; the sum
    modulo 2 of the taps is shifted in.
    """
    length, taps = 2**order - 1, _TAPS[order]
    positions = [order, *(taps if isinstance(taps, tuple) else (taps,))]
    register, sequence = seed & length or 1, np.empty(length)
    for n in range(length):
        sequence[n] = 2 * (register >> (order - 1)) - 1
        bit = 0
        for tap in positions:
            bit ^= register >> (tap - 1)
        register = (register << 1 | bit & 1) & length
    sequence.flags.writeable = False
    return sequence


@cache
def multisine_phases(frequencies: tuple[float, ...], crest: float | None) -> tuple[np.ndarray, float]:
    """Return the phases of equal cosines with a given crest factor, and the peak of their sum.

    Schroeder's phases (IEEE Trans. Inf. Theory 16(1), 1970) are scaled by s. From s = 1 to s = 0, where all cosines are
    in phase, the crest factor rises from about 1.7 to sqrt(2 N). The value of s is found by bisection.

    Args:
        frequencies: Frequencies [Hz].
        crest: Required crest factor; None for that of Schroeder's phases.

    Raises:
        InputError: No s gives the crest factor, or the frequencies have no common base frequency.
    """
    ratios = [exact(hz) for hz in frequencies]
    scale = math.lcm(*(hz.denominator for hz in ratios))
    base = Fraction(math.gcd(*(int(hz * scale) for hz in ratios)), scale)
    lines = [int(hz / base) for hz in ratios]
    if len(set(lines)) < len(lines) or max(lines) > _MAX_LINE:
        must = f"different multiples of one that the highest has at most {_MAX_LINE} of"
        raise InputError("frequencies", must, list(frequencies))
    n = len(lines)
    schroeder = -math.pi * np.arange(n) ** 2 / n
    points = 1 << (64 * max(lines)).bit_length()

    def peak(s: float) -> float:
        spectrum = np.zeros(points // 2 + 1, complex)
        spectrum[lines] = 0.5 * points * np.exp(1j * s * schroeder)
        size = np.abs(np.fft.irfft(spectrum))
        top = int(np.argmax(size))
        left, top_value, right = size[top - 1], size[top], size[(top + 1) % points]
        bend = left - 2.0 * top_value + right  # the parabola through the three highest points
        return float(top_value - (right - left) ** 2 / (8.0 * bend)) if bend else float(top_value)

    rms = math.sqrt(0.5 * n)
    s, min_crest, max_crest = 1.0, peak(1.0) / rms, math.sqrt(2.0 * n)
    if crest is not None:
        if not min_crest * (1.0 - 1e-6) <= crest <= max_crest * (1.0 + 1e-6):
            raise InputError("crest", f"from {min_crest:.4g} to {max_crest:.4g} with these frequencies", crest)
        low, high = 0.0, 1.0
        for _ in range(40):
            s = 0.5 * (low + high)
            low, high = (s, high) if peak(s) / rms > crest else (low, s)
    return s * schroeder, peak(s)
