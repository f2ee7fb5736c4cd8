"""Test the claims of the comparison on its rows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from experiments.harness import Claim
from experiments.solvers.compare_solvers.cases import (
    ELASTIC,
    EXACT,
    REFERENCE,
    TUNED,
    UNGUARDED,
    Method,
    scenarios,
)
from experiments.solvers.compare_solvers.cell import Row
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.status import Status

AGREE = 1e-4
"""Relative difference of total delta-v, or merit, within which two methods found the same optimum."""

FORMS = ("condensed", "frozen-covariance")
FROZEN = (Method("frozen-stm", "scvx", "CLARABEL"), Method("frozen-covariance", "scvx", "CLARABEL"))


def of_group(rows: Iterable[Row], group: str) -> list[Row]:
    """Rows of a group."""
    return [row for row in rows if row.group == group]


def best_of(rows: Iterable[Row]) -> float:
    """Least total delta-v of the solved rows, m/s."""
    return min((row.total_dv_m_s for row in rows if row.solved), default=np.nan)


class Agreement(NamedTuple):
    """SCP's P2 and IPOPT's from the same P3 solution and facets, elastic where SCP did not converge.

    The difference is IPOPT's delta-v (if infeasible, merit) over SCP's, less one.
    """

    scenario: str
    ours: Row
    theirs: Row
    difference: float
    verdict: str


def agreements(rows: Sequence[Row]) -> list[Agreement]:
    """SCP with full linearisation against IPOPT, scenario by scenario."""
    found = {(row.scenario, row.method): row for row in of_group(rows, "scenarios")}
    result = []
    for scenario in dict.fromkeys(row.scenario for row in of_group(rows, "scenarios")):
        ours = found.get((scenario, REFERENCE.name))
        if ours is None:
            continue
        method = TUNED if ours.solved else ELASTIC
        theirs = found.get((scenario, method.name))
        if theirs is not None:
            result.append(_agreement(scenario, ours, theirs))
    return result


def _agreement(scenario: str, ours: Row, theirs: Row) -> Agreement:
    infeasible = Status.INFEASIBLE.value.name
    if ours.solved and theirs.solved:
        difference = theirs.total_dv_m_s / ours.total_dv_m_s - 1.0
    elif ours.status == theirs.status == infeasible:
        difference = theirs.heavy_merit_m_s / ours.heavy_merit_m_s - 1.0
    else:
        return Agreement(scenario, ours, theirs, np.nan, "one of them did not end")
    verdict = "same optimum" if abs(difference) <= AGREE else "another local optimum: "
    if abs(difference) > AGREE:
        verdict += "SCP's is better" if difference > 0.0 else "IPOPT's is better"
    return Agreement(scenario, ours, theirs, difference, verdict)


def claims(rows: Sequence[Row]) -> list[Claim]:
    """Claims of the comparison, of uniform risk and of exact risk."""
    return [
        *_agreement_claims(rows),
        *_frozen_claims(rows),
        *_algorithm_claims(rows),
        _guess_claim(rows),
        *exact_claims(rows),
    ]


def _agreement_claims(rows: Sequence[Row]) -> list[Claim]:
    ended = [a for a in agreements(rows) if np.isfinite(a.difference)]
    found = []
    for what, solved in (("P2's total delta-v", True), ("the merit of infeasible cases", False)):
        off = [abs(a.difference) for a in ended if a.ours.solved == solved]
        measured, holds = "no scenario in which both end", None
        if off:
            agree = sum(d <= AGREE for d in off)
            measured = f"largest {max(off):.1e}; {agree} of {len(off)} scenarios in which both end"
            holds = max(off) <= AGREE
        found.append(Claim(f"SCP and IPOPT agree on {what}", f"within {AGREE:g}", measured, holds))
    return found


def _frozen_claims(rows: Sequence[Row]) -> list[Claim]:
    found = {(row.scenario, row.method): row for row in of_group(rows, "scenarios")}
    result = []
    for method in FROZEN:
        pairs = [
            (row, found[scenario, method.name])
            for (scenario, name), row in found.items()
            if name == REFERENCE.name and row.solved and (scenario, method.name) in found
        ]
        measured, holds = "no scenario", None
        if pairs:
            dearer = [b.total_dv_m_s / a.total_dv_m_s - 1.0 for a, b in pairs if b.solved]
            lost = [a.scenario for a, b in pairs if not b.solved]
            more = f"delta-v up to {max(dearer):.1e} higher; " if dearer else ""
            measured = f"{more}not solved where the full one is: {_listed(lost)}"
            holds = bool(lost) or max(dearer) > AGREE
        words = f"{method.formulation} differs from the full linearisation"
        result.append(Claim(words, f"by more than {AGREE:g}, or unsolved", measured, holds))
    return [*result, _artificial_claim(found)]


def _artificial_claim(found: dict[tuple[str, str], Row]) -> Claim:
    """Claim of artificial infeasibility: one case shows it; only all scenarios can refute it."""
    free, frozen = (Method(form, UNGUARDED, "CLARABEL").name for form in FORMS)
    needed = (REFERENCE.name, free, frozen)
    tried = [
        [found[scenario, name] for name in needed]
        for scenario in dict.fromkeys(scenario for scenario, _ in found)
        if all((scenario, name) in found for name in needed)
    ]
    infeasible = [
        third.scenario
        for first, second, third in tried
        if first.solved and second.solved and third.status == Status.INFEASIBLE.value.name
    ]
    return Claim(
        "without a safeguard frozen-covariance reports infeasible what the full method solves, with "
        "a safeguard or without",
        "in one scenario",
        f"in {_listed(infeasible)}",
        True if infeasible else None if len(tried) < len(scenarios()) else False,
    )


def _algorithm_claims(rows: Sequence[Row]) -> list[Claim]:
    """Claims on the three algorithms, all with the condensed form and Clarabel."""
    whole = [row for row in rows if row.group in ("matrix", "scenarios")]
    return [
        _algorithm_claim(whole, "from P3's solution, the straight line and the ballistic arc"),
        _algorithm_claim(of_group(rows, "guesses"), "from random guesses"),
    ]


def _algorithm_claim(rows: Sequence[Row], where: str) -> Claim:
    words, threshold = f"SCvx, PTR and SCvx* {where} reach the same optimum", f"within {AGREE:g}"
    cases = [case for case in _cases(rows).values() if len(case) == len(ALGORITHMS)]
    solved = [case for case in cases if all(row.solved for row in case)]
    partly = [case for case in cases if len({row.solved for row in case}) > 1]
    none = [case for case in cases if not any(row.solved for row in case)]
    if not (solved or partly):
        return Claim(words, threshold, "no case", None)
    costs = [[row.total_dv_m_s for row in case] for case in solved]
    worst = max((max(found) / min(found) - 1.0 for found in costs), default=0.0)
    measured = (
        f"largest {worst:.1e}, in {len(solved)} of {len(cases)} cases; only some solve: "
        f"{_listed(map(_unsolved, partly))}; none solves: {_listed(map(_unsolved, none))}"
    )
    return Claim(words, threshold, measured, worst <= AGREE and not partly)


def _cases(rows: Sequence[Row]) -> dict[tuple[str, str, int], list[Row]]:
    """Rows of the condensed form by Clarabel and each algorithm, by scenario, start and seed."""
    names = [Method("condensed", algorithm, "CLARABEL").name for algorithm in ALGORITHMS]
    found: dict[tuple[str, str, int], list[Row]] = {}
    for row in rows:
        if row.method in names:
            found.setdefault((row.scenario, row.start, row.seed), []).append(row)
    return found


def _unsolved(case: Sequence[Row]) -> str:
    """A case's name, and the status of the algorithms that did not solve it."""
    first = case[0]
    name = {"random": f"guess {first.seed}", "p3": first.scenario}.get(first.start, first.start)
    ends = [f"{row.algorithm} {row.status.replace('_', ' ')}" for row in case if not row.solved]
    if len({row.status for row in case}) == 1:
        ends = [first.status.replace("_", " ")]
    return f"{name} ({', '.join(ends)})"


def _listed(words: Iterable[str]) -> str:
    return ", ".join(words) or "none"


def _guess_claim(rows: Sequence[Row]) -> Claim:
    guesses = of_group(rows, "guesses")
    ours = [row for row in guesses if row.method == REFERENCE.name]
    theirs = [row for row in guesses if row.method == TUNED.name]
    best, rival = best_of(ours), best_of(theirs)
    measured = f"{best:.6f} of {len(ours)} and {rival:.6f} m/s of {len(theirs)}"
    known = bool(np.isfinite(best) and np.isfinite(rival))
    words = "over the random guesses SCP's best is no worse than IPOPT's best"
    holds = best <= rival * (1.0 + AGREE) if known else None
    return Claim(words, f"within {AGREE:g}", measured if known else "no such rows", holds)


# --- exact risk -----------------------------------------------------------------------------------

WITHIN = 3e-3
"""Relative excess of total delta-v that counts as the same."""

SHORT_SIGMA, MISS_M = 0.02, 0.01
"""Allowed shortfall of the probability in the check, in standard deviations, and of the rest in m: what
quadratures, sets of directions and the check itself err by."""

SOLVERS = ("SLSQP", "IPOPT")


def holds(row: Row) -> bool:
    """Whether a row's burns keep the required probability and all limits, by the check."""
    if not np.isfinite(row.reached):
        return False
    short = float(ndtri(row.asked) - ndtri(min(max(row.reached, 1e-9), 1.0 - 1e-9)))
    return short <= SHORT_SIGMA and row.violation_m <= MISS_M


class Verdict(NamedTuple):
    """The planner's row of a scenario, and the cheapest valid row of any method.

    The excess is the planner's delta-v over the best one less one; infinite if only others solve the
    scenario, NaN if none does.
    """

    scenario: str
    ours: Row | None
    best: Row | None
    excess: float

    @property
    def words(self) -> str:
        """The outcome in words."""
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
    """Claims that plans are as good as the best known, and that converged plans hold by the check."""
    found = [v for v in verdicts(rows) if v.ours is not None]
    solved = [v for v in found if v.best is not None]
    words = "exact plans cost no more than the best that the planner, SLSQP and IPOPT find"
    threshold = f"{100 * WITHIN:g} %"
    if not solved:
        return [Claim(words, threshold, "no scenario", None)]
    same = [v for v in solved if v.excess <= WITHIN]
    apart = [f"{v.scenario} ({excess(v)})" for v in solved if v.excess > WITHIN]
    none = [v.scenario for v in found if v.best is None]
    worst = max((v.excess for v in same), default=np.nan)
    measured = (
        f"at most {100 * worst:.2g} % in {len(same)} of {len(solved)} scenarios that any of them "
        f"solves; not in: {_listed(apart)}; none solves: {_listed(none)}"
    )
    return [Claim(words, threshold, measured, not apart), _converged_claim(found)]


def _converged_claim(found: Sequence[Verdict]) -> Claim:
    plans = [v.ours for v in found if v.ours is not None and v.ours.solved]
    short = [row.scenario for row in plans if not holds(row)]
    measured = f"{len(plans) - len(short)} of {len(plans)} scenarios; not in: {_listed(short)}"
    words = "plans that the planner calls converged hold by the check"
    return Claim(words, "in every scenario", measured, not short if plans else None)


def excess(verdict: Verdict) -> str:
    """Extra cost of the planner's plan over the best."""
    return "not solved" if verdict.excess == np.inf else f"{100 * verdict.excess:+.2f} %"
