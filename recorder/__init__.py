"""Records the rig's streams to MCAP files and reads them back.

Knows the rig through its channel table, its wire format and a transport client; never the model.
"""
