"""Ensembles: many runs of a scene with varied values, in Python (`rig.ensemble`) and as sweeps of files (`rig sweep`).

The package is callable, because `rig.ensemble(...)` and `from rig.ensemble.plan import ...` share the name:
its arguments are those of `rig.ensemble.ensemble.ensemble`.

Example:
    >>> import rig
    >>> over = {"contact.friction": [0.1, 0.2], "hammer.force_n": {"from": 50, "to": 150, "count": 2}}
    >>> runs = rig.ensemble("hammer", over, changes={"duration_s": 0.03})
    >>> len(runs), runs.unit("hammer.force_n"), runs["contact.friction"]
    (4, 'N', array([0.1, 0.1, 0.2, 0.2]))
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _Ensembles(ModuleType):
    def __call__(self, *arguments: Any, **settings: Any) -> Any:
        """Simulate an ensemble: `rig.ensemble.ensemble.ensemble`."""
        from rig.ensemble.ensemble import ensemble

        return ensemble(*arguments, **settings)


sys.modules[__name__].__class__ = _Ensembles
