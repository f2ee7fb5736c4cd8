"""What the verification found of a solution, as it stands in its file."""

from __future__ import annotations

from typing import Literal

from scp_recon.solution.part import Part, Probability


class MeanMargin(Part):
    """Margin of an original constraint for the mean, between the nodes too."""

    name: str
    worst_margin: float
    unit: Literal["m", "rad", "m/s"]
    worst_t_s: float


class JointProbability(Part):
    """Probability of a joint constraint at the time when it is smallest, by Monte Carlo."""

    name: str
    worst_t_s: float
    estimate: Probability
    low: Probability
    high: Probability


class FinalMiss(Part):
    """By how much the final state is missed, where the burns left are too few to meet it.

    `weighted_m_s` is what the plan charges for it, beside its delta-v.
    """

    position_m: float
    velocity_m_s: float
    weighted_m_s: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"the final state is missed by {self.position_m:.4g} m and {self.velocity_m_s:.4g} m/s: "
            "too few burns are left to meet it"
        )


class FinalSigma(Part):
    """A limit on the covariance after the last burn, and what nonlinear flights reach of it.

    Root of the summed variances of the three components; `error` is one standard error.
    """

    name: str
    unit: Literal["m", "m/s"]
    asked: float
    flown: float
    error: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"{self.name} of flights {self.flown:.4g} +- {self.error:.2g} {self.unit}, "
            f"asked at most {self.asked:g}"
        )


class Verification(Part):
    """An independent look at the result; `failed` names what keeps it from being ok."""

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
    ok: bool

    def __str__(self) -> str:
        """The verdict, and the lowest probabilities."""
        lines = ["verified" if self.ok else f"not verified: {', '.join(self.failed)}"]
        lines += [str(self.missed)] if self.missed else []
        lines += [str(sigma) for sigma in self.final_sigmas]
        lines += [
            f"P({p.name}) {p.estimate:.4f}, {p.low:.4f} to {p.high:.4f}, at {p.worst_t_s:.0f} s"
            for p in self.probabilities
        ]
        return "\n".join(lines)

    def __repr__(self) -> str:
        """One line."""
        return f"<Verification: {str(self).partition(chr(10))[0]}>"
