"""Programs that talk to a running rig: they know the channel table, the wire and the transport, never the model."""
