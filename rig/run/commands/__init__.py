"""Scene commands: what can be done to a rig while it runs.

What names a command follows from this table and from the command's class in `mechanical` or `channel`: messages, help,
command line, console, CAN frames, events, triggers, viewer, campaigns, identification. What an entry lacks,
`tests/unit/test_command_table.py` names. This module imports neither, so that help is instant; `table` imports both.
"""

SUMMARIES = {
    "hammer": "Hit the shaft of a running rig at the disk",
    "speed": "Set the spin speed of a running rig",
    "release": "Make the magnets of a running rig let go of the shaft",
    "fault": "Make a channel of a running rig misbehave, or end that",
    "clear": "",
}
"""Line of help by command, in the order in which commands are listed; empty: an option of another command (`rig fault
--clear`). The command `name` is the class `NameCommand`."""
