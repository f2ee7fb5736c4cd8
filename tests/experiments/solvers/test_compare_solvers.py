"""The comparison of solvers, and of exact risk with other programs: rows, and claims that follow."""

from collections.abc import Generator, Iterable
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from scipy.special import ndtr

from experiments.__main__ import main
from experiments.harness import Findings, tables_of
from experiments.solvers.compare_solvers import study as compare_solvers
from experiments.solvers.compare_solvers.cases import (
    ELASTIC,
    NLP_METHODS,
    PROBLEMS,
    REFERENCE,
    REPEATS,
    SCP_METHODS,
    SHOOTING_UNO,
    TUNED,
    UNGUARDED,
    Cell,
    Method,
    crossing,
    exact_design,
)
from experiments.solvers.compare_solvers.cell import FAILED, Row, failed_row, solve_cell
from experiments.solvers.compare_solvers.claims import (
    FROZEN,
    MISS_M,
    WITHIN,
    claims,
    exact_claims,
    holds,
    verdicts,
)
from experiments.solvers.compare_solvers.exact.check import check
from experiments.solvers.compare_solvers.exact.program import (
    BurnsProgram,
    FlightRow,
    NodeRows,
    ProbabilityRows,
    ray_quantiles,
)
from experiments.solvers.compare_solvers.exact.search import search
from experiments.solvers.compare_solvers.study import ROWS_FILE, Solve, run_cells
from experiments.solvers.compare_solvers.tables import report
from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.rows.node_probability import joint_events, node_quantiles
from scp_recon.jobs.job import TIMED_OUT, Done, Executor, Failure, Job, attempt
from scp_recon.jobs.processes import Limits
from scp_recon.jobs.store import Store, read_rows
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from tests.helpers import nightly
from tests.normal_law import cone_probability

CELLS = [Cell("matrix", "recon_b", (), REFERENCE, "random", seed) for seed in range(3)]
LIMIT_S = 2.0
UNGUARDED_FROZEN = Method("frozen-covariance", UNGUARDED, "CLARABEL")


def figures_of(cell: Cell, flights: int) -> Row:
    """What stands for the solving of a cell."""
    # NaN is not even equal to itself.
    figures = dict.fromkeys([f.name for f in fields(Row) if f.default is np.nan], float(flights))
    return replace(failed_row(cell, ""), status="converged", problem="P2", **figures)


def raises(cell: Cell, flights: int) -> Row:
    raise ArithmeticError(f"nothing for {cell.seed} with {flights}")


def never_ends(cell: Cell, flights: int) -> Row:
    raise NotImplementedError


def in_process(_: int, limits: Limits) -> Executor:
    """Run cells here; what never ends runs into its limit."""

    def run(work: Any, jobs: Iterable[Job]) -> Generator[Done, None, None]:
        for job in jobs:
            if work.func is never_ends:
                failure = Failure(TIMED_OUT, f"{limits.cpu_s:g} s")
                yield Done(job.key, None, failure, 1.0, limits.cpu_s, 1)
            else:
                yield attempt(work, job)

    return run


def collect(
    path: Path, solve: Solve, cells: list[Cell] = CELLS, limit_s: float = LIMIT_S
) -> list[Row]:
    with mock.patch.object(compare_solvers, "Processes", in_process), Store(path, {}) as store:
        return list(run_cells(cells, store, flights=5, limit_s=limit_s, solve=solve))


def test_a_cell_that_fails_is_a_row_and_is_tried_again_but_for_one_at_its_limit(
    tmp_path, monkeypatch
):
    path = tmp_path / ROWS_FILE
    (first,) = collect(path, figures_of, CELLS[:1])
    rows = collect(path, raises)
    np.testing.assert_equal(asdict(rows[0]), asdict(first))
    assert [row.status for row in rows] == ["converged", FAILED, FAILED]
    assert (rows[1].key, rows[1].solved) == (CELLS[1].key, False)
    assert rows[1].detail == "ArithmeticError: nothing for 1 with 5"
    assert {row.status for row in collect(path, figures_of)} == {"converged"}
    # Rows of another limit are left alone.
    assert {row.status for row in collect(path, raises, limit_s=LIMIT_S + 1.0)} == {FAILED}
    assert {row.status for row in collect(path, raises)} == {"converged"}
    for solve in (never_ends, figures_of):
        (row,) = collect(tmp_path / "other", solve, CELLS[:1])
        assert row.detail == "no end after 2 s"
    again = replace(CELLS[0], repeat=1)
    monkeypatch.setattr(compare_solvers, "CORES", 1)
    rows = collect(tmp_path / "other", raises, [CELLS[0], again])
    assert [row.key for row in rows] == [CELLS[0].key, again.key]
    assert {row.detail for row in rows} == {"no end after 2 s"}


def test_a_cell_is_solved_as_the_planner_solves_it(mission):
    done = plan(mission, initial_guess.cold(mission))
    expected = done.final.result.lin.iterate.total_dv * mission.units.speed_m_s
    for start in ("cold", "p3"):
        row = solve_cell(Cell("matrix", "recon_b", (), REFERENCE, start), 0)
        assert row.solved
        assert row.total_dv_m_s == pytest.approx(expected, rel=1e-9)
        assert row.merit_m_s == pytest.approx(expected, rel=1e-6)
        assert row.iterations_p2 == len(done.final.result.records)
        assert 0.0 < row.solver_s < row.total_s
        assert row.peak_mib > 10.0


@pytest.mark.parametrize("name", PROBLEMS)
def test_every_problem_is_crossed_with_every_method_and_repeated(name):
    cells = [cell for cell in crossing() if cell.scenario == name]
    assert {(cell.method, cell.repeat) for cell in cells} == {
        (method, repeat) for method in (*SCP_METHODS, *NLP_METHODS) for repeat in range(REPEATS)
    }
    assert len({cell.key for cell in cells}) == len(cells)
    mission = Mission.from_scenario(load_scenario(cells[0].base, cells[0].overrides))
    assert plan(mission, initial_guess.cold(mission)).status is Status.CONVERGED


def test_uno_finds_the_optimum_that_scp_finds():
    ours, theirs = (
        solve_cell(Cell("scenarios", "recon_b", (), method, "p3"), 0)
        for method in (REFERENCE, SHOOTING_UNO)
    )
    assert theirs.solved
    assert theirs.iterations_p2 > 0
    assert theirs.total_dv_m_s == pytest.approx(ours.total_dv_m_s, rel=1e-6)
    assert theirs.setup_s < theirs.total_s


def row_of(scenario: str, method: Method, dv: float, status: str = "converged") -> Row:
    cell = Cell("scenarios", scenario, (), method, "p3")
    figures = {"total_dv_m_s": dv, "merit_m_s": dv, "heavy_merit_m_s": dv}
    return replace(failed_row(cell, ""), status=status, problem="P2", **figures)


AGREEING = [
    row_of("a", REFERENCE, 0.14),
    row_of("a", TUNED, 0.140001),
    row_of("a", FROZEN[0], 0.141),
    row_of("a", FROZEN[1], 0.13, "stalled"),
    row_of("a", Method("condensed", UNGUARDED, "CLARABEL"), 0.14),
    row_of("a", UNGUARDED_FROZEN, 0.13, "infeasible"),
    row_of("b", REFERENCE, 5.0, "infeasible"),
    row_of("b", TUNED, 0.1, FAILED),
    row_of("b", ELASTIC, 5.0001, "infeasible"),
]


def test_claims_hold_where_the_rows_say_so():
    assert [claim.holds for claim in claims(AGREEING)] == 5 * [True] + 4 * [None]


def test_random_scenarios_are_counted_by_how_near_the_least_a_method_ends():
    rows = [
        *(row_of("a", REFERENCE, 0.1), row_of("a", TUNED, 0.1005)),
        *(row_of("b", REFERENCE, 0.2), row_of("b", TUNED, 0.1)),
        *(row_of("c", REFERENCE, 0.3, "infeasible"), row_of("c", TUNED, 0.3, FAILED)),
    ]
    tables = tables_of(Findings(report([replace(row, group="random") for row in rows]), {}), "")
    ours, theirs = ([*row.values()][:-1] for row in tables["random"])
    assert ours == [REFERENCE.name, 3, 2, 2, 1, 1, 1]
    assert theirs == [TUNED.name, 3, 2, 2, 1, 2, 2]


def test_the_command_leaves_its_tables_and_takes_up_its_rows(tmp_path, monkeypatch, capsys):
    cells = (Cell("matrix", "recon_b", (), REFERENCE, "cold"),)
    monkeypatch.setattr(compare_solvers, "quick_design", lambda: cells)
    monkeypatch.setattr(compare_solvers, "exact_design", lambda *_: ())
    monkeypatch.setattr(compare_solvers, "Processes", in_process)
    monkeypatch.setattr(compare_solvers, "FLIGHTS", 1000)
    written = []
    for _ in range(2):
        assert main(["compare_solvers", "--quick", "--out", str(tmp_path)]) == 0
        assert "only --full settles" in " ".join(capsys.readouterr().out.split())
        written.append((tmp_path / ROWS_FILE).read_bytes())
    assert written[0] == written[1]
    names = {path.name for path in tmp_path.iterdir() if not path.name.startswith(".")}
    assert names == {"comparison.csv", "comparison.md", "evidence.json", ROWS_FILE}
    assert len(list(read_rows(tmp_path / ROWS_FILE))) == 1


EXACT = {"risk.allocation": "exact", "risk.p_chance": 0.9}


@pytest.fixture(scope="module")
def exact() -> Mission:
    return Mission.from_scenario(load_scenario().replace(EXACT))


@pytest.fixture(scope="module")
def planned(exact) -> Plan:
    return plan(exact, initial_guess.cold(exact))


@pytest.fixture(scope="module")
def p3(exact) -> Linearisation:
    return plan(exact, initial_guess.cold(exact), problem="P3").final.result.lin


def test_rays_agree_with_nested_quadrature_and_with_the_planner(exact, planned):
    lin = planned.final.result.lin
    event = next(e for e in joint_events(exact.problem.constraints) if e.name == "emission")
    event = event.at(np.arange(len(event.nodes) - 4, len(event.nodes)))
    mean, factor = lin.iterate.mean[event.nodes, :3], lin.factor[event.nodes, :3]
    ours, theirs = ray_quantiles(event, mean, factor), node_quantiles(event, mean, factor)
    (outer,), (inner,) = event.keep_in, event.keep_out
    for i, node in enumerate(ours.value):
        covariance, one = factor[i] @ factor[i].T, np.array([i])
        within = [cone_probability(r.at(one), mean[i], covariance) for r in (outer, inner)]  # type: ignore[arg-type]
        assert ndtr(node) == pytest.approx(within[0] - within[1], abs=1e-4)
    assert ours.value == pytest.approx(theirs.value, abs=1e-3)
    for mine, planners in ((ours.by_mean, theirs.by_mean), (ours.by_factor, theirs.by_factor)):
        assert np.abs(mine - planners).max() < 5e-3 * np.abs(planners).max()


def program(mission: Mission, rows: ProbabilityRows, start: Linearisation) -> BurnsProgram:
    return BurnsProgram(mission, rows, 1e-3, np.inf, start, 100)


@pytest.mark.parametrize("scope", ["node", "flight"])
def test_the_program_has_its_own_derivatives(scope, exact, planned):
    problem, lin = exact.problem, planned.final.result.lin
    rows = NodeRows(problem, 0.9, 8192) if scope == "node" else FlightRow(problem, 0.9, 64)
    nlp, z = program(exact, rows, lin), lin.iterate.burns.ravel() + 1e-3
    direction = np.random.default_rng(3).standard_normal(len(z))
    here, step = nlp.at(z), 1e-5
    ahead, behind = (nlp.at(z + move * direction) for move in (step, -step))
    for value, slope, error in (
        ("cost", "by_cost", 1e-5),
        ("equal", "by_equal", 1e-5),
        ("least", "by_least", 2e-2),
    ):
        expected = (getattr(ahead, value) - getattr(behind, value)) / (2.0 * step)
        told = getattr(here, slope) @ direction
        assert np.abs(told - expected).max() <= error * np.abs(expected).max()


@nightly
@pytest.mark.parametrize("solver", ["IPOPT", "SLSQP"])
def test_references_reach_the_planners_optimum(solver, exact, planned, p3):
    found = search(exact, {"P3": p3}, solver, 60.0)
    assert found.holds
    cost = np.linalg.norm(found.burns, axis=1).sum() * exact.units.speed_m_s
    assert cost == pytest.approx(planned.total_dv_m_s, rel=5e-4)


@pytest.mark.parametrize("scope", ["node", "flight"])
def test_the_check_finds_what_was_asked_and_what_was_not_met(scope, planned):
    mission = Mission.from_scenario(load_scenario().replace(EXACT | {"risk.scope": scope}))
    own = planned if scope == "node" else plan(mission, initial_guess.cold(mission))
    burns = own.burns_m_s
    found = check(mission, burns)
    assert found.probability == pytest.approx(0.9, abs=2e-3)
    assert found.error < 2e-3
    assert found.violation_m < MISS_M
    worse = check(mission, 1.02 * burns)
    assert worse.violation_m > 1.0
    assert worse.total_dv_m_s == pytest.approx(1.02 * found.total_dv_m_s)


def exact_row(cell: Cell, cost: float, reached: float = 0.9, status: str = "converged") -> Row:
    found = {"total_dv_m_s": cost, "violation_m": 1e-4, "asked": 0.9, "reached": reached}
    row = replace(failed_row(cell, ""), status=status, problem="P2", **found)
    return replace(row, reached_error=1e-4, cpu_s=1.0)


def rows_with(ours: float, theirs: Array | list[float], **about: object) -> list[Row]:
    planner, *others = exact_design(range(1))
    make = partial(exact_row, planner, ours)
    return [make(**about), *map(exact_row, others, theirs)]  # type: ignore[arg-type]


def test_the_best_of_all_is_what_a_plan_is_held_against():
    rows = rows_with(0.1002, [0.11, 0.1])
    (verdict,) = verdicts(rows)
    assert verdict.excess == pytest.approx(2e-3)
    assert [claim.holds for claim in exact_claims(rows)] == [True, True]
    dear = rows_with(0.1 * (1.0 + 1.1 * WITHIN), [0.11, 0.1])
    assert [claim.holds for claim in exact_claims(dear)] == [False, True]
    assert "not in: node 00 (+0.33 %)" in exact_claims(dear)[0].measured


def test_what_misses_the_probability_or_did_not_converge_is_no_answer():
    rows = rows_with(0.1, [0.09, 0.1])
    assert verdicts(rows)[0].excess > WITHIN
    rows[1] = replace(rows[1], reached=0.85)
    assert verdicts(rows)[0].excess == 0.0
    assert not holds(replace(rows[1], reached=0.9, violation_m=5.0))
    for about in ({"reached": 0.8}, {"status": "infeasible"}):
        rows = rows_with(0.1, [0.1] * 2, **about)
        assert verdicts(rows)[0].excess == np.inf
        assert exact_claims(rows)[0].holds is False
    assert exact_claims(rows_with(0.1, [0.1] * 2, reached=0.8))[1].holds is False
