"""Random scenes: numbered draws over all parameters, laws, sets and levels, and over the events of a run.

Scene k of a seed does not depend on other scenes, so each can be repeated by its number.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rig.base.errors import InputError
from rig.physics.contacts import DAMPING, KELVIN_VOIGT, STIFFNESS
from rig.physics.levels import FRICTION_LAWS, ModelLevels
from rig.physics.model import build_model
from rig.physics.parameters import load_parameters, set_names
from rig.run.scenes import Scene, parse_scene

_RUN_AFTER_S = (0.1, 0.5)
"""Range of the run length after the first hammer pulse [s]."""
_MIN_PAUSE_MS = 2.0
"""Shortest pause between two hammer pulses [ms]."""
_MAX_TRIES = 20
_SCALES = {
    "shaft.mass": (0.5, 2.0),
    "shaft.transverse_inertia": (0.6, 3.0),
    "shaft.polar_inertia": (0.3, 3.0),
    "shaft.arm_ring": (0.8, 1.25),
    "shaft.radius": (0.5, 2.0),
    "shaft.young_modulus": (0.1, 3.0),
    "ring.young_modulus": (0.1, 3.0),
    "ring.width": (0.2, 4.0),
    "magnet.length": (0.7, 1.5),
    "magnet.magnetisation": (0.9, 1.5),
    "drive.torque_gain": (0.1, 10.0),
    "contact.reference_speed": (0.1, 5.0),
}
"""Range of factors on other parameters of the set."""


class _Dice(NamedTuple):
    """Random draws of one scene, rounded to four digits."""

    rng: np.random.Generator

    def uniform(self, low: float, high: float) -> float:
        """Draw uniformly between two numbers."""
        return float(f"{self.rng.uniform(low, high):.4g}")

    def log_uniform(self, low: float, high: float) -> float:
        """Draw uniformly in the logarithm."""
        return float(f"{np.exp(self.rng.uniform(np.log(low), np.log(high))):.4g}")

    def chance(self, share: float) -> bool:
        """Return True with the given probability."""
        return bool(self.rng.random() < share)

    def pick(self, weights: dict[str, float]) -> str:
        """Draw one of several names by weight."""
        shares = np.array(list(weights.values()))
        return str(self.rng.choice(list(weights), p=shares / shares.sum()))

    def choice(self, *names: str) -> str:
        """Draw one of several names with equal probability."""
        return self.pick(dict.fromkeys(names, 1.0))

    def at_s(self, low: float, high: float) -> float:
        """Draw a time in whole microseconds [s]."""
        return round(float(self.rng.uniform(low, high)), 6)


def draw_scene(seed: int, number: int) -> Scene:
    """Return the scene of a number.

    A draw that the model rejects (a ring in which the shaft does not rest, an invalid law) is repeated.

    Args:
        seed: Seed common to all numbers.
        number: Number of the scene, from 0.

    Example:
        >>> draw_scene(1, 0) == draw_scene(1, 0), draw_scene(1, 0) == draw_scene(1, 1)
        (True, False)
    """
    dice = _Dice(np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,))))
    for _ in range(_MAX_TRIES - 1):
        try:
            return _draw(dice, f"random-{seed}-{number}")
        except InputError:
            continue
    return _draw(dice, f"random-{seed}-{number}")


def _draw(dice: _Dice, name: str) -> Scene:
    parameters = dice.pick({own: 3.0 if at == 0 else 1.5 for at, own in enumerate(set_names())})
    levels = _levels(dice)
    changes = _rotor(dice) | _contact(dice) | _houses(dice, parameters)
    own = load_parameters(parameters)
    for key, (low, high) in _SCALES.items():
        if dice.chance(0.12):
            changes[key] = float(f"{float(own.entries[key].value) * dice.log_uniform(low, high):.4g}")
    clearance = changes.get("ring.clearance", 0.926)
    magnets = not dice.chance(0.1)
    position = dice.pick({"equilibrium": 8.0 * magnets, "given": 1.5, "top": 1.0, "bottom": 1.0})
    if dice.chance(0.5):  # ring not centred on the shaft
        angle, far = dice.uniform(0.0, 2.0 * np.pi), dice.uniform(0.0, 0.8 * clearance)
        sag = 1e3 * build_model(own.override(changes), ModelLevels(**levels)).sag
        changes["ring.offset_x"] = round(far * float(np.cos(angle)), 6)
        changes["ring.offset_y"] = round(sag + far * float(np.sin(angle)), 6)
    initial: dict[str, Any] = {"position": position, "magnets": magnets}
    if position == "given":
        angle, far = dice.uniform(0.0, 2.0 * np.pi), dice.uniform(0.0, 0.99 * clearance)
        initial |= {"x_mm": round(far * float(np.cos(angle)), 6), "y_mm": round(far * float(np.sin(angle)), 6)}
    first_s = dice.at_s(0.001, 0.02)
    duration_s = round(first_s + dice.uniform(*_RUN_AFTER_S), 3)
    commands = _impacts(dice, first_s, duration_s, needed=position == "equilibrium")
    if magnets and dice.chance(0.1):
        commands.append({"at_s": dice.at_s(0.0, duration_s), "command": "release"})
    if dice.chance(0.15):
        at_s = dice.at_s(0.0, duration_s)
        commands.append({"at_s": at_s, "command": "speed", "speed_hz": dice.uniform(0.5, 14.0)})
    scene = parse_scene(
        {
            "name": name,
            "parameters": parameters,
            "set": changes,
            "duration_s": duration_s,
            "model": levels,
            # Every engine that supports the law is tested; this one supports all except state-only friction laws.
            "engine": {"name": "rk8" if levels["contact"] == "compliant" else "split"},
            "initial": initial,
            "drive": _drive(dice, duration_s),
            "commands": commands,
        }
    )
    build_model(scene.load_parameters(), scene.model)
    return scene


def _rotor(dice: _Dice) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    if dice.chance(0.7):
        changes["shaft.unbalance_eccentricity"] = dice.uniform(0.0, 0.5)
        changes["shaft.unbalance_phase"] = dice.uniform(-3.0, 3.0)
    if dice.chance(0.3):
        changes |= {f"shaft.damping_ratio_{axis}": dice.uniform(0.0, 0.1) for axis in "xy"}
    if dice.chance(0.6):
        changes["ring.clearance"] = dice.log_uniform(0.2, 2.0)
    if dice.chance(0.4):
        changes["magnet.stiffness"] = dice.uniform(1.0, 4.0) if dice.chance(0.5) else dice.choice("eq35", "cylinders")
    if dice.chance(0.15):
        changes["magnet.count"] = float(dice.rng.integers(3, 13))
    if dice.chance(0.3):
        changes["drive.ramp_rate"] = dice.log_uniform(0.5, 200.0)
    if dice.chance(0.05):
        changes["gravity.acceleration"] = dice.uniform(0.0, 15.0)
    return changes


def _contact(dice: _Dice) -> dict[str, Any]:
    changes: dict[str, Any] = {
        "contact.friction": 0.0 if dice.chance(0.05) else dice.uniform(0.0, 0.9),
        "contact.restitution": 1.0 if dice.chance(0.05) else dice.uniform(0.05, 1.0),
    }
    named = dice.chance(0.6)
    changes["contact.stiffness"] = dice.choice(*STIFFNESS) if named else dice.log_uniform(1e9, 1e12)
    if dice.chance(0.7):
        changes["contact.damping_factor"] = dice.uniform(0.0, 1.5) if dice.chance(0.1) else dice.choice(*DAMPING)
    if changes.get("contact.damping_factor") != KELVIN_VOIGT and dice.chance(0.25):
        # The unit of a numeric stiffness depends on the exponent, so the exponent stays close to 1.5.
        changes["contact.exponent"] = dice.uniform(1.0, 2.5) if named else dice.uniform(1.4, 1.6)
    if dice.chance(0.08):
        changes["contact.viscous_damping"] = dice.log_uniform(1.0, 1e4)
    if dice.chance(0.5):
        changes["contact.speed_floor"] = dice.log_uniform(0.01, 50.0)
    if dice.chance(0.5):
        changes["contact.smoothing_speed"] = dice.log_uniform(0.5, 20.0)
    return changes


def _houses(dice: _Dice, parameters: str) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    own = load_parameters(parameters).entries
    for key in own:
        if key.startswith("house.") and key.endswith(("_mass", "_stiffness", "_damping", "_vertical", "_horizontal")):
            value = own[key].value
            if dice.chance(0.4) and not isinstance(value, str):
                changes[key] = float(f"{value * dice.log_uniform(0.03, 10.0):.4g}")
    if dice.chance(0.5):
        changes["house.preload"] = dice.log_uniform(100.0, 5000.0)
    if dice.chance(0.15):
        changes["house.gap_counts_outer"] = float(dice.chance(0.6))
    return changes


def _levels(dice: _Dice) -> dict[str, Any]:
    weights = {"exact": 14.0, "smoothed": 2.5, "none": 2.0, "switch": 1.5}
    return {
        "magnet": dice.pick({"map": 6.0, "cylinders": 2.0, "linear": 2.0}),
        "shaft": dice.pick({"euler": 8.0, "planar": 2.0}),
        "stator": dice.pick({"two-houses": 8.0, "inner-house": 1.0, "rigid": 1.0}),
        "contact": (contact := dice.pick({"compliant": 19.0, "impact": 1.0})),
        "friction": dice.pick({law: weights[law] for law in FRICTION_LAWS if contact == "compliant" or law == "exact"}),
    }


def _drive(dice: _Dice, duration_s: float) -> dict[str, Any]:
    mode = "ideal" if dice.chance(0.15) else "torque"
    if dice.chance(0.1):
        middle_s = round(dice.uniform(0.02, duration_s - 0.02), 6)
        points = [(at_s, dice.uniform(0.0, 14.0)) for at_s in (0.0, middle_s, duration_s)]
        return {"mode": mode, "profile": points}
    return {"mode": mode, "speed_hz": 0.0 if dice.chance(0.04) else dice.uniform(0.5, 14.0)}


def _impacts(dice: _Dice, first_s: float, duration_s: float, *, needed: bool) -> list[dict[str, Any]]:
    blows: list[dict[str, Any]] = []
    at_s = first_s
    count = int(dice.pick({"0": 0.3 if needed else 3.0, "1": 6.0, "2": 2.0, "3": 1.0, "4": 0.5}))
    while len(blows) < count and at_s < duration_s - 0.01:
        length_ms = dice.log_uniform(0.5, 20.0)
        direction = dice.choice("x", "y", "-x", "-y") if dice.chance(0.2) else dice.uniform(-180.0, 180.0)
        blows.append(
            {
                "at_s": at_s,
                "command": "hammer",
                "force_n": dice.log_uniform(20.0, 1000.0),
                "duration_ms": length_ms,
                "direction": direction,
            }
        )
        at_s = round(at_s + 1e-3 * (length_ms + _MIN_PAUSE_MS) + dice.at_s(0.0, 0.15), 6)
    return blows
