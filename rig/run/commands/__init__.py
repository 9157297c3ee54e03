"""Scene commands: actions on a running rig.

All that depends on a command follows from this table and from the command's class in `mechanical` or `channel`:
messages, help, command line, console, CAN frames, events, triggers, viewer, campaigns, identification.
`tests/unit/test_command_table.py` reports incomplete entries. This module imports neither, so that help is instant;
`table` imports both.
"""

SUMMARIES = {
    "hammer": "Hit the disk of a running rig with the hammer",
    "speed": "Set the spin speed of a running rig",
    "release": "Release the shaft of a running rig from the magnets",
    "fault": "Inject a fault into a channel of a running rig, or clear it",
    "clear": "",
}
"""Help line by command, in the order of listing; empty for an option of another command (`rig fault --clear`). The
command `name` is the class `NameCommand`."""
