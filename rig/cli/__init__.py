"""The one command, `rig`: a subcommand a file; heavy libraries load inside the function that needs them."""
