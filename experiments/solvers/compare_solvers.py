"""Compare SCP's forms, algorithms and conic solvers with IPOPT.

Every method plans the default scenario, a pass from a home orbit and the rest of a flight; a few plan
variations of the default scenario, start from random guesses, and plan random scenarios with uniform
and with exact risk, whose burns an independent check judges. Two cells are solved at a time, each in a
process of its own within a limit of processor time. OUT/comparison.csv has a row for each cell, the
other tables sum them up. A run that was stopped continues with the first missing row.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np
import pandas as pd
from scipy.special import ndtri

from experiments.harness import FRESH, Claim, Findings, Record, Session, Study, option
from experiments.solvers.cases import (
    ELASTIC,
    EXACT,
    QUICK,
    REFERENCE,
    TUNED,
    UNGUARDED,
    Cell,
    Method,
    exact_design,
    full_design,
    quick_design,
    scenarios,
)
from experiments.solvers.cells import CONVERGED, FAILED, named, solve
from scp_recon.jobs.job import TIMED_OUT, Failure, Job
from scp_recon.jobs.processes import Limits, Processes
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.results.table import Table
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.status import Status

FLIGHTS, LIMIT_S, QUICK_LIMIT_S, EXACT_LIMIT_S = 2_000, 30.0, 20.0, 300.0
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
    limit_s = QUICK_LIMIT_S if session.options.quick else LIMIT_S
    store, rows = session.store("rows.jsonl"), list[Record]()
    if session.options.fresh:
        store.forget()
    late: set[str] = set()
    for group, seconds, flights in (("", limit_s, FLIGHTS), (EXACT, EXACT_LIMIT_S, 0)):
        limits = Limits(seconds=ASLEEP * seconds, cpu_s=seconds, apart=True)
        own = [cell for cell in cells if (cell.group == EXACT) == (group == EXACT)]
        for again in (False, True):
            some = [cell for cell in own if bool(cell.repeat) == again]
            some = [cell for cell in some if replace(cell, repeat=0).key not in late]
            if not some:
                continue
            jobs = [Job(f"{cell.key}|{seconds:g} s", cell) for cell in some]
            by_key = {job.key: cell for job, cell in zip(jobs, some, strict=True)}
            found = session.rows(
                f"{group or 'uniform'} risk{', repeated' if again else ''}",
                partial(solve, flights=flights),
                jobs,
                store,
                executor=Processes(CORES, limits),
                failed=lambda key, failure: ended(by_key[key], seconds, failure),  # noqa: B023 -- called at once
            )
            late |= {row["key"] for row in found if row["status"] == FAILED}
            rows += found
    return pd.DataFrame(rows)


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


def shown(row: pd.Series) -> str:
    """A row's status as the tables print it."""
    words = row.detail or row.status.replace("_", " ")
    return f"{words} (P3)" if row.problem == "P3" else str(words)


# --- tables ---------------------------------------------------------------------------------------


def methods(rows: Frame) -> list[Record]:
    """A row for each problem, start and method, with the medians of the repeats' times."""
    found = []
    for (problem, start, method), own in rows.groupby(["scenario", "start", "method"], sort=False):
        row, times = own.iloc[0], own[["cpu_s", "total_s", "setup_s", "solver_s"]].median()
        found.append(
            {
                "problem": problem,
                "start": start,
                "method": method,
                "status": shown(row),
                "delta_v_m_s": figure(row.total_dv_m_s, ".6f"),
                "merit_m_s": figure(row.merit_m_s, ".6f"),
                "worst_violation_m": figure(row.violation_m, ".1e"),
                "p3_p2_iterations": f"{figure(row.iterations_p3, '.0f')} + "
                f"{figure(row.iterations_p2, '.0f')}",
                "repeats": len(own),
                "processor_s": figure(times.cpu_s, ".2f"),
                "wall_s": figure(times.total_s, ".2f"),
                "of_it_set_up_s": figure(times.setup_s, ".2f"),
                "of_it_solver_s": figure(times.solver_s, ".2f"),
                "peak_mib": figure(row.peak_mib, ".0f"),
                "observes_s": figure(row.observed_s, ".0f"),
            }
        )
    return found


def figure(value: float, form: str) -> str:
    """A number, or a dash."""
    return format(value, form) if np.isfinite(value) else "-"


def by_scenario(rows: Frame) -> list[Record]:
    """P2 from the same P3 solution and facets: a row for each scenario, a column for each method.

    A cell has delta-v if solved, else status and merit with the second weight, of the burns flown.
    """
    found: dict[str, Record] = {}
    for row, ok in zip(rows.itertuples(), solves(rows), strict=True):
        words = f"{row.total_dv_m_s:.6f} ({row.cpu_s:.2f} s)"
        if not ok:
            merit, seconds = figure(row.heavy_merit_m_s, ".4f"), figure(row.cpu_s, ".2f")
            words = f"{shown(row)}, {merit} ({seconds} s)"
        column = row.method.replace("/", "_").replace("-", "_").lower()
        found.setdefault(row.scenario, {"scenario": row.scenario})[column] = words
    off = differences(rows)
    return [
        row | {"ipopt_over_scp_less_one": figure(off.get(name, np.nan), "+.1e")}
        for name, row in found.items()
    ]


def differences(rows: Frame) -> dict[str, float]:
    """IPOPT's delta-v (if infeasible, elastic merit) over SCP's less one; NaN where one did not end."""
    table = rows.assign(solved=solves(rows)).set_index(["scenario", "method"])
    found = {}
    for name in rows.scenario.unique():
        ours = table.loc[name].loc[REFERENCE.name]
        method, column = (TUNED, "total_dv_m_s") if ours.solved else (ELASTIC, "heavy_merit_m_s")
        if (name, method.name) not in table.index:
            continue
        theirs = table.loc[name].loc[method.name]
        infeasible = ours.status == theirs.status == Status.INFEASIBLE.value.name
        ended = (ours.solved and theirs.solved) or infeasible
        found[name] = theirs[column] / ours[column] - 1.0 if ended else np.nan
    return found


def shares(rows: Frame) -> list[Record]:
    """How often each method solves a scenario, and how near the least of all methods."""
    cost = rows.total_dv_m_s.where(solves(rows))
    least = cost.groupby(rows.scenario).transform("min")
    found = []
    for method, own in rows.groupby("method", sort=False):
        excess = cost[own.index] / least[own.index] - 1.0
        seconds = own.cpu_s[cost[own.index].notna()].median()
        near = {f"within_{most:g}_of_the_least".replace(".", "_"): most for most in EXCESSES}
        found.append(
            {
                "method": method,
                "scenarios": len(own),
                "solved_by_any": int(least[own.index].notna().sum()),
                "solved": int(excess.notna().sum()),
                **{column: int((excess <= most).sum()) for column, most in near.items()},
                "median_processor_s_of_the_solved": figure(seconds, ".2f"),
            }
        )
    return found


def guesses(rows: Frame) -> list[Record]:
    """How often each method solves from a random guess; what does not converge begins elsewhere."""
    ok, found = solves(rows), []
    best = rows.total_dv_m_s[ok].min()
    for method, tries in rows.groupby("method", sort=False):
        solved = ok[tries.index]
        first = solved & tries.at_once.eq(True)  # missing where a cell failed
        at_best = solved & (tries.total_dv_m_s <= best * (1.0 + AGREE))
        counts = {
            "solved_at_the_first_try": first,
            "solved": solved,
            "at_the_best_optimum": at_best,
        }
        intervals = ("first_interval", "solved_interval", "best_interval")
        row: Record = {"method": method, "guesses": len(tries)}
        for (name, count), interval in zip(counts.items(), intervals, strict=True):
            share = proportion(int(count.sum()), len(tries))
            row[name] = f"{100 * share.value:.0f} %"
            row[interval] = f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
        median, most = tries.cpu_s.quantile([0.5, 0.9])
        row |= {
            "median_processor_s": figure(median, ".2f"),
            "90th_percentile": figure(most, ".2f"),
            "best_delta_v_m_s": figure(tries.total_dv_m_s[solved].min(), ".6f"),
        }
        found.append(row)
    return found


# --- claims ---------------------------------------------------------------------------------------


def claims(rows: Frame) -> list[Claim]:
    """Claims of the comparison that the rows suffice to judge."""
    found = list[Claim]()
    groups = dict(list(rows.groupby("group")))
    if "scenarios" in groups:
        found += [*agreement_claims(groups["scenarios"]), *frozen_claims(groups["scenarios"])]
    condensed = [Method("condensed", algorithm, "CLARABEL").name for algorithm in ALGORITHMS]
    own = rows[rows.method.isin(condensed) & (rows["repeat"] == 0)]
    whole = own[own.group.isin(["matrix", "scenarios"])]
    found.append(
        algorithm_claim(whole, "from P3's solution, the straight line and the ballistic arc")
    )
    if "guesses" in groups:
        guessed = groups["guesses"]
        found.append(algorithm_claim(own[own.group == "guesses"], "from random guesses"))
        best = [
            guessed.total_dv_m_s[solves(guessed) & (guessed.method == method.name)].min()
            for method in (REFERENCE, TUNED)
        ]
        words = "over the random guesses SCP's best is no worse than IPOPT's best"
        holds = bool(best[0] <= best[1] * (1.0 + AGREE)) if np.isfinite(best).all() else None
        found.append(
            Claim(words, f"within {AGREE:g}", "{:.6f} and {:.6f} m/s".format(*best), holds)
        )
    if EXACT in groups:
        found += exact_claims(groups[EXACT])
    return found


def agreement_claims(rows: Frame) -> list[Claim]:
    """SCP with full linearisation against IPOPT, from one P3 solution on the same facets."""
    off = pd.Series(differences(rows), dtype=float).dropna().abs()
    reference = rows[rows.method == REFERENCE.name]
    solved = {*reference.scenario[solves(reference)]}
    found = []
    for what, chosen in (
        ("P2's total delta-v", off[off.index.isin(solved)]),
        ("the merit of infeasible cases", off[~off.index.isin(solved)]),
    ):
        agree, holds = int((chosen <= AGREE).sum()), None
        measured = "no scenario in which both end"
        if len(chosen):
            measured = (
                f"largest {chosen.max():.1e}; {agree} of {len(chosen)} scenarios in which both end"
            )
            holds = agree == len(chosen)
        found.append(Claim(f"SCP and IPOPT agree on {what}", f"within {AGREE:g}", measured, holds))
    return found


def frozen_claims(rows: Frame) -> list[Claim]:
    """What freezing the STM or the covariance costs, with a safeguard and without."""
    cost = rows.assign(cost=rows.total_dv_m_s.where(solves(rows)))
    table = cost.pivot_table(index="scenario", columns="method", values="cost", sort=False)
    ended = rows.pivot(index="scenario", columns="method", values="status")
    full, found = table[REFERENCE.name].dropna(), []
    for form in ("frozen-stm", "frozen-covariance"):
        name = Method(form, "scvx", "CLARABEL").name
        if name not in ended:
            continue
        own = table.get(name, pd.Series(dtype=float)).reindex(full.index)
        dearer, lost = (own / full - 1.0).max(), list(full.index[own.isna()])
        measured = (
            f"delta-v up to {dearer:.1e} higher; not solved where the full one is: {listed(lost)}"
        )
        holds = bool(lost) or bool(dearer > AGREE)
        words = f"{form} differs from the full linearisation"
        found.append(Claim(words, f"by more than {AGREE:g}, or unsolved", measured, holds))
    free, frozen = (
        Method(form, UNGUARDED, "CLARABEL").name for form in ("condensed", "frozen-covariance")
    )
    if {free, frozen} <= {*ended.columns}:
        both = full.index.intersection(table.get(free, full[:0]).dropna().index)
        lost = [name for name in both if ended[frozen][name] == Status.INFEASIBLE.value.name]
        words = (
            "without a safeguard frozen-covariance reports infeasible what the full method solves, "
            "with a safeguard or without"
        )
        refuted = False if len(ended) >= len(scenarios()) else None
        found.append(Claim(words, "in one scenario", f"in {listed(lost)}", bool(lost) or refuted))
    return found


def algorithm_claim(rows: Frame, where: str) -> Claim:
    """Whether the three algorithms, condensed and by Clarabel, reach the same optimum."""
    words, threshold = f"SCvx, PTR and SCvx* {where} reach the same optimum", f"within {AGREE:g}"
    rows = rows.assign(cost=rows.total_dv_m_s.where(solves(rows)))
    cases = rows.pivot(
        index=["group", "scenario", "start", "seed"], columns="algorithm", values="cost"
    )
    solved = cases.dropna()
    partly = cases[cases.notna().any(axis=1) & cases.isna().any(axis=1)]
    if cases.notna().sum().sum() == 0:
        return Claim(words, threshold, "no case", None)
    worst = (solved.max(axis=1) / solved.min(axis=1) - 1.0).max() if len(solved) else 0.0
    measured = (
        f"largest {worst:.1e}, in {len(solved)} of {len(cases)} cases; only some solve: "
        f"{listed(' '.join(map(str, case)) for case in partly.index)}; "
        f"none solves {int(cases.isna().all(axis=1).sum())}"
    )
    return Claim(words, threshold, measured, bool(worst <= AGREE) and not len(partly))


def exact_claims(rows: Frame) -> list[Claim]:
    """The default plans of exact risk against the cheapest of all methods, and by the check."""
    cost = rows.total_dv_m_s.where(solves(rows))
    least = cost.groupby(rows.scenario).min().dropna()
    ours = rows[rows.method == REFERENCE.name].set_index("scenario")
    own = cost[rows.method == REFERENCE.name].set_axis(ours.index).reindex(least.index)
    excess = own / least - 1.0
    apart = [
        f"{name} ({'not solved' if np.isnan(excess[name]) else f'{100 * excess[name]:+.2f} %'})"
        for name in least.index
        if not excess[name] <= AGREE
    ]
    same = excess[excess <= AGREE]
    none = [name for name in ours.index if name not in least.index]
    measured = (
        f"within {AGREE:g} in {len(same)} of {len(least)} scenarios that any of them solves; "
        f"not in: {listed(apart)}; none solves: {listed(none)}"
    )
    words = "the default's exact plans cost no more than the cheapest of all methods"
    converged = ours[ours.status == CONVERGED].index
    short = [name for name in converged if not own.reindex(ours.index).notna()[name]]
    return [
        Claim(words, f"within {AGREE:g}", measured, not apart),
        Claim(
            "plans that the planner calls converged hold by the check",
            "in every scenario",
            f"{len(converged) - len(short)} of {len(converged)} scenarios; not in: {listed(short)}",
            not short,
        ),
    ]


def listed(words: Iterable[object]) -> str:
    """Words with commas between, or none."""
    return ", ".join(map(str, words)) or "none"


# --- the study ------------------------------------------------------------------------------------


def design(session: Session) -> Sequence[Cell]:
    """The cells to solve."""
    if session.options.exact:
        return exact_design()
    if session.options.quick:
        return (*quick_design(), *exact_design(QUICK))
    return (*full_design(), *exact_design())


def tables_of(rows: Frame) -> dict[str, list[Record]]:
    """The tables that sum up the rows, by name."""
    groups = dict(list(rows.groupby("group", sort=False)))
    makers = {"matrix": methods, "scenarios": by_scenario, "random": shares, "guesses": guesses}
    names = {"matrix": "methods"}
    found = {names.get(g, g): make(groups[g]) for g, make in makers.items() if g in groups}
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
    rows = solved_cells(session, design(session))
    session.say(
        f"`python -m paper_figs solver_comparison --runs {session.out} --out DIR` draws it."
    )
    if session.options.quick:
        session.say("A quick run shows a few cells of each kind: only --full settles the claims.")
    tables = {name: Table.of_records("", own) for name, own in tables_of(rows).items()}
    files = {f"{name}.csv": table for name, table in tables.items()}
    every = Table.of_records("", rows.to_dict("records"))
    return Findings({**files, "comparison.csv": every}, claims(rows))


STUDY = Study(
    __doc__,
    run,
    (
        option("--quick", action="store_true", help="a cell of every kind: three minutes"),
        option("--full", action="store_true", help="everything, three to four hours (default)"),
        option("--exact", action="store_true", help="random scenarios of exact risk alone"),
        FRESH,
    ),
    folder="comparison",
)
