"""Virtual CAN: the rig's messages (`signals`), python-can interface (`interface`), DBC, bus load and response times.

`bus/` is the bus itself, `gateway/` the rig as a node of it.
"""
