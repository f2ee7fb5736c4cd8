"""Mean, factor and virtual control as variables make the condensed program again."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Polytopes, choose_facets
from formulations.problem.feedback import Cost
from formulations.problem.flyby import StateConstraint
from formulations.problem.polytopes import ball
from formulations.problem.regions import Ball, Cone
from formulations.program import convex_subproblem, lifted, solvers
from formulations.program.solvers import SOLVERS
from formulations.program.subproblem import Penalty, PenaltyParameters
from formulations.registry import FORMULATIONS, make_subproblem
from formulations.rows.cones import PARTS
from formulations.rows.uniform import ChanceRows, DeterministicRows
from tests.helpers import constrain, random_flyby, random_unit

from .support import PENALTIES, alone, charge_for, every_row, minimum, need, small

Limits = tuple[float | None, float | None]
every_limit = pytest.mark.parametrize("limits", [(None, None), (0.9, 0.8)], ids=["", "limited"])


def limited(lin: Linearisation, parts: Limits) -> Limits:
    """Limits of the final spread, as parts of what it is at an iterate."""
    now = [float(np.linalg.norm(lin.factor[-1, rows])) for _, rows in PARTS]
    position, velocity = (part and part * size for part, size in zip(parts, now, strict=True))
    return position, velocity


@every_limit
@pytest.mark.parametrize("seed", range(6))
def test_lifted_rows_may_start_and_end_at_any_node(seed: int, limits: Limits) -> None:
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
        merits = []
        for formulation in ("condensed", "lifted"):
            subproblem = make_subproblem(problem, every_row(lin, name, 4), formulation)
            subproblem.update(lin)
            merits.append(subproblem.solve(0.5, 10.0).merit)
        assert merits[1] == pytest.approx(merits[0], rel=1e-6)


@every_limit
@pytest.mark.parametrize("scope", ["node", "flight"])
@pytest.mark.parametrize("seed", [3, 4])
def test_the_gradient_of_exact_risk_acts_on_the_factor_as_it_does_on_the_burns(
    seed: int, scope: str, limits: Limits
) -> None:
    """The same program, at a flight that obeys the dynamics, within 1e-6 with tightened loops."""
    flyby = small(seed, defect=0.0)
    problem = replace(flyby.problem, final_spread=limited(flyby, limits))
    lin, rows = replace(flyby, problem=problem), every_row(replace(flyby, problem=problem), scope)
    steps = []
    for formulation in ("condensed", "lifted"):
        subproblem = make_subproblem(problem, rows, formulation)
        subproblem.update(lin)
        steps.append([subproblem.solve(radius, 1.0) for radius in (0.02, 0.2)])
    for ours, theirs in zip(*steps, strict=True):
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
def test_corrections_are_linearised_as_in_the_condensed_form(
    seed: int, name: str, cost: Cost
) -> None:
    lin = corrected(seed, cost)
    rows, steps = every_row(lin, name, 4), []
    for formulation in ("condensed", "lifted"):
        subproblem = make_subproblem(lin.problem, rows, formulation)
        subproblem.update(lin)
        steps.append(subproblem.solve(0.2, 10.0))
    ours, theirs = steps
    assert theirs.merit == pytest.approx(ours.merit, rel=1e-6)
    assert theirs.burns == pytest.approx(ours.burns, abs=1e-4)
    if cost != "nominal":  # which hardly tells one gain from another
        assert theirs.gains == pytest.approx(ours.gains, abs=1e-3)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize(
    ("formulation", "solver"),
    [("condensed", "QOCO"), ("condensed", "ECOS"), *(("lifted", s) for s in (*SOLVERS, "ECOS"))],
)
def test_conic_solvers_agree(
    penalty: Penalty, formulation: str, solver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Built, then updated or built anew."""
    need(solver)
    lin = small()
    rows = every_row(lin, "P2", 4)
    charge, found = charge_for(penalty, rows, lin), []
    for form, by in (("condensed", "CLARABEL"), (formulation, solver)):
        if by == solver and solver in SOLVERS:
            alone(monkeypatch, solver)
        subproblem = make_subproblem(lin.problem, rows, form, by, penalty)
        assert subproblem.rows is rows
        subproblem.update(lin)
        found += [minimum(subproblem.solve(radius, charge), lin, charge) for radius in (0.1, 0.5)]
    assert found[2:] == pytest.approx(found[:2], rel=1e-6)


def test_clarabels_regularisation_is_what_this_form_needs_and_no_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each solver gets the settings for it; a step is what the solver said."""
    asked: list[tuple[str, Any]] = []
    lin = small()

    def recording(name: str) -> Any:
        def make(settings: Any) -> Any:
            asked.append((name, dict(settings)))
            real = solvers.Clarabel(settings)

            def solve(program: Any) -> Any:
                said = real.solve(program)
                return said._replace(accurate=False, solver_s=3.0, multipliers=None)

            return SimpleNamespace(solve=solve)

        return make

    monkeypatch.setitem(SOLVERS, "CLARABEL", recording("CLARABEL"))
    monkeypatch.delitem(SOLVERS, "QOCO")
    for formulation in ("condensed", "lifted"):
        subproblem = make_subproblem(lin.problem, every_row(lin, "P3", 4), formulation)
        subproblem.update(lin)
        clock = iter(float(k) for k in range(100))
        for module in (convex_subproblem, lifted):
            monkeypatch.setattr(module, "perf_counter", lambda clock=clock: next(clock))
        step = subproblem.solve(0.5, 10.0)
        assert not step.accurate
        assert step.solver_s >= 6.0  # asked twice, because it was not accurate
        monkeypatch.undo()
        monkeypatch.setitem(SOLVERS, "CLARABEL", recording("CLARABEL"))
        monkeypatch.delitem(SOLVERS, "QOCO")
    settings = {"static_regularization_constant": 1e-7}
    assert asked == [("CLARABEL", {})] * 2 + [("CLARABEL", settings)] * 2


Keep = Literal["in", "out"]


def on_the_wrong_side(keep: Keep, n_nodes: int) -> Linearisation:
    """Flown through a ball and a cone that it should keep out of, or past both, at some nodes."""
    rng = np.random.default_rng(8)
    flyby = random_flyby(rng, nodes=6)
    lin = flyby.perturbed(rng, 0.0, 0.0)
    nodes = np.sort(rng.choice(np.arange(1, 6), n_nodes, replace=False))
    track, away = lin.iterate.mean[nodes, :3], random_unit(rng, n_nodes)
    # Each node has a distance of its own.
    distance = np.linspace(0.1, 0.4, n_nodes)[:, None] + (1.5 if keep == "in" else 0.0)
    aside = 0.1 * random_unit(rng, n_nodes)
    sense = -1.0 if keep == "in" else 1.0
    regions = Ball(track + distance * away, 0.8), Cone(track - distance * away, sense * away, 0.6)
    cone = replace(regions[1], apex=regions[1].apex + distance * aside)
    constraints = (
        StateConstraint("ball", nodes, regions[0], keep, 0.8),
        StateConstraint("cone", nodes, cone, keep, 0.8),
    )
    return replace(lin, problem=replace(flyby.problem, constraints=constraints))


@pytest.mark.parametrize("n_nodes", [1, 2, 4])
@pytest.mark.parametrize("keep", ["in", "out"])
@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_without_a_step_every_row_costs_its_own_violation(
    formulation: str, name: str, keep: Keep, n_nodes: int
) -> None:
    lin = on_the_wrong_side(keep, n_nodes)
    facets = choose_facets(lin.problem, Polytopes(ball(6), 4), lin.iterate.mean, lin.factor)
    every = np.ones(len(facets.node), dtype=np.bool_)
    rows = (
        DeterministicRows(lin.problem) if name == "P3" else ChanceRows(lin.problem, facets, every)
    )
    subproblem = make_subproblem(lin.problem, rows, formulation)
    violations = subproblem.merit.violations(lin)
    if name == "P3":
        assert all(np.all(violations[c.name] > 0.0) for c in lin.problem.constraints)
    subproblem.update(lin)
    merit = subproblem.merit(lin, 10.0)
    assert subproblem.solve(1e-11, 10.0).merit == pytest.approx(merit, rel=1e-6)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("penalty", PENALTIES)
def test_without_a_row_the_flight_alone_counts(penalty: Penalty, formulation: str) -> None:
    """P3 without constraints and P2 without a facet are the same program, in any charge."""
    lin = on_the_wrong_side("in", 2)
    facets = choose_facets(lin.problem, Polytopes(ball(6), 4), lin.iterate.mean, lin.factor)
    bare = replace(lin.problem, constraints=())
    none = ChanceRows(lin.problem, facets, np.zeros(len(facets.node), dtype=np.bool_))
    limits = 6 + 3 * lin.problem.n_burns
    multipliers = np.linspace(0.0, 1.0, limits) if penalty == "augmented" else None
    charge, merits = PenaltyParameters(10.0, multipliers=multipliers), []
    for rows in (DeterministicRows(bare), none):
        subproblem = make_subproblem(bare, rows, formulation, penalty=penalty)
        subproblem.update(replace(lin, problem=bare))
        merits.append(subproblem.solve(0.5, charge).merit)
    assert merits[1] == pytest.approx(merits[0], rel=1e-6)
