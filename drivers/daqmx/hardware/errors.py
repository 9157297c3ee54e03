"""Errors of the device, with the codes of NI-DAQmx."""

from __future__ import annotations

from typing import NoReturn

from nidaqmx.error_codes import DAQmxErrors

from rig.base.errors import InputError

Code = DAQmxErrors


class DaqmxError(Exception):
    """Error of a call, with its code.

    Args:
        code: Code of NI-DAQmx.
        detail: Cause, and what to do.
    """

    def __init__(self, code: DAQmxErrors, detail: str) -> None:
        super().__init__(f"{describe(code)}: {detail}")
        self.code = code


def describe(code: int) -> str:
    """Return the text of a code: its name in the table of the package, in words; empty if it has none."""
    return DAQmxErrors(code).name.replace("_", " ").capitalize() if code in list(DAQmxErrors) else ""


def refuse_value(what: str, must: str, received: object) -> NoReturn:
    """Raise the error for a value that the device does not support.

    Raises:
        DaqmxError: Always.
    """
    raise DaqmxError(Code.INVALID_ATTRIBUTE_VALUE, str(InputError(what, must, received)))
