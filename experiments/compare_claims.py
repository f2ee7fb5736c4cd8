"""What the comparison is to show, and whether its rows show it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from experiments.compare_cases import ELASTIC, REFERENCE, TUNED, UNGUARDED, Method
from experiments.compare_cell import Row
from scp_recon.status import Status

AGREE = 1e-4
"""Relative difference of total delta-v, or merit, within which two methods found the same optimum."""

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
        _algorithm_claim(rows),
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
    infeasible = [
        row.scenario
        for (_, name), row in found.items()
        if name == f"frozen-covariance/{UNGUARDED}/CLARABEL"
        and row.status == Status.INFEASIBLE.value.name
        and found[row.scenario, REFERENCE.name].solved
    ]
    words = (
        "frozen-covariance without a safeguard reports infeasible what is solved in: "
        f"{', '.join(infeasible) or '-'}"
    )
    return [*result, Claim(words, bool(infeasible))]


def _algorithm_claim(rows: Sequence[Row]) -> Claim:
    """Full linearisations only: the frozen ones solve another problem."""
    worst, cases = 0.0, 0
    for group in ("matrix", "scenarios"):
        chosen = [
            row
            for row in of_group(rows, group)
            if row.formulation in ("condensed", "lifted") and row.solved
        ]
        for key in {(row.scenario, row.start) for row in chosen}:
            found = [row.total_dv_m_s for row in chosen if (row.scenario, row.start) == key]
            if len(found) > 1:
                worst, cases = max(worst, max(found) / min(found) - 1.0), cases + 1
    words = f"SCvx, PTR and SCvx* reach the same optimum within {AGREE:g}"
    if not cases:
        return Claim(words, None)
    return Claim(f"{words} in {cases} cases (largest difference {worst:.1e})", worst <= AGREE)


def _guess_claim(rows: Sequence[Row]) -> Claim:
    guesses = of_group(rows, "guesses")
    ours = best_of(row for row in guesses if row.method == REFERENCE.name)
    theirs = best_of(row for row in guesses if row.method == TUNED.name)
    words = "over the random guesses SCP's best is no worse than IPOPT's best"
    if not (np.isfinite(ours) and np.isfinite(theirs)):
        return Claim(words, None)
    return Claim(f"{words} ({ours:.6f} and {theirs:.6f} m/s)", ours <= theirs * (1.0 + AGREE))
