"""Find when a site can be observed: its lighting windows, and a whole pass with its own times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta

import numpy as np

from scp_recon.api.inputs import PlanRequest, read_in_degrees
from scp_recon.api.options import PlanOptions
from scp_recon.display import Tabulated
from scp_recon.errors import InputError
from scp_recon.jobs.cores import one_thread
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Survey
from scp_recon.passes.design import Designer, Trial
from scp_recon.passes.space import settled, spaces_of
from scp_recon.passes.timing import PassResult, RulePrice, Timing, explain_failure
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.method import SETTLE, FacetRounds
from scp_recon.planning.plan import Plan
from scp_recon.results.table import Column, Table
from scp_recon.scenario.schema import Scenario

INIT = "design"


@dataclass(frozen=True, eq=False)
class Design(Tabulated):
    """Result of a design; its table has a row for each plan that it made.

    Attributes:
        trials: every plan that the design made.
        best: the cheapest pass; if no pass has a plan, the one that came furthest.
        scenario: the given scenario with the pass's epoch, phases and times; None if no pass has a
            plan.
        plan: the plan of that scenario; None before it is made.
        start: a plan to start from; None if planning starts from the burns of the best pass.
        prices: what rules of the firing times cost.
    """

    trials: tuple[Trial, ...]
    best: PassResult
    scenario: Scenario | None
    plan: Plan | None = None
    start: Plan | None = None
    prices: tuple[RulePrice, ...] = ()

    @property
    def message(self) -> str:
        """The pass found; without a plan the best pass and the limit that it violates most."""
        if self.scenario is None:
            return explain_failure(self.best, len(self.trials))
        return f"a pass for {self.best.dv_m_s:.6f} m/s, in {len(self.trials)} plans"

    def __repr__(self) -> str:
        """One line."""
        return f"<Design: {self.message}>"

    def __str__(self) -> str:
        """What was found."""
        return self.message


def phases_deg(result: PassResult) -> tuple[float | None, float | None]:
    """Phases of departure and arrival; None between given boundary states."""
    if result.mission.scenario.boundary.home is None:
        return None, None
    departure, arrival = np.rad2deg(result.at.phases) % 360.0
    return float(departure), float(arrival)


def trials_table(found: Design) -> Table:
    """A row for each plan: times past the scenario's epoch; no delta-v without convergence."""
    phases = ("departure_deg", "arrival_deg")
    columns = ("step", "window", "problem", *phases, "times_s", "status", "dv_m_s")
    rows = (
        [
            one.step,
            one.result.space.number,
            one.result.stage.problem,
            *phases_deg(one.result),
            " ".join(f"{one.result.space.begin_s + t:.1f}" for t in one.result.at.times_s),
            one.result.stage.result.status.value.name,
            one.result.dv_m_s if one.result.converged else None,
        ]
        for one in found.trials
    )
    return Table.of("Plans of a design", columns, rows)


def options_for(
    scenario: Scenario, *, certify: bool | None, facet_rounds: FacetRounds = SETTLE
) -> PlanOptions:
    """Options with which the pass of a design is planned."""
    # The map of a home orbit's phases has been several starts.
    starts = None if scenario.boundary.home is None else 1
    options = PlanOptions(certify=certify, facet_rounds=facet_rounds, starts=starts)
    options.check(scenario)
    return options


@one_thread
def find_pass(
    scenario: Scenario,
    observe: Callable[[Trial], None] = lambda _: None,
    facet_rounds: FacetRounds = SETTLE,
) -> Design:
    """Find the cheapest pass.

    `observe` is called with every plan that the design makes; `facet_rounds` are of plans between given
    boundary states, as of `Planner.plan`.
    """
    designer = Designer(scenario, observe, facet_rounds)
    try:
        best = designer.run()
    except InputError as error:
        raise read_in_degrees(scenario, error, spaces_of) from None
    fixed = settled(scenario, best.space, best.at) if best.converged else None
    # From a home orbit only passes without corrections are found by programs with free times.
    has_prices = fixed and (scenario.policy.kind == "open" or not best.space.has_home)
    timing = Timing(best.space.with_policy_of(scenario), facet_rounds)
    prices = timing.prices(best) if has_prices else ()
    return Design(tuple(designer.trials), best, fixed, start=designer.corrected, prices=prices)


def request_of(found: Design, options: PlanOptions) -> PlanRequest:
    """What to plan: the pass of a design, started from its burns."""
    assert found.scenario is not None
    mission = Mission.from_scenario(found.scenario)
    start = found.start or from_burns(mission, found.best.burns_m_s, INIT)
    return PlanRequest(mission, start, options, called=INIT)


# --- lighting windows ----------------------------------------------------------------------------

DAYS_MAX = 100.0
"""Most days of a span, and of its begin from the epoch. The planets, which two-body motion
leaves out, turn Bennu's direction of the Sun by 0.001 deg in 100 days, and by 0.02 deg in 400."""
MARK = b"opens_tdb,closes_tdb,"
"""Head of every table of windows."""


def tdb(scenario: Scenario, time_s: float) -> str:
    """Date and time of seconds past the scenario's epoch, TDB, to the second."""
    date = scenario.epoch.tdb + timedelta(seconds=time_s + 0.5)
    return date.replace(microsecond=0).isoformat()


def windows_table(found: Survey) -> Table:
    """One row for each window; times in s past the scenario's epoch, and edges as TDB dates too.

    An empty interval of a burn has its first number above its second.
    """
    burns = range(1, len(found.scenario.burns.times_s) + 1)
    columns = (
        *(Column(f"{edge}, TDB", name=f"{edge}_tdb") for edge in ("opens", "closes")),
        *(Column(name, "s", ".1f") for name in ("opens", "closes")),
        Column("least incidence", "deg", ".2f"),
        *(Column(f"local solar time {edge}", "h", ".2f") for edge in ("opens", "closes")),
        *(Column(f"burn {i} {end}", "s") for i in burns for end in ("earliest", "latest")),
    )
    rows = (
        [
            *(tdb(found.scenario, edge) for edge in w.edges_s),
            *w.edges_s,
            float(np.rad2deg(w.least_incidence_rad)),
            *w.local_solar_time_h,
            *(edge for interval in w.burns_s for edge in interval),
        ]
        for w in found.windows
    )
    return Table.of("Windows", columns, rows)
