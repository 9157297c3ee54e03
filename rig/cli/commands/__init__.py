"""The subcommands of `rig`, one module each."""
