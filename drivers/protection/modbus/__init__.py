"""Modbus TCP gateway of a protection rack: the rig's channels as registers, alarms as bits, commands as coils."""
