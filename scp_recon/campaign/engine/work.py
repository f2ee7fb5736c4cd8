"""What a campaign does with a case of a study, and the row that comes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scp_recon.campaign.engine.columns import (
    FIXED,
    OWN,
    binding,
    certified_row,
    flown_row,
    planned_row,
    simulated_row,
)
from scp_recon.campaign.rows.case import Case, Found, solution_name
from scp_recon.campaign.study.changes import changed
from scp_recon.campaign.study.checks import check_do
from scp_recon.campaign.study.study import Do, Study
from scp_recon.certification.certify import certify
from scp_recon.cli.view.design_tables import why_nothing
from scp_recon.mission.mission import Mission
from scp_recon.pass_design.design import Designer
from scp_recon.pass_design.setting import settled
from scp_recon.planning.initial_guess import cold, from_burns
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.solution.from_plan import make_solution
from scp_recon.verification.reintegration import verify

FACET_ROUNDS = 3
"""Of a design's plan, as `python -m scp_recon.design` makes it."""


def work_of(study: Study) -> StudyWork:
    """What the cases of a study come to.

    Raises:
        InputError: if the extra is missing that it needs.
    """
    if study.campaign.do == "simulate":
        from scp_recon.spacecraft.basilisk.optional import needing_basilisk

        with needing_basilisk("campaign.do"):
            import scp_recon.spacecraft.basilisk.simulation  # noqa: F401 -- whether it is there
    given = study.campaign
    return StudyWork(
        study.base, study.folder.absolute(), given.do, given.samples, given.keep_solutions
    )


@dataclass(frozen=True)
class StudyWork:
    """Does the same with each case: see `case.Work`.

    Attributes:
        base: scenario that the cases change.
        folder: to which files are relative that they name.
        do: what is done.
        samples: flights with "fly".
        keep: whether solutions are kept.
    """

    base: Scenario
    folder: Path
    do: Do
    samples: int
    keep: bool

    @property
    def columns(self) -> Mapping[str, type]:
        """Columns of its rows."""
        return FIXED | OWN[self.do]

    def __call__(self, case: Case, /) -> Found:
        """Plan, verify, and what else is to be done.

        Raises:
            InputError: if the case is no mission.
            KeyboardInterrupt: if the plan was interrupted.
        """
        scenario = changed(self.base, case.changes, self.folder)
        row: dict[str, Any] = {"asked": scenario.risk.p_chance}
        check_do(self.do, scenario)
        if self.do == "design":
            found, own = designed(scenario)
            row |= own
            if found is None:
                return Found(row)
        else:
            found = planned(scenario, certified=self.do == "certify")
        if found.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        solution = make_solution(found)
        verification = verify(found.mission, solution)
        solution = solution.model_copy(update={"verification": verification})
        row |= planned_row(solution, verification)
        if found.status is not Status.CONVERGED:
            row["binds"] = binding(found.final)
        if self.do == "certify":
            row |= certified_row(found)
        elif self.do == "fly" and found.status is Status.CONVERGED:
            row |= flown_row(found, solution, self.samples, case.seed)
        elif self.do == "simulate" and found.status is Status.CONVERGED:
            row |= simulated_row(solution, case.seed)
        files = {solution_name(case.number): solution.text().encode()} if self.keep else {}
        return Found(row, files)


def planned(scenario: Scenario, *, certified: bool) -> Plan:
    """A scenario's plan from a straight line."""
    mission = Mission.from_scenario(scenario)
    if certified:
        return certify(mission, cold(mission), lambda m, s, aim: plan(m, s, aim=aim, init="cold"))
    return plan(mission, cold(mission), init="cold")


def designed(scenario: Scenario) -> tuple[Plan | None, dict[str, Any]]:
    """The plan of the cheapest pass from the home orbit, with what is known of the pass.

    Where no pass has a plan, there is what stopped the one that came furthest.
    """
    designer = Designer(scenario, lambda _: None)
    space, found = designer.run()
    if not found.converged:
        return None, {
            "status": Status.INFEASIBLE.value.name,
            "binds": binding(found.stage),
            "message": why_nothing(found, len(designer.tried)),
        }
    fixed = settled(scenario, space, found.at)
    mission = Mission.from_scenario(fixed)
    rounds = 0 if fixed.risk.allocation == "exact" else FACET_ROUNDS
    start = from_burns(mission, found.burns_m_s, "design")
    own = {
        "departure_tdb": fixed.epoch.tdb.isoformat(),
        "duration_s": fixed.duration_s,
        "burns": len(fixed.burns.times_s),
    }
    return plan(mission, start, facet_rounds=rounds, init="design"), own
