"""Errors of the device, with the codes of NI-DAQmx."""

from __future__ import annotations

from enum import EnumMeta
from typing import NoReturn

from nidaqmx import constants
from nidaqmx.error_codes import DAQmxErrors

from rig.base.errors import InputError, Words

Code = DAQmxErrors
_NAMES = {
    item.value: Words(item.name) for kind in vars(constants).values() if isinstance(kind, EnumMeta)
    for item in kind if item.value >= 10_000
}  # fmt: skip
"""Name of each value of the package's constants; smaller values have several meanings."""


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


def name_constant(value: object) -> object:
    """Return the name of a value of the package's constants, or the value if it has no name."""
    return _NAMES.get(value, value)


def refuse_value(what: str, must: str, received: object) -> NoReturn:
    """Raise the error for a value that the device does not support.

    Raises:
        DaqmxError: Always.
    """
    raise DaqmxError(Code.INVALID_ATTRIBUTE_VALUE, str(InputError(what, must, received)))
