"""Import paths of version 0.1, such as `rig.scenes` for `rig.run.scenes`: they work in this version, with a warning."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from os.path import dirname, exists, join
from types import ModuleType

_PLACE = dirname(dirname(dirname(__file__)))  # noqa: PTH120 - pathlib would take longer to load than all else here
_FOLDERS = {
    "rig": ("base", "physics", "channels", "run", "serve"),
    "drivers": ("instruments", "sources"),
    "recorder": ("files", "contents", "output"),
}
"""Where a module that stood at the top of a package may be now."""


class OldPaths:
    """Gives a module that has moved its old name as well."""

    def find_spec(self, fullname: str, path: object, target: object = None) -> ModuleSpec | None:
        """Return a spec for an old name, none for others."""
        package, *rest = fullname.split(".")
        if package not in _FOLDERS or not rest or _is_there(package, rest[0]):
            return None
        folder = next((each for each in _FOLDERS[package] if _is_there(package, each, rest[0])), None)
        if folder is None or not _is_there(package, folder, *rest):
            return None
        return ModuleSpec(fullname, self, origin=".".join([package, folder, *rest]))  # pyright: ignore[reportArgumentType]

    def create_module(self, spec: ModuleSpec) -> None:
        """Leave it to the import system: the module is replaced when it is executed."""

    def exec_module(self, module: ModuleType) -> None:
        """Put the module of the new name in the place of the one that was made."""
        import warnings
        from importlib import import_module

        spec = module.__spec__
        assert spec is not None
        warnings.warn(f"{spec.name} is {spec.origin} now", DeprecationWarning, stacklevel=2)
        sys.modules[spec.name] = import_module(str(spec.origin))


def _is_there(*names: str) -> bool:
    path = join(_PLACE, *names)  # noqa: PTH118
    return exists(path) or exists(f"{path}.py")  # noqa: PTH110


def serve_old_paths() -> None:
    """Let imports find modules by their old names."""
    if not any(isinstance(finder, OldPaths) for finder in sys.meta_path):
        # Before the usual search, which would load a second copy of what lies deeper.
        sys.meta_path.insert(0, OldPaths())  # pyright: ignore[reportArgumentType]
