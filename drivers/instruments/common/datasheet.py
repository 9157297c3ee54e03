"""What an instrument says about itself: a TEDS-like datasheet (after IEEE 1451.4: identification, then calibration)."""

from __future__ import annotations

from pydantic import BaseModel, ValidationError

from rig.base.errors import InputError
from rig.channels.table import Channel, Group


class Datasheet(BaseModel, frozen=True, extra="forbid"):
    """Identification, and for each channel its complete calibration."""

    manufacturer: str
    model: str
    serial: str
    virtual: bool
    """True for a twin: nothing here was ever calibrated against a standard."""
    title: str
    rate_hz: int
    """Rows per second at which it measures [Hz]; 0 where it measures nothing."""
    channels: tuple[Channel, ...]
    """Sensitivity, bias, range, bandwidth, converter; `kind` is the provenance of these figures."""
    acts: tuple[str, ...]
    """What it can be told to do."""

    def group(self, names: tuple[str, ...] | None = None) -> Group:
        """Channels as a group that converts counts; all, or those named.

        Raises:
            InputError: There is no such channel.
        """
        known = {channel.name: channel for channel in self.channels}
        for name in names or ():
            if name not in known:
                raise InputError("channel", f"one of {', '.join(known)}", name)
        chosen = self.channels if names is None else tuple(known[name] for name in names)
        return Group(name=self.model, title=self.title, rate_hz=self.rate_hz or 1, channels=chosen)


def parse_datasheet(text: str) -> Datasheet:
    """The datasheet in a JSON text.

    Raises:
        InputError: It is none.
    """
    try:
        return Datasheet.model_validate_json(text)
    except ValidationError:
        raise InputError("datasheet", "an instrument's datasheet", text[:60]) from None
