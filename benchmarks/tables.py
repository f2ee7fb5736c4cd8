"""Make rows of the benchmarks' figures.

Times are of the wall clock, unless they say otherwise; those of growth are of the processor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.growth import Fit
from benchmarks.methods import REPLANS, Timed

Rows = list[dict[str, Any]]


def method_rows(figures: Mapping[str, Timed]) -> Rows:
    """Planning: a row a method, with the difference of its delta-v from the first's."""
    reference = next(iter(figures.values())).total_dv_m_s
    return [
        {
            "method": name,
            "total_dv_m_s": f.total_dv_m_s,
            "off": abs(f.total_dv_m_s / reference - 1.0),
            "status": f.status + (", verified" if f.verified else ", not verified"),
            "import_s": f.details["import"],
            "first_s": f.first,
            "later_s": f.best,
            "processor_s": f.cpu,
            **{f"{part}_s": max(seconds, 0.0) for part, seconds in f.split.items()},
            "peak_mib": f.peak_mib,
        }
        for name, f in figures.items()
        if f.split
    ]


def ratio_rows(figures: Mapping[str, Timed], commands: Mapping[str, float]) -> Rows:
    """Ratios of the methods' times, and of the commands', with what they are made from."""
    ours, printed = figures["scp condensed"], figures["ipopt printed"]
    tuned = [figures[name] for name in ("ipopt tuned", "ipopt shooting")]
    first, built = min(f.first for f in tuned), min(without_setup(f) for f in tuned)
    conic = ours.split["conic_solver"]
    replan, solve = figures["replan"], commands["solve"]
    rows = {
        "IPOPT as printed over SCP, first plan of a process": printed.first / ours.first,
        "IPOPT as printed over SCP": without_setup(printed) / without_setup(ours),
        "best tuned NLP over SCP, first plan of a process": first / ours.first,
        "best tuned NLP over SCP": built / without_setup(ours),
        "conic solver, s": conic,
        "subproblem of P2, s": ours.details["p2_subproblem"],
        "all else over the conic solver": (ours.best - conic) / conic,
        "canonicalisation over the conic solver": ours.split["canonicalise"] / conic,
        "first plan of a process less a later one, s": ours.first - ours.best,
        "replans": REPLANS,
        "replans converged": replan.details["converged"],
        "replan, s": replan.best,
        "cold plan of the same state, s": replan.details["cold"],
        "replan over cold plan": replan.best / replan.details["cold"],
        "flights a second": figures["montecarlo"].details["flights_per_s"],
        "command line, s": solve,
        "command line over importing CVXPY": solve / commands["import cvxpy"],
    }
    return [{"figure": name, "value": value} for name, value in rows.items()]


def without_setup(figures: Timed) -> float:
    """Seconds of the fastest later run without building."""
    return figures.best - figures.split["setup"]


def growth_rows(fits: Sequence[Fit]) -> Rows:
    """Growth: a row for each quantity and method."""
    rows = []
    for fit in fits:
        points = zip(fit.seconds, fit.iterations, fit.statuses, strict=True)
        seconds = ", ".join(
            f"{s:.2f} ({n}{'' if status == 'converged' else ', ' + status.replace('_', ' ')})"
            for s, n, status in points
        )
        rows.append(
            {
                "growth with": fit.name,
                "method": fit.method,
                "sizes": ", ".join(map(str, fit.sizes)),
                "seconds": seconds,
                "total_dv_m_s": ", ".join(f"{dv:.6f}" for dv in fit.total_dv_m_s),
                "exponent": fit.exponent,
                "last": fit.last,
                "an_iteration": fit.an_iteration,
            }
        )
    return rows
