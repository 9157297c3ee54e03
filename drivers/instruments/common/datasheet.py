"""Electronic datasheet of an instrument, similar to TEDS (IEEE 1451.4): identification, then calibration."""

from __future__ import annotations

from pydantic import BaseModel, ValidationError

from rig.base.errors import InputError
from rig.channels.table import Channel, Group


class Datasheet(BaseModel, frozen=True, extra="forbid"):
    """Identification of an instrument, and the complete calibration of each channel."""

    manufacturer: str
    model: str
    serial: str
    virtual: bool
    """True for a twin: its figures were never calibrated against a standard."""
    title: str
    rate_hz: int
    """Sample rate [Hz]; 0 for an instrument that measures nothing."""
    channels: tuple[Channel, ...]
    """Sensitivity, bias, range, bandwidth, converter; `kind` is the provenance of these figures."""
    acts: tuple[str, ...]
    """Names of the commands that it accepts."""

    def group(self, names: tuple[str, ...] | None = None) -> Group:
        """Return channels as a group that converts counts.

        Args:
            names: Names of the channels; by default all.

        Raises:
            InputError: The channel does not exist.
        """
        channels = {channel.name: channel for channel in self.channels}
        for name in names or ():
            if name not in channels:
                raise InputError("channel", f"one of {', '.join(channels)}", name)
        chosen = self.channels if names is None else tuple(channels[name] for name in names)
        return Group(name=self.model, title=self.title, rate_hz=self.rate_hz or 1, channels=chosen)


def parse_datasheet(text: str) -> Datasheet:
    """Parse a datasheet in JSON.

    Raises:
        InputError: The text is not a datasheet.
    """
    try:
        return Datasheet.model_validate_json(text)
    except ValidationError:
        raise InputError("datasheet", "an instrument's datasheet", text[:60]) from None
