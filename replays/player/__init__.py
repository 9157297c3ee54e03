"""A recording played again to whoever listens, as if it were the rig.

`track` reads the files, `timeline` puts the payloads in the order of their deadlines, `readahead` reads while others
wait, `edit` changes keys, channels and numbers, `outlet` publishes and counts, `playhead` keeps the time of the play,
`play_range` says which part is played how often, and `player` serves it and obeys.
"""
