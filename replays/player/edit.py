"""Changes between the recording and the wire: keys, channels, row numbers and ticks.

Without options, payloads are published unchanged, byte for byte.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import ChannelTable


class Edit:
    """Selection and renaming of published payloads and of their columns.

    Args:
        catalogue: Recorded catalogue document.
        keys: New keys by recorded key; payloads stay the same.
        channels: Channels to publish, in this order within their groups; None: all.
        names: New channel names by recorded name; calibrations stay the same.
        truth: Whether to publish the truth.

    Raises:
        InputError: If a channel does not exist, or a key or name would occur twice.
    """

    def __init__(
        self,
        catalogue: dict[str, Any],
        *,
        keys: Mapping[str, str] | None = None,
        channels: Sequence[str] | None = None,
        names: Mapping[str, str] | None = None,
        truth: bool = True,
    ) -> None:
        table = ChannelTable.model_validate(catalogue["table"])
        self._keys = dict(keys or {})
        self._truth = truth
        self._columns: dict[str, list[int]] = {}
        self._dropped: set[str] = set()
        valid_keys = [
            *map(wire.sensor_key, table.groups),
            *map(wire.truth_key, catalogue.get("truth", {})),
            *(wire.EDGES, wire.EVENTS, wire.STATUS),
        ]
        for old, new in self._keys.items():
            if old not in valid_keys:
                raise InputError("remap", f"from one of {', '.join(valid_keys)}", old)
            if not new.startswith(f"{wire.ROOT}/") or wire.get_schema(new) != wire.get_schema(old):
                raise InputError("remap", f"to a key for the same kind of payload as {old}", new)
        after = [self._keys.get(key, key) for key in valid_keys]
        for key in after:
            if after.count(key) > 1:
                raise InputError("remap", "to a key that nothing else has", key)
        self.catalogue = self._apply_edits(catalogue, table, channels, dict(names or {}))
        """Catalogue that matches the published payloads."""

    @property
    def changes(self) -> bool:
        """True if anything is changed or left out."""
        return bool(self._keys or self._columns or self._dropped or not self._truth)

    def key(self, key: str) -> str | None:
        """Return the key on which a payload is published, or None if it is not."""
        if key in self._dropped or (not self._truth and key.startswith(f"{wire.TRUTH}/")):
            return None
        return self._keys.get(key, key)

    def block(self, key: str, block: wire.Block) -> wire.Block:
        """Return a block with the selected columns; the same object if all are selected."""
        columns = self._columns.get(key)
        if columns is None or block.values.shape[1] <= max(columns):
            return block
        return replace(block, values=block.values[:, columns])

    def _apply_edits(
        self, catalogue: dict[str, Any], table: ChannelTable, channels: Sequence[str] | None, names: dict[str, str]
    ) -> dict[str, Any]:
        for name in [*(channels or ()), *names]:
            if name not in table.channels:
                raise InputError("channels", f"one of {', '.join(table.channels)}", name)
        if channels is not None and (not channels or len(set(channels)) != len(channels)):
            raise InputError("channels", "at least one, each once", ",".join(channels))
        chosen = list(table.channels if channels is None else channels)
        called = [names.get(name, name) for name in chosen]
        if len(set(called)) != len(called):
            raise InputError("rename", "to names that no other channel has", ", ".join(names.values()))
        if channels is None and not names:
            return catalogue if self._truth else {**catalogue, "truth": {}}
        groups = {}
        for group in table.groups.values():
            columns = [group.names.index(name) for name in chosen if name in group.names]
            key = wire.sensor_key(group.name)
            if not columns:
                self._dropped.add(key)
                continue
            if columns != list(range(len(group.channels))):
                self._columns[key] = columns
            rows = (group.channels[column] for column in columns)
            renamed = tuple(row.model_copy(update={"name": names.get(row.name, row.name)}) for row in rows)
            groups[group.name] = group.model_copy(update={"channels": renamed})
        edited = {**catalogue, "table": table.model_copy(update={"groups": groups}).model_dump(mode="json")}
        return edited if self._truth else {**edited, "truth": {}}


class Stamp:
    """Renumbering of rows and ticks: they begin at 0 and stay continuous when the recording jumps (a loop or a seek).

    All streams are shifted by the same time, so simultaneous samples of different streams keep the same number, and
    gaps of the recording stay gaps.
    """

    def __init__(self) -> None:
        self._shift = 0
        self._end = 0
        self._edges = 0
        self._edges_shift: int | None = None

    @property
    def moves(self) -> bool:
        """True if numbers differ from the recorded ones."""
        return self._shift != 0 or bool(self._edges_shift)

    def jump(self, tick: int) -> None:
        """Set the tick of the recording with which the numbering continues."""
        self._shift = self._end - tick
        self._edges_shift = None

    def block(self, key: str, block: wire.Block) -> wire.Block:
        """Return a block with its new numbers; the same object if they do not change."""
        if key == wire.EDGES:
            if self._edges_shift is None:
                self._edges_shift = self._edges - block.index
            rows = self._edges_shift
            self._edges = block.index + rows + len(block.values)
        else:
            ticks_a_row = block.tick_rate_hz / block.rate_hz if block.rate_hz > 0.0 else 1.0
            rows = round(self._shift / ticks_a_row)
            self._end = max(self._end, block.tick + self._shift + round(len(block.values) * ticks_a_row))
        if not self._shift and not rows:
            return block
        return replace(block, tick=block.tick + self._shift, index=block.index + rows)

    def document(self, document: dict[str, Any], tick_rate_hz: float) -> dict[str, Any]:
        """Return a document with its new time; the same object if it does not change or has none."""
        tick = document.get("tick")
        if not self._shift or not isinstance(tick, int):
            return document
        tick += self._shift
        return {**document, "tick": tick, "time_s": tick / tick_rate_hz}
