"""A recording played again to whoever listens, as if it were the rig.

`tape` reads the files, `timeline` puts the payloads in the order of their deadlines, `edit` changes keys, channels and
numbers, `readahead` reads while others wait, and `player` serves and paces.
"""
