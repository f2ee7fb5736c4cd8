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
    ok: bool

    def __str__(self) -> str:
        """The verdict, and the lowest probabilities."""
        lines = ["verified" if self.ok else f"not verified: {', '.join(self.failed)}"]
        lines += [
            f"P({p.name}) {p.estimate:.4f}, {p.low:.4f} to {p.high:.4f}, at {p.worst_t_s:.0f} s"
            for p in self.probabilities
        ]
        return "\n".join(lines)

    def __repr__(self) -> str:
        """One line."""
        return f"<Verification: {str(self).partition(chr(10))[0]}>"
