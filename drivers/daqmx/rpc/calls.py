"""Calls of NI-DAQmx over gRPC: methods that handle all calls of a pattern, and end them with the vendor's errors."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any, NoReturn

import grpc
from nidaqmx._stubs import nidaqmx_pb2  # noqa: PLC2701
from nidaqmx._stubs.nidaqmx_pb2_grpc import NiDAQmxServicer  # noqa: PLC2701
from nidaqmx.errors import DaqError

from drivers.daqmx.hardware.errors import Code, DaqmxError
from rig.base.errors import RefusedError

CHECKED_VERSION = "1.7.0"
"""Version of the package whose private messages were checked."""


def call(pattern: str) -> Callable[[Any], Any]:
    """Make a method handle the calls of a pattern; it gets request, context, response and the groups of the pattern.

    Args:
        pattern: Regular expression of whole names. A generator handles calls with several responses.
    """

    def mark(method: Any) -> Any:
        method.pattern = re.compile(pattern)
        return method

    return mark


class Calls(NiDAQmxServicer):
    """Servicer whose methods are marked by `call`; other calls are refused."""

    def bind(self) -> None:
        """Bind the methods to the calls of the protocol."""
        methods = [getattr(self, name) for name in dir(type(self)) if hasattr(getattr(type(self), name), "pattern")]
        for name in vars(NiDAQmxServicer):
            if name.startswith("_"):
                continue
            handle = _stream if name.startswith("Register") else _respond
            found = [(method, match.groups()) for method in methods if (match := method.pattern.fullmatch(name))]
            method, groups = found[0] if found else (_refuse_call, (name,))
            setattr(self, name, partial(handle, method, f"{name}Response", groups))


def _refuse_call(_: Any, __: Any, ___: Any, name: str) -> NoReturn:
    raise DaqmxError(Code.FUNCTION_NOT_SUPPORTED_FOR_DEVICE, name)


def _respond(method: Any, response: str, groups: tuple[str, ...], request: Any, context: Any) -> Any:
    result = getattr(nidaqmx_pb2, response)()
    try:
        method(request, context, result, *groups)
    except (DaqmxError, DaqError, ValueError, RefusedError, ConnectionError, EOFError) as error:
        _abort(context, request, error)
    return result


def _stream(method: Any, response: str, groups: tuple[str, ...], request: Any, context: Any) -> Any:
    try:
        yield from method(request, context, getattr(nidaqmx_pb2, response), *groups)
    except DaqmxError as error:
        _abort(context, request, error)


def _abort(context: Any, request: Any, error: Exception) -> NoReturn:
    """End a call with an error, in the metadata that the package reads."""
    if isinstance(error, ValueError | RefusedError):
        error = DaqmxError(Code.INVALID_ATTRIBUTE_VALUE, str(error))
    elif isinstance(error, DaqError):  # of the package's parser of channel lists
        error = DaqmxError(Code(error.error_code), "channels as in rig/ai0:3, rig/ai7")
    elif not isinstance(error, DaqmxError):
        error = DaqmxError(Code.DEV_CANNOT_BE_ACCESSED, str(error))
    task = request.task.name if hasattr(request, "task") else ""
    name = f"\n\nTask Name: {task}" if task else ""
    context.set_trailing_metadata((("ni-error", str(int(error.code))),))
    context.abort(grpc.StatusCode.UNKNOWN, f"{error}{name}\n\nStatus Code: {int(error.code)}")
    raise error
