"""Calls of NI-DAQmx over gRPC, by subject."""
