"""A program in CVXPY says what the iterate, the radius, and the charge make of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from formulations.modelled import STATE_MODELS, ModelledSubproblem

from formulations import conic
from formulations.facets import Polytopes, choose_facets
from formulations.lifting import Linearisation
from formulations.penalty import Charge, Penalty
from formulations.polytopes import ball
from formulations.program.subproblem import SubproblemError
from formulations.regions import Ball
from formulations.registry import FORMULATIONS, is_direct, make_subproblem
from formulations.rows import P2Rows, P3Rows, Rows
from tests.helpers import Array, constrain, random_flyby

PENALTIES: tuple[Penalty, ...] = get_args(Penalty)


def linearised(seed: int = 3, **sizes: int) -> Linearisation:
    rng = np.random.default_rng(seed)
    return constrain(rng, random_flyby(rng, **{"nodes": 5, **sizes})).perturbed(rng, 0.1, 0.05)


def rows_of(lin: Linearisation, name: str) -> Rows:
    if name == "P3":
        return P3Rows(lin.problem)
    facets = choose_facets(lin.problem, Polytopes(ball(4), 3), lin.iterate.mean, lin.factor)
    return P2Rows(lin.problem, facets, np.ones(len(facets.node), dtype=np.bool_))


def charge_for(penalty: Penalty, lin: Linearisation, rows: Rows, weight: float) -> Charge:
    if penalty == "augmented":
        count = 6 + 3 * lin.problem.n_burns + rows.count
        return Charge(weight, multipliers=np.linspace(0.0, 2.0, count))
    return Charge(weight, prox=0.7 if penalty == "proximal" else 0.0)


def elsewhere(lin: Linearisation) -> Linearisation:
    """The same arcs around other burns and means."""
    rng = np.random.default_rng(11)
    burns = lin.iterate.burns + 0.1 * rng.normal(size=lin.iterate.burns.shape)
    mean = lin.iterate.mean + 0.05 * rng.normal(size=lin.iterate.mean.shape)
    return Linearisation(lin.problem, replace(lin.iterate, burns=burns, mean=mean), lin.arcs)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_an_updated_program_is_a_new_one(formulation: str, name: str, penalty: Penalty) -> None:
    """Every parameter is set again: nothing is left of the last iterate, radius and charge."""
    lin = linearised()
    rows, moved = rows_of(lin, name), elsewhere(lin)
    used, fresh = (
        ModelledSubproblem(lin.problem, rows, formulation, penalty=penalty) for _ in range(2)
    )
    used.update(lin)
    used.solve(0.1, charge_for(penalty, lin, rows, 3.0))
    charge = charge_for(penalty, lin, rows, 20.0)
    for subproblem in (used, fresh):
        subproblem.update(moved)
    again, new = used.solve(0.5, charge), fresh.solve(0.5, charge)
    assert again.merit == pytest.approx(new.merit, rel=1e-6)
    assert again.burns == pytest.approx(new.burns, abs=1e-3)
    assert np.abs(again.burns - moved.iterate.burns).max() <= 0.5 + 1e-6


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("name", ["P3", "P2"])
def test_the_lifted_program_is_the_condensed_one(name: str, penalty: Penalty) -> None:
    lin = linearised(5)
    rows, merits = rows_of(lin, name), []
    charge = charge_for(penalty, lin, rows, 10.0)
    for formulation in ("condensed", "lifted"):
        subproblem = ModelledSubproblem(lin.problem, rows, formulation, penalty=penalty)
        subproblem.update(lin)
        step = subproblem.solve(0.8, charge)
        moved = ((step.burns - lin.iterate.burns) ** 2).sum()
        merits.append(step.merit + 0.5 * charge.prox * float(moved))
    assert merits[1] == pytest.approx(merits[0], rel=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_lifted_rows_may_start_and_end_at_any_node(seed: int) -> None:
    """One constraint at a few nodes: before the first inner burn, after the last, and at burns."""
    flyby = linearised(seed, nodes=8, burns=4)
    one = flyby.problem.constraints[0]
    assert isinstance(one.region, Ball)
    nodes = np.array([[0], [1], [2, 3], [7], [3, 4, 6], [0, 7]][seed])
    region = Ball(np.repeat(one.region.center[:1], len(nodes), axis=0), one.region.radius)
    problem = replace(flyby.problem, constraints=(replace(one, nodes=nodes, region=region),))
    lin = Linearisation(problem, flyby.iterate, flyby.arcs)
    for name in ("P3", "P2"):
        merits = []
        for formulation in ("condensed", "lifted"):
            subproblem = ModelledSubproblem(problem, rows_of(lin, name), formulation)
            subproblem.update(lin)
            merits.append(subproblem.solve(0.5, 10.0).merit)
        assert merits[1] == pytest.approx(merits[0], rel=1e-6)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("formulation", ["condensed", "lifted"])
def test_limits_on_burns_are_broken_at_their_price(formulation: str, side: float) -> None:
    """Burns twice as large as allowed and close to the Sun's line, with no way to turn."""
    flyby = linearised()
    burns, mean = flyby.iterate.burns, flyby.iterate.mean
    sizes = np.linalg.norm(burns, axis=1, keepdims=True)
    sun = side * burns / sizes + 0.05
    problem = replace(
        flyby.problem,
        dv_max=0.5 * float(sizes.min()),
        sun=sun / np.linalg.norm(sun, axis=1, keepdims=True),
        final_state=mean[-1],
    )
    state = mean[1:].copy()
    state[problem.burn_nodes[1:] - 1, 3:] -= burns[1:]  # no defects
    arcs = replace(flyby.arcs, state=state)
    lin = Linearisation(problem, flyby.iterate, arcs)
    assert np.abs(lin.defects).max() < 1e-12
    subproblem = ModelledSubproblem(problem, P3Rows(problem), formulation)
    subproblem.update(lin)
    merit, broken = subproblem.merit(lin, 10.0), subproblem.violations(lin)
    assert min(broken[name].sum() for name in ("dv_max", "dv_battery")) > 0.01
    assert subproblem.solve(1e-10, 10.0).merit == pytest.approx(merit, rel=1e-6)


# --- the solver behind it -----------------------------------------------------------------------


def test_a_step_is_what_the_solver_said(monkeypatch: pytest.MonkeyPatch) -> None:
    lin, asked, real = linearised(), [], conic.solve
    said = {"solver_s": 3.0, "canonicalise_s": 5.0, "accurate": False}

    def solve(program: Any, solver: str, settings: dict[str, Any]) -> conic.Answer:
        asked.append((solver, settings))
        return replace(real(program, solver, settings), **said)

    monkeypatch.setattr(conic, "solve", solve)
    for formulation, solver in (
        ("condensed", "CLARABEL"),
        ("lifted", "CLARABEL"),
        ("lifted", "ECOS"),
    ):
        subproblem = ModelledSubproblem(lin.problem, rows_of(lin, "P3"), formulation, solver)
        subproblem.update(lin)
        step = subproblem.solve(0.5, 10.0)
        assert {key: getattr(step, key) for key in said} == said
    # The settings are Clarabel's, for the one form that needs any.
    settings = {"static_regularization_constant": 1e-7}
    assert asked == [("CLARABEL", {}), ("CLARABEL", settings), ("ECOS", {})]


@pytest.mark.parametrize("wrong", [None, np.nan, np.inf])
def test_burns_that_are_not_finite_are_none(
    wrong: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    lin = linearised()
    subproblem = ModelledSubproblem(lin.problem, rows_of(lin, "P3"), "condensed", "ECOS")
    subproblem.update(lin)

    def solve(*_: Any) -> conic.Answer:
        burns = lin.iterate.burns.copy()
        burns[1, 2] = 0.0 if wrong is None else wrong
        subproblem._burns.save_value(None if wrong is None else burns)
        return conic.Answer(1.0, True, 0.0, 0.0)

    monkeypatch.setattr(conic, "solve", solve)
    with pytest.raises(SubproblemError, match=r"^ECOS gave no finite burns$"):
        subproblem.solve(0.5, 10.0)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("solver", ["CLARABEL", "ECOS"])
def test_dynamics_without_finite_derivatives_are_refused(formulation: str, solver: str) -> None:
    lin = linearised()
    stm: Array = np.full_like(lin.arcs.stm, np.nan)
    broken = Linearisation(lin.problem, lin.iterate, replace(lin.arcs, stm=stm))
    subproblem = make_subproblem(lin.problem, rows_of(lin, "P3"), formulation, solver)
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(SubproblemError, match="no finite derivatives at the iterate"),
    ):
        subproblem.update(broken)


# --- which of them ------------------------------------------------------------------------------


def test_what_needs_no_modelling_layer_has_none() -> None:
    lin = linearised()
    for formulation in FORMULATIONS:
        for solver in ("CLARABEL", "QOCO", "ECOS", "SCS"):
            direct = formulation != "lifted" and solver in ("CLARABEL", "QOCO")
            assert is_direct(formulation, solver) is direct
            if solver == "QOCO":
                pytest.importorskip("qoco", reason="QOCO is not installed")
            made = make_subproblem(lin.problem, rows_of(lin, "P3"), formulation, solver)
            assert isinstance(made, ModelledSubproblem) is not direct
            assert solver in vars(made).values()
    assert set(FORMULATIONS) == set(STATE_MODELS)
    plain = make_subproblem(lin.problem, rows_of(lin, "P3"))
    assert not isinstance(plain, ModelledSubproblem)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize(
    ("formulation", "solver"), [("frozen-stm", "CLARABEL"), ("lifted", "ECOS")]
)
def test_the_rows_and_the_penalty_are_those_asked_for(
    formulation: str, solver: str, penalty: Penalty
) -> None:
    lin = linearised()
    rows = rows_of(lin, "P2")
    charge, found = charge_for(penalty, lin, rows, 10.0), []
    makes = [make_subproblem, ModelledSubproblem]
    for make in makes:
        subproblem = make(lin.problem, rows, formulation, solver, penalty)
        assert subproblem.rows is rows
        subproblem.update(lin)
        step = subproblem.solve(0.5, charge)
        moved = ((step.burns - lin.iterate.burns) ** 2).sum()
        found.append(step.merit + 0.5 * charge.prox * float(moved))
    assert found[0] == pytest.approx(found[1], rel=1e-5)
