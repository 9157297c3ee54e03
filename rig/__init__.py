"""A virtual rotor-stator test rig: motion, forces and sensors as arrays.

    import rig
    run = rig.simulate("hammer", {"drive.speed_hz": 5.2, "contact.friction": 0.3})
    run["disk_x"].max(), run.unit("disk_x")  # all quantities of the model, in SI
    run.samples["disk_x"].max(), run.samples.unit("disk_x")  # samples of the sensors
    run.samples.to_si()["disk_x"], run.times_s  # samples in SI, and their times

`run.names` and `run.samples.names` list the names; an unknown name raises a
KeyError that suggests similar ones. `rig.load_scene` checks a scene without
running it, `rig.load_parameters` returns the parameters with their sources, and
`rig.Simulation` advances step by step. `rig.full_spectrum`, `rig.waterfall`,
`rig.whirl_frequency` and `rig.synchronous` (1X of a run-up) compute the usual
rotordynamic plots from samples. `rig.ensemble` simulates a scene many times with
varied values, and `rig.open_sweep` reads the runs of `rig sweep`.

Recordings are opened by `recorder.reader.Recording`, with samples of the same
type, and written by `replays.recordings.export.write_run`; `rig.connect`, which
is `drivers.client.connect`, reads and commands a running rig. `rig.open_session`
opens one of the recordings that are installed with the rig, and
`rig.show_progress` shows a progress bar of long work. The commands of `rig` use
the same objects.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rig.base.import_paths import find_our_modules

if TYPE_CHECKING:
    from rig.base.errors import InputError, UnknownNameError
    from rig.base.samples import Samples
    from rig.channels.orbit import full_spectrum, synchronous, waterfall, whirl_frequency
    from rig.ensemble.ensemble import Ensemble, ensemble
    from rig.ensemble.sweep import open_sweep
    from rig.physics.parameters import ParameterSet, load_parameters
    from rig.run.offline import Run, simulate
    from rig.run.scenes import Scene, load_scene
    from rig.run.simulation import Simulation

    def connect(url: str = "", **settings: Any) -> Any:
        """Connect to a running rig: `drivers.client.connect`, which must not be imported from here."""

    def open_session(name: str) -> Any:
        """Open a reference session that is installed with the rig: `replays.sessions.open_session`."""

    def show_progress(text: str = "") -> Any:
        """Show a progress bar: `rig.cli.output.progress.show_progress`."""


__all__ = [
    "Ensemble", "InputError", "ParameterSet", "Run", "Samples", "Scene", "Simulation", "UnknownNameError", "connect",
    "ensemble", "full_spectrum", "load_parameters", "load_scene", "open_session", "open_sweep", "show_progress",
    "simulate", "synchronous", "waterfall", "whirl_frequency",
]  # fmt: skip

find_our_modules()
_HOMES = {
    "base.errors": ("InputError", "UnknownNameError"),
    "ensemble.ensemble": ("Ensemble",),
    "ensemble.sweep": ("open_sweep",),
    "run.offline": ("Run", "simulate"),
    "channels.orbit": ("full_spectrum", "synchronous", "waterfall", "whirl_frequency"),
    "physics.parameters": ("ParameterSet", "load_parameters"),
    "base.samples": ("Samples",),
    "run.scenes": ("Scene", "load_scene"),
    "run.simulation": ("Simulation",),
    "cli.output.progress": ("show_progress",),
}
_OTHER_PACKAGES = {"connect": "drivers.client", "open_session": "replays.sessions"}

if not TYPE_CHECKING:  # a type checker uses the imports above

    def __getattr__(name: str) -> Any:
        # Imported on first use: `rig --help` must not load compiled code.
        from importlib import import_module, metadata

        if (other := _OTHER_PACKAGES.get(name)) is not None:
            from pathlib import Path

            from rig.base.import_paths import PLACE

            module = import_module(other)
            if not Path(str(module.__file__)).resolve().is_relative_to(Path(PLACE, other.partition(".")[0]).resolve()):
                raise ImportError(f"{other} must be the rig's own; received {module.__file__}; rename it")
            return getattr(module, name)
        if name == "ensemble":
            return import_module("rig.ensemble")  # a package that is called
        if name == "__version__":
            return metadata.version("rotor-stator-rig")
        home = next((home for home, names in _HOMES.items() if name in names), None)
        if home is None:
            raise AttributeError(f"module 'rig' has no attribute {name!r}")
        try:
            return getattr(import_module(f"rig.{home}"), name)
        except ModuleNotFoundError as error:
            from rig.base.errors import describe_missing_package

            if need := describe_missing_package(error):
                error.add_note(f"rig.{name} {need}")
            raise


def __dir__() -> list[str]:
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
