"""Virtual CAN: the rig's messages (`signals`), python-can's way to them (`interface`), DBC, load and response times.

Behind them stand the bus itself (`bus/`) and the rig as a node of it (`gateway/`).
"""
