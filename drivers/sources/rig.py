"""Samples from the rig's own keys: one stream a sensor group."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drivers.samples import Samples
from drivers.stream import RigStream, thin, whole_step
from rig import wire
from rig.channels import Group
from rig.transport import Client


class RigSource:
    """Sensor groups of a running rig.

    Args:
        client: Transport to the rig.
        close: Called when the source is closed; closes the client where it belongs to the source.
    """

    def __init__(self, client: Client, *, close: Callable[[], None] | None = None) -> None:
        self._stream = RigStream(client)
        self._close = close
        self._leave: list[Callable[[], None]] = []

    def streams(self) -> dict[str, tuple[str, ...]]:
        """The groups of this rig's channel table."""
        return {name: group.names for name, group in self._stream.table().groups.items()}

    def start(
        self,
        streams: Sequence[str],
        rate_hz: float | None,
        on_samples: Callable[[str, Samples], None],
        on_end: Callable[[str, str], None],
    ) -> float:
        """Begin; every n-th row is taken where a group is faster than the rate."""
        groups = [self._stream.group(name) for name in streams]
        rate = float(rate_hz or min(group.rate_hz for group in groups))
        for group in groups:
            whole_step(group.rate_hz, rate)
        for group in groups:
            self._listen(group, rate, on_samples, on_end)
        return rate

    def _listen(
        self,
        group: Group,
        rate_hz: float,
        on_samples: Callable[[str, Samples], None],
        on_end: Callable[[str, str], None],
    ) -> None:
        units = tuple(channel.unit for channel in group.channels)
        step = whole_step(group.rate_hz, rate_hz)

        def take(block: wire.Block) -> None:
            if block.values.shape[1] != len(units) or round(block.rate_hz / step) != round(rate_hz):
                on_end(group.name, "the rig's channels or rates have changed")
                return
            block = thin(block, step)
            if len(block.values):
                samples = Samples(
                    index=block.index,
                    tick=block.tick,
                    rate_hz=block.rate_hz,
                    tick_rate_hz=block.tick_rate_hz,
                    channels=group.names,
                    units=units,
                    values=group.engineering(block.values),
                )
                on_samples(group.name, samples)

        self._leave.append(self._stream.listen(group.name, take, lambda reason: on_end(group.name, reason)))

    def close(self) -> None:
        """Listen no more."""
        while self._leave:
            self._leave.pop()()
        close, self._close = self._close, None
        if close is not None:
            close()
