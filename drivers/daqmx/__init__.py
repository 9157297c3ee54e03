"""NI-DAQmx device of a running rig, served over gRPC for programs that use the package `nidaqmx`.

The messages and the base class of the server are those that the package ships in a private module; a test compares its
version with the one that was checked. Nothing here has access to the model or its truth.
"""
