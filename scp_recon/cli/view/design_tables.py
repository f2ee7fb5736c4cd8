"""What a design shows and keeps of what it tried: progress, a table, and why nothing was found."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import StringIO

import numpy as np
from rich.console import Console

from scp_recon.pass_design.design import Tried
from scp_recon.pass_design.near import Found
from scp_recon.planning.primer import WORTH
from scp_recon.planning.stage import scale
from scp_recon.solution.primer import Primer

COLUMNS = (
    "step",
    "window",
    "problem",
    "departure_deg",
    "arrival_deg",
    "times_s",
    "status",
    "dv_m_s",
)


@contextmanager
def progress(console: Console) -> Iterator[Callable[[Tried], None]]:
    """Count plans as they are made, and leave a line with the best of each step; yields what counts."""
    counts: dict[str, int] = {}
    least: dict[str, Tried] = {}

    def line(step: str) -> str:
        best, count = least[step], f"{step:10} {counts[step]:4} plans"
        if not best.found.converged:
            return f"{count}, none that holds"
        departure, arrival = np.rad2deg(best.found.at.phases) % 360.0
        return (
            f"{count}, best {best.found.dv_m_s:.6f} m/s from {departure:.1f} to {arrival:.1f} deg"
            + (", without uncertainty" if step in ("map", "certain") else "")
        )

    with console.status("designing") as status:

        def count(tried: Tried) -> None:
            step = tried.step
            if step not in counts and counts:
                console.print(line(next(reversed(counts))), highlight=False)
            counts[step] = counts.get(step, 0) + 1
            best = least.setdefault(step, tried)
            if tried.found.dv_m_s < best.found.dv_m_s:
                least[step] = tried
            status.update(line(step))

        yield count
    if counts:
        console.print(line(next(reversed(counts))), highlight=False)


def as_csv(tried: Sequence[Tried]) -> str:
    """A row for each plan; times past the scenario's epoch, no delta-v where there is no plan."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for one in tried:
        found = one.found
        phases = [f"{phase:.4f}" for phase in np.rad2deg(found.at.phases) % 360.0]
        times = " ".join(f"{one.begin_s + time:.1f}" for time in found.at.times_s)
        status = found.stage.result.status.value.name
        cost = f"{found.dv_m_s:.8f}" if found.converged else ""
        writer.writerow([one.step, one.window, found.stage.problem, *phases, times, status, cost])
    return text.getvalue()


def why_nothing(found: Found, plans: int) -> str:
    """How far a design came that found nothing, which limit stopped it and for which departure."""
    stage, mission = found.stage, found.mission
    worst, most = "the final state", 0.0
    for name, margins in stage.margins.items():
        least = int(np.argmin(margins.margin))
        amount = -float(margins.margin[least])
        if amount > most:
            most, unit = amount, stage.unit(name)
            short = f"{amount * scale(mission, unit):.3g} {unit}"
            at = mission.times_s[margins.nodes[least]]
            worst = f"{name}, short by {short} {at:.0f} s after the begin"
    departure, arrival = np.rad2deg(found.at.phases) % 360.0
    return (
        f"no pass found in {plans} plans; the one that came furthest, of {stage.problem} from "
        f"{departure:.1f} to {arrival:.1f} deg with burns at "
        f"{', '.join(f'{time:.0f}' for time in found.at.times_s)} s, was stopped by {worst}"
    )


def primer_says(primer: Primer | None) -> str:
    """What a plan's primer tells of one more burn, in a line."""
    if primer is None:
        return "no primer: it takes a plan whose errors shrink with the burns"
    legal = np.flatnonzero(primer.legal)
    if len(legal) == 0:
        return "primer: no time is legal for another burn with these kept: it tells nothing of one"
    best = legal[np.argmax(np.array(primer.allowed)[legal])]
    most, when = primer.allowed[best], f"at {primer.t_s[best]:.0f} s"
    if most <= 1.0 + WORTH:
        return f"primer at most {most:.3f} at legal times ({when}): no small burn more helps"
    return f"primer up to {most:.3f} at legal times: a burn more {when} would help"
