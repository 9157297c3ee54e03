"""Criteria of a validation: a checked TOML file, with a default set."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from replays.recordings.validation.phases import PHASES, QUANTITIES
from rig.base.checks import check, read_toml
from rig.physics.parameters import load_parameters

DEFAULT = Path(__file__).with_name("default.toml")

_DRIFT_FACTOR = 2.0
"""Factor on the drift limit of a log: residuals of a fit are not noise, and their means do not shrink."""

Positive = Annotated[FiniteFloat, Field(gt=0.0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0.0)]
Reason = Annotated[str, Field(min_length=1)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class WindowRules(_Section):
    """Limits of the predictable part of a trajectory, and of the compared part of a recording."""

    reason: Reason
    perturbation: Positive
    """Relative change of the perturbed parameters, as large as the difference between two builds."""
    parameters: tuple[str, ...]
    """Parameters that are perturbed."""
    share: Positive
    """The window ends when the perturbed run differs by this part of any channel's noise floor."""
    longest_s: Positive
    """Compared time from the first sample [s]; bits are compared to the end."""

    @field_validator("parameters")
    @classmethod
    def _known(cls, keys: tuple[str, ...]) -> tuple[str, ...]:
        entries = load_parameters().entries
        for key in keys:
            if key not in entries or isinstance(entries[key].value, str):
                raise ValueError(f"parameters that are numbers; {key} is not one")
        if not keys:
            raise ValueError("at least one parameter")
        return keys


class TrajectoryCriterion(_Section):
    """Limits of the residual over its noise floor, sample by sample within the window."""

    channels: tuple[str, ...]
    """Patterns of channel names, such as `P_*`; the first criterion that matches a channel applies."""
    reason: Reason
    rms: Positive
    """Largest RMS of the residual over the floor, without its standard error."""
    sigmas: NotNegative
    """Number of standard errors that are added to `rms`."""
    peak: Positive
    """Largest single residual [floors]."""
    drift: Positive
    """Largest mean over a stretch [standard errors of the mean]."""


class StatisticCriterion(_Section):
    """Limits of the difference between the recorded and the predicted quantity of a phase."""

    phases: tuple[str, ...]
    quantities: tuple[str, ...]
    """Patterns of names; the first criterion that matches phase and quantity applies."""
    reason: Reason
    relative: NotNegative = 0.0
    """First term of the limit: part of the predicted value, or of 1 for a distance of spectra."""
    absolute: NotNegative = 0.0
    """Second term of the limit, in the quantity's unit."""
    spread: NotNegative
    """Third term of the limit: number of standard deviations over the ensemble."""

    @field_validator("phases")
    @classmethod
    def _phases(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return _known_names(names, PHASES)

    @field_validator("quantities")
    @classmethod
    def _quantities(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return _known_names(names, tuple(QUANTITIES))


class Ensemble(_Section):
    """Perturbed re-simulations with independent noise, which show how well a quantity can be predicted."""

    reason: Reason
    members: Annotated[int, Field(ge=3, le=100)]
    perturbation: Positive
    """Relative change of the window's parameters."""


class TruthCriterion(_Section):
    """Limit for the recorded truth, within the window."""

    reason: Reason
    relative: Positive
    """Largest difference relative to each column's largest value, in addition to that of the perturbed run."""


class Variant(_Section):
    """An equally valid model."""

    reason: Reason
    set: dict[str, Any]
    """Scene and parameters that are changed."""


class Imported(_Section):
    """Additional tolerances for logs of other systems, whose experiment and noise are known less exactly."""

    reason: Reason
    title: str = ""
    """Title of the criteria; "" for the title of all."""
    nuisances: tuple[str, ...]
    """Numbers that are fitted before anything is compared."""
    noise: NotNegative
    """Relative error of the noise estimated from the log."""
    bandwidth: Positive
    """Corner of a real anti-alias filter over the stated one."""
    calibration: NotNegative
    """Relative calibration error of a channel."""
    statistics: NotNegative
    """Relative tolerance of a quantity of a phase, in addition to its spread."""
    variants: tuple[Variant, ...]


class Candidate(_Section):
    """Numbers of the experiment that are changed together to explain a difference."""

    name: str
    keys: Annotated[tuple[str, ...], Field(min_length=1)]
    """Parameters, numbers of the scene, or of a command (`hammer.1.force_n`)."""
    unit: str = ""
    """Unit of the change, which is added; without a unit the change is relative."""
    largest: Positive
    """Largest change of a fit, in either direction."""
    step: Positive = 1.0e-5
    """Step of the difference quotient, in the unit of `largest`."""


class Attribution(_Section):
    """Limits for the explanation of a failure."""

    reason: Reason
    longest_s: Positive
    """Time after the first difference that is fitted [s]."""
    equal: NotNegative
    """Smallest difference of the explained parts by which two candidates are distinguished."""
    enough: Positive
    """Smallest part of the residual that an explanation must explain."""
    least: NotNegative
    """Smallest change of a number of the model that is a finding in a log: relative, or over its related length."""
    candidates: tuple[Candidate, ...]

    def before_contact(self) -> Attribution:
        """Return the limits for a difference before the first contact, which the contact cannot cause."""
        kept = tuple(one for one in self.candidates if not one.name.startswith("contact."))
        return self.model_copy(update={"candidates": kept})


class Criteria(_Section):
    """All criteria of a validation."""

    title: str
    window: WindowRules
    trajectory: tuple[TrajectoryCriterion, ...]
    truth: TruthCriterion
    ensemble: Ensemble
    statistics: tuple[StatisticCriterion, ...]
    attribution: Attribution
    imported: Imported
    floating: tuple[str, ...] = ()
    """Numbers that are fitted without a prior before anything is compared, and are not judged."""

    def with_floating(self, keys: Sequence[str]) -> Criteria:
        """Return the criteria with numbers that are fitted first and not judged."""
        named = tuple(one for one in self.attribution.candidates if not set(one.keys) & set(keys))
        attribution = self.attribution.model_copy(update={"candidates": named})
        return self.model_copy(update={"floating": tuple(dict.fromkeys(keys)), "attribution": attribution})

    def for_log(self) -> Criteria:
        """Return the criteria for a log: wider by the uncertainty of its noise and of equally valid models."""
        rules = self.imported
        wide = 1.0 + rules.noise
        wider = tuple(
            c.model_copy(update={"rms": c.rms * wide, "peak": c.peak * wide, "drift": c.drift * wide * _DRIFT_FACTOR})
            for c in self.trajectory
        )
        more = tuple(c.model_copy(update={"relative": c.relative + rules.statistics}) for c in self.statistics)
        title = rules.title or self.title
        return self.model_copy(update={"title": title, "trajectory": wider, "statistics": more})

    def find_trajectory(self, channel: str) -> TrajectoryCriterion | None:
        """Return the criterion of a channel, or None."""
        return next((c for c in self.trajectory if any(fnmatchcase(channel, p) for p in c.channels)), None)

    def find_statistic(self, phase: str, quantity: str) -> StatisticCriterion | None:
        """Return the criterion of a quantity of a phase, or None."""
        fits = (
            c
            for c in self.statistics
            if any(fnmatchcase(phase, p) for p in c.phases) and any(fnmatchcase(quantity, p) for p in c.quantities)
        )
        return next(fits, None)


def _known_names(patterns: tuple[str, ...], names: tuple[str, ...]) -> tuple[str, ...]:
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise ValueError(f"patterns that match one of {', '.join(names)}")
    return patterns


def load_criteria(path: Path | None = None) -> Criteria:
    """Load criteria, the rig's own by default.

    Raises:
        InputError: The file is invalid; the message has the first error and its field.
    """
    path = DEFAULT if path is None else path
    data = read_toml(path)
    return check(Criteria, data, field=path.name)
