"""The benchmarks' figures as Markdown."""

from __future__ import annotations

from benchmarks.growth import Fit
from benchmarks.methods import REPLANS, Timed

PARTS = ("setup", "linearise", "canonicalise", "conic_solver", "other")


def pair_table(figures: dict[str, Timed]) -> str:
    """Planning: a row a method."""
    lines = [
        "| method | delta-v m/s | status | first s | later s | set-up | linearise | canonicalise "
        "| solver | other | peak MiB |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, f in figures.items():
        if f.split:
            parts = " | ".join(f"{1e3 * max(f.split[part], 0.0):.1f} ms" for part in PARTS)
            lines.append(
                f"| {name} | {f.total_dv_m_s:.6f} | {f.status} | {f.first:.3f} | {f.best:.3f} "
                f"| {parts} | {f.peak_mib:.0f} |"
            )
    return "\n".join(lines)


def ratio_lines(figures: dict[str, Timed], commands: dict[str, float]) -> list[str]:
    """What is compared with what."""
    ours = figures["scp condensed"]
    printed, tuned = (
        figures["ipopt printed"],
        min((figures[name] for name in ("ipopt tuned", "ipopt shooting")), key=lambda f: f.first),
    )
    conic = ours.split["conic_solver"]
    rest = ours.best - conic
    again, cold = figures["replan"].best, figures["replan"].details["cold"]
    return [
        f"- IPOPT as printed over SCP: {printed.first / ours.first:.0f} with set-up, "
        f"{without_setup(printed) / without_setup(ours):.0f} without.",
        f"- Best tuned NLP over SCP: {tuned.first / ours.first:.1f} with set-up, "
        f"{without_setup(tuned) / without_setup(ours):.1f} without.",
        f"- Conic solver: {1e3 * conic:.0f} ms in all, "
        f"{1e3 * ours.details['p2_subproblem']:.1f} ms for a P2 subproblem; everything else "
        f"{rest / conic:.2f} of it, canonicalisation {ours.split['canonicalise'] / conic:.2f}.",
        f"- First plan in a process: {ours.first - ours.best:+.3f} s over a later one.",
        f"- Planning again, {REPLANS} perturbed initial states, "
        f"{figures['replan'].details['converged']:.0f} converged: {1e3 * again:.0f} ms against "
        f"{1e3 * cold:.0f} ms cold, {again / cold:.2f} of it.",
        f"- Monte Carlo with crossing times: {figures['montecarlo'].details['flights_per_s']:,.0f} "
        "flights/s on one core.",
        f"- Command line, start to verdict: {commands['solve']:.2f} s, "
        f"{commands['solve'] / commands['import cvxpy']:.2f} of importing CVXPY.",
    ]


def without_setup(figures: Timed) -> float:
    """Seconds of the fastest later run but for building."""
    return figures.best - figures.split["setup"]


def growth_table(fits: list[Fit]) -> str:
    """Growth: a row a study."""
    lines = ["| growth with | sizes | seconds | exponent |", "|---|---|---|---|"]
    for fit in fits:
        sizes = ", ".join(str(size) for size in fit.sizes)
        seconds = ", ".join(f"{s:.3f}" for s in fit.seconds)
        lines.append(f"| {fit.name} | {sizes} | {seconds} | {fit.exponent:.2f} |")
    return "\n".join(lines)
