"""Scorecards of a DAQ under test: its recording compared with the rig's samples, by counts or by least squares.

`judgement` returns a `scorecard` for a file and a session: `digital` compares rows, `analogue` fits the known signal.
The two never share a verdict.
"""
