"""Secret file of a server whose protocol has no certificates: programs that may read it may send commands.

A server at the loopback lends its own certificate to every program of this computer; the secret limits that to the
programs of one user.
"""

from __future__ import annotations

import os
import re
import secrets
from pathlib import Path

from rig.base.errors import InputError, Words
from rig.base.files import read_file

_BYTES = 16
"""Length of a secret [bytes]."""


def read_secret(path: Path) -> str:
    """Return the secret of a file, which is created if it does not exist; only its owner can read it.

    Args:
        path: The file.

    Raises:
        InputError: It is no such file, others can read it, or it cannot be created.
    """
    path = path.expanduser()
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(f"{secrets.token_hex(_BYTES)}\n")
    except FileExistsError:
        pass
    except OSError as error:
        raise InputError("--secret", f"a file that can be created ({error.strerror})", str(path)) from None
    try:
        secret, mode = read_file(path, 4 * _BYTES).decode("ascii", "replace").strip(), path.stat().st_mode
    except OSError as error:
        raise InputError("--secret", f"a file that can be read ({error.strerror})", str(path)) from None
    if not re.fullmatch(rf"[0-9a-f]{{{2 * _BYTES}}}", secret):
        must = f"a new file, or one with {2 * _BYTES} hexadecimal digits, as this command creates it"
        raise InputError("--secret", must, str(path))
    if os.name == "posix" and mode & 0o077:
        raise InputError("--secret", f"a file that is private to its owner (chmod 600 {path})", Words("another"))
    return secret
