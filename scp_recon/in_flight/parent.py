"""The plan that is flown: from memory, or from its file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from scp_recon.errors import InputError, shortened
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.scenario.warning import ScenarioWarning
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution, read_solution
from scp_recon.solution.from_plan import make_solution
from scp_recon.solution.runs import resolve_run
from scp_recon.verification.reintegration import verify

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FlownPlan:
    """A plan that is flown.

    Attributes:
        name: what the new plan's file calls it.
        mission: its.
        burns_m_s: its burns, shape (m, 3).
        times_s: its nodes, shape (n,).
        states: means there, after the burns, J2000, m and m/s, shape (n, 6).
        covariances: there, shape (n, 6, 6).
        problem: with uncertainty, or without it.
        status: how it ended.
        plan_hash: see `Solution.plan_hash`.
        failed: what its verification does not find right; None if it was not asked.
        warnings: that go with it.
    """

    name: str
    mission: Mission
    burns_m_s: Array
    times_s: Array
    states: Array
    covariances: Array
    problem: Literal["P3", "P2"]
    status: str
    plan_hash: str
    failed: tuple[str, ...] | None
    warnings: tuple[ScenarioWarning, ...]

    @classmethod
    def of(cls, given: Plan | Solution | str | Path, name: str | None = None) -> FlownPlan:
        """From a plan; or from a solution, or its file or folder, which is verified anew.

        Args:
            given: any of these.
            name: what the new plan's file calls it, if not by its path.

        Raises:
            InputError: if it is none of these, or the file cannot be used.
        """
        if isinstance(given, Plan):
            solution = make_solution(given)
            return cls._of(name or "a plan", given.mission, solution, None)
        if not isinstance(given, Solution | str | Path):
            raise InputError("plan", shortened(given), "must be a plan, a solution or its file")
        if isinstance(given, Solution):
            solution, called = given, "a solution"
        else:
            home = resolve_run(Path(given))  # runs/latest will point to another
            solution, called = read_solution(home), str(home)
        mission = Mission.from_scenario(solution.scenario)
        failed = tuple(verify(mission, solution).failed)
        return cls._of(name or called, mission, solution, failed)

    @classmethod
    def _of(
        cls, name: str, mission: Mission, solution: Solution, failed: tuple[str, ...] | None
    ) -> FlownPlan:
        return cls(
            name=name,
            mission=mission,
            burns_m_s=solution.burns_m_s,
            times_s=np.array(solution.nodes.t_s),
            states=np.array(solution.nodes.state),
            covariances=np.array(solution.nodes.covariance),
            problem=solution.problem,
            status=solution.status,
            plan_hash=solution.plan_hash,
            failed=failed,
            warnings=solution.warnings,
        )

    def strange(self) -> Iterator[ScenarioWarning]:
        """What a new plan has to say of it."""
        converged = Status.CONVERGED.value.name
        if self.failed:
            yield ScenarioWarning.of(
                "parent",
                f"{self.name}, which is not verified: {', '.join(self.failed)}",
                "a verified plan would be no surprise: of the flight so far nothing is known for sure",
            )
        elif self.status != converged:
            yield ScenarioWarning.of(
                "parent",
                f"{self.name}, which is {self.status}",
                f"{converged} would be no surprise",
            )
