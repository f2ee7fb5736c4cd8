"""Read the plan in flight, from memory or its file, and predict its state at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from scp_recon.errors import InputError, shortened
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import RK4_STEP_MAX_S, Units
from scp_recon.physics.flow import differentiate
from scp_recon.physics.forces import ForceModel
from scp_recon.planning.initial_guess import nondimensional
from scp_recon.planning.method import ScpMethod, scp_method
from scp_recon.planning.plan import Plan
from scp_recon.results.figures import is_converged, strange_parts
from scp_recon.results.policy import Policy, policy_of, with_policy
from scp_recon.results.read import read_solution, resolve_run
from scp_recon.results.solution import Solution, make_solution
from scp_recon.results.verification import in_words
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import (
    POSITION_LIMIT_M,
    VELOCITY_LIMIT_M_S,
    relative_error,
)

PATH_ERROR_M, COVARIANCE_ERROR = 1e-2, 1e-6
"""Tolerances of a file's nodes: in m, with speeds over one unit of time; relative in scaled units."""

LOST_SIGMAS = 3.0
"""Sigmas of the predicted final dispersion, which fewer than 0.3 % of a plan's flights exceed."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """A state (6,), J2000, m and m/s, and a factor (6, c) of its covariance."""

    state: Array
    factor: Array

    @property
    def covariance(self) -> Array:
        """Shape (6, 6)."""
        return self.factor @ self.factor.T

    def carried(self, duration_s: float, forces: ForceModel, start_s: float) -> Prediction:
        """The prediction after a coast that starts at a time."""
        state, factor = self.state, self.factor
        steps = int(np.ceil(duration_s / RK4_STEP_MAX_S))
        for k in range(steps):
            took = np.array([duration_s / steps])
            arc = differentiate(state[None], took, forces, start=start_s + k * took)
            state, factor = arc.state[0], arc.stm[0] @ factor
        return Prediction(state, factor)

    def burnt(self, burn: Array, kick: Array) -> Prediction:
        """The prediction after a burn in m/s, shape (3,), that adds `kick` (3, c) to the factor."""
        factor = self.factor.copy()
        factor[3:] += kick
        return Prediction(self.state + np.r_[np.zeros(3), burn], factor)


@dataclass(frozen=True, eq=False)
class FlownPlan:
    """The plan in flight.

    Attributes:
        name: its name in the file of the new plan.
        solution: its facts.
        mission: its.
        lin: its linearisation, with the gains of its corrected burns.
        method: the method that made it, as far as it is available.
        failed: failed checks, and contradictions in its file.
    """

    name: str
    solution: Solution
    mission: Mission
    lin: Linearisation
    method: ScpMethod
    failed: tuple[str, ...]

    @classmethod
    def of(cls, given: Plan | Solution | str | Path, name: str | None = None) -> FlownPlan:
        """Make it from a plan, a solution, or the solution's file or folder.

        A new plan builds on nodes and spread, so both are checked against the scenario and the
        burns of a solution. The rest of the file's verification is trusted. The new plan's file
        refers to this plan by `name`, else by its path.

        Raises:
            InputError: if `given` is none of these, or cannot be used.
        """
        noun = "a plan" if isinstance(given, Plan) else "a solution"
        if isinstance(given, Plan):
            given = make_solution(given)
        elif isinstance(given, str | Path):
            home = resolve_run(Path(given))  # runs/latest will point to another
            given, noun = read_solution(home), str(home)
        elif not isinstance(given, Solution):
            raise InputError("plan", shortened(given), "must be a plan, a solution or its file")
        mission, solution = given.mission, given
        if strange := strange_parts(mission, solution):
            contradicts = f"{strange[0]} that contradict its scenario"
            raise InputError("plan", contradicts, "must be of one plan")
        states = np.array(solution.nodes.state)
        path = nondimensional(mission, solution.burns_m_s, states)
        lin = mission.dynamics.linearise(mission.problem, path)
        if solution.policy is None:
            lin = lin.known(None)
        lin = with_policy(mission, lin, solution.corrections)
        failed = [] if solution.verification is None else solution.verification.failed
        failed = [*dict.fromkeys((*failed, *_contradictions(solution, lin, mission.units)))]
        return cls(name or noun, solution, mission, lin, _method(solution), tuple(failed))

    @property
    def times_s(self) -> Array:
        """Its nodes, shape (n,)."""
        return self.mission.times_s

    @cached_property
    def burns_m_s(self) -> Array:
        """Its burns, shape (m, 3)."""
        return self.lin.iterate.burns * self.mission.units.speed_m_s

    @cached_property
    def states(self) -> Array:
        """Means at the nodes, after the burns, J2000, m and m/s, shape (n, 6)."""
        return self.lin.iterate.mean * self.mission.units.state

    @cached_property
    def factors(self) -> Array:
        """S with S S' the covariances there, shape (n, 6, c)."""
        return self.lin.factor * self.mission.units.state[:, None]

    @cached_property
    def kicks(self) -> Array:
        """Columns of each burn in the factor of the velocity, corrections included, shape (m, 3, c)."""
        nodes, first = self.lin.problem.burn_nodes, self.lin.problem.initial_factor
        before = np.zeros_like(self.lin.factor[nodes])
        before[:, :, : first.shape[1]] = first[:6]
        later = nodes > 0
        arcs = nodes[later] - 1
        before[later] = (self.lin.stm_of_arcs[arcs] @ self.lin.spread.factor[arcs])[:, :6]
        kicks = self.lin.factor[nodes, 3:] - before[:, 3:]
        return np.asarray(kicks * self.mission.units.speed_m_s)

    @cached_property
    def policy(self) -> Policy:
        """Its corrections; none where all burns are fixed."""
        return policy_of(self.mission, self.lin)

    def known_at(self, at_s: float) -> Array | None:
        """Covariance (6, 6) of the estimate that its filter has at a time; None if it has no filter."""
        if not self.policy:
            return None
        factors = self.lin.flown_filter.error[:, :6] * self.mission.units.state[:, None]
        return self._carried(factors, at_s).covariance

    def commanded(self, state: Array, at_s: float) -> Array | None:
        """The next burn as its policy alone would command it, m/s, shape (3,).

        From an estimate (6,), J2000, m and m/s, at a time not after that burn's cut-off: by its
        deviation from the path, carried there. None of a plan without corrections or without a burn
        left, and where gains act on estimates at earlier cut-offs too, which no delivery tells.
        """
        burn = sum(time <= at_s for time in self.mission.scenario.burn_times_s)
        for one in self.policy:
            if one.burn == burn:
                if one.gains[:-1].any():
                    return None
                planned = self._carried(self.factors, at_s)
                apart = Prediction(planned.state, (state - planned.state)[:, None])
                apart = apart.carried(max(one.cut_off_s - at_s, 0.0), self.mission.forces, at_s)
                return np.asarray(self.burns_m_s[burn] + one.gains[-1] @ apart.factor[:, 0])
        return self.burns_m_s[burn] if self.policy and burn < len(self.burns_m_s) else None

    def _carried(self, factors: Array, at_s: float) -> Prediction:
        """The plan's path at a time, after a burn there, and the factors of its nodes carried there."""
        node = int(np.searchsorted(self.times_s, at_s, side="right")) - 1
        last = Prediction(self.states[node], factors[node])
        since = float(self.times_s[node])
        return last.carried(at_s - since, self.mission.forces, since)

    def is_lost(self, miss: Array) -> bool:
        """Whether a miss (6,), J2000, m and m/s, is beyond three sigma of the final dispersion.

        In position or in velocity, each sigma the root of the three components' summed variances at the
        plan's last node, as `boundary.final_sigma_position_m` counts it. What a verification allows of
        any plan is no loss.
        """
        spread = np.linalg.norm(self.factors[-1].reshape(2, -1), axis=1)
        tolerance = self.mission.units.tolerance
        least = tolerance(POSITION_LIMIT_M, "m"), tolerance(VELOCITY_LIMIT_M_S, "m/s")
        allowed = np.maximum(LOST_SIGMAS * spread, least)
        return bool(np.any(np.linalg.norm(miss.reshape(2, 3), axis=1) > allowed))

    def strange(self) -> Iterator[ScenarioWarning]:
        """Warnings about this plan for a new plan."""
        if self.failed:
            yield ScenarioWarning.of(
                "parent",
                f"{self.name}, which is not verified: {', '.join(map(in_words, self.failed))}",
                "expected a verified plan: only then are its nodes and their spread certain",
            )
        elif not is_converged(self.solution):
            expected = f"expected {Status.CONVERGED.value.name}"
            ended = f"{self.name}, which is {self.solution.status}"
            yield ScenarioWarning.of("parent", ended, expected)


def _method(made: Solution) -> ScpMethod:
    """The plan's own method; the default if SCP did not make it, or its solver is not installed.

    Raises:
        InputError: if a formulation or an algorithm is not known.
    """
    if made.method not in (None, "scp"):
        return scp_method()
    try:
        return scp_method(made.formulation, made.algorithm, made.solver)
    except InputError:
        return scp_method(made.formulation, made.algorithm)


def _contradictions(solution: Solution, lin: Linearisation, units: Units) -> Iterator[str]:
    """Parts of the nodes that contradict scenario and burns, by the verification's names."""
    first = lin.problem.initial_state.copy()
    if not lin.problem.coasts:
        first[3:] += lin.iterate.burns[0]
    off = max(np.abs(lin.defects[:-1]).max(), np.abs(lin.iterate.mean[0] - first).max())
    if not off * units.length_m <= units.tolerance(PATH_ERROR_M, "m"):
        yield "max_defect"
    expected, scale = lin.factor @ lin.factor.swapaxes(1, 2), np.outer(units.state, units.state)
    if relative_error(solution.nodes.covariance, expected * scale, scale) > COVARIANCE_ERROR:
        yield "covariance_error"


def predict(flown: FlownPlan, at_s: float, measured: Mapping[int, Array]) -> Prediction:
    """The state that a plan predicts for a time, after a burn there, with linear spread.

    The flight starts at the plan's last node before that time and before the first measured burn. A
    measured burn adds no error. Its information on errors that all burns share is not used, so the
    other burns keep their errors. Measured burns are by their number in the flight from 1, m/s,
    shape (3,).
    """
    scenario, forces, times = flown.mission.scenario, flown.mission.forces, flown.times_s
    first = scenario.burns_flown + 1
    burns = [(t, i) for i, t in enumerate(scenario.burn_times_s) if t <= at_s]
    again = [(t, i) for t, i in burns if i + first in measured]
    node = int(np.searchsorted(times, again[0][0] if again else at_s, side="right")) - 1
    now, state = times[node], Prediction(flown.states[node], flown.factors[node])
    if again:
        i = again[0][1]
        took = measured[i + first] - flown.burns_m_s[i]
        state = state.burnt(took, -flown.kicks[i])
        for time, i in burns:
            if time > now:
                known = measured.get(i + first)
                burn = flown.burns_m_s[i] if known is None else known
                kick = flown.kicks[i] if known is None else np.zeros_like(flown.kicks[i])
                state = state.carried(time - now, forces, now).burnt(burn, kick)
                now = time
    return state.carried(at_s - now, forces, now)
