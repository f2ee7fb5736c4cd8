"""Define the record of a verification, as in a plan's file: what was checked, and what failed; SI."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from scp_recon.display import digits
from scp_recon.mission.constraints import Miss
from scp_recon.scenario.fields import Line, Number, Probability

NAMES = {
    "risk": "stored probabilities",
    "certificate": "certificate by flights",
    "covariance_error": "covariance, re-integrated",
    "knowledge_error": "knowledge, re-integrated",
    "drift_error_m": "drifts, re-integrated",
    "max_defect": "nodes, re-integrated",
    "sample_error_m": "sampled flights, re-integrated",
    "terminal_position_error_m": "final position, re-integrated",
    "terminal_velocity_error_m_s": "final velocity, re-integrated",
}
"""Words for checks whose names are those of the file."""


def in_words(name: str) -> str:
    """A check in words, by its name in the file."""
    return NAMES.get(name, name)


@dataclass(frozen=True)
class MeanMargin:
    """Margin of an original constraint for the mean, between the nodes too.

    Attributes:
        name: of the constraint.
        worst_margin: the smallest, >= 0 where satisfied.
        unit: of the margin.
        worst_t_s: its time.
    """

    name: str
    worst_margin: float
    unit: Literal["m", "rad", "m/s"]
    worst_t_s: float


@dataclass(frozen=True)
class JointProbability:
    """Probability of a joint constraint at the time when it is lowest, by Monte Carlo.

    Attributes:
        name: of the constraint.
        worst_t_s: that time.
        estimate: share of the flights.
        low: lower end of its Clopper-Pearson interval.
        high: upper end of it.
    """

    name: str
    worst_t_s: float
    estimate: Probability
    low: Probability
    high: Probability


@dataclass(frozen=True)
class LostContact:
    """What flights keep if a contact is lost: its burn is commanded from earlier data.

    Attributes:
        burn: that uses its data, from 1.
        begin_s: beginning of the contact past the epoch.
        end_s: end of it.
        worst: of whole flights with the scope "flight", else of the joint constraint that fewest keep.
    """

    burn: Annotated[int, Field(ge=1)]
    begin_s: float
    end_s: float
    worst: JointProbability


@dataclass(frozen=True)
class DriftSafety:
    """Free drifts after a burn that is missed or cut short, by nonlinear flights.

    Attributes:
        burn: its number in the flight, from 1.
        share: of the burn that happens, 0 where it is missed.
        drift_s: time flown from the burn on.
        radius_m: distance from the body's centre that safe drifts keep.
        required: probability that is planned for; absent where none is.
        value: share of safe drifts.
        low: lower end of its Clopper-Pearson interval.
        high: upper end of it.
        closest_m: distance from the centre that 99.7 % of drifts keep.
        closest_t_s: time past the epoch of the approach at that distance.
        impact: share of drifts that come within the body's reference radius.
    """

    burn: Annotated[int, Field(ge=1)]
    share: float
    drift_s: float
    radius_m: float
    required: Probability | None
    value: Probability
    low: Probability
    high: Probability
    closest_m: Number
    closest_t_s: float
    impact: Probability

    @property
    def event(self) -> str:
        """What happens, in words."""
        return Miss(self.burn, self.share).event

    @property
    def check(self) -> str:
        """Its name among the checks."""
        return f"P(safe drift where {self.event})"

    @property
    def row(self) -> str:
        """Its name in tables of limits."""
        return f"drift: {self.event}"

    @property
    def is_refuted(self) -> bool:
        """Whether flights refute the required probability, if there is one."""
        return self.required is not None and self.high < self.required

    @property
    def binds(self) -> bool:
        """Whether flights cannot tell the probability from what is required, or refute that."""
        return self.required is not None and self.low < self.required

    def __str__(self) -> str:
        """In words."""
        return (
            f"drift: closest 99.7 % in {self.drift_s / 3600.0:.3g} h after {self.event}: "
            f"{self.closest_m:.0f} m from the centre; impact {100.0 * self.impact:.3g} %"
        )


@dataclass(frozen=True)
class BurnLimit:
    """Probability that a corrected burn, as it is commanded, keeps a limit on burns.

    Attributes:
        burn: its number.
        name: of the limit.
        t_s: time of the burn.
        probability: by the normal law of the correction.
    """

    burn: int
    name: Line
    t_s: float
    probability: Probability

    def __str__(self) -> str:
        """Its name in checks."""
        return f"P({self.name} of burn {self.burn})"


@dataclass(frozen=True)
class FinalMiss:
    """Miss of the final state, where too few burns are left to meet it.

    Attributes:
        position_m: in position.
        velocity_m_s: in velocity.
        weighted_m_s: charge for it in the plan's cost, beside the delta-v.
    """

    position_m: float
    velocity_m_s: float
    weighted_m_s: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"the final state is missed by {digits(self.position_m, 4)} m and "
            f"{digits(1e3 * self.velocity_m_s, 4)} mm/s: too few burns are left to meet it"
        )


@dataclass(frozen=True)
class FinalSigma:
    """A limit on the covariance after the last burn, and the value that nonlinear flights reach.

    Attributes:
        name: of the limit.
        unit: of the figures.
        required: largest root of the summed variances of the three components.
        flown: that root over 5000 nonlinear flights.
        error: one standard error of it.
    """

    name: str
    unit: Literal["m", "m/s"]
    required: Annotated[float, Field(alias="asked")]
    flown: float
    error: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"{self.name} of flights {digits(self.flown, 4)} +- {self.error:.2g} {self.unit}, "
            f"required at most {self.required:g}"
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class Verification:
    """A check of the plan without the solver.

    Attributes:
        terminal_position_error_m: miss of the final position when the burns are flown again.
        terminal_velocity_error_m_s: miss of the final velocity.
        max_defect: largest difference between a stored node and that flight, m; velocities count as
            metres per unit of time.
        sample_error_m: largest difference between sampled flights and the adaptive integration; the
            same.
        covariance_error: largest error of a stored covariance, relative to its largest entry in scaled
            units.
        knowledge_error: largest error of a stored covariance of estimates, likewise; absent without
            feedback.
        drift_error_m: largest distance of a planned drift's mean from its adaptive integration; absent
            without planned drifts.
        mean_margins: every original constraint on the mean, between the nodes too.
        samples: flights of the Monte Carlo simulation.
        confidence: of its Clopper-Pearson intervals.
        probabilities: each joint constraint where it is smallest.
        failed: names of failed checks, among them a status other than converged.
        missed: miss of the final state where too few burns are left to meet it; reported, no check.
        final_sigmas: limits on the covariance after the last burn.
        burn_limits: limits on corrected burns, with feedback.
        drifts: after each missed burn, and after those cut short for which was planned.
        lost_contacts: what each lost contact does, if `navigation.contacts.what_if_lost` asks for it.
        wider: sigma of flights after the last burn over the predicted one, of those components of the
            state in which flights spread clearly more; absent if none does.
        ok: whether no check failed.
    """

    terminal_position_error_m: float
    terminal_velocity_error_m_s: float
    max_defect: float
    sample_error_m: float
    covariance_error: float
    mean_margins: list[MeanMargin]
    samples: int
    confidence: float
    probabilities: list[JointProbability]
    failed: list[str]
    missed: FinalMiss | None = None
    final_sigmas: tuple[FinalSigma, ...] = ()
    burn_limits: tuple[BurnLimit, ...] = ()
    drifts: tuple[DriftSafety, ...] = ()
    lost_contacts: tuple[LostContact, ...] | None = None
    wider: dict[str, float] | None = None
    knowledge_error: float | None = None
    drift_error_m: float | None = None
    ok: bool

    @property
    def nearest_drift(self) -> DriftSafety | None:
        """The drift that comes nearest, of those after the first burn where there are any."""
        later = [drift for drift in self.drifts if drift.burn > 1] or self.drifts
        return min(later, key=lambda drift: drift.closest_m, default=None)

    @property
    def verdict(self) -> str:
        """Whether the plan is verified, or which checks failed, on one line."""
        return "verified" if self.ok else f"not verified: {self.failed_in_words}"

    @property
    def failed_in_words(self) -> str:
        """Failed checks in words, on one line."""
        return ", ".join(map(in_words, self.failed))

    def __str__(self) -> str:
        """The verdict, and the lowest probabilities."""
        lines = [self.verdict]
        lines += [str(self.missed)] if self.missed else []
        lines += [str(sigma) for sigma in self.final_sigmas]
        lines += [str(drift) for drift in self.drifts]
        lines += [
            f"P({p.name}) {p.estimate:.4f}, {p.low:.4f} to {p.high:.4f}, at {p.worst_t_s:.0f} s"
            for p in self.probabilities
        ]
        return "\n".join(lines)

    def __repr__(self) -> str:
        """One line."""
        return f"<Verification: {self.verdict}>"
