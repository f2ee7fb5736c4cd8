"""The nonlinear programs say what the convex ones say, and IPOPT finds what SCP finds."""

from __future__ import annotations

import contextlib
import json
import signal
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, get_args

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, reject, settings
from hypothesis import strategies as st

from experiments.solvers.cases import drawn
from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.nlp import solve
from formulations.nlp.covariance import Covariance
from formulations.nlp.program import Arcs, Program, Start, Transcription, assemble
from formulations.nlp.shooting import MultipleShooting, SingleShooting
from formulations.nlp.solve import (
    EXACT,
    QUASI_NEWTON,
    VARIANTS,
    NlpOutcome,
    solve_nlp,
)
from formulations.problem.controls import Cost
from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.problem.regions import Ball, Cone
from formulations.program.subproblem import DYNAMICS_WEIGHT
from formulations.rows.uniform import ChanceRows, DeterministicRows
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning.planner import Plan, Stage, plan
from scp_recon.planning.solver import unobserved
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.loop import Record
from scp_recon.scp.status import Status
from tests.helpers import nightly, share_of_examples, usually
from tests.oracles.closed_loop import solve_corrected
from tests.scenarios import COARSE
from tests.scp_recon.support import from_cold


@dataclass(frozen=True)
class Case:
    """A mission planned by SCP, and the same arcs for CasADi."""

    mission: Mission
    plan: Plan
    arcs: Arcs

    @classmethod
    @cache
    def of(cls, *overrides: str) -> Case:
        mission = Mission.from_scenario(load_scenario(None, overrides))
        found = plan(mission, initial_guess.cold(mission))
        return cls(mission, found, ipopt.casadi_arcs(mission.flow))

    @property
    def problem(self) -> FlybyProblem:
        return self.mission.problem

    @property
    def p3(self) -> Stage:
        return self.plan.stages[0]

    @property
    def p2(self) -> Stage:
        return self.plan.final

    @property
    def facets(self) -> Facets:
        """Those of P2 that its convex program carries."""
        facets, rows = self.p2.facets, self.p2.merit.rows
        assert facets is not None
        assert isinstance(rows, ChanceRows)
        return facets.chosen(rows.included)

    def start(self, stage: Stage) -> Start:
        return Start(stage.result.lin.iterate, stage.result.lin.factor)

    def near(self, seed: int, *, flown: bool = False) -> Linearisation:
        """A random iterate near the solution, with defects everywhere unless it is flown."""
        rng, best = np.random.default_rng(seed), self.p2.result.lin.iterate
        burns = best.burns + 0.1 * rng.normal(size=best.burns.shape)
        mean = best.mean + 0.1 * rng.normal(size=best.mean.shape)
        if flown:
            mean = self.mission.dynamics.rollout(self.problem.initial_state, burns)
        return self.mission.dynamics.linearise(self.problem, Iterate(burns, mean))

    def program(
        self,
        transcription: Transcription,
        facets: Facets | None,
        lin: Linearisation,
        *,
        elastic: bool = True,
    ) -> Program:
        start = Start(lin.iterate, lin.factor)
        return transcription(self.problem, self.arcs, facets, start, elastic)


@pytest.fixture(scope="module")
def coarse() -> Case:
    """Arcs of several Runge-Kutta steps, and few enough of them to differentiate the whole."""
    return Case.of(COARSE)


@pytest.fixture(scope="module")
def infeasible() -> Case:
    return Case.of(COARSE, "risk.p_chance=0.99")


def within(value: Array) -> Any:
    """What the two sides have to agree to."""
    return pytest.approx(value, rel=0.0, abs=1e-9)


@pytest.mark.slow
def test_casadi_flies_the_planners_arcs(coarse):
    lin, flow = coarse.near(1), coarse.mission.flow
    assert flow.substeps > 1
    start, durations = lin.iterate.mean[:-1], flow.durations[None]
    end = np.array(coarse.arcs.flow.map(len(start))(start.T, durations)).T
    expected = propagate(start, flow.durations, flow.forces, flow.substeps)
    assert end == pytest.approx(expected, rel=1e-12, abs=1e-13)
    x, h = ca.SX.sym("x", 6), ca.SX.sym("h")
    jacobian = ca.Function("stm", [x, h], [ca.jacobian(coarse.arcs.flow(x, h), x)])
    blocks = np.hsplit(np.array(jacobian.map(len(start))(start.T, durations)), len(start))
    assert blocks == pytest.approx(lin.arcs.stm, rel=1e-9, abs=1e-11)


@pytest.mark.parametrize("seed", usually(range(3), 1))
@pytest.mark.parametrize("printed", [True, False])
def test_p3_has_the_rows_of_the_convex_side(coarse, printed, seed):
    """Also of a burn that is held, and of one that is raised."""
    lin = coarse.near(seed)
    problem = replace(coarse.problem, held=(1,), raised=(2,), dv_min=0.02)
    transcription = MultipleShooting(printed)
    start = Start(lin.iterate, lin.factor)
    program = transcription(problem, coarse.arcs, None, start, True)
    rows = program.residuals(program.start)
    arcs = rows.pop("arcs").reshape(-1, 6)
    assert arcs[1:] == within(lin.defects[:-1])
    _check_rows(DeterministicRows(problem), lin, rows)


@pytest.mark.parametrize("seed", usually(range(3), 1))
@pytest.mark.parametrize("printed", [True, False])
def test_p2_has_the_rows_of_the_convex_side(coarse, printed, seed):
    lin, problem, facets = coarse.near(seed), coarse.problem, coarse.p2.facets
    program = coarse.program(MultipleShooting(printed), facets, lin)
    rows = program.residuals(program.start)
    # Row by row the mean's defects; the spread that goes with the iterate has none.
    size, expected = Covariance(problem, printed=printed).size, []
    last = problem.n_nodes - 1 if printed else facets.node.max()
    first = np.r_[problem.initial_state - lin.iterate.mean[0]]
    first[3:] += lin.iterate.burns[0]
    for node, defect in enumerate([first, *lin.defects[:-1]]):
        expected += [defect, np.zeros(size if node <= last else 0)]
    assert rows.pop("arcs") == within(np.concatenate(expected))
    _check_rows(_every(problem, facets), lin, rows)


def _every(problem: FlybyProblem, facets: Facets) -> ChanceRows:
    return ChanceRows(problem, facets, np.ones(len(facets.node), dtype=bool))


def _check_rows(
    own: DeterministicRows | ChanceRows, lin: Linearisation, rows: dict[str, Array]
) -> None:
    """The final state, the burns, and the convex side's own rows are all that is left of them."""
    problem = own.problem
    margins = problem.burn_margins(lin.iterate.burns)
    assert rows.pop("final_state") == within(lin.defects[-1])
    assert rows.pop("dv_max") == within(margins["dv_max"])
    nappes = rows.pop("dv_battery").reshape(2, -1)
    assert nappes.min(axis=0) == within(margins["dv_battery"])
    held, raised = lin.iterate.burns[[*problem.held]], lin.iterate.burns[[*problem.raised]]
    assert rows.pop("dv_held") == within(held.ravel())
    assert rows.pop("dv_min") == within(np.linalg.norm(raised, axis=1) - problem.dv_min)
    margins = own.margins(lin)
    assert rows.keys() == margins.keys()
    for name, expected in margins.items():
        assert rows[name] == within(expected.margin), name


@pytest.mark.parametrize("seed", usually(range(3), 1))
def test_p3_as_printed_bounds_the_same_sets(coarse, seed):
    """The paper's ratios, turned into distances from the apex, are the convex side's margins."""
    lin, problem = coarse.near(seed), coarse.problem
    transcription = VARIANTS["printed"].transcription
    program = coarse.program(transcription, None, lin, elastic=False)
    rows = program.residuals(program.start)

    def distance(cone: Cone, point: Array, cosine: Array) -> Array:
        reach = np.linalg.norm(point - cone.apex, axis=1)
        angle = np.arccos(cosine + np.cos(cone.half_angle))
        inside: Array = reach * np.sin(cone.half_angle - angle)
        return inside

    for constraint in problem.constraints:
        value, margin = rows[constraint.name], constraint.margin(lin.iterate.mean)
        if isinstance(constraint.region, Ball):
            assert value == within(margin), constraint.name
            continue
        sign = 1.0 if constraint.keep == "in" else -1.0
        point = lin.iterate.mean[constraint.nodes, :3]
        inside = sign * distance(constraint.region, point, sign * value)
        assert inside == within(margin), constraint.name
    toward, away = np.split(rows["dv_battery"], 2)
    for cone, value in zip(problem.burn_cones, (toward, away), strict=True):
        burns = lin.iterate.burns
        assert distance(cone, burns, -value) == within(cone.inside(burns))


@pytest.mark.slow
def test_derivatives_by_arc_are_those_of_the_whole(coarse):
    program = coarse.program(MultipleShooting(printed=False), coarse.facets, coarse.near(5))
    assert program.mapped is not None
    arcs, *others = program.blocks
    arcs = replace(arcs, value=arcs.value + program.mapped.value)
    by_arc = assemble(program, 10.0)
    whole = assemble(replace(program, blocks=(arcs, *others), mapped=None), 10.0)
    assert by_arc.jacobian is not None
    assert by_arc.hessian is not None
    x, rng = whole.unknowns, np.random.default_rng(5)
    factors = rng.normal(size=whole.rows.numel())
    lagrangian = 0.7 * whole.objective + ca.dot(factors, whole.rows)
    mine = [by_arc.rows, by_arc.jacobian, by_arc.hessian(ca.MX(0.7), ca.MX(factors))]
    theirs = [whole.rows, ca.jacobian(whole.rows, x), ca.triu(ca.hessian(lagrangian, x)[0])]
    own, reference = ca.Function("own", [by_arc.unknowns], mine), ca.Function("whole", [x], theirs)
    for mine, theirs in zip(own(by_arc.start), reference(whole.start), strict=True):
        scale = float(ca.norm_inf(ca.vec(theirs)))
        assert float(ca.norm_inf(ca.vec(mine - theirs))) < 1e-11 * scale


@pytest.mark.slow
def test_ipopt_and_scp_agree_on_infeasible_merit(infeasible):
    stage, start, weight = infeasible.p2, infeasible.start(infeasible.p3), 1_000.0
    assert stage.result.status is Status.INFEASIBLE
    problem, variant = infeasible.problem, VARIANTS["shooting"]
    result = solve_nlp(problem, infeasible.arcs, infeasible.facets, start, variant, weight)
    assert result.outcome is NlpOutcome.SOLVED, result.status
    merit = stage.merit(stage.result.lin, weight)
    assert result.objective == pytest.approx(merit, rel=1e-4)
    lin = infeasible.mission.dynamics.linearise(problem, result.iterate)
    assert stage.merit(lin, weight) == pytest.approx(result.objective, rel=1e-6)


@pytest.mark.parametrize("name", ["tuned", "shooting"])
def test_the_penalty_weighs_as_the_merit_does(coarse, name):
    """At an iterate with every kind of violation, slacks that just fill it cost the merit."""
    lin, stage = coarse.near(7, flown=True), coarse.p2
    nlp = assemble(coarse.program(VARIANTS[name].transcription, coarse.facets, lin), 10.0)
    objective, rows = ca.Function("f", [nlp.unknowns], [nlp.objective, nlp.rows])(nlp.start)
    assert np.array(rows).min() >= -1e-9
    defect = np.abs(lin.defects[:-1]).sum()
    merit = stage.merit(lin, 10.0) - 10.0 * DYNAMICS_WEIGHT * defect
    assert float(objective) == pytest.approx(merit, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("variant", usually(["tuned", "shooting"], 1))
def test_ipopt_and_scp_find_the_same_plan(coarse, variant, capfd):
    mission = coarse.mission
    lines: list[tuple[str, int]] = []

    def observe(stage: str, record: Record) -> None:
        lines.append((stage, record.k))

    start = initial_guess.cold(mission)
    result = ipopt.plan(mission, start, variant=variant, observe=observe)
    assert capfd.readouterr() == ("", "")
    solution = make_solution(result)
    assert solution.status == "converged"
    assert [stage.name for stage in solution.stages] == ["P3", "P2"]
    assert len(lines) == len(solution.iterations) == sum(s.iterations for s in solution.stages)
    expected = coarse.p2.result.lin.iterate.total_dv * mission.units.speed_m_s
    assert solution.total_dv_m_s == pytest.approx(expected, rel=1e-4)
    assert not solution.violation.by_constraint
    p3 = result.stages[0].result.lin.iterate.total_dv
    assert p3 == pytest.approx(coarse.p3.result.lin.iterate.total_dv, rel=1e-4)


def navigated(seed: int) -> tuple[str, ...]:
    """A random scenario with uniform risk, navigation and feedback, on few nodes."""
    changes, rng = drawn(seed)[1], np.random.default_rng([seed, 30])
    changes |= {
        "risk.allocation": "uniform",
        "risk.scope": "node",
        "policy.kind": "feedback",
        "policy.cost": str(rng.choice(get_args(Cost))),
        "navigation.lead_s": float(rng.choice([0.0, 3600.0, 7200.0])),
        "navigation.sigma_position_m": round(10.0 ** rng.uniform(0.0, 1.7), 2),
        "navigation.sigma_velocity_m_s": round(10.0 ** rng.uniform(-4.3, -2.7), 6),
        "grid.step_max_s": 1000.0,
    }
    if "uncertainty.gates.magnitude_bias" in changes:
        changes["uncertainty.gates.magnitude_bias"] = 0.0  # which no filter estimates
    if rng.random() < 0.5:  # burns after the window are then corrected too
        changes["boundary.final_sigma_position_m"] = float(rng.choice([120.0, 1000.0]))
        if rng.random() < 0.5:
            changes["burns.times_s"] = [0.0, 8000.0, 24000.0, 32000.0, 40000.0]
    return tuple(f"{key}={json.dumps(value)}" for key, value in changes.items())


def again(case: Case) -> tuple[NlpOutcome, Linearisation]:
    """IPOPT's run from a plan, and where it ends."""
    lin, start = case.p2.result.lin, case.start(case.p2)
    iterate, outcome = solve_corrected(lin.problem, case.arcs, case.facets, start)
    return outcome, case.mission.dynamics.linearise(lin.problem, iterate)


@nightly
@pytest.mark.slow
@pytest.mark.parametrize("seed", usually([0, 4, 5, 11], 1))
def test_ipopt_returns_to_plans_with_corrected_burns(seed):
    """By other derivatives and a filter of its own, for one to three corrected burns."""
    case = Case.of(*navigated(seed))
    assert case.p2.result.status is Status.CONVERGED
    outcome, theirs = again(case)
    assert outcome is NlpOutcome.SOLVED
    assert case.p2.merit.worst_violation(theirs) < 1e-6
    assert theirs.cost.value == pytest.approx(case.p2.result.lin.cost.value, rel=1e-5)


@nightly
@given(st.integers(0, 999))
@settings(max_examples=share_of_examples(50))
def test_ipopt_finds_no_better_corrected_burns(seed):
    """Some runs do not arrive; what they have by then may cost more."""
    try:
        case = Case.of(*navigated(seed))
    except InputError:
        reject()
    assume(case.p2.result.status is Status.CONVERGED)
    outcome, theirs = again(case)
    ours = case.p2.result.lin.cost.value
    if outcome is NlpOutcome.SOLVED:
        assert theirs.cost.value == pytest.approx(ours, rel=1e-5)
    elif case.p2.merit.worst_violation(theirs) < 1e-6:
        assert theirs.cost.value > (1.0 - 1e-5) * ours


@pytest.mark.slow
def test_failed_stages_restart_from_the_ballistic_arc(coarse, monkeypatch):
    """As the planner has it; here P3 is given too few iterations, so that no try converges."""
    brief = replace(VARIANTS["shooting"], p3=replace(EXACT, max_iterations=3))
    monkeypatch.setitem(VARIANTS, "shooting", brief)
    result = ipopt.plan(coarse.mission, initial_guess.cold(coarse.mission), variant="shooting")
    names = [stage.name for stage in result.stages]
    assert names[:4] == ["P3", "P3b", "P3c", "P3d"]
    assert all(name.startswith("P2") for name in names[4:])
    first, again = result.stages[0].result.lin, result.stages[1].result.lin
    assert np.abs(first.iterate.burns - again.iterate.burns).max() > 0.0


@pytest.mark.slow
def test_infeasible_is_never_called_solved(infeasible):
    mission, start = infeasible.mission, infeasible.start(infeasible.p3)
    variant = replace(VARIANTS["shooting"], p2=replace(QUASI_NEWTON, max_iterations=60))
    hard = solve_nlp(infeasible.problem, infeasible.arcs, infeasible.facets, start, variant)
    assert hard.outcome in (NlpOutcome.INFEASIBLE, NlpOutcome.LIMIT), hard.status
    stages = ipopt.IpoptPlanner(mission, "shooting", elastic=True)
    start_lin = infeasible.p3.result.lin
    elastic = stages.solve(infeasible.p2.spec, start_lin, mission.dynamics, lambda *_: None)
    assert elastic.result.status is Status.INFEASIBLE
    violations = elastic.merit.violations(elastic.result.lin)
    assert max(violations["site_distance_max"]) > elastic.tolerance


@pytest.mark.parametrize("by_hand", [True, False], ids=["ctrl-c", "another exception"])
def test_only_ctrl_c_is_called_an_interrupt(coarse, by_hand, monkeypatch):
    """Both end as an exception in IPOPT."""

    class Thrown:
        def __init__(self, *_: object) -> None: ...

        def __call__(self, x0: object, **_: object) -> dict[str, object]:
            if by_hand:
                with contextlib.suppress(KeyboardInterrupt):  # as IPOPT does
                    signal.raise_signal(signal.SIGINT)
            return {"x": x0, "f": 0.0}

        def stats(self) -> dict[str, object]:
            return {"return_status": "NonIpopt_Exception_Thrown"}

    monkeypatch.setattr(solve, "ipopt_solver", Thrown)
    start = Start(initial_guess.cold(coarse.mission))
    result = solve_nlp(coarse.problem, coarse.arcs, None, start, VARIANTS["shooting"])
    assert result.outcome is (NlpOutcome.INTERRUPTED if by_hand else NlpOutcome.FAILED)


def test_p2_needs_a_factor_to_start_from(coarse):
    start = Start(coarse.p3.result.lin.iterate)
    with pytest.raises(ValueError, match="factor"):
        solve_nlp(coarse.problem, coarse.arcs, coarse.facets, start, VARIANTS["tuned"])


@nightly
@pytest.mark.parametrize("name", ["shooting", "tuned", "printed"])
def test_without_a_facet_p2_only_flies(coarse, name):
    none = Facets(*(getattr(coarse.facets, field)[:0] for field in Facets.__annotations__))
    start = coarse.start(coarse.p3)
    result = solve_nlp(coarse.problem, coarse.arcs, none, start, VARIANTS[name])
    assert result.outcome is NlpOutcome.SOLVED, result.status
    assert result.iterate.total_dv < coarse.p3.result.lin.iterate.total_dv


KNOWN: dict[str, Any] = {
    "body": {"gm_m3_s2": 0.2, "j2": 0.002, "prime_meridian_deg": 1.0},
    "spacecraft": {"reflectivity_coefficient": 0.1},
    "site": {"position_body_m": [2.0, 3.0, 1.0], "normal_body": [0.02, 0.02, 0.01]},
}
"""Path and regions move, these with turns too: 10 numbers."""


def mission_with(**changes: Any) -> Mission:
    scenario = load_scenario().replace({"grid.step_max_s": 900.0, **changes})
    return Mission.from_scenario(scenario.replace({"knowledge": KNOWN}))


@pytest.fixture(scope="module")
def known() -> Plan:
    return from_cold(mission_with(), facet_rounds=0)


@pytest.mark.slow
def test_rows_have_the_parameters_of_the_convex_side(known):
    mission, lin, facets = known.mission, known.final.result.lin, known.final.facets
    every = _every(mission.problem, facets)
    start = Start(lin.iterate, lin.factor)
    arcs = ipopt.casadi_arcs(mission.flow)
    program = SingleShooting()(mission.problem, arcs, facets, start, elastic=False)
    rows = program.residuals(program.start)
    for name, expected in every.margins(lin).items():
        np.testing.assert_allclose(rows[name], expected.margin, atol=1e-7)


@pytest.mark.slow
def test_ipopt_finds_the_same_plan_with_parameters(known):
    """The same facets from the plan's burns: one problem, to 1e-5."""
    mission, lin = known.mission, known.final.result.lin
    stages = ipopt.IpoptPlanner(mission, "shooting")
    pushed = mission.dynamics.linearise(
        mission.problem, initial_guess.from_burns(mission, 1.05 * known.burns_m_s)
    )
    found = stages.solve(
        stages.p2_stage(known.final.facets, lin), pushed, mission.dynamics, unobserved
    )
    assert found.result.status is Status.CONVERGED
    cost = found.result.lin.cost.value * mission.units.speed_m_s
    assert cost == pytest.approx(known.total_dv_m_s, rel=1e-5)


@pytest.mark.parametrize(
    ("variant", "changes"),
    [
        ("tuned", {}),
        ("shooting", {"body.planned_degree": 2}),
        ("shooting", {"safety.missed_burns": True}),
    ],
)
def test_other_programs_refuse_parameters(variant, changes):
    mission = mission_with(**changes)
    with pytest.raises(InputError, match=r"shooting' if no force"):
        ipopt.plan(mission, initial_guess.cold(mission), variant=variant)
