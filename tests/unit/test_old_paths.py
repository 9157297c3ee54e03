"""Import paths of earlier versions give the modules of today, with a warning, and wrong ones their usual error."""

from __future__ import annotations

import sys
from importlib import import_module

import pytest


@pytest.mark.filterwarnings("ignore:(rig.(kernels|sensors)|drivers.force) is")
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("rig.scenes", "rig.run.scenes"),
        ("rig.wire", "rig.base.wire"),
        ("rig.transport", "rig.serve.transport"),
        ("rig.kernels.signals", "rig.physics.kernels.signals"),
        ("rig.sensors.conditioning", "rig.channels.sensors.conditioning"),
        ("drivers.force.driver", "drivers.instruments.force.driver"),
    ],
)
def test_an_old_path_is_the_same_module(old: str, new: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if f"{old}.".startswith(f"{name}.") and name != "rig"]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.warns(DeprecationWarning, match=f"^{old} is {new} now$"):
        assert import_module(old) is import_module(new)


@pytest.mark.filterwarnings("ignore:rig.kernels is")
@pytest.mark.parametrize("name", ["rig.nonsense", "rig.kernels.nonsense", "rig.run.nonsense"])
def test_a_wrong_path_is_no_module(name: str) -> None:
    with pytest.raises(ModuleNotFoundError, match=f"No module named '{name}'"):
        import_module(name)
