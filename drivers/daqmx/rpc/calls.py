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

from drivers.daqmx.hardware.errors import Code, DaqmxError, refuse_value
from rig.base.errors import RefusedError, Words
from rig.base.text import printable

CHECKED_VERSION = "1.7.0"
"""Version of the package whose private messages were checked."""
_MAX_TEXT, _MAX_RANGES = 1024, 16
"""Longest text of a request, and its largest number of colons: each range in a list may have 15,000 channels."""
_MAX_ERROR = 1500
"""Longest text of an error: gRPC clients refuse metadata above 8 kB."""


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
            setattr(self, name, partial(handle, self, method, f"{name}Response", groups))

    def check(self, call: str, request: Any, context: Any) -> None:
        """Check a request before its method handles it.

        Args:
            call: Name of the call.
            request: The request.
            context: Context of the call.

        Raises:
            DaqmxError: A text is too long.
        """
        for field, value in (*request.ListFields(), *(request.task.ListFields() if hasattr(request, "task") else ())):
            if isinstance(value, str) and (len(value) > _MAX_TEXT or value.count(":") > _MAX_RANGES):
                detail = Words(f"{len(value)} characters with {value.count(':')} colons")
                refuse_value(field.name, f"at most {_MAX_TEXT} characters with {_MAX_RANGES} colons", detail)


def _refuse_call(_: Any, __: Any, ___: Any, name: str) -> NoReturn:
    raise DaqmxError(Code.FUNCTION_NOT_SUPPORTED_FOR_DEVICE, name)


def _respond(calls: Calls, method: Any, response: str, groups: tuple[str, ...], request: Any, context: Any) -> Any:
    result = getattr(nidaqmx_pb2, response)()
    try:
        calls.check(response.removesuffix("Response"), request, context)
        method(request, context, result, *groups)
    except (DaqmxError, DaqError, ValueError, RefusedError, ConnectionError, EOFError) as error:
        _abort(context, request, error)
    return result


def _stream(calls: Calls, method: Any, response: str, groups: tuple[str, ...], request: Any, context: Any) -> Any:
    try:
        calls.check(response.removesuffix("Response"), request, context)
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
    name = f"\n\nTask Name: {printable(task, _MAX_ERROR // 4)}" if task else ""
    context.set_trailing_metadata((("ni-error", str(int(error.code))),))
    denied = error.code in (Code.PASSWORD_REQUIRED, Code.INCORRECT_PASSWORD)
    status = grpc.StatusCode.PERMISSION_DENIED if denied else grpc.StatusCode.UNKNOWN
    context.abort(status, f"{printable(str(error), _MAX_ERROR)}{name}\n\nStatus Code: {int(error.code)}")
    raise error
