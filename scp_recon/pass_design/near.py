"""Plans near a pass: one grid, one set of facets, one compiled program, begun where the last ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import choose_facets
from formulations.rows.chance import ChanceRows
from formulations.rows.cones import Rows
from scp_recon.mission.mission import Mission
from scp_recon.pass_design.optimum import slope
from scp_recon.pass_design.space import Pass, Space
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.planner import CLEARANCE_AGAIN_M, Planner, ScpStages
from scp_recon.planning.stage import Stage
from scp_recon.planning.stages import StageRunner
from scp_recon.scp.loop import Record
from scp_recon.scp.status import Status

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Found:
    """A pass with what was planned for it.

    Attributes:
        at: the pass.
        mission: of the pass.
        stage: of P3 or P2, as it ended.
    """

    at: Pass
    mission: Mission
    stage: Stage

    @property
    def converged(self) -> bool:
        """Whether there is a plan."""
        return self.stage.result.status is Status.CONVERGED

    @property
    def dv_m_s(self) -> float:
        """Total delta-v of the plan; infinite where there is none."""
        total = self.stage.result.lin.iterate.total_dv * self.mission.units.speed_m_s
        return total if self.converged else float("inf")

    @property
    def burns_m_s(self) -> Array:
        """Burns, J2000, shape (m, 3)."""
        return self.stage.result.lin.iterate.burns * self.mission.units.speed_m_s


def uninterrupted(stage: Stage) -> Stage:
    """A stage that ended by itself: an interrupted one is no pass without a plan.

    Raises:
        KeyboardInterrupt: if Ctrl-C ended it, as it is to end the design.
    """
    if stage.result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return stage


class Near:
    """Plans P2 near a pass, and says how the optimum changes.

    Facets are chosen as `Planner.plan` does, at the solution of P3, and kept: so the cost is a smooth
    function of phases and times, whose derivative the multipliers give. With exact risk there are none.
    Without uncertainty it is P3 that is planned.

    Args:
        space: of the passes.
        at: whose plan comes first.
        burns_m_s: where that plan begins, J2000, shape (m, 3).
        certain: whether uncertainty is left out.

    Attributes:
        first: the plan at `at`.
    """

    def __init__(self, space: Space, at: Pass, burns_m_s: Array, *, certain: bool = False) -> None:
        self.space, self._mission = space, space.mission_of(at)
        self._planner = planner = Planner(self._mission)
        self._stages = ScpStages(planner, self._mission, planner.algorithm)
        self._exact = self._mission.scenario.risk.allocation == "exact"
        runner = self._runner(self._mission)
        start = runner.start(from_burns(self._mission, burns_m_s))
        if not (self._exact or certain):
            p3 = runner.solver.solve("P3", planner.p3_rows, start, _unseen)
            start = uninterrupted(p3).result.lin
        self._rows: Rows = planner.p3_rows if certain else self._rows_at(start)
        self._name: Literal["P3", "P2"] = "P3" if certain else "P2"
        self.first = self.plan(space.vector(at), start)

    def plan(self, x: Array, start: Linearisation | None = None) -> Found:
        """P2 at x, begun at the burns of another iterate, or where the first plan ended."""
        at = self.space.at(x)
        mission = self.space.moved(self._mission, at)
        runner, begun = self._runner(mission), start or self.first.stage.result.lin
        lin = runner.start(begun.iterate)
        if isinstance(self._rows, ChanceRows):
            return Found(at, mission, runner.restore("P2", self._rows, lin))
        stage = runner.solver.solve(self._name, self._rows, lin, _unseen)
        return Found(at, mission, uninterrupted(stage))

    def slope(self, found: Found, free: npt.NDArray[np.bool_]) -> Array:
        """See `optimum.slope`."""
        x = self.space.vector(found.at)
        return slope(self.space, found.mission, found.stage, x, free)

    def _runner(self, mission: Mission) -> StageRunner:
        stages = ScpStages(self._planner, mission, self._planner.algorithm)
        return StageRunner(mission, stages)

    def _rows_at(self, lin: Linearisation) -> Rows:
        if self._exact:
            ways = self._stages.exact_rows()
            return ways[min(1, len(ways) - 1)][1]  # of whole flights those of few directions
        problem, polytopes = self._mission.problem, self._mission.polytopes
        facets = choose_facets(problem, polytopes, lin.iterate.mean, lin.factor)
        return self._planner.p2_rows(facets, lin, CLEARANCE_AGAIN_M)


def _unseen(name: str, record: Record) -> None:
    """Nobody looks on."""
