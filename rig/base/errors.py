"""User-facing errors: wrong input, a refusal by the rig, a failed run, a file that cannot be written."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from rig.base.text import Words as Words
from rig.base.text import find_similar, format_value, printable

FULL_PACKAGES = frozenset({"scipy", "numba", "rerun", "matplotlib", "pyarrow", "jinja2", "fpdf"})
"""Import names of the packages in the extra `full`; clients of a rig do not need them."""
INSTALL_COMMAND = "pip install 'rotor-stator-rig[full]'"
"""Command that installs them."""
_MAX_LINE = 5000
_MAX_NAMES = 12


class InputError(ValueError):
    """A field has an invalid value.

    The message is always `FIELD must be MUST; received RECEIVED`, in every command, service reply and notebook.
    The command line prints it on one line and exits with status 2. RECEIVED is a value, which is quoted, or `Words`
    about it.

    Example:
        >>> import rig
        >>> rig.load_scene("hammer", {"duration_s": -1})
        Traceback (most recent call last):
        rig.base.errors.InputError: duration_s must be greater than 0; received -1
    """

    def __init__(self, field: str, must: str, received: object) -> None:
        """Set the field, the requirement, and the received value."""
        self.field = field
        self.must = must
        self.received = received
        super().__init__(printable(f"{field} must be {must}; received {format_value(received)}", _MAX_LINE))


class UnknownNameError(InputError, KeyError):
    """An unknown name; the message suggests similar known names, otherwise it lists all.

    Example:
        >>> import rig
        >>> try:
        ...     rig.simulate("hammer", duration_s=0.01).samples["disk_z"]
        ... except KeyError as error:
        ...     print(error)
        name must be one of the existing names, such as disk_y, disk_x (15 in all); received 'disk_z'
    """

    def __init__(self, field: str, must: str, name: object, known_names: Iterable[str]) -> None:
        """Set the field, the requirement, the unknown name, and the known names."""
        super().__init__(field, such_as(must, name, known_names), name)

    __str__ = ValueError.__str__  # KeyError would add quotes


def such_as(must: str, name: object, known_names: Iterable[str]) -> str:
    """Return a requirement with known names similar to an unknown one, otherwise with all."""
    known_names = list(dict.fromkeys(known_names))
    shown = find_similar(name, known_names) or known_names[:_MAX_NAMES]
    more = f" ({len(known_names)} in all)" if len(known_names) > len(shown) else ""
    listed = all(one in must for one in shown)
    return must if listed else f"{must}, such as {', '.join(shown)}{more}"


class RefusedError(InputError):
    """The rig refused a request; the message is the rig's own line."""

    def __init__(self, line: str) -> None:
        """Keep the whole line."""
        self.field, self.must = "request", "one that the rig accepts"
        self.received: object = None
        ValueError.__init__(self, printable(line))


class SimulationError(RuntimeError):
    """The state of a simulation is no longer finite, and the run ends."""


class DiskError(RuntimeError):
    """The disk refused during writing; the message says what is kept."""


class MissingPackageError(ModuleNotFoundError):
    """A package of an extra is not installed; the message has the command that installs it."""


def describe_missing_package(error: ModuleNotFoundError) -> str | None:
    """Return the hint for a missing package of the extra `full`; None for any other."""
    if (name := (error.name or "").partition(".")[0]) not in FULL_PACKAGES:
        return None
    return f"needs {name}, which comes with the whole rig: {INSTALL_COMMAND}"


def require_package(name: str, extra: str) -> Any:
    """Return an optional package, imported.

    Args:
        name: Import name.
        extra: Extra of this product that has it.

    Raises:
        MissingPackageError: It is not installed.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        line = f"{name} is not installed: pip install 'rotor-stator-rig[{extra}]'"
        raise MissingPackageError(line, name=name) from error


def is_full_missing() -> bool:
    """Return whether a package of the extra `full` is missing, without importing any."""
    return any(find_spec(module) is None for module in FULL_PACKAGES)
