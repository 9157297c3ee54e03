"""Schedule of a rig's messages on a bus: rates, load and latency."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivers.can import analysis
from drivers.can.bus.timing import Speed
from drivers.can.message import CanMessage, MessageTable
from drivers.can.signals import CLASSIC_HZ, CLASSIC_SHARE, FD_HZ, default_messages
from rig.base.errors import InputError, Words

SLOT_S = 1e-3
"""Period in which the gateway passes frames to the bus [s]: a frame may be queued this much later than it is due."""
SAMPLE_DEADLINE_S = 10e-3
"""Longest time that a sample frame may wait for the bus [s]."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """Rates of the two sample layouts.

    Attributes:
        classic_hz: Rate of the classic layout [Hz]; None if it is not sent.
        fd_hz: Rate of the FD layout [Hz]; None if it is not sent.
        table: Messages; by default those of the standard channel table.
    """

    classic_hz: int | None = CLASSIC_HZ
    fd_hz: int | None = None
    table: MessageTable = field(default_factory=default_messages, compare=False)

    def messages(self) -> dict[CanMessage, float]:
        """Return every message and its period [s]."""
        return self.table.schedule(classic_hz=self.classic_hz, fd_hz=self.fd_hz)

    def response_times(self, speed: Speed) -> list[tuple[CanMessage, analysis.Response]]:
        """Return the worst case of every message on a bus of that speed, the highest priority first.

        The load of a message is `transmission_s / message.period_s`. Messages sent by events count at their shortest
        period. Delays of the gateway's process by the operating system are not included.

        Raises:
            InputError: FD frames on a bus for classic CAN only.
        """
        self._check_fd(speed)
        table = {message.identifier: message for message in self.messages()}
        return [(table[row.message.identifier], row) for row in analysis.worst_case(self._shapes(), speed)]

    def load(self, speed: Speed) -> float:
        """Return the largest share of the bus that all messages can take, with the maximum number of stuff bits."""
        return analysis.load(self._shapes(), speed)

    def check(self, speed: Speed) -> float:
        """Return the load if the bus can carry it.

        Raises:
            InputError: It exceeds 100 %; the message gives the load.
        """
        self._check_fd(speed)
        share = self.load(speed)
        if share > 1.0:
            must = "a schedule of at most 100 % of the bus in the worst case (or add --can-overload)"
            raise InputError("CAN load", must, Words(f"{100 * share:.1f} % of {speed}"))
        return share

    def warnings(self, speed: Speed) -> list[str]:
        """Return a warning if the bus is fuller than the classic layout was designed for."""
        share = self.load(speed)
        if self.classic_hz is None or self.fd_hz is not None or share <= CLASSIC_SHARE:
            return []
        must = f"at most {100 * CLASSIC_SHARE:g} % of {speed} with classic frames, to leave room for other nodes"
        received = Words(f"{100 * share:.1f} % with {len(self.table.classic)} frames an instant")
        return [f"{InputError('CAN load', must, received)} (a lower --can-rate or --can-fd helps)"]

    def _check_fd(self, speed: Speed) -> None:
        if self.fd_hz is not None and not speed.fd:
            raise InputError("--can-bitrate", "two rates for CAN FD, such as 1M/8M", str(speed))

    def _shapes(self) -> list[analysis.PeriodicMessage]:
        return [
            analysis.PeriodicMessage(
                row.identifier,
                period_s,
                row.length,
                jitter_s=SLOT_S if row.periodic else 0.0,
                # Samples may wait for others: they are numbered, and a controller queues them.
                deadline_s=period_s if row.samples is None else SAMPLE_DEADLINE_S,
                fd=row.fd,
                brs=row.fd,
            )
            for row, period_s in self.messages().items()
        ]


def schedule_from(*, classic: bool, fd: bool, rate_hz: int | None, table: MessageTable | None = None) -> Schedule:
    """Return the schedule for the options of `rig run` and `rig can load`.

    Args:
        classic: Send the classic layout; also sent if neither is requested.
        fd: Send the FD layout.
        rate_hz: Sample rate [Hz], for classic frames at most their usual one; None for the usual rates.
        table: Messages; by default those of the standard channel table.

    Raises:
        InputError: The rate is out of range.
    """
    if rate_hz is not None and not 1 <= rate_hz <= 20_000:
        raise InputError("--can-rate", "between 1 and 20000 Hz", rate_hz)
    classic = classic or not fd
    if classic and not fd and rate_hz is not None and rate_hz > CLASSIC_HZ:
        raise InputError("--can-rate", f"at most {CLASSIC_HZ} Hz for classic frames (add --can-fd)", rate_hz)
    return Schedule(
        classic_hz=min(rate_hz or CLASSIC_HZ, CLASSIC_HZ) if classic else None,
        fd_hz=(rate_hz or FD_HZ) if fd else None,
        table=table or default_messages(),
    )
