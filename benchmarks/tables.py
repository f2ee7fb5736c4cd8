"""Write the benchmarks' figures as Markdown."""

from __future__ import annotations

from benchmarks.growth import Fit
from benchmarks.methods import REPLANS, Timed
from scp_recon.results.table import Column, Table

PARTS = ("setup", "linearise", "canonicalise", "conic_solver", "other")


def pair_table(figures: dict[str, Timed]) -> str:
    """Planning: a row a method."""
    reference = next(iter(figures.values())).total_dv_m_s
    rows = [
        (
            name,
            f"{f.total_dv_m_s:.6f}, {abs(f.total_dv_m_s / reference - 1.0):.0e}",
            f.status + (", verified" if f.verified else ", not verified"),
            f.first,
            f.best,
            *(f"{1e3 * max(f.split[part], 0.0):.1f} ms" for part in PARTS),
            f.peak_mib,
        )
        for name, f in figures.items()
        if f.split
    ]
    columns = (
        Column("method"),
        *(Column("delta-v m/s, off the first by"), Column("status")),
        *(Column("first s", form=".3f"), Column("later s", form=".3f")),
        *map(Column, ("set-up", "linearise", "canonicalise", "solver", "other")),
        Column("peak MiB", form=".0f"),
    )
    return Table.of("", columns, rows).markdown()


def ratio_lines(figures: dict[str, Timed], commands: dict[str, float]) -> list[str]:
    """Ratios of the methods' times, and of the commands'."""
    ours = figures["scp condensed"]
    printed = figures["ipopt printed"]
    tuned = [figures[name] for name in ("ipopt tuned", "ipopt shooting")]
    first = min(f.first for f in tuned)
    built = min(without_setup(f) for f in tuned)
    conic = ours.split["conic_solver"]
    rest = ours.best - conic
    again, cold = figures["replan"].best, figures["replan"].details["cold"]
    return [
        f"- IPOPT as printed over SCP: {printed.first / ours.first:.0f} with set-up, "
        f"{without_setup(printed) / without_setup(ours):.0f} without.",
        f"- Best tuned NLP over SCP: {first / ours.first:.1f} with set-up, "
        f"{built / without_setup(ours):.1f} without.",
        f"- Conic solver: {1e3 * conic:.0f} ms in all, "
        f"{1e3 * ours.details['p2_subproblem']:.1f} ms for a P2 subproblem; everything else "
        f"{rest / conic:.2f} times that, canonicalisation "
        f"{ours.split['canonicalise'] / conic:.2f} times.",
        f"- First plan in a process: {ours.first - ours.best:+.3f} s over a later one.",
        f"- Planning again, {REPLANS} perturbed initial states, "
        f"{figures['replan'].details['converged']:.0f} converged: {1e3 * again:.0f} ms against "
        f"{1e3 * cold:.0f} ms cold, {again / cold:.2f} of it. Replanning keeps "
        "the last plan's facets; planning cold chooses them anew.",
        f"- Monte Carlo with crossing times: {figures['montecarlo'].details['flights_per_s']:,.0f} "
        "flights/s on one core.",
        f"- Command line, start to verdict: {commands['solve']:.2f} s, "
        f"{commands['solve'] / commands['import cvxpy']:.2f} times that of importing CVXPY.",
    ]


def without_setup(figures: Timed) -> float:
    """Seconds of the fastest later run without building."""
    return figures.best - figures.split["setup"]


def growth_table(fits: list[Fit]) -> str:
    """Growth: a row a study."""
    rows = []
    for fit in fits:
        points = zip(fit.seconds, fit.iterations, fit.statuses, strict=True)
        seconds = ", ".join(
            f"{s:.3f} ({n}{'' if status == 'converged' else ', ' + status})"
            for s, n, status in points
        )
        rows.append((fit.name, ", ".join(map(str, fit.sizes)), seconds, fit.exponent, fit.last))
    columns = (
        "growth with",
        "sizes",
        "seconds of a plan (iterations)",
        Column("exponent", form=".2f"),
        Column("of the last doubling", form=".2f"),
    )
    return Table.of("", columns, rows).markdown()
