"""What the terminal shows while it plans: the iterations as they come, and the rounds of flights."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from scp_recon.cli.tables import plain_table
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.scp.loop import Record
from scp_recon.solution.from_plan import iteration_record

HEADINGS = (
    "stage",
    "k",
    "merit\nm/s",
    "predicted\nm/s",
    "actual\nm/s",
    "radius\nm/s",
    "violation\nm",
    "defect\nm",
    "solver\ns",
)


@dataclass
class Progress:
    """The planner's observer: a table that grows by a row per iteration, and a line per round above it.

    Attributes:
        mission: that is planned.
        live: where it is shown.
        table: of the iterations.
        rounds: lines by their number.
    """

    mission: Mission
    live: Live
    table: Table
    rounds: dict[int, Text] = field(default_factory=dict)

    def __call__(self, stage: str, record: Record) -> None:
        """An iteration is done."""
        r = iteration_record(self.mission, stage, record)
        if record.failure:
            self.table.add_row(stage, str(r.k), Text("solver failed", style="yellow"))
        else:
            self.table.add_row(
                stage,
                str(r.k),
                f"{r.merit:.6f}",
                f"{r.predicted:.2e}",
                f"{r.actual:.2e}" if r.accepted else f"({r.actual:.2e})",
                f"{r.trust_radius:.1e}",
                f"{r.max_violation:.1e}",
                f"{r.max_defect:.1e}",
                f"{r.solver_s:.3f}",
            )
        self._refresh()

    def round(self, number: int, plan: Plan, samples: int, flown: int = 0) -> None:
        """So many flights of a round of certification are flown, or all of them."""
        reached = plan.certificate
        said = (
            f"{flown} flown"
            if reached is None
            else f"{reached.reached:.4f}, at least {reached.low:.4f}"
        )
        self.rounds[number] = Text(
            f"round {number}: aimed at {plan.aim:.5g}, {plan.total_dv_m_s:.6f} m/s, "
            f"{len(plan.times_s)} nodes; {samples} flights: {said}"
        )
        self._refresh()

    def _refresh(self) -> None:
        self.live.update(Group(*self.rounds.values(), self.table), refresh=True)


@contextmanager
def live_progress(console: Console, mission: Mission) -> Iterator[Progress]:
    """Show what planning is at, until it ends."""
    table = plain_table(*HEADINGS, no_wrap=True)
    # Redrawn on every row and never from a thread, so that a captured log holds the table once.
    with Live(table, console=console, auto_refresh=False) as live:
        yield Progress(mission, live, table)
    console.print(
        "\nmerit: total delta-v plus penalties; in brackets: step rejected; violation and defect: "
        "velocities count as metres per unit of time",
        style="dim",
    )
