"""What the comparison is to show, and whether its rows show it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from experiments.compare_solvers.cases import (
    ELASTIC,
    REFERENCE,
    TUNED,
    UNGUARDED,
    Method,
    scenarios,
)
from experiments.compare_solvers.row import Row
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.status import Status

AGREE = 1e-4
"""Relative difference of total delta-v, or merit, within which two methods found the same optimum."""

FORMS = ("condensed", "frozen-covariance")
FROZEN = (Method("frozen-stm", "scvx", "CLARABEL"), Method("frozen-covariance", "scvx", "CLARABEL"))


class Claim(NamedTuple):
    """Something that the comparison is to show, and whether it does; None where no row can tell."""

    words: str
    holds: bool | None


def of_group(rows: Iterable[Row], group: str) -> list[Row]:
    """Rows of a group."""
    return [row for row in rows if row.group == group]


def best_of(rows: Iterable[Row]) -> float:
    """Least total delta-v of what was solved, m/s."""
    return min((row.total_dv_m_s for row in rows if row.solved), default=np.nan)


class Agreement(NamedTuple):
    """Two methods' P2 from the same P3 solution and facets.

    Attributes:
        scenario: its name.
        ours, theirs: SCP's row and IPOPT's, hard where SCP converged and elastic where not.
        difference: theirs over ours less one, of the delta-v or, where infeasible, of the merit.
        verdict: in words.
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
    """What the comparison is to show."""
    return [
        *_agreement_claims(rows),
        *_frozen_claims(rows),
        *_algorithm_claims(rows),
        _guess_claim(rows),
    ]


def _agreement_claims(rows: Sequence[Row]) -> list[Claim]:
    ended = [a for a in agreements(rows) if np.isfinite(a.difference)]
    for_dv = [abs(a.difference) for a in ended if a.ours.solved]
    for_merit = [abs(a.difference) for a in ended if not a.ours.solved]
    return [
        Claim(
            f"SCP and IPOPT agree on {what} within {AGREE:g} in {sum(d <= AGREE for d in found)} of "
            f"{len(found)} scenarios in which both end (largest difference {max(found):.1e})",
            max(found) <= AGREE,
        )
        if found
        else Claim(f"SCP and IPOPT agree on {what} within {AGREE:g}", None)
        for what, found in (
            ("P2's total delta-v", for_dv),
            ("the merit of infeasible cases", for_merit),
        )
    ]


def _frozen_claims(rows: Sequence[Row]) -> list[Claim]:
    found = {(row.scenario, row.method): row for row in of_group(rows, "scenarios")}
    result = []
    for method in FROZEN:
        pairs = [
            (row, found[scenario, method.name])
            for (scenario, name), row in found.items()
            if name == REFERENCE.name and row.solved and (scenario, method.name) in found
        ]
        words = f"{method.formulation} differs from the full linearisation"
        if not pairs:
            result.append(Claim(words, None))
            continue
        dearer = [b.total_dv_m_s / a.total_dv_m_s - 1.0 for a, b in pairs if b.solved]
        lost = [a.scenario for a, b in pairs if not b.solved]
        if dearer:
            words += f", its delta-v is higher by up to {max(dearer):.1e} (relative)"
        words += f", not solved where the full one is: {', '.join(lost) or 'never'}"
        result.append(Claim(words, bool(lost) or max(dearer) > AGREE))
    return [*result, _artificial_claim(found)]


def _artificial_claim(found: dict[tuple[str, str], Row]) -> Claim:
    """One case is enough, so that a part of the scenarios can show it but not deny it."""
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
    words = "without a safeguard frozen-covariance reports infeasible what the full method solves"
    if infeasible:
        return Claim(f"{words}, with a safeguard or without, in: {', '.join(infeasible)}", True)
    return Claim(words, None if len(tried) < len(scenarios()) else False)


def _algorithm_claims(rows: Sequence[Row]) -> list[Claim]:
    """Condensed by Clarabel, which is where all three algorithms meet."""
    whole = [row for row in rows if row.group in ("matrix", "scenarios")]
    return [
        _algorithm_claim(whole, "from P3's solution, the straight line and the ballistic arc"),
        _algorithm_claim(of_group(rows, "guesses"), "from random guesses"),
    ]


def _algorithm_claim(rows: Sequence[Row], where: str) -> Claim:
    words = f"SCvx, PTR and SCvx* {where} reach the same optimum within {AGREE:g}"
    cases = [case for case in _cases(rows).values() if len(case) == len(ALGORITHMS)]
    solved = [case for case in cases if all(row.solved for row in case)]
    partly = [case for case in cases if len({row.solved for row in case}) > 1]
    none = [case for case in cases if not any(row.solved for row in case)]
    if not (solved or partly):
        return Claim(words, None)
    costs = [[row.total_dv_m_s for row in case] for case in solved]
    worst = max((max(found) / min(found) - 1.0 for found in costs), default=0.0)
    words += f" in {len(solved)} of {len(cases)} cases (largest difference {worst:.1e})"
    words += f"; only some solve: {', '.join(map(_unsolved, partly)) or 'none'}"
    words += f"; none solves: {', '.join(map(_unsolved, none)) or 'none'}"
    return Claim(words, worst <= AGREE and not partly)


def _cases(rows: Sequence[Row]) -> dict[tuple[str, str, int], list[Row]]:
    """Rows of the condensed form by Clarabel and each algorithm, by scenario, start and seed."""
    names = [Method("condensed", algorithm, "CLARABEL").name for algorithm in ALGORITHMS]
    found: dict[tuple[str, str, int], list[Row]] = {}
    for row in rows:
        if row.method in names:
            found.setdefault((row.scenario, row.start, row.seed), []).append(row)
    return found


def _unsolved(case: Sequence[Row]) -> str:
    """A case by name, and what its algorithms say that did not solve it."""
    first = case[0]
    name = {"random": f"guess {first.seed}", "p3": first.scenario}.get(first.start, first.start)
    ends = [f"{row.algorithm} {row.status.replace('_', ' ')}" for row in case if not row.solved]
    if len({row.status for row in case}) == 1:
        ends = [first.status.replace("_", " ")]
    return f"{name} ({', '.join(ends)})"


def _guess_claim(rows: Sequence[Row]) -> Claim:
    guesses = of_group(rows, "guesses")
    ours = [row for row in guesses if row.method == REFERENCE.name]
    theirs = [row for row in guesses if row.method == TUNED.name]
    best, rival = best_of(ours), best_of(theirs)
    words = f"over the random guesses SCP's best is no worse than IPOPT's best, within {AGREE:g}"
    if not (np.isfinite(best) and np.isfinite(rival)):
        return Claim(words, None)
    words += f" ({best:.6f} of {len(ours)} and {rival:.6f} m/s of {len(theirs)})"
    return Claim(words, best <= rival * (1.0 + AGREE))
