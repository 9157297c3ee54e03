"""What is changed between the recording and the wire: keys, channels, and the numbers of rows and ticks.

Without options nothing is, and a payload keeps its bytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import ChannelTable


class Edit:
    """Which payloads go out, on which key, and which columns they have.

    Args:
        catalogue: The recorded catalogue document.
        keys: New key of each key that is to go elsewhere; the payloads stay the same.
        channels: Only these channels go out, in this order within their groups; None: all.
        names: New name of each channel that is to have another; its calibration stays.
        truth: Whether the truth goes out.

    Raises:
        InputError: There is no such channel, or two things would get the same key or name.
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
        known = [
            *map(wire.sensor_key, table.groups),
            *map(wire.truth_key, catalogue.get("truth", {})),
            *(wire.EDGES, wire.EVENTS, wire.STATUS),
        ]
        for old, new in self._keys.items():
            if old not in known:
                raise InputError("remap", f"from one of {', '.join(known)}", old)
            if not new.startswith(f"{wire.ROOT}/") or wire.schema_of(new) != wire.schema_of(old):
                raise InputError("remap", f"to a key for the same kind of payload as {old}", new)
        after = [self._keys.get(key, key) for key in known]
        for key in after:
            if after.count(key) > 1:
                raise InputError("remap", "to a key that nothing else has", key)
        self.catalogue = self._edited(catalogue, table, channels, dict(names or {}))
        """The catalogue that goes with what is published."""

    @property
    def changes(self) -> bool:
        """Whether anything is changed or left out."""
        return bool(self._keys or self._columns or self._dropped or not self._truth)

    def key(self, key: str) -> str | None:
        """Key on which a payload goes out; None where it does not."""
        if key in self._dropped or (not self._truth and key.startswith(f"{wire.TRUTH}/")):
            return None
        return self._keys.get(key, key)

    def block(self, key: str, block: wire.Block) -> wire.Block:
        """A block of a recorded key with the columns that go out; the same object where it keeps all."""
        columns = self._columns.get(key)
        if columns is None or block.values.shape[1] <= max(columns):
            return block
        return replace(block, values=block.values[:, columns])

    def _edited(
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
    """Numbers rows and ticks anew, so that they run on where the recording jumps (a loop, a seek) and begin at 0.

    All streams are moved by the same time, so rows of different streams that belong together still have the same
    number, and what the recording itself lacks is still a gap.
    """

    def __init__(self) -> None:
        self._shift = 0
        self._end = 0
        self._edges = 0
        self._edges_shift: int | None = None

    @property
    def moves(self) -> bool:
        """Whether numbers differ from the recorded ones."""
        return self._shift != 0 or bool(self._edges_shift)

    def jump(self, tick: int) -> None:
        """What comes next begins at this tick of the recording; it follows on what went out before."""
        self._shift = self._end - tick
        self._edges_shift = None

    def block(self, key: str, block: wire.Block) -> wire.Block:
        """A block with its new numbers; the same object where they are the old ones."""
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
        """A document with its new time; the same object where it is the old one or has none."""
        tick = document.get("tick")
        if not self._shift or not isinstance(tick, int):
            return document
        tick += self._shift
        return {**document, "tick": tick, "time_s": tick / tick_rate_hz}
