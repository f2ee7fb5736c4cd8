"""Mean, factor and virtual control as variables make the condensed program again."""

from dataclasses import replace

import numpy as np
import pytest

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.controls import Cost
from formulations.problem.facets import Polytopes, ball, choose_facets
from formulations.problem.regions import Ball
from formulations.program.subproblem import Step
from formulations.registry import FORMULATIONS, make_subproblem
from formulations.rows.cones import PARTS, Rows
from formulations.rows.uniform import ChanceRows, DeterministicRows
from tests.helpers import constrain, random_flyby, usually

from .support import PENALTIES, charge_for, every_row, small

pytestmark = pytest.mark.slow

Limits = tuple[float | None, float | None]
every_limit = pytest.mark.parametrize("limits", [(None, None), (0.9, 0.8)], ids=["", "limited"])


def limited(lin: Linearisation, parts: Limits) -> Limits:
    """Limits of the final spread, as parts of what it is at an iterate."""
    now = [float(np.linalg.norm(lin.factor[-1, rows])) for _, rows in PARTS]
    position, velocity = (part and part * size for part, size in zip(parts, now, strict=True))
    return position, velocity


def steps_of_both(lin: Linearisation, rows: Rows, weight: float, *radii: float) -> list[list[Step]]:
    """Of the condensed form and of the lifted one, by radius."""
    found = []
    for formulation in ("condensed", "lifted"):
        subproblem = make_subproblem(lin.problem, rows, formulation)
        subproblem.update(lin)
        found.append([subproblem.solve(radius, weight) for radius in radii])
    return found


@every_limit
@pytest.mark.parametrize("seed", usually(range(6), 3))
def test_lifted_rows_span_any_two_nodes(seed, limits):
    """One constraint at a few nodes: before and after inner burns, at burns, in a coast."""
    flyby = small(seed, nodes=8, burns=4, coast=seed % 2)
    one = flyby.problem.constraints[0]
    assert isinstance(one.region, Ball)
    nodes = np.array([[0], [1], [2, 3], [7], [3, 4, 6], [0, 7]][seed])
    region = Ball(np.repeat(one.region.center[:1], len(nodes), axis=0), one.region.radius)
    constraints = (replace(one, nodes=nodes, region=region),)
    spread = limited(flyby, limits)
    problem = replace(flyby.problem, constraints=constraints, final_spread=spread)
    lin = Linearisation(problem, flyby.iterate, flyby.arcs)
    for name in ("P3", "P2") if limits[0] is None else ("P2",):
        ((ours,), (theirs,)) = steps_of_both(lin, every_row(lin, name, 4), 10.0, 0.5)
        assert theirs.merit == pytest.approx(ours.merit, rel=1e-6)


@every_limit
@pytest.mark.parametrize("scope", ["node", "flight"])
@pytest.mark.parametrize("seed", [3, 4])
def test_exact_risk_gradient_matches_factor_and_burns(seed, scope, limits):
    """The same program, at a flight that obeys the dynamics, within 1e-6 with tightened loops."""
    flyby = small(seed, defect=0.0)
    problem = replace(flyby.problem, final_spread=limited(flyby, limits))
    lin = replace(flyby, problem=problem)
    for ours, theirs in zip(
        *steps_of_both(lin, every_row(lin, scope), 1.0, 0.02, 0.2), strict=True
    ):
        assert theirs.merit == pytest.approx(ours.merit, rel=1e-6)
        assert theirs.burns == pytest.approx(ours.burns, abs=1e-4)


def corrected(seed: int, cost: Cost) -> Linearisation:
    """A flyby under way, flown with random gains, whose defects move what its measurements tell."""
    rng = np.random.default_rng(seed)
    flyby = constrain(rng, random_flyby(rng, nodes=6, burns=3, coast=1)).corrected(rng, cost)
    lin = flyby.perturbed(rng, 0.05, 0.02)
    gains = 0.1 * rng.normal(size=len(lin.problem.gain_controls))
    return replace(lin, iterate=replace(lin.iterate, gains=gains))


@pytest.mark.parametrize(
    ("seed", "name", "cost"), [(1, "P2", "dv99"), (2, "node", "expected"), (3, "flight", "nominal")]
)
def test_corrections_are_linearised_as_in_the_condensed_form(seed, name, cost):
    lin = corrected(seed, cost)
    ((ours,), (theirs,)) = steps_of_both(lin, every_row(lin, name, 4), 10.0, 0.2)
    assert theirs.merit == pytest.approx(ours.merit, rel=1e-6)
    assert theirs.burns == pytest.approx(ours.burns, abs=1e-4)
    if cost != "nominal":  # which hardly tells one gain from another
        assert theirs.gains == pytest.approx(ours.gains, abs=1e-3)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("penalty", PENALTIES)
def test_without_a_row_the_flight_alone_counts(penalty, formulation):
    """P3 without constraints and P2 without a facet are the same program, in any charge."""
    lin = small()
    facets = choose_facets(lin.problem, Polytopes(ball(6), 4), lin.iterate.mean, lin.factor)
    bare = replace(lin.problem, constraints=())
    none = ChanceRows(lin.problem, facets, np.zeros(len(facets.node), dtype=np.bool_))
    charge, merits = charge_for(penalty, none, replace(lin, problem=bare)), []
    for rows in (DeterministicRows(bare), none):
        subproblem = make_subproblem(bare, rows, formulation, penalty=penalty)
        subproblem.update(replace(lin, problem=bare))
        merits.append(subproblem.solve(0.5, charge).merit)
    assert merits[1] == pytest.approx(merits[0], rel=1e-6, abs=1e-9)
