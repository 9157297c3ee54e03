"""An independent simulator of the same laboratory, which shares no code with the product.

Its logs test validation. Deliberate differences: the shaft is a direction in space with an angular momentum (a heavy
symmetric top), not angles; friction is `mu F_n tanh(v_t / 1 mm/s)`; classical Runge-Kutta at steps of 2 us, with the
onset of each contact located by bisection; sensors after a low-pass of scipy, with
independent noise, clock and shaft angle.

    L' = torque,  u' = L x u / Ixx,  w = L . u / Izz,  theta' = w - G' u_x,
    G' = (u_y u_z' - u_y' u_z) / (u_y^2 + u_z^2)

Numbers are those of the paper's tables and of the product's page on its parameters; `Rig` has them by the paper's
symbols [SI].
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

STEP_S = 0.5e-6
LEAD_STEP_S = 4e-6
"""Step before the recorded part, which has no contact [s]."""
_NAMES = ("disk_x", "disk_y", "ring_x", "ring_y", "P_N", "P_S", "P_E", "P_W", "inner_x", "inner_y", "outer_x",
          "outer_y", "speed", "keyphasor", "hammer")  # fmt: skip
UNITS = dict(zip(_NAMES, ["mm"] * 4 + ["N"] * 4 + ["m/s^2"] * 4 + ["Hz", "1", "N"], strict=True))
NOISE = dict(zip(_NAMES, [4e-4] * 2 + [2e-4] * 2 + [0.8] * 4 + [0.08] * 4 + [3e-3, 2e-4, 0.06], strict=True))
"""Standard deviation of each channel, in its unit."""


class Rig(NamedTuple):
    """Parameters of the rig."""

    M: float = 1.28
    Ixx: float = 0.0771
    Izz: float = 7.78e-4
    arm_ring: float = 0.197
    arm_magnet: float = 0.391
    arm_centre: float = 0.176
    arm_disk: float = 0.314
    eps: float = 1e-4
    phi: float = 0.21
    K_mag: float = 1.7e3
    a3: float = 7508.318908347222
    a5: float = 11166367.464150665
    a7: float = 394442421548.21075
    D_x: float = 2 * 0.016 * math.sqrt(1.7e3 * 1.28)
    D_y: float = 2 * 0.035 * math.sqrt(1.7e3 * 1.28)
    c_d: float = 0.1
    R_S: float = 12.5e-3
    r0: float = 0.926e-3
    x0: float = 0.0
    y0: float = math.nan  # centred on the sagging shaft
    K: float = 2.8583050011e10
    c: float = 0.16648195
    mu: float = 0.25
    v_s: float = 1e-3
    M_ih: float = 1.70
    M_oh: float = 7.18
    K_bv: float = 1.23e7
    K_bh: float = 2.4e7
    D_bv: float = 238.0
    D_bh: float = 1576.0
    k_ns: float = 2 * 8.88e7
    k_ew: float = 2 * 8.88e7
    P0: float = 3000.0
    g: float = 9.81
    exponent: float = 1.5
    late: int = 0  # steps of 0.5 us after which each contact begins


@njit(cache=True)
def _pair(u, k, P0):
    return max(P0 + 0.5 * k * u, 0.0), max(P0 - 0.5 * k * u, 0.0)


@njit(cache=True)
def _rates(rig, t, omega0, pulse, v0, y, dy, seen):
    """Return the rates of u, L, theta and the housings; `seen` receives the sensors' inputs."""
    ux, uy, uz, Lx, Ly, Lz = y[0], y[1], y[2], y[3], y[4], y[5]
    vx, vy, vz = (Ly * uz - Lz * uy) / rig.Ixx, (Lz * ux - Lx * uz) / rig.Ixx, (Lx * uy - Ly * ux) / rig.Ixx
    w = (Lx * ux + Ly * uy + Lz * uz) / rig.Izz
    turning = w - ux * (uy * vz - vy * uz) / (uy * uy + uz * uz)
    hammer = 0.0
    if pulse[0] <= t < pulse[0] + pulse[1]:
        hammer = pulse[2] * math.sin(math.pi * (t - pulse[0]) / pulse[1])
    bx, by = rig.arm_magnet * ux, rig.arm_magnet * uy
    s = bx * bx + by * by
    k = rig.K_mag * (1.0 + s * (rig.a3 + s * (rig.a5 + s * rig.a7)))
    out = rig.M * rig.eps * turning * turning
    # Sum of arm times lateral force.
    fx = rig.arm_magnet * (-k * bx - rig.D_x * rig.arm_magnet * vx)
    fy = rig.arm_magnet * (-k * by - rig.D_y * rig.arm_magnet * vy) - rig.arm_centre * rig.M * rig.g
    fx += rig.arm_disk * (out * math.cos(y[6] + rig.phi) + hammer)
    fy += rig.arm_disk * out * math.sin(y[6] + rig.phi)
    ex, ey = rig.arm_ring * ux - y[7] - rig.x0, rig.arm_ring * uy - y[8] - rig.y0
    r = max(math.sqrt(ex * ex + ey * ey), 1e-12)
    depth = r - rig.r0
    cx = cy = couple = 0.0
    if depth > 0.0 and v0 > 0.0:
        nx, ny = ex / r, ey / r
        rx, ry = rig.arm_ring * vx - y[11], rig.arm_ring * vy - y[12]
        force = max(0.0, rig.K * depth**rig.exponent * (1.0 + rig.c * (rx * nx + ry * ny) / v0))
        rub = rig.mu * force * math.tanh((ry * nx - rx * ny + rig.R_S * w) / rig.v_s)
        cx, cy, couple = -force * nx + rub * ny, -force * ny - rub * nx, -rig.R_S * rub
    fx += rig.arm_ring * cx
    fy += rig.arm_ring * cy
    couple += rig.c_d * (omega0 - turning)
    dy[0], dy[1], dy[2] = vx, vy, vz
    dy[3], dy[4], dy[5] = couple * ux - uz * fy, couple * uy + uz * fx, couple * uz + ux * fy - uy * fx
    dy[6] = turning
    dy[7], dy[8], dy[9], dy[10] = y[11], y[12], y[13], y[14]
    north, south = _pair(y[8] - y[10], rig.k_ns, rig.P0)
    east, west = _pair(y[9], rig.k_ew, rig.P0)
    beam = rig.D_bv * (y[11] - y[13]) + rig.K_bv * (y[7] - y[9])
    dy[11] = (-cx - beam) / rig.M_ih
    dy[12] = (-cy - (north - south)) / rig.M_ih
    dy[13] = (beam - (east - west)) / rig.M_oh
    dy[14] = (north - south - rig.D_bh * y[14] - rig.K_bh * y[10]) / rig.M_oh
    disk = 1e3 * rig.arm_disk  # in mm
    seen[0], seen[1] = disk * (ux - rig.x0 / rig.arm_ring), disk * (uy - rig.y0 / rig.arm_ring)
    seen[2], seen[3] = 1e3 * ex, 1e3 * ey
    seen[4], seen[5], seen[6], seen[7] = north, south, east, west
    seen[8], seen[9], seen[10], seen[11] = y[11], y[12], y[13], y[14]
    seen[12] = turning / (2.0 * math.pi)
    mark = y[6] % (2.0 * math.pi)
    seen[13] = 1.0 if mark < math.radians(10.0) else 0.0
    seen[14] = hammer
    return depth, (ex * (rig.arm_ring * vx - y[11]) + ey * (rig.arm_ring * vy - y[12])) / r


@njit(cache=True)
def _step(rig, t, h, omega0, pulse, v0, y, work):
    k1, k2, k3, k4, z, none = work
    _rates(rig, t, omega0, pulse, v0, y, k1, none)
    z[:] = y + 0.5 * h * k1
    _rates(rig, t + 0.5 * h, omega0, pulse, v0, z, k2, none)
    z[:] = y + 0.5 * h * k2
    _rates(rig, t + 0.5 * h, omega0, pulse, v0, z, k3, none)
    z[:] = y + h * k3
    _rates(rig, t + h, omega0, pulse, v0, z, k4, none)
    return y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@njit(cache=True)
def _run(rig, y, omega0, pulse, t0, h, steps, every, rows):
    work, v0, contacts, inside = np.empty((6, 15)), 0.0, 0, 0
    for n in range(steps):
        t, part = t0 + n * h, 0.0
        inputs = rows[n // every] if n % every == 0 else work[5]
        _rates(rig, t, omega0, pulse, v0, y, work[0], inputs)
        ahead = _step(rig, t, h, omega0, pulse, v0, y, work)
        depth, rate = _rates(rig, t + h, omega0, pulse, v0, ahead, work[0], work[5])
        inside = inside + 1 if depth > 0.0 and v0 == 0.0 else 0
        if inside > rig.late:
            low, part = 0.0, 1.0
            for _ in range(0 if rig.late else 50):
                middle = 0.5 * (low + part)
                depth, _rate = _rates(rig, t, omega0, pulse, v0, _step(rig, t, middle * h, omega0, pulse, v0, y, work),
                                      work[0], work[5])  # fmt: skip
                low, part = (low, middle) if depth > 0.0 else (middle, part)
            start = _step(rig, t, part * h, omega0, pulse, v0, y, work)
            depth, rate = _rates(rig, t + part * h, omega0, pulse, v0, start, work[0], work[5])
            v0 = max(rate, 1e-3)
            contacts += 1
            ahead = _step(rig, t + part * h, (1.0 - part) * h, omega0, pulse, v0, start, work)
        elif depth <= 0.0:
            v0 = 0.0
        y[:] = ahead
    return contacts


@dataclass(frozen=True)
class Motion:
    """Ideal sensor signals, without filter, noise and clock error.

    Attributes:
        rate_hz: Row rate [Hz].
        values: By channel, in its unit, each shape (n,).
        hammer_s: Start of the hammer pulse after the first row [s].
        contacts: Contacts begun.
    """

    rate_hz: float
    values: dict[str, np.ndarray]
    hammer_s: float
    contacts: int


def simulate_pulse(
    rig: Rig | None = None,
    *,
    speed_hz: float = 6.2,
    force_n: float = 100.0,
    duration_ms: float = 5.0,
    direction: float = 0.0,
    turned: float = 0.0,
    before_s: float = 0.8,
    after_s: float = 0.7,
    settled_s: float = 3.0,
) -> Motion:
    """Simulate a hammer pulse within a run.

    Args:
        rig: Its parameters.
        speed_hz: Of the shaft and of its drive.
        force_n: Of the pulse.
        duration_ms: Of the pulse.
        direction: Of the pulse, from x to y [rad].
        turned: Angle of the shaft at the start [rad].
        before_s: Recorded time before the pulse, ...
        after_s: ... and from its start [s].
        settled_s: Duration of the run before that [s].
    """
    rig = Rig() if rig is None else rig
    assert direction == 0.0, "along x"
    low, high = -0.1, 0.0  # where the magnets carry the shaft
    for _ in range(100):
        uy = 0.5 * (low + high)
        b = rig.arm_magnet * uy
        force = -rig.K_mag * b * (1.0 + b * b * (rig.a3 + b * b * (rig.a5 + b * b * rig.a7)))
        low, high = (low, uy) if rig.arm_magnet * force < rig.arm_centre * rig.M * rig.g else (uy, high)
    uy = 0.5 * (low + high)
    if math.isnan(rig.y0):
        rig = rig._replace(y0=rig.arm_ring * uy)
    omega = 2.0 * math.pi * speed_hz
    u = np.array([0.0, uy, math.sqrt(1.0 - uy * uy)])
    y = np.concatenate([u, rig.Izz * omega * u, [turned], np.zeros(8)])
    every = 4
    rows = np.empty((round((before_s + after_s) / STEP_S / every), len(_NAMES)))
    quiet = np.empty((1, len(_NAMES)))
    pulse = (before_s, duration_ms * 1e-3, force_n)
    lead = round(settled_s / LEAD_STEP_S)
    assert not _run(rig, y, omega, pulse, -settled_s, LEAD_STEP_S, lead, lead + 1, quiet)
    contacts = _run(rig, y, omega, pulse, 0.0, STEP_S, len(rows) * every, every, rows)
    assert np.isfinite(rows).all()
    # Accelerations jump where friction changes its sign; differences of the speeds locate it between the rows.
    v = np.pad(rows[:, 8:12], ((2, 2), (0, 0)), mode="edge")
    rows[:, 8:12] = (8.0 * (v[3:-1] - v[1:-3]) - v[4:] + v[:-4]) / (12.0 * every * STEP_S)
    return Motion(1.0 / (STEP_S * every), dict(zip(_NAMES, rows.T.copy(), strict=True)), before_s, contacts)


LOW_PASSES = ("butterworth", "bessel", "chebyshev", "butterworth-2", "fir", "fir-compensated", "sinc")


def apply_low_pass(
    kind: str, values: np.ndarray, rate_hz: float, corner_hz: float, fir_half_s: float = 1.6e-3
) -> np.ndarray:
    """Return a signal after one of `LOW_PASSES`, settled at its first value.

    A Chebyshev has 0.5 dB of ripple; a FIR is twice `fir_half_s` long; "sinc" is that of a sigma-delta converter: three
    moving averages in series. Corners are at -3 dB; of a Chebyshev the edge of the passband, of a FIR at -6 dB.
    """
    from scipy import signal

    if kind in ("fir", "fir-compensated", "sinc"):
        length = 0.26193 * rate_hz / corner_hz
        average = np.ones(int(length) + 2)
        average[[0, -1]] = 0.5 * (length % 1.0)
        average /= average.sum()
        half = round(fir_half_s * rate_hz)
        taps = signal.firwin(2 * half + 1, corner_hz, fs=rate_hz)
        taps = np.convolve(np.convolve(average, average), average) if kind == "sinc" else taps
        ahead = half if kind == "fir-compensated" else 0
        padded = np.pad(values, (len(taps) - 1 - ahead, ahead), mode="edge")
        return signal.oaconvolve(padded, taps, mode="valid")
    sos = {
        "butterworth": lambda: signal.butter(4, corner_hz, fs=rate_hz, output="sos"),
        "butterworth-2": lambda: signal.butter(2, corner_hz, fs=rate_hz, output="sos"),
        "bessel": lambda: signal.bessel(4, corner_hz, norm="mag", fs=rate_hz, output="sos"),
        "chebyshev": lambda: signal.cheby1(4, 0.5, corner_hz, fs=rate_hz, output="sos"),
    }[kind]()
    gain = math.prod(sos[:, :3].sum(axis=1) / sos[:, 3:].sum(axis=1))
    return signal.sosfilt(sos, values, zi=signal.sosfilt_zi(sos) * values[0])[0] / gain


def record_log(
    motion: Motion,
    *,
    seed: int,
    rate_hz: float = 20_000.0,
    ppm: float = 80.0,
    bandwidth_hz: float = 5000.0,
    low_pass: str | dict[str, str] = "butterworth",
    fir_half_s: float = 1.6e-3,
    noise: float = 1.0,
    edit: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]] = lambda values: values,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the log of another recorder: times by its own clock [s], and values by channel.

    Args:
        motion: Ideal signals.
        seed: Of the noise.
        rate_hz: Sample rate by the recorder's own clock [Hz].
        ppm: Error of that clock [ppm]; positive: fast.
        bandwidth_hz: Of the low-pass before the converter; the speed's is 200 Hz.
        low_pass: Its kind, or kinds by channel; others and the speed have a fourth-order Butterworth.
        fir_half_s: Half of the length of a linear-phase filter [s].
        noise: Factor of the sensors' noise.
        edit: Changes the signals before the filter: faults of sensors.
    """
    from scipy.interpolate import CubicSpline

    rng = np.random.default_rng(seed)
    n = int((len(motion.values["speed"]) - 4) / motion.rate_hz * rate_hz)
    own_s = np.arange(n) / rate_hz
    place = own_s * (1.0 - ppm * 1e-6) * motion.rate_hz
    found = {}
    for name, values in edit(motion.values).items():
        kind = low_pass if isinstance(low_pass, str) else low_pass.get(name, "butterworth")
        slow = ("butterworth", 200.0) if name == "speed" else (kind, bandwidth_hz)
        smooth = apply_low_pass(slow[0], values, motion.rate_hz, slow[1], fir_half_s)
        found[name] = CubicSpline(np.arange(len(smooth)), smooth)(place)
        found[name] += noise * NOISE[name] * rng.standard_normal(n)
    return own_s, found


def add_noise(
    own_s: np.ndarray, values: dict[str, np.ndarray], *, slope: float, level: float, lines: int, seed: int
) -> dict[str, np.ndarray]:
    """Return a log with the noise of a real measuring chain in addition to white noise, except on the keyphasor.

    Args:
        own_s: Times [s].
        values: By channel.
        slope: Of the density of the noise, (100 Hz / f)^slope; 0: white.
        level: Of that noise at 100 Hz, over the white noise.
        lines: Number of odd harmonics of 50 Hz, each with an RMS of 0.4 of the white noise.
        seed: Of the noise.
    """
    rng, n = np.random.default_rng([seed, 1]), len(own_s)
    f = np.fft.rfftfreq(n, own_s[1] - own_s[0])
    f[0] = f[1]
    noisy = dict(values)
    for name in (one for one in values if one != "keyphasor"):
        lines_of_noise = rng.standard_normal(len(f)) + 1j * rng.standard_normal(len(f))
        more = level * np.fft.irfft(lines_of_noise * (100.0 / f) ** (0.5 * slope), n) * math.sqrt(n / 2.0)
        for k in range(lines):
            turn = 2.0 * math.pi * (50.0 * (2 * k + 1) * own_s + rng.random())
            more += 0.4 * math.sqrt(2.0) * np.sin(turn)
        noisy[name] = values[name] + NOISE[name] * more
    return noisy
