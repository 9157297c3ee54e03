"""Programs that talk to a running rig: they know the channel table, the wire and the transport, never the model."""

from rig.base.old_paths import serve_old_paths

serve_old_paths()
