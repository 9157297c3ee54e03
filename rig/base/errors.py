"""Errors that a user meets: wrong input, a refusal by the rig, a run that failed, a file that cannot be written."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

from rig.base.text import Words as Words
from rig.base.text import nearest, printable, shown

PART_SUFFIX = ".part"
"""What a file's name ends in while it is being written."""
FULL = frozenset({"scipy", "numba", "rerun", "matplotlib", "pyarrow", "jinja2", "fpdf"})
"""What the extra `full` brings, by the names that are imported: what talks to a rig does without."""
WHOLE_RIG = "pip install 'rotor-stator-rig[full]'"
"""How to get it."""
_LONGEST_LINE = 5000
_MOST_NAMES = 12


class InputError(ValueError):
    """A field has a value it must not have.

    The message always reads `FIELD must be MUST; instead received RECEIVED`, so that every command, service reply and
    notebook shows the same three facts. The command line turns it into one line and exit status 2. What was received is
    a value, which is quoted, or `Words` about it.

    Example:
        >>> import rig
        >>> rig.load_scene("hammer", {"duration_s": -1})
        Traceback (most recent call last):
        rig.base.errors.InputError: duration_s must be greater than 0; instead received -1
    """

    def __init__(self, field: str, must: str, received: object) -> None:
        """Name the field, what it must be, and what it was."""
        self.field = field
        self.must = must
        self.received = received
        super().__init__(printable(f"{field} must be {must}; instead received {shown(received)}", _LONGEST_LINE))


class UnknownNameError(InputError, KeyError):
    """A name that nothing has; the message tells the nearest that there are, or all where none is near.

    Example:
        >>> import rig
        >>> try:
        ...     rig.simulate("hammer", duration_s=0.01).samples["disk_z"]
        ... except KeyError as error:
        ...     print(error)
        name must be one of those that there are, such as disk_y, disk_x (15 in all); instead received 'disk_z'
    """

    def __init__(self, field: str, must: str, name: object, known: Iterable[str]) -> None:
        """Name the field, what it must be, the name that is none, and those that there are."""
        super().__init__(field, such_as(must, name, known), name)

    __str__ = ValueError.__str__  # of a KeyError, it would be in quotes


def such_as(must: str, name: object, known: Iterable[str]) -> str:
    """What a name that is none must be, with the nearest that there are, or all where none is near."""
    known = list(dict.fromkeys(known))
    shown = nearest(name, known) or known[:_MOST_NAMES]
    more = f" ({len(known)} in all)" if len(known) > len(shown) else ""
    return f"{must}, such as {', '.join(shown)}{more}" if shown else must


class RefusedError(InputError):
    """The rig refused a request: carries the rig's own line, which is complete as it stands."""

    def __init__(self, line: str) -> None:
        """Keep the whole line."""
        self.field, self.must = "request", "one that the rig accepts"
        self.received: object = None
        ValueError.__init__(self, printable(line))


class SimulationError(RuntimeError):
    """The numbers have gone wrong: the state is no longer finite, and the run ends."""


class DiskError(RuntimeError):
    """The disk refused in the middle of writing; the message says what is kept of it."""


def need_of_full(error: ModuleNotFoundError) -> str | None:
    """What to say where a part of the whole rig was left out on purpose; None where something else is not there."""
    if (name := (error.name or "").partition(".")[0]) not in FULL:
        return None
    return f"needs {name}, which comes with the whole rig: {WHOLE_RIG}"


def lacks_full() -> bool:
    """Whether a part of the whole rig is not installed; nothing is imported."""
    return any(find_spec(module) is None for module in FULL)


def check_new_file(path: Path, *, field: str, suffixes: tuple[str, ...], force: bool) -> None:
    """Refuse a file that cannot be written, before anything is worked out.

    Args:
        path: The file.
        field: What the user knows it by.
        suffixes: Endings that it may have.
        force: An existing file may be replaced.

    Raises:
        InputError: Another ending, a folder that is missing or read-only, or an existing file.
    """
    if path.suffix not in suffixes:  # also of a path without a name, such as "" and /
        *others, last = suffixes
        endings = f"{', '.join(others)} or {last}" if others else last
        raise InputError(field, f"a file name that ends in {endings}", str(path))
    try:
        path.with_name(path.name + PART_SUFFIX).exists()
    except OSError as error:  # a name that is too long
        raise InputError(field, "a file name that the system accepts", Words(f"{path} ({error.strerror})")) from None
    if not path.parent.is_dir():
        raise InputError(field, "in a folder that exists", str(path))
    if path.is_dir():
        raise InputError(field, "a file, not a folder", str(path))
    if path.exists() and not force:
        raise InputError(field, "a new file (--force replaces one)", Words(f"{path}, which exists"))
    try:
        # Asked of the system by trying: permissions alone do not tell.
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise InputError(field, "in a folder that can be written", Words(f"{path} ({error.strerror})")) from None


def check_not_among(sources: list[Path], output: Path, *, field: str = "output") -> None:
    """Refuse to write over what is read, by whatever name.

    Raises:
        InputError: The file, or the one that it is while it is written, is among the sources.
    """
    for taken in (output, output.with_name(output.name + PART_SUFFIX)):
        for source in sources:
            with suppress(OSError):  # one of them is not there
                if source.samefile(taken):
                    raise InputError(field, "another file than those that are read", str(output))


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A draft beside a file, which takes its place where the block ends well and is removed where it does not.

    Raises:
        DiskError: The disk refused, in whatever words the library that wrote has for it.
    """
    draft = path.with_name(path.name + PART_SUFFIX)
    try:
        yield draft
        draft.replace(path)
    except (InputError, SimulationError, DiskError):
        raise
    except (OSError, RuntimeError, ValueError) as error:  # what libraries make of it; all else is a fault of ours
        # A library that closes what has failed may fail again: the system's own word came first.
        reason, earlier = str(error) or type(error).__name__, error
        while earlier is not None:
            reason = (isinstance(earlier, OSError) and earlier.strerror) or reason
            earlier = earlier.__context__
        raise DiskError(f"{path} could not be written: {reason}; nothing of it is kept") from error
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
