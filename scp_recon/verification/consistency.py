"""Check by independent means that a solution's statements follow from its own facts.

Facets are checked against the regions' centres, radii, apices, axes and angles. The risk of an
exact plan at each node is checked by the original limits at points of the node's normal law.
Neither check shares code with the planner's rows. The probability of a whole flight, and the
probability in a certificate, are checked by the flights of the Monte Carlo: see `probabilities`.
There is no check that all facets of a polytope together lie within a keep-in region; only the Monte
Carlo estimate covers that.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.arrays import Array, Indices
from formulations.problem.flyby import StateConstraint
from formulations.problem.regions import Ball, Cone
from formulations.rows.exact_flight import FLIGHT
from formulations.rows.node_probability import SPREAD_MIN
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import (
    TEST_CONFIDENCE,
    TESTS_MAX,
    flights_of_test,
    of_strata,
    proportion,
    seed_of_test,
)
from scp_recon.monte_carlo.limits import limit_margins
from scp_recon.planning.plan import Unit, scales
from scp_recon.planning.records import Certificate
from scp_recon.results.facts import EventProbability, FacetTable, Risk
from scp_recon.results.figures import (
    BARELY,
    FINAL_STATE,
    TIME_ERROR_S,
    ConstraintResult,
    Rows,
    Violation,
    ViolationAmount,
    facets_at,
    figures_of,
    is_converged,
    relative_covariances,
    rows_of,
    strange_parts,
    summed,
)
from scp_recon.results.policy import SAME, misjudged
from scp_recon.results.solution import Solution
from scp_recon.scp.status import Status

FACET_ERROR = 1e-9
MEASUREMENT_ERROR, PICTURED = 1e-6, 2.0 * SAME
"""Relative tolerance of a covariance in scaled units, and of what pictures tell along the plan."""
POINTS, SEED = 2**15, 7
"""Size and seed of a scrambled Sobol net. On plans per node for 0.70, 0.90 and 0.99 its error is at
most 4e-4. The same number of draws has a standard error of up to 2.5e-3. The planner's quadrature
is accurate to 1e-6."""
MARGIN_ERROR: dict[Unit, float] = {"m": 1e-3, "m/s": 1e-8, "sigma": 1e-9}
"""Error of a carried margin at the default mission's scale: the variance along a facet is a difference
of large numbers."""
SAME_PROBABILITY, ROUNDING = 1e-9, 1e-9
"""Tolerance between a probability and its quantile; relative rounding of sums."""
ERRORS = 2.0
"""Tolerance in standard errors of as many draws; 0.9 was measured."""
FEW = 3.0 / POINTS
"""In the tails, where a point counts for more than what it stands for."""


def inconsistencies(mission: Mission, solution: Solution) -> list[str]:
    """Parts of a solution that contradict its scenario or each other, by name.

    They include the figures that its file carried, and violations of a converged plan.
    """
    found = strange_parts(mission, solution)
    if "nodes.t_s" in found:  # nothing else can be told without them
        return found
    if solution.problem == "P2" and mission.scenario.risk.allocation == "exact":
        risk, required = solution.risk, mission.scenario.risk
        if risk is None or (risk.scope, risk.required) != (required.scope, required.p_chance):
            return [*found, "risk"]
        if not _is_law(mission, solution, risk) or not _is_promise(risk):
            found.append("risk")
    elif solution.problem == "P2" and not _are_sound(mission, solution.facets):
        return [*found, "facets"]
    if "policy.corrections" not in found and not _is_policy(mission, solution):
        found.append("policy.corrections")
    return [*found, *_wrong_figures(mission, solution)]


def _wrong_figures(mission: Mission, solution: Solution) -> list[str]:
    """Names of a file's status and figures that do not follow from its facts, within rounding.

    The status must be that of a stage, unless the plan was interrupted. A converged plan must
    violate nothing.
    """
    found, own = [], figures_of(mission, solution)
    carried = solution.carried or own
    stages = {stage.status for stage in solution.stages}
    if stages and solution.status not in stages | {Status.INTERRUPTED.value.name}:
        found.append("status")
    if not np.isclose(carried.total_dv_m_s, own.total_dv_m_s, rtol=ROUNDING, atol=1e-12):
        found.append("total_dv_m_s")
    rows, results = rows_of(mission, solution), {c.name: c for c in carried.constraints}
    if [c.name for c in carried.constraints] != [*rows] or not all(
        _is_result(mission, results[name], one, solution) for name, one in rows.items()
    ):
        found.append("constraints")
    violated = carried.violation.by_constraint or own.violation.by_constraint
    refuted = is_converged(solution) and violated
    if refuted or not _is_violation(mission, solution, own.violation, carried.violation):
        found.append("violation")
    return found


def _is_result(
    mission: Mission, reported: ConstraintResult, rows: Rows, solution: Solution
) -> bool:
    """Whether kind, unit and facets agree, and the margin is the smallest, at its time."""
    there = np.abs(rows.times - reported.worst_t_s) <= TIME_ERROR_S
    least = np.array([rows.margin.min(), rows.margin[there].min(initial=np.inf)])
    return bool(
        (reported.kind, reported.unit) == (rows.kind, rows.unit)
        and reported.facets == facets_at(rows, there, solution)
        and np.abs(reported.worst_margin - least).max()
        <= mission.units.tolerance(MARGIN_ERROR[rows.unit], rows.unit)
    )


def _is_violation(
    mission: Mission, solution: Solution, own: Violation, reported: Violation
) -> bool:
    """Whether carried amounts are the computed ones within the tolerance, and their sum is theirs."""
    parts, computed = reported.by_constraint, own.by_constraint
    scale, none = scales(mission.units), ViolationAmount(0.0, 0.0, "m")
    rows = len(solution.nodes.t_s) * 6 + len(solution.facets.node if solution.facets else [])
    if not parts.keys() <= {FINAL_STATE, *rows_of(mission, solution)}:
        return False
    if not all(part.total >= part.max * (1.0 - ROUNDING) > 0.0 for part in parts.values()):
        return False
    for name in parts.keys() | computed.keys():
        one, other = parts.get(name, none), computed.get(name, none)
        unit = other.unit if name in computed else one.unit
        error = BARELY * solution.tolerance * scale[unit]
        error += mission.units.tolerance(MARGIN_ERROR[unit], unit)
        if name in parts and one.unit != unit:
            return False
        if abs(one.max - other.max) > error or abs(one.total - other.total) > rows * error:
            return False
    sums = summed(parts, mission.units)
    given, expected = (reported.max, reported.total), (sums.max, sums.total)
    return np.allclose(given, expected, rtol=ROUNDING, atol=0.0)


def _is_policy(mission: Mission, solution: Solution) -> bool:
    """Whether a plan has corrections if its scenario asks for them, by the scenario's measurements."""
    feedback = mission.feedback
    if solution.policy is None:
        return feedback is None or solution.problem == "P3" or not is_converged(solution)
    assert feedback is not None  # as its parts are the mission's
    if mission.scenario.navigation.landmarks is not None:
        return misjudged(mission, solution.corrections, solution.burns_m_s) <= PICTURED
    given = np.array([c.measurement_covariance for c in solution.policy.corrections])
    given /= np.outer(mission.units.state, mission.units.state)
    expected = feedback.measurement @ feedback.measurement.swapaxes(1, 2)
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    return bool(np.all(np.abs(given - expected) <= MEASUREMENT_ERROR * size))


def _are_sound(mission: Mission, facets: FacetTable | None) -> bool:
    """Whether the facets leave no more than the allowed risk, and keep-out planes cut no region."""
    if facets is None:
        return False
    normal, offset = np.array(facets.normal).reshape(-1, 3), np.array(facets.offset_m)
    if not np.allclose(np.linalg.norm(normal, axis=1), 1.0, atol=FACET_ERROR):
        return False
    name, node = np.array(facets.constraint), np.array(facets.node, dtype=np.intp)
    risk = ndtr(-np.array(facets.quantile))
    for c in mission.problem.constraints:
        rows = np.flatnonzero(name == c.name)
        if not np.array_equal(np.unique(node[rows]), c.nodes):
            return False
        taken = np.bincount(node[rows], risk[rows], mission.problem.n_nodes)
        if np.any(taken[c.nodes] > 1.0 - c.probability + FACET_ERROR):
            return False
        if c.keep == "out":
            at = np.searchsorted(c.nodes, node[rows])
            beyond = _least(c, at, normal[rows], mission.units.length_m) - offset[rows]
            if np.any(beyond < -FACET_ERROR * mission.units.length_m):
                return False
    return len(name) == np.isin(name, [c.name for c in mission.problem.constraints]).sum()


def _least(constraint: StateConstraint, at: Indices, normal: Array, m: float) -> Array:
    """Smallest n'y over each region, m; -inf where a cone reaches through the plane."""
    region = constraint.region
    if isinstance(region, Ball):
        return m * (np.einsum("ri,ri->r", normal, region.center[at]) - region.radius)
    assert isinstance(region, Cone)  # a mission has no other regions
    leans = (
        np.einsum("ri,ri->r", normal, region.axis[at]) >= np.sin(region.half_angle) - FACET_ERROR
    )
    return np.where(leans, m * np.einsum("ri,ri->r", normal, region.apex[at]), -np.inf)


def _is_law(mission: Mission, solution: Solution, risk: Risk) -> bool:
    """Whether the normal law's probabilities are those of the nodes' means and covariances."""
    reported = {event.name: event for event in risk.normal_law}
    if len(reported) != len(risk.normal_law):
        return False
    if risk.scope == "flight" and reported.keys() == {FLIGHT}:
        whole = reported[FLIGHT]
        same = np.abs(ndtr(whole.sigma) - whole.probability).max() <= SAME_PROBABILITY
        return bool(same and len(whole.probability) == 1)
    expected = node_probabilities(mission, solution)
    return reported.keys() == expected.keys() and all(
        np.array_equal(reported[name].t_s, times) and _agree(reported[name], probability)
        for name, (times, probability) in expected.items()
    )


def _agree(reported: EventProbability, expected: Array) -> bool:
    p = np.array(reported.probability)
    if np.abs(ndtr(reported.sigma) - p).max() > SAME_PROBABILITY:
        return False
    return bool(np.all(np.abs(p - expected) <= FEW + ERRORS * np.sqrt(p * (1.0 - p) / POINTS)))


def node_probabilities(mission: Mission, solution: Solution) -> dict[str, tuple[Array, Array]]:
    """Times and probabilities of each joint constraint, by points of the nodes' normal laws.

    By definition no law of a position is narrower than `SPREAD_MIN`, so that one without errors is one.
    """
    times = np.array(solution.nodes.t_s)
    mean = np.array(solution.nodes.state)[:, :3]
    covariance = np.array(solution.nodes.covariance)[:, :3, :3]
    first, last = mission.observed_s or (np.inf, np.inf)
    window = (times >= first) & (times <= last)
    least = (SPREAD_MIN * mission.units.length_m) ** 2 * np.eye(3)
    positions = mean[:, None] + normal_points(covariance + least)
    margins = limit_margins(mission, times, positions, window)
    for c in mission.problem.constraints if solution.nodes.parameters is not None else ():
        if c.motion is not None:
            relative = covariance.copy()
            relative[c.nodes] = relative_covariances(mission, solution, c.motion, c.nodes)
            seen = mean[:, None] + normal_points(relative + least)
            margins[c.event] = limit_margins(mission, times, seen, window)[c.event]
    return {name: (at, (margin >= 0.0).mean(axis=1)) for name, (at, margin) in margins.items()}


def normal_points(covariance: Array) -> Array:
    """Sobol points of normal laws about zero, shape (..., POINTS, n), of covariances (..., n, n)."""
    from scipy.stats import qmc  # half a second to import

    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    draws = ndtri(qmc.Sobol(covariance.shape[-1], scramble=True, rng=SEED).random(POINTS))
    return np.asarray(draws @ root.swapaxes(-1, -2))


def _is_promise(risk: Risk) -> bool:
    """Whether the promised probability is the target, or is certified by valid flights.

    The target of a plan without a certificate must be at least the required probability. The target
    of a certified plan is free: it is less than required if flights reach more than the law
    predicts.
    """
    if risk.certificate is None:
        return risk.target >= risk.required - SAME_PROBABILITY
    return _is_sound(risk.certificate, risk.required)


def _is_sound(reached: Certificate, required: float) -> bool:
    """Whether a certificate has enough valid flights, and their interval."""
    flights: float = reached.samples
    if reached.strata is None:
        expected = proportion(round(reached.reached * flights), reached.samples, TEST_CONFIDENCE)
    else:
        expected = of_strata(reached.strata, TEST_CONFIDENCE)
        flights = reached.strata.allocation.draws
    reported = (reached.reached, reached.low, reached.high)
    unseen = 1 <= reached.tests <= TESTS_MAX and reached.seed == seed_of_test(reached.tests)
    try:
        enough = flights >= flights_of_test(required)
    except InputError:  # no flights certify so much
        return False
    same = np.allclose(reported, expected, rtol=0.0, atol=1e-9)
    return bool(
        same
        and enough
        and unseen
        and reached.confidence == TEST_CONFIDENCE
        and reached.reached <= reached.at_nodes
        and (reached.strata is None or reached.samples == sum(reached.strata.flown))
    )
