"""Additional import paths: modules that have moved, and modules hidden by the user's files.

Paths of version 0.1, such as `rig.scenes` for `rig.run.scenes`, still work, with a warning. A user's folder or file
named `drivers`, `recorder` or `replays` does not hide our modules, except modules of the same name.
"""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import spec_from_file_location
from os.path import abspath, dirname, exists, join
from types import ModuleType
from typing import Any

PLACE = dirname(dirname(dirname(__file__)))  # noqa: PTH120 - pathlib would take longer to load than all else here
"""Folder of our packages."""
_FOLDERS = {
    "rig": ("base", "physics", "channels", "run", "serve"),
    "drivers": ("instruments", "sources"),
    "recorder": ("files", "contents", "output"),
    "replays": (),
}
"""Our packages, and the folders that modules of their top level may have moved to."""


class ModuleFinder:
    """Finds moved modules by their old names, and our modules in a user's package of the same name."""

    def find_spec(self, fullname: str, path: Any, target: object = None) -> ModuleSpec | None:
        """Return the spec of such a module; None for others."""
        package, *rest = fullname.split(".")
        if package not in _FOLDERS:
            return None
        if not rest:
            return _spec_of_file(package)
        ours = join(PLACE, package)  # noqa: PTH118
        if _module_exists(package, rest[0]):
            if len(rest) > 1 or ours in path or PathFinder.find_spec(fullname, path):
                return None
            return PathFinder.find_spec(fullname, [ours])
        folder = next((each for each in _FOLDERS[package] if _module_exists(package, each, rest[0])), None)
        if folder is None or not _module_exists(package, folder, *rest):
            return None
        loader: Any = self
        return ModuleSpec(fullname, loader, origin=".".join([package, folder, *rest]))

    def create_module(self, spec: ModuleSpec) -> None:
        """Use the default module, which is replaced when it is executed."""

    def exec_module(self, module: ModuleType) -> None:
        """Replace the module with the one of the new name."""
        import warnings
        from importlib import import_module

        spec = module.__spec__
        assert spec is not None
        warnings.warn(f"{spec.name} is {spec.origin} now", DeprecationWarning, stacklevel=2)
        sys.modules[spec.name] = import_module(str(spec.origin))


def _spec_of_file(package: str) -> ModuleSpec | None:
    """Return the spec of a user's file such as `recorder.py`, extended by our modules; None for folders."""
    spec = PathFinder.find_spec(package)
    if spec is None or spec.submodule_search_locations is not None or spec.origin is None:
        return None
    main = getattr(sys.modules.get("__main__"), "__file__", None)
    if main is not None and abspath(main) == abspath(spec.origin):  # noqa: PTH100
        return PathFinder.find_spec(package, [PLACE])  # not run twice
    return spec_from_file_location(package, spec.origin, submodule_search_locations=[join(PLACE, package)])  # noqa: PTH118


def _module_exists(*names: str) -> bool:
    path = join(PLACE, *names)  # noqa: PTH118
    return exists(path) or exists(f"{path}.py")  # noqa: PTH110


def find_our_modules() -> None:
    """Install the finder of old names and of our modules in users' packages."""
    if not any(isinstance(finder, ModuleFinder) for finder in sys.meta_path):
        # Before the default finders, which would load a second copy of deeper modules.
        finder: Any = ModuleFinder()
        sys.meta_path.insert(0, finder)
        for package in _FOLDERS:
            module: Any = sys.modules.get(package)
            if module is not None and not hasattr(module, "__path__"):  # a file of the user's, imported before us
                module.__path__ = [join(PLACE, package)]  # noqa: PTH118
