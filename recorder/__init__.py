"""Recorder: writes the rig's streams to MCAP files and reads them back.

Depends on the channel table, the wire format and a transport client of the rig, never on its model.
"""
