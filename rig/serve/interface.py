"""The page of keys, messages and units: `keys.jinja`, filled from channel table, codec and access table.

`rig keys` shows it; rig/KEYS.md is its committed copy.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any

from rig.base import wire
from rig.channels.faults import describe_kinds
from rig.channels.sampling import SensorChoice
from rig.physics.kernels import signals
from rig.run.commands.command import Quantity
from rig.run.commands.table import COMMANDS, EVENT_KINDS
from rig.run.scenes import rig_table
from rig.serve.transport.exposure import access


def page() -> str:
    """Return the page as Markdown."""
    import jinja2

    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {"g": "{:g}".format, "fields": _fields}
    template = environment.from_string(files("rig.serve").joinpath("keys.jinja").read_text(encoding="utf-8"))
    return template.render(
        wire=wire,
        groups=rig_table().groups.values(),
        signals=signals,
        truth_hz=SensorChoice().truth_rate_hz,
        commands=COMMANDS,
        event_kinds=EVENT_KINDS,
        faults=describe_kinds(rig_table()),
        access=access,
    )


def _fields(command: Any) -> str:
    """Return the fields of a command with their limits and defaults."""
    fields = "; ".join(_field(key, field) for key, field in command.model_fields.items() if key != "command")
    return fields.replace("`what`", "`kind` and its parameters, below") or "no fields"


def _field(key: str, field: Any) -> str:
    limits = {
        kind: value
        for item in field.metadata
        for kind in ("ge", "le")
        if (value := getattr(item, kind, None)) is not None
    }
    text = f"`{key}`"
    if limits:
        text += " " + " ".join(f"{'from' if kind == 'ge' else 'to'} {value:g}" for kind, value in limits.items())
    text += "".join(f" {item.takes}" for item in field.metadata if isinstance(item, Quantity) and item.takes)
    if not field.is_required():
        text += f" (default {field.default})"
    return text
