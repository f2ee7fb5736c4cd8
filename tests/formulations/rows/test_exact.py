"""Exact rows: margins, slopes and curvature; limits of the final spread; programs of other code."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import null_space
from scipy.special import ndtr

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation, condense, final_state_map
from formulations.rows.cones import (
    BEND,
    FINAL_POSITION,
    FINAL_VELOCITY,
    FinalSpread,
    Rows,
    curved_cones,
    slopes_by_states,
)
from formulations.rows.exact import NodeRows
from formulations.rows.exact_flight import FLIGHT, TANGENTS, FlightRows
from formulations.rows.flight_probability import Coordinates
from formulations.rows.node_probability import joint_events, node_quantiles
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from tests.formulations.program.support import slack
from tests.helpers import generators, nightly, random_flyby
from tests.normal_law import cone_probability
from tests.oracles import burns_program
from tests.oracles.burns_program import BurnsProgram, FlightRow, ray_quantiles
from tests.oracles.burns_search import search
from tests.scenarios import COARSE

SCOPES = ("node", "flight")


@given(generators, st.integers(1, 6))
def test_curved_cone_has_value_slope_concave_curvature(rng, p):
    """By differences of y_0 - ||y_1..|| about where it is made; and it is triangular."""
    r, h = 3, 1e-4
    margin, slope, z = rng.normal(size=r), rng.normal(size=(r, p)), rng.normal(size=p)
    hessian = rng.normal(size=(r, p, p))
    hessian = hessian + hessian.swapaxes(1, 2)
    cones = curved_cones(np.arange(r), margin, slope, hessian, z)
    both = np.concatenate([cones.values, cones.constants[..., None]], axis=2)
    assert cones.triangular
    np.testing.assert_array_equal(both[:, 1:], np.triu(both[:, 1:]))
    assert slack(cones, z) == pytest.approx(margin, abs=1e-12)
    eye = h * np.eye(p)
    first = np.array([(slack(cones, z + e) - slack(cones, z - e)) / (2.0 * h) for e in eye]).T
    np.testing.assert_allclose(first, slope, atol=1e-6)
    values, axes = np.linalg.eigh(hessian)
    concave = np.einsum("rij,rj,rkj->rik", axes, np.minimum(values, 0.0), axes)

    def bent(e: Array, f: Array) -> Array:
        ahead = slack(cones, z + e + f) - slack(cones, z + e - f)
        return ahead - slack(cones, z - e + f) + slack(cones, z - e - f)

    second = np.array([[bent(e, f) for f in eye] for e in eye])
    np.testing.assert_allclose(second.transpose(2, 0, 1) / (4.0 * h * h), concave, atol=1e-4)


@given(generators, st.sampled_from([-1.0, 0.0, 1.0]))
def test_a_curved_cone_lies_between_parabola_and_tangent(rng, sign):
    """What curves upwards or not at all is left affine, however far."""
    p, z = 4, rng.normal(size=4)
    root = rng.normal(size=(1, p, p))
    margin, slope = rng.normal(size=1), rng.normal(size=(1, p))
    hessian = sign * root @ root.swapaxes(1, 2)
    cones = curved_cones(np.arange(1), margin, slope, hessian, z)
    for size in (0.1, 1.0, 10.0):
        d = size * rng.normal(size=p)
        tangent, found = margin + slope @ d, slack(cones, z + d)
        if sign >= 0.0:
            assert found == pytest.approx(tangent, abs=1e-5)
        else:
            assert tangent + 0.5 * d @ hessian[0] @ d - 1e-9 <= found <= tangent + 1e-9
    if sign < 0.0:
        # c (sqrt(1 + d'Hd / c) - 1): at d'Hd = 3 c it has bent by c.
        size = np.sqrt(3.0 * BEND / -(d @ hessian[0] @ d))
        expected = margin + size * slope @ d - BEND
        assert slack(cones, z + size * d) == pytest.approx(expected, rel=1e-6, abs=1e-6)


@cache
def flown(scope: str, p: float = 0.9) -> tuple[Mission, Linearisation]:
    """The coarse default mission, at a plan for a probability."""
    chosen = COARSE, "risk.allocation=exact", f"risk.scope={scope}", f"risk.p_chance={p}"
    mission = Mission.from_scenario(load_scenario(None, chosen))
    return mission, plan(mission, initial_guess.cold(mission)).final.result.lin


def rows_of(scope: str, mission: Mission, p: float = 0.9) -> Rows:
    if scope == "node":
        return NodeRows(mission.problem, p)
    return FlightRows(mission.problem, p, 1024, 1e-5)


def margins(rows: Rows, lin: Linearisation) -> Array:
    return np.concatenate([part.margin for part in rows.margins(lin).values()])


def modelled(rows: Rows, lin: Linearisation, z: Array) -> Array:
    found = np.empty(rows.count)
    for cones in rows.cones(lin, condense(lin, rows.nodes)):
        found[cones.rows] = slack(cones, z)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("scope", SCOPES)
def test_at_the_iterate_rows_have_the_margins_themselves(scope):
    mission, lin = flown(scope)
    rows = rows_of(scope, mission)
    found = modelled(rows, lin, lin.iterate.burns.ravel())
    np.testing.assert_allclose(found, margins(rows, lin), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("scope", "accuracy"), [("node", 1e-3), ("flight", 3e-2)])
def test_rows_have_slope_of_flown_margins(scope, accuracy):
    """Along directions that keep the final state, whose steps are flown by Newton's method."""
    mission, lin = flown(scope)
    rows, z = rows_of(scope, mission), lin.iterate.burns.ravel()
    _, jacobian = final_state_map(lin)
    free = np.linalg.svd(jacobian)[2][6:]
    step = 1e-4
    near = margins(rows, lin) < 3.0  # what is farther is told by its facet
    assert near.any()
    for direction in free:
        ends = []
        for move in (step * direction, -step * direction):
            other = mission.dynamics.close_defects(lin, (z + move).reshape(-1, 3))
            ends.append((margins(rows, other), other.iterate.burns.ravel()))
        difference = (ends[0][0] - ends[1][0])[near]
        # Newton's method may turn the burns a little; the model is asked about those flown.
        expected = (modelled(rows, lin, ends[0][1]) - modelled(rows, lin, ends[1][1]))[near]
        scale = np.abs(expected).max() + step
        np.testing.assert_allclose(difference, expected, rtol=0.0, atol=accuracy * scale)


@pytest.mark.slow
def test_bundle_bounds_flight_by_its_tangents():
    """None of them cuts off the iterate; where a tangent belongs, the model says no more than it."""
    mission, lin = flown("flight")
    rows, z = rows_of("flight", mission).bundled(), lin.controls
    free, rng = null_space(final_state_map(lin)[1]), np.random.default_rng(4)
    others = [
        mission.dynamics.close_defects(lin, (z + free @ move).reshape(-1, 3))
        for move in rng.normal(scale=1e-4, size=(5, free.shape[1]))
    ]
    values = [margins(rows, other).item() for other in (*others, lin)]
    (cones,) = rows.cones(lin, condense(lin, rows.nodes))
    assert cones.shared
    assert cones.rows.tolist() == [0] * TANGENTS
    at_iterate = slack(cones, z)
    assert at_iterate.min() == pytest.approx(at_iterate[0], abs=1e-12)
    assert at_iterate[0] == pytest.approx(values[-1], abs=1e-9)
    assert len({*at_iterate.round(10)}) == 1 + len(others)  # each has its own tangent
    for other, value in zip(others, values, strict=False):
        # g is concave here but for its kinks, which a tangent through the iterate leaves out.
        assert slack(cones, other.controls).min() < value + 1e-6


def test_nearby_slopes_bound_through_iterates_value():
    """Without curvature; those beyond the reach are left out, and what is evaluated later counts."""
    mission, lin = flown("flight")
    bundle, z = rows_of("flight", mission).bundled(), lin.controls
    rows, free = bundle.sloped(1e-3), null_space(final_state_map(lin)[1])
    for size in (5e-4, 1e-2):
        other = mission.dynamics.close_defects(lin, (z + size * free[:, 0]).reshape(-1, 3))
        margins(bundle, other)
        (cones,) = rows.cones(lin, condense(lin, rows.nodes))
        assert len({*cones.at(z + free[:, 0])[:, 0].round(10)}) == 2  # the iterate's and the first
    assert cones.shared
    assert cones.values.shape == (TANGENTS, 1, len(z))
    np.testing.assert_allclose(cones.at(z)[:, 0], margins(rows, lin).item(), atol=1e-9)


@pytest.mark.slow
def test_curvature_of_node_is_its_margins():
    """On the affine model: second differences of g, where g is concave along a direction."""
    mission, lin = flown("node")
    rows, z = NodeRows(mission.problem, 0.9), lin.iterate.burns.ravel()
    _, jacobian = final_state_map(lin)
    at, h = margins(rows, lin), 3e-3
    bound = np.argmin(at)
    for direction in np.linalg.svd(jacobian)[2][6:]:
        flights = [
            mission.dynamics.close_defects(lin, (z + move * direction).reshape(-1, 3))
            for move in (h, -h)
        ]
        second = sum(margins(rows, flight)[bound] for flight in flights) - 2.0 * at[bound]
        model = sum(modelled(rows, lin, flight.iterate.burns.ravel())[bound] for flight in flights)
        model -= 2.0 * at[bound]
        # The flow's own curvature is no part of the model, nor is what curves upwards.
        assert model == pytest.approx(min(second, 0.0), abs=0.35 * abs(second) + 2e-3)


def test_margin_is_at_node_ending_most_flights():
    mission, lin = flown("flight")
    rows = rows_of("flight", mission)
    ((name, found),) = rows.margins(lin).items()
    assert name == FLIGHT
    assert found.margin.shape == found.nodes.shape == (1,)
    nodes = NodeRows(mission.problem, 0.9).margins(lin).values()
    worst = min(nodes, key=lambda part: part.margin.min())
    # The tightest node, or one beside it.
    assert abs(found.nodes[0] - worst.nodes[np.argmin(worst.margin)]) <= 2
    assert found.margin[0] <= worst.margin.min() + 1e-2


@pytest.mark.parametrize("scope", SCOPES)
def test_higher_target_costs_difference_of_quantiles(scope):
    mission, lin = flown(scope)
    less, more = (rows_of(scope, mission, p) for p in (0.8, 0.95))
    apart = margins(less, lin) - margins(more, lin)
    np.testing.assert_allclose(apart, 1.6448536269514722 - 0.8416212335729143, rtol=1e-9)


def test_vanished_burn_turns_no_coordinates():
    """Its velocities are all but known from what came before: nearly nothing has any direction."""
    problem = Mission.from_scenario(load_scenario(None, (COARSE,))).problem
    rng = np.random.default_rng(5)
    factor = rng.normal(size=(problem.n_nodes, 6, 20))
    first, vanished = problem.leg_starts[:2]
    known = rng.normal(size=(3, 6)) @ factor[first]
    coordinates = Coordinates(problem.leg_starts[:-1].tolist())

    def reduced() -> Array:
        factor[vanished, 3:] = known + 1e-6 * rng.normal(size=known.shape)
        coordinates.settle(factor)
        return coordinates.reduced(factor)

    one, other = reduced(), reduced()
    assert other == pytest.approx(one, abs=1e-2)


PARTS = {FINAL_POSITION: slice(0, 3), FINAL_VELOCITY: slice(3, 6)}
limits = st.none() | st.floats(0.05, 2.0)


def flown_spread(rng: np.random.Generator, *spread: float | None) -> Linearisation:
    flyby = random_flyby(rng)
    problem = replace(flyby.problem, final_spread=spread)
    return replace(flyby, problem=problem).perturbed(rng, 0.1, 0.0)


@given(generators, limits, limits, st.integers(0, 5))
def test_each_limits_row_has_root_summed_variance(rng, position, velocity, first):
    lin = flown_spread(rng, position, velocity)
    rows, last = FinalSpread(lin.problem, first), lin.problem.n_nodes - 1
    both = dict(zip(PARTS, (position, velocity), strict=True))
    wanted = {name: limit for name, limit in both.items() if limit is not None}
    assert rows.count == len(wanted)
    assert rows.nodes.tolist() == ([last] if wanted else [])
    margins, variances = rows.margins(lin), np.diag(lin.factor[-1] @ lin.factor[-1].T)
    assert list(margins) == list(wanted)
    for name, limit in wanted.items():
        expected = limit - np.sqrt(variances[PARTS[name]].sum())
        assert margins[name].nodes.tolist() == [last]
        assert margins[name].margin == pytest.approx([expected], abs=1e-12)
    # The cones: exact in the burns, of the factor's affine model, wherever these are.
    s = condense(lin, np.array([0, last]))
    cones = rows.cones(lin, s)
    assert [int(cone.rows[0]) for cone in cones] == [first + k for k in range(len(wanted))]
    burns = lin.iterate.burns + rng.normal(size=lin.iterate.burns.shape)
    factor = s.factor_constant[-1] + s.factor_jacobian[-1] @ burns.ravel()
    for cone, (name, limit) in zip(cones, wanted.items(), strict=True):
        (y,) = cone.at(burns.ravel())
        assert cone.triangular
        assert y[0] == pytest.approx(limit, abs=1e-12)
        assert np.linalg.norm(y[1:]) == pytest.approx(np.linalg.norm(factor[PARTS[name]]), rel=1e-9)


@given(generators, st.integers(0, 4), st.booleans())
def test_slopes_by_states_are_those_of_priced_roots(rng, first, certain):
    """By differences of margins."""
    lin = flown_spread(rng, 0.3, 0.2)
    rows, prices = FinalSpread(lin.problem, first), rng.uniform(0.5, 2.0, first + 2)
    if certain:
        lin.__dict__["factor"] = np.zeros_like(lin.factor)
    by_mean, by_factor = slopes_by_states(lin, rows.state_cones(), prices)
    assert by_factor.shape == lin.factor.shape
    assert not by_mean.any()
    assert not by_factor[:-1].any()
    if certain:
        assert not by_factor[-1].any()
        return
    move, h = rng.normal(size=lin.factor.shape[1:]), 1e-6

    def priced(step: float) -> float:
        other = Linearisation(lin.problem, lin.iterate, lin.arcs)
        other.__dict__["factor"] = lin.factor + step * move
        return -float(prices[first:] @ margins(rows, other))

    slope = (priced(h) - priced(-h)) / (2.0 * h)
    assert np.sum(by_factor[-1] * move) == pytest.approx(slope, rel=1e-6, abs=1e-8)


EXACT = {"risk.allocation": "exact", "risk.p_chance": 0.9}


@pytest.fixture(scope="module")
def planned() -> Plan:
    mission = Mission.from_scenario(load_scenario().replace(EXACT))
    return plan(mission, initial_guess.cold(mission))


@pytest.fixture(scope="module")
def exact(planned) -> Mission:
    return planned.mission


@pytest.fixture(scope="module")
def p3(exact) -> Linearisation:
    return plan(exact, initial_guess.cold(exact), problem="P3").final.result.lin


def test_ray_quantiles_are_the_planners(exact, planned):
    lin = planned.final.result.lin
    event = next(e for e in joint_events(exact.problem.constraints) if e.name == "emission")
    event = event.at(np.arange(len(event.nodes) - 4, len(event.nodes)))
    mean, factor = lin.iterate.mean[event.nodes, :3], lin.factor[event.nodes, :3]
    ours, theirs = ray_quantiles(event, mean, factor), node_quantiles(event, mean, factor)
    (outer,), (inner,) = event.keep_in, event.keep_out
    for i, node in enumerate(ours.value):
        covariance, one = factor[i] @ factor[i].T, np.array([i])
        within = [cone_probability(r.at(one), mean[i], covariance) for r in (outer, inner)]
        assert ndtr(node) == pytest.approx(within[0] - within[1], abs=1e-4)
    assert ours.value == pytest.approx(theirs.value, abs=1e-3)
    for mine, planners in ((ours.by_mean, theirs.by_mean), (ours.by_factor, theirs.by_factor)):
        assert np.abs(mine - planners).max() < 5e-3 * np.abs(planners).max()


@pytest.mark.parametrize("scope", ["node", "flight"])
def test_program_derivatives_are_finite_differences(scope, exact, planned):
    problem, lin = exact.problem, planned.final.result.lin
    rows = (
        burns_program.NodeRows(problem, 0.9, 8192)
        if scope == "node"
        else FlightRow(problem, 0.9, 64)
    )
    nlp = BurnsProgram(exact, rows, 1e-3, np.inf, lin, 100)
    z = lin.iterate.burns.ravel() + 1e-3
    direction = np.random.default_rng(3).standard_normal(len(z))
    here, step = nlp.at(z), 1e-5
    ahead, behind = (nlp.at(z + move * direction) for move in (step, -step))
    for value, slope, error in (
        ("cost", "by_cost", 1e-5),
        ("equal", "by_equal", 1e-5),
        ("least", "by_least", 2e-2),
    ):
        expected = (getattr(ahead, value) - getattr(behind, value)) / (2.0 * step)
        found = getattr(here, slope) @ direction
        assert np.abs(found - expected).max() <= error * np.abs(expected).max()


@nightly
def test_slsqp_reaches_the_planners_optimum(exact, planned, p3):
    found = search(exact, p3, 60.0)
    assert found is not None
    cost = np.linalg.norm(found, axis=1).sum() * exact.units.speed_m_s
    assert cost == pytest.approx(planned.total_dv_m_s, rel=5e-4)
