"""Programs that talk to a running rig: they know the channel table, the wire and the transport, never the model."""

from rig.base.import_paths import find_our_modules

find_our_modules()
