"""Compare SCP's forms, algorithms and conic solvers with IPOPT.

Every method plans the default scenario, a pass from a home orbit and the rest of a flight; a few plan
variations of the default scenario, start from random guesses, and plan random scenarios with uniform
and with exact risk, whose burns an independent check judges. Two cells are solved at a time, each in a
process of its own within a limit of processor time. OUT/comparison.csv has a row for each cell, the
other tables sum them up. A run that was stopped continues with the first missing row.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import pandas as pd
from scipy.special import ndtri

from experiments.harness import Findings, Record, Session, Study, claim
from experiments.solvers.cases import (
    ELASTIC,
    EXACT,
    PTR,
    REFERENCE,
    SCVX_STAR,
    TUNED,
    Cell,
    exact_design,
    full_design,
)
from experiments.solvers.cells import CONVERGED, FAILED, named, solve, wide
from scp_recon.jobs.job import TIMED_OUT, Failure, Job, Key
from scp_recon.jobs.processes import Limits, Processes
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.scp.status import Status

LIMIT_S, EXACT_LIMIT_S = 30.0, 300.0
CORES = 2
ASLEEP = 20.0
"""Times its limit that a cell's process may take by the clock, on a machine with other work."""
AGREE = 1e-4
"""Relative difference of total delta-v, or merit, within which two methods found the same optimum."""
EXCESSES = (AGREE, 0.01, 0.1)
"""Relative differences of total delta-v from the least."""
SHORT_SIGMA, MISS_M = 0.02, 0.01
"""Allowed shortfall of the probability in the check, in standard deviations, and of the rest in m: what
quadratures, sets of directions and the check itself err by."""

Frame: TypeAlias = pd.DataFrame


# --- rows -----------------------------------------------------------------------------------------


def solved_cells(session: Session, cells: Sequence[Cell]) -> Frame:
    """A row for each cell, from the store if it has them.

    A cell that reaches its limit is not repeated.
    """
    store = session.store("rows.jsonl")

    def rows(label: str, some: Sequence[Cell], seconds: float) -> list[Record]:
        by_key: dict[Key, Cell] = {f"{cell.key}|{seconds:g} s": cell for cell in some}
        limits = Limits(seconds=ASLEEP * seconds, cpu_s=seconds, apart=True)
        return session.rows(
            label,
            solve,
            [Job(*pair) for pair in by_key.items()],
            store,
            executor=Processes(CORES, limits),
            failed=lambda key, failure: ended(by_key[key], seconds, failure),
        )

    uniform = [cell for cell in cells if cell.group != EXACT]
    once = rows("uniform risk", [c for c in uniform if not c.repeat], LIMIT_S)
    late = {row["key"] for row in once if row["status"] == FAILED}
    again = [c for c in uniform if c.repeat and replace(c, repeat=0).key not in late]
    once += rows("uniform risk, repeated", again, LIMIT_S)
    exact = [cell for cell in cells if cell.group == EXACT]
    return pd.DataFrame(once + rows("exact risk", exact, EXACT_LIMIT_S))


def ended(cell: Cell, limit_s: float, failure: Failure) -> Record:
    """The row of a cell that reached its limit or failed."""
    late = failure.status == TIMED_OUT
    words = f"no end after {limit_s:g} s" if late else " ".join(failure.message.split())[:200]
    return {**named(cell), "status": FAILED, "detail": words, "cpu_s": limit_s if late else np.nan}


def solves(rows: Frame) -> pd.Series:
    """Whether P2 converged and, with exact risk, the check finds that its plan holds."""
    found = (rows.status == CONVERGED) & (rows.problem == "P2")
    if "asked" in rows:
        short = ndtri(rows.asked) - ndtri(rows.reached.clip(1e-9, 1.0 - 1e-9))
        holds = (short <= SHORT_SIGMA) & (rows.violation_m <= MISS_M)
        found &= holds | rows.asked.isna()
    return found


def costs(rows: Frame) -> pd.Series:
    """Total delta-v of the rows that are solved; NaN of the others."""
    return rows.total_dv_m_s.where(solves(rows))


def shown(row: pd.Series) -> str:
    """A row's status as the tables print it."""
    words = row.detail or row.status.replace("_", " ")
    return f"{words} (P3)" if row.problem == "P3" else str(words)


# --- tables ---------------------------------------------------------------------------------------


def methods(rows: Frame) -> list[Record]:
    """A row for each problem, start and method, with the medians of the repeats."""
    found = []
    for (problem, start, method), own in rows.groupby(["scenario", "start", "method"], sort=False):
        of = own.median(numeric_only=True)
        row = {"problem": problem, "start": start, "method": method, "status": shown(own.iloc[0])}
        row |= {
            "delta_v_m_s": figure(of.total_dv_m_s, ".6f"),
            "processor_s": figure(of.cpu_s, ".2f"),
        }
        p3, p2 = (figure(of[f"iterations_{stage}"], ".0f") for stage in ("p3", "p2"))
        found.append(row | {"p3_p2_iterations": f"{p3} + {p2}"})
    return found


def figure(value: float, form: str) -> str:
    """A number, or a dash."""
    return format(value, form) if np.isfinite(value) else "-"


def by_scenario(rows: Frame) -> list[Record]:
    """P2 from the same P3 solution and facets: a row for each scenario, a column for each method.

    A cell has delta-v if solved, else status and merit with the second weight, of the burns flown.
    """
    words = [
        f"{row.total_dv_m_s:.6f} ({row.cpu_s:.2f} s)"
        if ok
        else f"{shown(row)}, {figure(row.heavy_merit_m_s, '.4f')} ({figure(row.cpu_s, '.2f')} s)"
        for (_, row), ok in zip(rows.iterrows(), solves(rows), strict=True)
    ]
    columns = rows.method.str.replace("[/-]", "_", regex=True).str.lower()
    found, off = rows.assign(words=words, column=columns), differences(rows)
    return [
        row | {"ipopt_over_scp_less_one": figure(off.get(row["scenario"], np.nan), "+.1e")}
        for row in wide(found, ["scenario"], "column", "words")
    ]


def differences(rows: Frame) -> dict[str, float]:
    """IPOPT's delta-v (if infeasible, elastic merit) over SCP's less one; NaN where one did not end."""
    table = rows.assign(cost=costs(rows)).set_index(["scenario", "method"])
    found = {}
    for name in rows.scenario.unique():
        ours = table.loc[name, REFERENCE.name]
        solved = bool(ours.cost > 0.0)
        method, column = (TUNED, "cost") if solved else (ELASTIC, "heavy_merit_m_s")
        if (name, method.name) not in table.index:
            continue
        theirs = table.loc[name, method.name]
        both = solved or ours.status == theirs.status == Status.INFEASIBLE.value.name
        found[name] = theirs[column] / ours[column] - 1.0 if both else np.nan
    return found


def shares(rows: Frame) -> list[Record]:
    """How often each method solves a scenario, and how near the least of all methods."""
    cost = costs(rows)
    least = cost.groupby(rows.scenario).transform("min")
    found = []
    for method, own in rows.groupby("method", sort=False):
        excess = cost[own.index] / least[own.index] - 1.0
        near = {f"within_{most:g}_of_the_least".replace(".", "_"): most for most in EXCESSES}
        found.append(
            {
                "method": method,
                "scenarios": len(own),
                "solved_by_any": int(least[own.index].notna().sum()),
                "solved": int(excess.notna().sum()),
                **{column: int((excess <= most).sum()) for column, most in near.items()},
                "median_processor_s_of_the_solved": figure(
                    own.cpu_s[excess.notna()].median(), ".2f"
                ),
            }
        )
    return found


def guesses(rows: Frame) -> list[Record]:
    """How often each method solves from a random guess; what does not converge begins elsewhere."""
    found = []
    for method, tries in rows.assign(solved=solves(rows)).groupby("method", sort=False):
        first = tries.solved & tries.at_once.eq(True)  # missing where a cell failed
        share = proportion(int(first.sum()), len(tries))
        median, most = tries.cpu_s.quantile([0.5, 0.9])
        found.append(
            {
                "method": method,
                "guesses": len(tries),
                "solved_at_the_first_try": f"{100 * share.value:.0f} %",
                "first_interval": f"{100 * share.low:.0f} to {100 * share.high:.0f} %",
                "solved": f"{100 * tries.solved.mean():.0f} %",
                "median_processor_s": figure(median, ".2f"),
                "90th_percentile": figure(most, ".2f"),
            }
        )
    return found


# --- claims ---------------------------------------------------------------------------------------

WITHIN = f"within {AGREE:g}"


def claims(rows: Frame) -> list[Record]:
    """Claims of the comparison that the rows suffice to judge."""
    found = list[Record]()
    groups = dict(list(rows.groupby("group")))
    if "scenarios" in groups:
        found += agreement_claims(groups["scenarios"])
    whole = rows[rows.group.isin(["matrix", "scenarios"]) & (rows["repeat"] == 0)]
    found.append(
        algorithm_claim(whole, "from P3's solution, the straight line and the ballistic arc")
    )
    if "guesses" in groups:
        found.append(algorithm_claim(groups["guesses"], "from random guesses"))
    return found + (exact_claims(groups[EXACT]) if EXACT in groups else [])


def agreement_claims(rows: Frame) -> list[Record]:
    """SCP with full linearisation against IPOPT, from one P3 solution on the same facets."""
    off = pd.Series(differences(rows), dtype=float).dropna().abs()
    solved = off.index.isin(rows.scenario[costs(rows).notna() & (rows.method == REFERENCE.name)])
    found = []
    for what, chosen in (
        ("P2's total delta-v", off[solved]),
        ("the merit of infeasible cases", off[~solved]),
    ):
        agree = int((chosen <= AGREE).sum())
        measured = (
            f"largest {chosen.max():.1e}; {agree} of {len(chosen)} scenarios in which both end"
        )
        holds = agree == len(chosen) if len(chosen) else None
        found.append(claim(f"SCP and IPOPT agree on {what}", WITHIN, measured, holds))
    return found


def algorithm_claim(rows: Frame, where: str) -> Record:
    """Whether the three algorithms, condensed and by Clarabel, reach the same optimum."""
    own = rows[rows.method.isin([one.name for one in (REFERENCE, PTR, SCVX_STAR)])]
    index = ["group", "scenario", "start", "seed"]
    cases = own.assign(cost=costs(own)).pivot(index=index, columns="algorithm", values="cost")
    solved = cases.notna().sum(axis=1)
    some, whole = cases[solved > 0], cases[solved == len(cases.columns)]
    partly = list(some.index.difference(whole.index))
    worst = (whole.max(axis=1) / whole.min(axis=1) - 1.0).max() if len(whole) else 0.0
    measured = (
        f"largest {worst:.1e}, in {len(whole)} of {len(cases)} cases; only some solve: "
        f"{listed(' '.join(map(str, case)) for case in partly)}; none solves {len(cases) - len(some)}"
    )
    holds = bool(worst <= AGREE) and not partly if len(some) else None
    return claim(f"SCvx, PTR and SCvx* {where} reach the same optimum", WITHIN, measured, holds)


def exact_claims(rows: Frame) -> list[Record]:
    """The default plans of exact risk against the cheapest of all methods, and by the check."""
    ours = rows[rows.method == REFERENCE.name].set_index("scenario")
    cost, least = costs(ours), costs(rows).groupby(rows.scenario).min().reindex(ours.index)
    excess = (cost / least - 1.0)[least.notna()]
    apart = [
        f"{name} ({'not solved' if np.isnan(off) else f'{100 * off:+.2f} %'})"
        for name, off in excess.items()
        if not off <= AGREE
    ]
    measured = (
        f"{WITHIN} in {len(excess) - len(apart)} of {len(excess)} scenarios that any of them solves; "
        f"not in: {listed(apart)}; none solves: {listed(ours.index[least.isna()])}"
    )
    words = "the default's exact plans cost no more than the cheapest of all methods"
    converged = ours.index[ours.status == CONVERGED]
    short = list(converged[cost[converged].isna()])
    kept = f"{len(converged) - len(short)} of {len(converged)} scenarios; not in: {listed(short)}"
    by_check = "plans that the planner calls converged hold by the check"
    return [
        claim(words, WITHIN, measured, not apart),
        claim(by_check, "in every scenario", kept, not short),
    ]


def listed(words: Iterable[object]) -> str:
    """Words with commas between, or none."""
    return ", ".join(map(str, words)) or "none"


# --- the study ------------------------------------------------------------------------------------


def tables_of(rows: Frame) -> Mapping[str, list[Record]]:
    """The tables that sum up the rows, by name."""
    groups = dict(list(rows.groupby("group", sort=False)))
    makers = {
        "methods": ("matrix", methods),
        "scenarios": ("scenarios", by_scenario),
        "random": ("random", shares),
        "guesses": ("guesses", guesses),
    }
    found = {name: make(groups[of]) for name, (of, make) in makers.items() if of in groups}
    if EXACT in groups:
        exact = groups[EXACT]
        columns = ["scenario", "method", "status", "total_dv_m_s", "violation_m", "asked"]
        columns += ["reached", "reached_error", "cpu_s"]
        found["exact"] = exact.reindex(columns=columns).to_dict("records")
        for scope in ("node", "flight"):
            found[f"{scope}s"] = shares(exact[exact.scenario.str.startswith(scope)])
    return found


def run(session: Session) -> Findings:
    """Solve the missing cells, those of exact risk last."""
    rows = solved_cells(session, (*full_design(), *exact_design()))
    return Findings({**tables_of(rows), "claims": claims(rows), "comparison": rows})


STUDY = Study(__doc__, run, folder="comparison")
