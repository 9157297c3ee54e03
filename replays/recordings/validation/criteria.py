"""What a validation asks for: a TOML file, checked; one comes with the rig."""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from replays.recordings.validation.phases import PHASES, QUANTITIES
from rig.base.checks import check, read_toml
from rig.physics.parameters import load_parameters

DEFAULT = Path(__file__).with_name("default.toml")

_LASTING = 2.0
"""Times what noise may drift by: what a fit leaves is none, and its mean over a stretch does not shrink."""

Positive = Annotated[FiniteFloat, Field(gt=0.0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0.0)]
Reason = Annotated[str, Field(min_length=1)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class WindowRules(_Section):
    """How long a trajectory can be predicted, and how much of a recording is compared at all."""

    reason: Reason
    perturbation: Positive
    """Relative change of the perturbed parameters: what another build may do."""
    parameters: tuple[str, ...]
    """Parameters that are changed by it."""
    share: Positive
    """The window ends where the perturbed run is off by this part of any channel's noise floor."""
    longest_s: Positive
    """Time from the first sample on that is compared [s]; bits are compared to the end."""

    @field_validator("parameters")
    @classmethod
    def _known(cls, keys: tuple[str, ...]) -> tuple[str, ...]:
        entries = load_parameters().entries
        for key in keys:
            if key not in entries or isinstance(entries[key].value, str):
                raise ValueError(f"parameters that are numbers; {key} is none")
        if not keys:
            raise ValueError("at least one parameter")
        return keys


class TrajectoryCriterion(_Section):
    """Limits of the residual over its noise floor, sample by sample inside the window."""

    channels: tuple[str, ...]
    """Patterns of channel names, such as `P_*`; of several criteria the first that fits a channel holds."""
    reason: Reason
    rms: Positive
    """Largest RMS of residual over floor, ..."""
    sigmas: NotNegative
    """... plus so many standard errors of it."""
    peak: Positive
    """Largest single residual [floors]."""
    drift: Positive
    """Largest mean over a stretch [standard errors of such a mean]."""


class StatisticCriterion(_Section):
    """Limits of a quantity of a phase: recorded against predicted."""

    phases: tuple[str, ...]
    quantities: tuple[str, ...]
    """Patterns of names; of several criteria the first that fits phase and quantity holds."""
    reason: Reason
    relative: NotNegative = 0.0
    """Part of the predicted value (a distance of spectra is a part already: then of 1), ..."""
    absolute: NotNegative = 0.0
    """... plus so much in the quantity's own unit, ..."""
    spread: NotNegative
    """... plus so many times the standard deviation over the ensemble."""

    @field_validator("phases")
    @classmethod
    def _phases(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return _known_names(names, PHASES)

    @field_validator("quantities")
    @classmethod
    def _quantities(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return _known_names(names, tuple(QUANTITIES))


class Ensemble(_Section):
    """Re-simulations that show how far a quantity can be predicted: perturbed, each with noise of its own."""

    reason: Reason
    members: Annotated[int, Field(ge=3, le=100)]
    perturbation: Positive
    """Relative, of the window's parameters."""


class TruthCriterion(_Section):
    """Limit for the truth, where it was recorded, inside the window."""

    reason: Reason
    relative: Positive
    """Largest difference as a part of each column's largest value, beyond that of the perturbed run."""


class Variant(_Section):
    """A model that is as right as ours."""

    reason: Reason
    set: dict[str, Any]
    """Scene and parameters that are changed."""


class Imported(_Section):
    """What is asked of logs of other systems, which tell less exactly what was done and how loud their sensors are."""

    reason: Reason
    title: str = ""
    """What they are judged by; "" for the title of all."""
    nuisances: tuple[str, ...]
    """Numbers that are fitted before anything is compared."""
    noise: NotNegative
    """By this part the noise may be off that was read off the log."""
    bandwidth: Positive
    """Corner of a real anti-alias filter over the one that is told."""
    calibration: NotNegative
    """By this part of what it shows a channel may be off: calibrations are no better."""
    statistics: NotNegative
    """By this part of it a quantity of a phase may be off beside its spread."""
    variants: tuple[Variant, ...]


class Candidate(_Section):
    """What may be off: numbers of the experiment that are changed together."""

    name: str
    keys: Annotated[tuple[str, ...], Field(min_length=1)]
    """Parameters, numbers of the scene, or of a command (`hammer.1.force_n`)."""
    unit: str = ""
    """With a unit the change is added, in that unit; without, it is a part of the value."""
    largest: Positive
    """The fit goes no further than this, either way."""
    step: Positive = 1.0e-5
    """Of the difference quotient, as `largest`."""


class Attribution(_Section):
    """How a failure is explained."""

    reason: Reason
    longest_s: Positive
    """Time behind the first difference that the fits see [s]."""
    equal: NotNegative
    """Candidates whose explained parts differ by less than this cannot be told apart."""
    enough: Positive
    """A candidate that explains less than this part of the residual is no explanation."""
    candidates: tuple[Candidate, ...]


class Criteria(_Section):
    """All of it."""

    title: str
    window: WindowRules
    trajectory: tuple[TrajectoryCriterion, ...]
    truth: TruthCriterion
    ensemble: Ensemble
    statistics: tuple[StatisticCriterion, ...]
    attribution: Attribution
    imported: Imported

    def of_log(self) -> Criteria:
        """For channels whose noise is known only to a part of it, and quantities that models as right leave open."""
        rules = self.imported
        wide = 1.0 + rules.noise
        wider = tuple(
            c.model_copy(update={"rms": c.rms * wide, "peak": c.peak * wide, "drift": c.drift * wide * _LASTING})
            for c in self.trajectory
        )
        more = tuple(c.model_copy(update={"relative": c.relative + rules.statistics}) for c in self.statistics)
        title = rules.title or self.title
        return self.model_copy(update={"title": title, "trajectory": wider, "statistics": more})

    def trajectory_of(self, channel: str) -> TrajectoryCriterion | None:
        """The criterion of a channel."""
        return next((c for c in self.trajectory if any(fnmatchcase(channel, p) for p in c.channels)), None)

    def statistic_of(self, phase: str, quantity: str) -> StatisticCriterion | None:
        """The criterion of a quantity of a phase."""
        fits = (
            c
            for c in self.statistics
            if any(fnmatchcase(phase, p) for p in c.phases) and any(fnmatchcase(quantity, p) for p in c.quantities)
        )
        return next(fits, None)


def _known_names(patterns: tuple[str, ...], known: tuple[str, ...]) -> tuple[str, ...]:
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in known):
            raise ValueError(f"patterns that fit one of {', '.join(known)}")
    return patterns


def load_criteria(path: Path | None = None) -> Criteria:
    """Load criteria, the rig's own by default.

    Raises:
        InputError: The one thing that is wrong, with its field.
    """
    path = DEFAULT if path is None else path
    data = read_toml(path)
    return check(Criteria, data, field=path.name)
