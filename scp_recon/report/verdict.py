"""The verdict of a plan in a line: what was asked, what is achieved, and whether it is verified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from formulations.rows.exact import FLIGHT
from scp_recon.report.content.achieved import SO_FAR, Achieved
from scp_recon.report.content.subject import Subject
from scp_recon.scp.status import Status


@dataclass(frozen=True)
class Verdict:
    """What stands at the head of the page.

    Attributes:
        good: verified, or not.
        word: the verdict.
        asked: what was asked.
        achieved: what flights achieve.
        cost: the delta-v.
        remarks: warnings, and what else has to be said of the plan.
    """

    good: bool
    word: str
    asked: str
    achieved: str
    cost: str
    remarks: tuple[str, ...]


def verdict_of(subject: Subject, found: Sequence[Achieved], total_high_m_s: float) -> Verdict:
    """Of a plan.

    Args:
        subject: the plan.
        found: probabilities over time by sampled flights, for plans that were not verified.
        total_high_m_s: what 99 % of the flights' totals of delta-v stay below.
    """
    solution = subject.solution
    checked, status = solution.verification, Status.named(solution.status)
    good = checked is not None and checked.ok and status is Status.CONVERGED
    word = "verified" if good else "not verified"
    if checked is None:
        word = "not checked"
    elif checked.failed:
        word = f"not verified: {', '.join(checked.failed)}"
    return Verdict(
        good,
        word,
        _asked(subject),
        _achieved(subject, found),
        f"{solution.total_dv_m_s:.6f} m/s in {len(solution.burns)} burns; 99 % of the flights stay "
        f"below {total_high_m_s:.6f} m/s",
        _remarks(subject, status),
    )


def _asked(subject: Subject) -> str:
    risk = subject.solution.scenario.risk
    if subject.solution.problem == "P3":
        return "no probability (P3: the problem without uncertainty)"
    if risk.scope == "flight":
        return f"at least {risk.p_chance:g} of whole flights keep every limit"
    return f"every limit at every node with at least {risk.p_chance:g}"


def _achieved(subject: Subject, found: Sequence[Achieved]) -> str:
    solution = subject.solution
    whole = solution.scenario.risk.scope == "flight"
    checked = solution.verification
    if checked is not None and checked.probabilities:
        chosen = [p for p in checked.probabilities if (p.name == FLIGHT) == whole]
        p = min(chosen or checked.probabilities, key=lambda p: p.estimate)
        name, value, low, high, at = p.name, p.estimate, p.low, p.high, p.worst_t_s
        samples = checked.samples
    else:
        one = min((f for f in found if (f.name == SO_FAR) == whole), key=lambda f: f.value.min())
        k = one.worst
        name, value, low, high = one.name, one.value[k], one.low[k], one.high[k]
        at, samples = one.times_s[k], 0
    of = f", by {samples} flights" if samples else ", by sampled flights"
    interval = f"95 % interval {low:.4f} to {high:.4f}"
    if whole:
        return f"{value:.4f} of whole flights ({interval}{of})"
    return f"{value:.4f} where it is least, {name} at {at:.0f} s ({interval}{of})"


def _remarks(subject: Subject, status: Status) -> tuple[str, ...]:
    solution = subject.solution
    said = [] if status is Status.CONVERGED else [solution.message]
    said += [
        f"{name}: violated by up to {amount.max:.4g} {amount.unit}"
        for name, amount in solution.violation.by_constraint.items()
    ]
    risk = solution.risk
    if risk is not None and risk.certificate is None:
        said.append("not certified by flights: the normal law alone promises the probability")
    elif risk is not None and risk.certificate is not None:
        c = risk.certificate
        said.append(
            f"certificate: {c.samples} flights reached {c.reached:.4f} ({c.low:.4f} to {c.high:.4f})"
        )
    warned = dict.fromkeys([*solution.warnings, *subject.mission.warnings])
    said += [f"warning: {w.entry}: {w.given}; {w.expected}" for w in warned]
    return (*said, *subject.passed_over)
