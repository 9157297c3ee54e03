"""Virtual CAN: frames bit by bit, a bus with arbitration and faults, response times, and what speaks to python-can."""
