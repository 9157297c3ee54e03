"""The `rig` command: one subcommand per module; heavy libraries are imported inside the function that needs them."""
