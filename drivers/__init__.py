"""Clients of a running rig. They use the channel table, the wire format and the transport, never the model."""

from rig.base.import_paths import find_our_modules

find_our_modules()
