"""White noise: standard normal numbers drawn within a kernel, from a separate stream for every channel.

The numbers equal those of numpy's `Generator(SFC64(...)).standard_normal()`: Doty-Humphrey's generator SFC64 and the
ziggurat of Marsaglia and Tsang (J. Stat. Softw. 5(8), 2000) with 256 layers. They are drawn where they are used, which
avoids the latency of refilling a buffer.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence

import numpy as np

from rig.physics.kernels.stage import kernel

_LAYERS = 256
EDGE = 3.6541528853610088
"""Abscissa at which the lowest layer ends and the tail begins."""
_AREA = EDGE * math.exp(-0.5 * EDGE * EDGE) + math.sqrt(0.5 * math.pi) * math.erfc(EDGE / math.sqrt(2.0))
"""Area of every layer."""


def _tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, per layer: limit of integers accepted at once, width per integer, and density at its edge."""
    edges = np.empty(_LAYERS)
    density = np.empty(_LAYERS)
    inside = np.zeros(_LAYERS, dtype=np.uint64)
    x = edges[-1] = EDGE
    density[-1] = math.exp(-0.5 * x * x)
    edges[0] = _AREA / density[-1]  # width of a rectangle with the lowest layer's area
    density[0] = 1.0
    inside[0] = int(EDGE / edges[0] * 2.0**52)
    for layer in range(_LAYERS - 2, 0, -1):
        inner = math.sqrt(-2.0 * math.log(_AREA / x + math.exp(-0.5 * x * x)))
        inside[layer + 1] = int(inner / x * 2.0**52)
        x = edges[layer] = inner
        density[layer] = math.exp(-0.5 * x * x)
    return inside, edges / 2.0**52, density


_INSIDE, _WIDTH, _DENSITY = _tables()
_MASK = np.uint64(2**52 - 1)
_LAYER = np.uint64(_LAYERS - 1)
_ONE, _THREE, _EIGHT, _NINE = np.uint64(1), np.uint64(3), np.uint64(8), np.uint64(9)
_ELEVEN, _TURN, _BACK = np.uint64(11), np.uint64(24), np.uint64(40)


def noise_streams(names: Sequence[str], seed: int) -> np.ndarray:
    """Return the initial streams of channels, keyed by seed and name, shape (channels, 4), uint64."""
    streams = np.empty((len(names), 4), dtype=np.uint64)
    for stream, name in zip(streams, names, strict=True):
        generator = np.random.SFC64(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))
        stream[:] = generator.state["state"]["state"]
    return streams


@kernel
def _uniform(stream):
    """Return a number in [0, 1); sums of unsigned integers wrap."""
    a, b, c, count = stream[0], stream[1], stream[2], stream[3]
    bits = a + b + count
    stream[0], stream[1], stream[3] = b ^ (b >> _ELEVEN), c + (c << _THREE), count + _ONE
    stream[2] = ((c << _TURN) | (c >> _BACK)) + bits
    return float(bits >> _ELEVEN) * 2.0**-53


@kernel
def _near_edge(stream, layer, whole, x):
    """Return whether a point near the edge of its layer is accepted, and its value; needed for 1 of 80 points."""
    if layer == 0:
        while True:
            beyond = -math.log1p(-_uniform(stream)) / EDGE
            height = -math.log1p(-_uniform(stream))
            if height + height > beyond * beyond:
                return True, -(EDGE + beyond) if (whole >> _EIGHT) & _ONE else EDGE + beyond
    rise = _DENSITY[layer - 1] - _DENSITY[layer]
    return rise * _uniform(stream) + _DENSITY[layer] < math.exp(-0.5 * x * x), x


@kernel
def draw(streams, out):
    """Draw the next numbers of every stream: normal, mean 0, variance 1.

    Args:
        streams: In and out, shape (channels, 4), uint64.
        out: Out, shape (n, channels).
    """
    for channel in range(len(streams)):
        stream = streams[channel]
        a, b, c, count = stream[0], stream[1], stream[2], stream[3]
        n = 0
        while n < len(out):
            bits = a + b + count
            a, b, c = b ^ (b >> _ELEVEN), c + (c << _THREE), ((c << _TURN) | (c >> _BACK)) + bits
            count += _ONE
            layer = int(bits & _LAYER)
            whole = (bits >> _NINE) & _MASK
            x = float(whole) * _WIDTH[layer]
            out[n, channel] = -x if (bits >> _EIGHT) & _ONE else x
            if whole < _INSIDE[layer]:
                n += 1
            else:
                stream[0], stream[1], stream[2], stream[3] = a, b, c, count
                counts, out[n, channel] = _near_edge(stream, layer, whole, out[n, channel])
                if counts:
                    n += 1
                a, b, c, count = stream[0], stream[1], stream[2], stream[3]
        stream[0], stream[1], stream[2], stream[3] = a, b, c, count
