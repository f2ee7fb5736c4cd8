"""Firing times as controls: derivatives of mean, factor and every kind of row, by differences."""

from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formulations.arrays import Array, Indices
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import (
    Linearisation,
    condense,
    miss_of,
    step_mean,
)
from formulations.problem.controls import UNIT, Boundary, Feedback, FiringTimes
from formulations.problem.execution_errors import ComponentwiseErrors, GatesErrors
from formulations.problem.expression_flow import ExpressionDerivatives, ExpressionFlow
from formulations.problem.facets import Polytopes, choose_facets
from formulations.problem.flyby import FlybyProblem, Iterate, StateConstraint
from formulations.problem.regions import Ball
from formulations.rows.exact import NodeRows
from formulations.rows.exact_flight import FlightRows
from formulations.rows.uniform import ChanceRows, DeterministicRows
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import GridFlow
from scp_recon.scenario.load import load_scenario
from tests.formulations.program.support import assert_transposed
from tests.helpers import generators, random_unit, share_of_examples

pytestmark = pytest.mark.slow

BURNS = np.array([0, 4, 9, 16])
NODES = np.r_[np.linspace(0.0, 0.4, 5), 0.4 + np.linspace(0.06, 0.3, 5), np.linspace(0.8, 1.4, 7)]
WINDOW = np.array([5, 6, 7])
MODELS = ComponentwiseErrors(0.08), GatesErrors(0.03, 0.05, 0.01, 0.04, 0.06)
STEP = 1e-4
CUT_OFFS: list[dict[int, int]] = [
    {},
    {1: 2},
    {2: 9},
    {1: 4, 2: 8},
    {1: 1, 2: 3},
    {1: 3, 2: 9, 3: 12},
]
"""Nodes of cut-offs by the burns that they serve: none, with and without lead, before another burn."""
SUBSTEPS = 6  # so many that the scheme's derivatives are the flow's


def dragged(r: Any, v: Any, t: Any, p: Any) -> Any:
    """A centre of attraction in a rotating frame, with drag and a push that depends on time."""
    pull = -r / (0.3 + ca.sumsqr(r)) ** 1.5
    turning = ca.vertcat(2.0 * v[1], -2.0 * v[0], 0.0)
    return pull + p[0] * (turning - ca.norm_2(v) * v) + ca.vertcat(0.0, 0.0, p[0] * ca.cos(3.0 * t))


class MovableDerivatives(ExpressionDerivatives):
    """Derivatives that know the flow's rate."""

    def rate(self, state: Array, arcs: Indices) -> tuple[Array, Array]:
        times = np.append(self._steps[0].time[0], self._steps[-1].time[-1, -1])[arcs]
        acceleration = self._flow._rate(state.T, [times], self._flow.parameters)[0]
        gradient = self._flow._gradient(state.T, [times], self._flow.parameters)[0]
        turn = np.zeros((len(state), 6, 6))
        turn[:, :3, 3:] = np.eye(3)
        turn[:, 3:] = np.moveaxis(gradient.reshape(3, -1, len(state))[:, :6], 2, 0)
        return np.hstack([state[:, 3:], acceleration.T]), turn


class MovableFlow(ExpressionFlow):
    """A flow whose nodes can be moved in time."""

    def at(self, times: Array) -> "MovableFlow":
        moved = copy(self)
        moved.times = times
        return moved

    def differentiate(self, state: Array) -> MovableDerivatives:
        d = super().differentiate(state)
        return MovableDerivatives(d.state, d.stm, d.by_parameters, d._steps, d._flow)


FLOWS = {
    drag: MovableFlow(dragged, NODES, parameters=[drag], substeps=SUBSTEPS) for drag in (0.0, 0.3)
}


class Case(NamedTuple):
    """A problem with its dynamics, and an iterate that obeys them."""

    problem: FlybyProblem
    dynamics: Dynamics
    lin: Linearisation

    def at(self, times: Array) -> Linearisation:
        """The same burns at other times."""
        problem, burns = self.problem.at(times), self.lin.iterate.burns
        gains = self.lin.iterate.gains
        moved = self.dynamics.at(problem, times)
        mean = moved.rollout(problem.initial_state, burns)
        return self.dynamics.linearise(problem, Iterate(burns, mean, gains, times))

    def differences(self, of: Any, direction: Array) -> Any:
        """Central differences of functions of the iterate along a direction of the times' controls."""
        times = self.lin.iterate.times
        ahead, behind = (of(self.at(times + s * STEP * UNIT * direction)) for s in (1, -1))
        return [(a - b) / (2 * STEP) for a, b in zip(ahead, behind, strict=True)]


@st.composite
def cases(draw: st.DrawFn) -> Case:
    rng, drag = draw(generators), draw(st.sampled_from(list(FLOWS)))
    errors, home = draw(st.sampled_from(MODELS)), draw(st.booleans())
    several = not errors.shared
    cut_offs = draw(st.sampled_from([one for one in CUT_OFFS if several or len(one) < 2]))
    return case(rng, FLOWS[drag], errors, home=home, cut_offs=cut_offs)


def case(
    rng: np.random.Generator,
    flow: ExpressionFlow,
    errors: Any,
    *,
    home: bool,
    cut_offs: dict[int, int],
) -> Case:
    """A problem with four burns, two or all of which move about nodes that stay; both phases too.

    Burns with a cut-off are corrected, and the cut-off moves along.
    """
    start = np.r_[random_unit(rng), 0.3 * rng.normal(size=3)]
    burns = 0.3 * rng.normal(size=(4, 3))
    free, boundary = np.arange(4) if home else np.array([1, 2]), None
    if home:
        bend, root = 0.3 * rng.normal(size=(3, 6)), 0.02 * rng.normal(size=(6, 6))

        def last(phase: float) -> Array:
            return start + bend[0] * np.sin(phase) + bend[1] * (np.cos(phase) - 1.0)

        def first(phase: float) -> tuple[Array, Array]:
            return last(phase), root + 0.1 * np.outer(last(phase), bend[2])

        boundary = Boundary(first, last, (0.3, -0.4), (0, 1))
    q = len(free) + 2 * home
    rules = np.eye(q), np.zeros(q), tuple("abcdef"[:q])
    firing = FiringTimes.on_grid(free, NODES, BURNS, WINDOW, rules, boundary, cut_offs)
    feedback = None
    if cut_offs:
        feedback = Feedback(
            np.array(list(cut_offs)),
            np.array(list(cut_offs.values())),
            0.02 * rng.normal(size=(len(cut_offs), 6, 6)),
            "dv99",
            0.9,
        )
    problem = FlybyProblem(
        n_nodes=len(NODES),
        burn_nodes=BURNS,
        initial_state=start,
        final_state=np.zeros(6),
        initial_factor=0.02 * rng.normal(size=(6, 6)),
        execution_errors=errors,
        dv_max=3.0,
        sun=random_unit(rng, 4),
        dv_cone=0.2,
        constraints=(),
        firing=firing,
        feedback=feedback,
    )
    dynamics = Dynamics(flow, BURNS)
    mean = dynamics.rollout(start, burns)
    times = firing.start + 0.01 * rng.normal(size=q)
    gains = 0.03 * rng.normal(size=0 if feedback is None else feedback.size)
    iterate = Iterate(burns, mean, gains)
    found = Case(problem, dynamics, dynamics.linearise(problem, iterate))
    return found._replace(lin=found.at(times))


def close(found: Array, expected: Array, tolerance: float = 1e-6) -> None:
    scale = max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=tolerance * scale)


few = settings(max_examples=share_of_examples(20, 3))


@few
@given(cases(), generators)
def test_mean_and_factor_have_derivatives_by_times(one, rng):
    """At all nodes: those that stay, those that move along, and those of the burns."""
    timed = one.problem.time_controls
    direction = rng.normal(size=len(timed))
    s = condense(one.lin)
    of = one.differences(lambda lin: (lin.iterate.mean, lin.factor, lin.defects[-1]), direction)
    mean, factor, miss = of
    close(s.mean_jacobian[..., timed] @ direction, mean)
    close(s.factor_jacobian[..., timed] @ direction, factor)
    constant, jacobian = miss_of(one.lin)
    close(jacobian[:, timed] @ direction, miss)
    close(constant + jacobian @ one.lin.controls, one.lin.defects[-1])
    assert_transposed(one.lin, rng)


@few
@pytest.mark.parametrize("cut_offs", CUT_OFFS[1:])
@pytest.mark.parametrize("home", [False, True])
@given(generators)
def test_factor_of_corrected_burns_has_derivatives_by_times(cut_offs, home, rng):
    """Measurements move along with their burns, and so does what the corrections know."""
    one = case(rng, FLOWS[0.3], MODELS[0], home=home, cut_offs=cut_offs)
    timed, s = one.problem.time_controls, condense(one.lin)
    direction = rng.normal(size=len(timed))
    moved = one.problem.firing.shares @ np.eye(len(timed))[0]
    burn = int(one.problem.firing.burns[0])
    if burn in cut_offs:
        assert moved[cut_offs[burn]] == moved[BURNS[burn]] == 1.0
    (factor,) = one.differences(lambda lin: (lin.factor,), direction)
    close(s.factor_jacobian[..., timed] @ direction, factor)
    assert_transposed(one.lin, rng, 3)


@few
@given(cases(), generators)
def test_the_model_errs_by_the_square_of_times(one, rng):
    """Of the mean that a step predicts, burns and times together."""
    burns, times = one.lin.iterate.burns, one.lin.iterate.times
    d_burns, d_times = 0.1 * rng.normal(size=(4, 3)), 0.01 * rng.normal(size=len(times))
    errors = []
    for share in (1e-2, 1e-3):
        moved = burns + share * d_burns, times + share * d_times
        start = one.problem.at(moved[1]).initial_state
        flown = one.dynamics.at(one.problem, moved[1]).rollout(start, moved[0])
        errors.append(np.linalg.norm(step_mean(one.lin, *moved) - flown))
    assert np.log10(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


@few
@given(cases())
def test_closing_defects_keeps_times_and_obeys_flow(one):
    step = one.lin.iterate.times + 0.01
    flown = one.dynamics.close_defects(one.lin, one.lin.iterate.burns, times=step)
    assert np.array_equal(flown.iterate.times, step)
    assert flown.is_dynamically_feasible
    start = one.problem.at(step).initial_state
    again = one.dynamics.at(one.problem, step).rollout(start, flown.iterate.burns)
    close(flown.iterate.mean, again, 1e-9)


@few
@pytest.mark.parametrize("kind", ["certain", "uniform", "node", "flight"])
@given(cases(), generators)
def test_rows_of_every_risk_have_derivatives(kind, one, rng):
    """Of a ball in the window and a ball that the whole flight keeps out of."""
    mean = one.lin.iterate.mean[:, :3]
    within = Ball(mean[WINDOW] + 0.05 * random_unit(rng, 3), 0.15)
    least = np.linalg.norm(mean, axis=1).min()
    out = Ball(np.zeros((len(NODES), 3)), max(least - 0.03, 0.5 * least))
    constraints = (
        StateConstraint("window", WINDOW, within, "in", 0.8),
        StateConstraint("safe", np.arange(len(NODES)), out, "out", 0.9),
    )
    one = one._replace(problem=replace(one.problem, constraints=constraints))
    one = one._replace(lin=one.at(one.lin.iterate.times))
    problem = one.problem
    if kind == "certain":
        rows: Any = DeterministicRows(problem)
    elif kind == "uniform":
        facets = choose_facets(problem, Polytopes(None, 4), one.lin.iterate.mean, one.lin.factor)
        rows = ChanceRows(problem, facets, np.ones(len(facets.node), dtype=bool))
    elif kind == "node":
        rows = NodeRows(problem, 0.8)
    else:
        rows = FlightRows(problem, 0.8, 256, 1e-5)
    direction = rng.normal(size=len(problem.time_controls))
    s = condense(one.lin, rows.nodes, factor=rows.condensed)
    slope = np.zeros(rows.count)
    for cones in rows.cones(one.lin, s):
        p = cones.values.shape[2]
        step = np.zeros(len(one.lin.controls))
        step[problem.time_controls] = direction
        y, d = cones.at(one.lin.controls), cones.values @ step[:p]
        size = np.linalg.norm(y[:, 1:], axis=1)
        tail = np.einsum("nd,nd->n", y[:, 1:], d[:, 1:]) / np.maximum(size, 1e-300)
        slope[cones.rows] = d[:, 0] - tail

    def margins(lin: Linearisation) -> list[Array]:
        return [np.concatenate([part.margin for part in rows.margins(lin).values()])]

    (margin,) = one.differences(margins, direction)
    if kind == "node":  # far from a limit its facet stands for it
        seen = np.abs(margins(one.lin)[0]) < 3.0
        close(slope[seen], margin[seen])
    else:
        close(slope, margin, 1e-4 if kind == "flight" else 1e-6)


@pytest.mark.parametrize("changes", [{}, {"knowledge.body.gm_m3_s2": 0.05}])
def test_default_flow_has_rates(changes):
    """Of the packaged scenario's forces, on its own grid with many steps an arc."""
    mission = Mission.from_scenario(load_scenario().replace(changes))
    nodes = mission.times_s / mission.units.time_s
    free = np.array([1, 2])
    firing = FiringTimes.on_grid(
        free, nodes, mission.burn_nodes, mission.window_nodes, (np.eye(2), np.zeros(2), ("a", "b"))
    )
    flow = replace(mission.flow, substeps=8)
    assert isinstance(flow, GridFlow)
    problem, dynamics = replace(mission.problem, firing=firing), Dynamics(flow, mission.burn_nodes)
    burns = 0.5 * np.random.default_rng(1).normal(size=(4, 3))
    mean = dynamics.rollout(problem.initial_state, burns)
    times = nodes[mission.burn_nodes[free]] + [-0.01, 0.02]
    one = Case(problem, dynamics, dynamics.linearise(problem, Iterate(burns, mean)))
    one = one._replace(lin=one.at(times))
    timed, s = problem.time_controls, condense(one.lin)
    for direction in np.eye(2):
        mean, factor = one.differences(lambda lin: (lin.iterate.mean, lin.factor), direction)
        close(s.mean_jacobian[..., timed] @ direction, mean)
        close(s.factor_jacobian[..., timed] @ direction, factor)
