"""The subcommands of `rig`, a module each."""
