"""Replay of a recording on the wire, as if the rig were running.

`track` reads the files, `timeline` orders the payloads by deadline, `readahead` reads on its own thread, `edit` changes
keys, channels and numbers, `outlet` publishes and counts, `playhead` keeps the time of the replay, `play_range` selects
the part and the number of passes, and `player` serves the replay and executes commands.
"""
