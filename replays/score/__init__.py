"""What a DAQ under test recorded, held against what the rig sent: by rows where it took counts, else by least squares.

`judgement` makes a `scorecard` of a file and a session: `digital` follows row by row, `analogue` fits the known signal.
The two never stand in one verdict.
"""
