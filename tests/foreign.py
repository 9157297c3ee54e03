"""Logs of other rigs, computed by plain formulas and written by the libraries of the formats.

A shaft orbits forward at its speed. After a hammer impact it whirls backward in its ring, faster and wider. Opposite
transducers are preloaded: one is relieved as the other is loaded. None of it uses the product's model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

SPIN_HZ, WHIRL_HZ = 6.2, 21.0
IMPACT_S, PULSE_LENGTH_S, PULSE_FORCE_N = 0.55, 5e-3, 92.0
DURATION_S = 1.2
RAMP, PULSE_S = 4, 8e-3
"""Keyphasor pulse: rise [samples] and length [s]; half height at (k + 0.3) / SPIN_HZ."""
PRELOAD_N = 2950.0


def instants(rate_hz: float) -> np.ndarray:
    return np.arange(round(DURATION_S * rate_hz)) / rate_hz


def pulse_times() -> np.ndarray:
    """Return the times at which keyphasor pulses cross half height [s]."""
    return (np.arange(int(SPIN_HZ * DURATION_S) + 1) + 0.3) / SPIN_HZ


def compute_orbit(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the position of the disk [mm]."""
    wide = np.clip((t - IMPACT_S) / 0.2, 0.0, 1.0)
    spin, whirl = 2 * np.pi * SPIN_HZ * t, 2 * np.pi * WHIRL_HZ * (t - IMPACT_S)
    x = 0.11 * np.cos(spin) + wide * 0.9 * np.cos(whirl)
    y = 0.11 * np.sin(spin) - wide * 0.9 * np.sin(whirl)
    return x, y


def hammer(t: np.ndarray) -> np.ndarray:
    part = (t - IMPACT_S) / PULSE_LENGTH_S
    return np.where((part > 0) & (part < 1), PULSE_FORCE_N * np.sin(np.pi * np.clip(part, 0, 1)), 0.0)


def make_keyphasor(t: np.ndarray) -> np.ndarray:
    """Return the keyphasor signal, from 0 to 1."""
    since, ramp_s = t[:, None] - pulse_times()[None, :], RAMP * t[1]
    return np.sum(np.clip(since / ramp_s + 0.5, 0, 1) - np.clip((since - PULSE_S) / ramp_s + 0.5, 0, 1), axis=1)


def make_signals(rate_hz: float, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Return the rig's channels in its units (mm, N, m/s^2, Hz) with white noise, each of shape (n,)."""
    t, generator = instants(rate_hz), np.random.default_rng(seed)
    x, y = compute_orbit(t)
    wide = np.clip((t - IMPACT_S) / 0.2, 0.0, 1.0)
    ring = np.exp(-np.maximum(t - IMPACT_S, 0.0) / 0.02) * np.sin(2 * np.pi * 900 * t) * (t > IMPACT_S)
    found = {
        "disk_x": x, "disk_y": y, "ring_x": 0.62 * x, "ring_y": 0.62 * y,
        "P_N": PRELOAD_N + 300 * wide * y, "P_S": PRELOAD_N + 40 - 300 * wide * y,
        "P_E": PRELOAD_N - 25 + 300 * wide * x, "P_W": PRELOAD_N - 300 * wide * x,
        "inner_x": 60 * ring + 9 * wide * x, "inner_y": 40 * ring + 9 * wide * y,
        "outer_x": 25 * ring + 4 * wide * x, "outer_y": 15 * ring + 4 * wide * y,
        "speed": SPIN_HZ - 0.05 * wide, "keyphasor": make_keyphasor(t), "hammer": hammer(t),
    }  # fmt: skip
    noise = {"mm": 3e-4, "N": 0.5, "a": 0.05, "speed": 2e-3, "keyphasor": 0.0, "hammer": 0.05}
    kinds = {name: "mm" if name[:4] in ("disk", "ring") else "N" if name[0] == "P" else "a" for name in found}
    return {
        name: values + noise.get(name, noise[kinds[name]]) * generator.standard_normal(len(t))
        for name, values in found.items()
    }


def write_mdf(path: Path) -> dict[str, tuple[float, np.ndarray]]:
    """Write an MDF file at 51.2 kHz, 20 kHz (clock 80 ppm fast) and 12.5 Hz; keyphasor and speed in separate groups.

    Returns:
        Rate [Hz] and values in the file, by channel of the rig.
    """
    from asammdf import MDF, Signal

    fast, middle, slow = 51_200.0, 20_001.6, 12.5
    names = {
        fast: {"Acc_IN_X": "inner_x", "Acc_IN_Y": "inner_y", "Acc_OUT_X": "outer_x", "Acc_OUT_Y": "outer_y",
               "KPH": "keyphasor", "Impact hammer": "hammer"},
        middle: {"Prox_disk_X": "disk_x", "Prox_disk_Y": "disk_y", "Prox_ring_X": "ring_x", "Prox_ring_Y": "ring_y",
                 "F_north": "P_N", "F_south": "P_S", "F_east": "P_E", "F_west": "P_W"},
        slow: {"Shaft RPM": "speed"},
    }  # fmt: skip
    scales = {"KPH": (10.0 / 32_768, "V", 5.0), "Impact hammer": (0.01, "N", 1.0), "Shaft RPM": (None, "rpm", 60.0)}
    kept = {}
    with MDF(version="4.10") as mdf:
        for rate, members in names.items():
            signals, channels = make_signals(rate), []
            for name, channel in members.items():
                unit = "mm" if name.startswith("Prox") else "N" if name.startswith("F_") else "m/s^2"
                scale, unit, factor = scales.get(name, (None, unit, 1.0))
                values = signals[channel] * factor
                if scale is not None:
                    codes = np.round(values / scale).astype(np.int16)
                    kept[channel] = (rate, codes * scale)
                    channels.append(
                        Signal(codes, instants(rate), name=name, unit=unit, conversion={"a": scale, "b": 0.0})
                    )
                else:
                    kept[channel] = (rate, values)
                    channels.append(Signal(values, instants(rate), name=name, unit=unit))
            mdf.append(channels, acq_name=f"Rate {rate:g}", common_timebase=True)
        mdf.save(path)
    return kept


PER_MM_V = 0.2 / 0.0254
VOLTS = {
    **{channel: (f"prox{number}", PER_MM_V, "mV/mil", 200.0, bias_v) for number, (channel, bias_v) in enumerate(
        {"disk_x": -10.05, "disk_y": -9.8, "ring_x": -10.2, "ring_y": -9.9}.items(), 1)},
    **{f"P_{side}": (f"Kraft {name}", 2e-3, "mV/N", 2.0, 0.0) for side, name in
       {"N": "Nord", "S": "Süd", "E": "Ost", "W": "West"}.items()},
    "hammer": ("hammer force", 2.25e-3, "mV/N", 2.25, 0.0),
}  # fmt: skip
"""Name in the file, volts per unit of the rig, unit and size of the sensitivity, volts at zero, by channel."""


def write_tdms(path: Path, *, rate_hz: float = 25_600.0) -> dict[str, tuple[float, np.ndarray]]:
    """Write a TDMS file in volts, with the sensors' sensitivities in properties.

    Returns:
        Rate [Hz] and volts, by channel of the rig.
    """
    from nptdms import ChannelObject, TdmsWriter

    signals, kept, objects = make_signals(rate_hz), {}, []
    began = np.datetime64("2026-11-21T10:00:00.000000")
    about = {"unit_string": "V", "wf_increment": 1.0 / rate_hz, "wf_start_time": began}
    for channel, (name, per_unit_v, unit, size, bias_v) in VOLTS.items():
        kept[channel] = (rate_hz, bias_v + per_unit_v * signals[channel])
        bias = {"bias": bias_v, "bias_unit": "V"} if bias_v else {}
        scale = {"sensitivity": size, "sensitivity_unit": unit, **bias}
        objects.append(ChannelObject("AI", name, kept[channel][1], {**about, **scale}))
    kept["keyphasor"] = (rate_hz, 5.0 * signals["keyphasor"])
    objects.append(ChannelObject("AI", "tacho", kept["keyphasor"][1], about))
    with TdmsWriter(path) as writer:
        writer.write_segment(objects)
    return kept


GERMAN = {
    "disk_x": ("Weg Scheibe x", "µm", 1e3), "disk_y": ("Weg Scheibe y", "µm", 1e3), "ring_x": ("Weg Ring x", "µm", 1e3),
    "ring_y": ("Weg Ring y", "µm", 1e3), "P_N": ("Kraft N", "N", 1.0), "P_S": ("Kraft S", "N", 1.0),
    "P_E": ("Kraft O", "N", 1.0), "P_W": ("Kraft W", "N", 1.0), "inner_x": ("Beschl. Innengehäuse x", "m/s²", 1.0),
    "inner_y": ("Beschl. Innengehäuse y", "m/s²", 1.0), "speed": ("Drehzahl", "1/min", 60.0),
    "keyphasor": ("Lichtschranke", "V", 5.0), "hammer": ("Schlaghammer", "N", 1.0),
}  # fmt: skip
"""Heading, unit, and factor from the rig's unit, by channel."""


def write_german_csv(path: Path, *, rate_hz: float = 5000.0) -> dict[str, tuple[float, np.ndarray]]:
    """Write a CSV file with semicolons, decimal commas, units in the headings, umlauts in latin-1 and times of day.

    Returns:
        Rate [Hz] and values in the file, by channel of the rig.
    """
    signals = make_signals(rate_hz)
    kept = {channel: (rate_hz, np.round(signals[channel] * size, 6)) for channel, (_, _, size) in GERMAN.items()}
    micros = np.rint(instants(rate_hz) * 1e6).astype(int)
    lines = ["Prüfstand;Fanglager", ";".join(["Uhrzeit", *(f"{name} [{unit}]" for name, unit, _ in GERMAN.values())])]
    columns = [values for _, values in kept.values()]
    for at, *row in zip(micros.tolist(), *(values.tolist() for values in columns), strict=True):
        second, micro = divmod(at, 1_000_000)
        texts = (f"{value:.6f}".replace(".", ",") for value in row)
        lines.append(";".join([f"10:59:{58 + second:02d},{micro:06d}", *texts]) if second < 2 else "")
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode("latin-1"))
    return kept


def write_nameless_csv(
    path: Path, *, rate_hz: float = 10_000.0, ppm: float = 80.0
) -> dict[str, tuple[float, np.ndarray]]:
    """Write a CSV file with units and numbers only, a clock that is off, and probes in micrometres without place or
    axis.

    Returns:
        True rate [Hz] and values in the file, by channel of the rig, in their order.
    """
    rate = rate_hz * (1.0 + ppm * 1e-6)
    signals = make_signals(rate)
    order = {"ring_x": ("CH1", "um", 1e3), "ring_y": ("CH2", "um", 1e3), "disk_x": ("CH3", "um", 1e3),
             "disk_y": ("CH4", "um", 1e3), "P_E": ("CH5", "N", 1.0), "P_N": ("CH6", "N", 1.0), "P_W": ("CH7", "N", 1.0),
             "P_S": ("CH8", "N", 1.0), "hammer": ("CH9", "N", 1.0), "speed": ("CH10", "", 60.0),
             "keyphasor": ("CH11", "V", 5.0)}  # fmt: skip
    kept = {channel: (rate, np.round(signals[channel] * size, 4)) for channel, (_, _, size) in order.items()}
    heads = [f"{name} [{unit}]" if unit else name for name, unit, _ in order.values()]
    rows = np.column_stack([instants(rate), *(values for _, values in kept.values())])
    np.savetxt(
        path,
        rows,
        fmt=["%.9f", *["%.4f"] * len(order)],
        delimiter=",",
        header=",".join(["time [s]", *heads]),
        comments="",
    )
    return kept
