"""What the comparison on exact risk is to show, scenario by scenario, and its table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from experiments.compare_solvers.cases import EXACT, REFERENCE
from experiments.compare_solvers.claims import Claim, of_group
from experiments.compare_solvers.row import Row
from experiments.studies import markdown

WITHIN = 3e-3
"""Relative excess of total delta-v that counts as the same."""

SHORT_SIGMA, MISS_M = 0.02, 0.01
"""What the check may find short of the probability, in standard deviations, and of the rest in m: what
quadratures, sets of directions and the check itself err by."""

SOLVERS = ("SLSQP", "IPOPT")


def holds(row: Row) -> bool:
    """Whether the check finds that a row's burns keep what was asked."""
    if not np.isfinite(row.reached):
        return False
    short = float(ndtri(row.asked) - ndtri(min(max(row.reached, 1e-9), 1.0 - 1e-9)))
    return short <= SHORT_SIGMA and row.violation_m <= MISS_M


class Verdict(NamedTuple):
    """One scenario.

    Attributes:
        scenario: its name.
        ours: the planner's row; None if it is missing.
        best: the cheapest row that holds, whoever has found it.
        excess: the planner's delta-v over the best one less one; infinite where others alone solve it,
            NaN where nobody does.
    """

    scenario: str
    ours: Row | None
    best: Row | None
    excess: float

    @property
    def words(self) -> str:
        """Who has solved it."""
        if self.best is None:
            return "no method solves it"
        if self.excess == np.inf:
            return "the planner does not solve it"
        return "same" if self.excess <= WITHIN else "another has a cheaper one"


def verdicts(rows: Sequence[Row]) -> list[Verdict]:
    """The planner against the best of all, for each scenario."""
    group, found = of_group(rows, EXACT), []
    for scenario in dict.fromkeys(row.scenario for row in group):
        own = [row for row in group if row.scenario == scenario]
        ours = next((row for row in own if row.method == REFERENCE.name), None)
        best = min(filter(holds, own), key=lambda row: row.total_dv_m_s, default=None)
        excess = np.nan if best is None else np.inf
        if best is not None and ours is not None and ours.solved and holds(ours):
            excess = ours.total_dv_m_s / best.total_dv_m_s - 1.0
        found.append(Verdict(scenario, ours, best, excess))
    return found


def exact_claims(rows: Sequence[Row]) -> list[Claim]:
    """What the table is to show."""
    found = [v for v in verdicts(rows) if v.ours is not None]
    solved = [v for v in found if v.best is not None]
    within = f"{100 * WITHIN:g} %"
    words = f"exact plans are within {within} of the best that the planner, SLSQP and IPOPT find"
    if not solved:
        return [Claim(words, None)]
    same = [v for v in solved if v.excess <= WITHIN]
    apart = [f"{v.scenario} ({_excess(v)})" for v in solved if v.excess > WITHIN]
    none = [v.scenario for v in found if v.best is None]
    worst = max((v.excess for v in same), default=np.nan)
    words += (
        f" in {len(same)} of {len(solved)} scenarios that any of them solves (there by at most "
        f"{100 * worst:.2g} %); not in: {', '.join(apart) or 'none'}; nobody solves: "
        f"{', '.join(none) or 'none'}"
    )
    return [Claim(words, not apart), _converged_claim(found)]


def _converged_claim(found: Sequence[Verdict]) -> Claim:
    """A plan that has converged keeps its word."""
    plans = [v.ours for v in found if v.ours is not None and v.ours.solved]
    short = [row.scenario for row in plans if not holds(row)]
    words = (
        f"what the planner calls converged holds by the check in {len(plans) - len(short)} of "
        f"{len(plans)} scenarios; not in: {', '.join(short) or 'none'}"
    )
    return Claim(words, not short if plans else None)


def _excess(verdict: Verdict) -> str:
    return "not solved" if verdict.excess == np.inf else f"{100 * verdict.excess:+.2f} %"


def exact_table(rows: Sequence[Row]) -> list[str]:
    """A line for each scenario."""
    group = of_group(rows, EXACT)
    header = (
        "scenario", "asked", "planner: m/s", "reached", "s",
        *(f"{solver}: m/s (s)" for solver in SOLVERS),
        "planner over best", "verdict",
    )  # fmt: skip
    lines = []
    for verdict in verdicts(rows):
        own = {r.solver: r for r in group if r.scenario == verdict.scenario}
        ours = verdict.ours
        theirs = [own.get(solver) for solver in SOLVERS]
        told = verdict.best is not None and verdict.excess < np.inf
        lines.append(
            (
                verdict.scenario,
                *(("-",) * 4 if ours is None else _ours(ours)),
                *map(_theirs, theirs),
                _excess(verdict) if told else "-",
                verdict.words,
            )
        )
    return markdown(header, lines).splitlines()


def _ours(row: Row) -> tuple[str, str, str, str]:
    if not np.isfinite(row.reached):
        return "-", row.detail, "-", f"{row.cpu_s:.1f}"
    cost = f"{row.total_dv_m_s:.6f}" if row.solved else row.status.replace("_", " ")
    return (
        f"{row.asked:g}",
        cost,
        f"{row.reached:.4f} +- {row.reached_error:.4f}",
        f"{row.cpu_s:.1f}",
    )


def _theirs(row: Row | None) -> str:
    """Delta-v where the check holds, however the search ended."""
    if row is None:
        return "-"
    if not np.isfinite(row.reached):
        return row.detail
    late = "; out of time" if row.status == "max_iterations" else ""
    cost = f"{row.total_dv_m_s:.6f}" if holds(row) else "nothing that holds"
    return f"{cost} ({row.cpu_s:.1f}{late})"
