"""The diagnosis of an infeasible run: what binds, the largest probability, a line that is feasible."""

import dataclasses
import shlex
from types import SimpleNamespace

import pytest
from scipy.special import ndtr, ndtri

from formulations.problem.flyby import Iterate
from scp_recon.api import infeasibility as module
from scp_recon.api import planning
from scp_recon.api.infeasibility import LIMITS, SIZE, SPLIT, Diagnosis, diagnose, exact_plan
from scp_recon.api.options import PlanOptions
from scp_recon.certification.certify import AimedPlanning
from scp_recon.cli.commands import solve
from scp_recon.cli.plan_run import undoing, what_binds, what_would_do
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Certificate
from scp_recon.planning.planner import Plan, plan
from scp_recon.reports.page import _advice
from scp_recon.reports.subject import Subject
from scp_recon.results.read import read_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from tests.scenarios import COARSE
from tests.scp_recon.support import CommandLine, fly_few, mission_of, run_solve

pytestmark = pytest.mark.slow

SPLIT_TOO_DEAR = ("--set", "risk.p_chance=0.98", "--set", COARSE)
EXACT = ("risk.allocation=exact", COARSE)
REACHED = Certificate(20_000, 2_000, 0.7, 0.69, 0.71, 0.7, 1, 1, 0.975)


def failed(*overrides: str, target: float | None = None) -> Plan:
    mission = mission_of(*overrides)
    found = plan(mission, initial_guess.cold(mission), target=target, once=True)
    assert found.status is Status.INFEASIBLE
    return found


def said(run: CommandLine) -> str:
    return run.output[run.output.index("what binds") :]


@pytest.fixture(scope="module")
def refused(tmp_path_factory) -> CommandLine:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "CLOSE", 1.0)
        fly_few(patch)
        folder = tmp_path_factory.mktemp("refused")
        return run_solve(folder, *SPLIT_TOO_DEAR, "--facet-rounds", "1")


def test_the_very_line_ends_verified(refused, tmp_path):
    """After the options that the command had, facet rounds among them."""
    assert refused.exit_code == 3
    line = shlex.split(said(refused).rsplit("with: ", 1)[1])
    again = run_solve(tmp_path, *SPLIT_TOO_DEAR, "--facet-rounds", "1", *line)
    assert (again.exit_code, again.errors) == (0, "")
    solution = read_solution(tmp_path)
    assert solution.verification.ok
    assert solution.scenario.risk.p_chance == 0.98
    assert f"feasible, for {solution.total_dv_m_s:.4f} m/s, with: " in said(refused)


def test_the_report_says_the_same(refused):
    solution = read_solution(refused.folder)
    assert solution.advice == tuple(said(refused).splitlines())
    assert _advice(Subject("plan", solution)) == solution.advice


def plan_options(parsed):
    names = [one.name for one in dataclasses.fields(PlanOptions)]
    return PlanOptions(**{name: getattr(parsed, name) for name in names})


@pytest.mark.parametrize(
    "own",
    [
        "--method ipopt",
        "--method ipopt --formulation printed",
        "--formulation frozen-stm",
        "--formulation lifted --facet-rounds 2",
    ],
)
def test_the_line_goes_with_every_method(own):
    """What the command says against exact risk is undone by what stands after it."""
    words, line = own.split(), ("--set", "risk.allocation=exact", "--certify", "no")
    before = solve.parser().parse_args([*words, *line])
    scenario = load_scenario(None, before.overrides)
    with pytest.raises(InputError):
        plan_options(before).check(scenario)
    after = solve.parser().parse_args([*words, *undoing(plan_options(before)), *line])
    plan_options(after).check(scenario)


def test_the_line_is_taken_after_a_budget():
    words = ["--objective", "probability", "--dv-budget", "0.2"]
    undone = undoing(plan_options(solve.parser().parse_args(words)))
    options = solve.parser().parse_args([*words, *undone])
    plan_options(options).check(mission_of(*EXACT).scenario)
    assert (options.objective, options.dv_budget_m_s) == ("delta-v", None)


def test_unreachable_final_covariance_is_named_as_binding():
    found = failed(*EXACT, "boundary.final_sigma_position_m=0.05")
    assert module._freed(found, module.FINAL_SPREAD) is not None


def test_exact_risk_is_proposed_with_its_price(refused):
    words = said(refused)
    assert words.startswith(f"what binds: {SPLIT}; violated: ")
    (cost,) = (line.split()[-2] for line in words.splitlines() if "exact risk solves" in line)
    mission = mission_of("risk.p_chance=0.98", COARSE)
    exact = exact_plan(mission, initial_guess.cold(mission), 0.98)
    assert float(cost) == pytest.approx(exact.total_dv_m_s, abs=1e-4)
    (largest,) = (line for line in words.splitlines() if "largest probability" in line)
    p, price = float(largest.split()[-4]), float(largest.split()[-2])
    assert 0.98 <= p < 1.0
    assert price > float(cost)


@pytest.fixture(scope="module")
def small_burns() -> tuple[Plan, Diagnosis]:
    """Exact risk where the burns may be as large as takes 0.7, and not 0.9."""
    found = failed(*EXACT, "burns.dv_max_m_s=0.038", "risk.p_chance=0.9")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "CLOSE", 0.3)
        fly_few(patch)
        return found, diagnose(found)


def test_sufficient_relaxation_is_named_with_its_size(small_burns):
    """And exact risk, which has failed, is not praised."""
    found, out = small_burns
    assert out.exact is None
    words = "\n".join([what_binds(out), *what_would_do(out, found, ())])
    assert "exact risk solves" not in words
    assert SPLIT not in words
    assert SIZE in out.binds
    assert LIMITS in out.binds
    assert "dv_max" in out.violated
    assert f"{SIZE} (up to {out.burn_m_s:.4f} m/s would do)" in what_binds(out)
    larger = mission_of(*EXACT, f"burns.dv_max_m_s={out.burn_m_s + 1e-6}", "risk.p_chance=0.9")
    start = found.final.result.lin.iterate
    assert plan(larger, start, once=True).status is Status.CONVERGED


def test_largest_probability_is_last_with_a_plan(small_burns):
    found, out = small_burns
    assert 0.5 < out.largest.target < 0.9
    beyond = float(ndtr(ndtri(out.largest.target) + 0.3))
    last = out.largest.final.result.lin.iterate
    assert exact_plan(found.mission, last, beyond).status is not Status.CONVERGED
    asked = out.verified.mission.scenario.risk.p_chance
    assert asked == pytest.approx(out.largest.target, abs=1e-4)
    assert asked <= out.largest.target
    words = "\n".join(what_would_do(out, found, ["--method", "scp"]))
    assert f"{asked:g} for {out.largest.total_dv_m_s:.4f} m/s" in words
    line = f"--method scp --set 'risk.allocation=\"exact\"' --set risk.p_chance={asked:g}"
    assert f"with: {line} " in words


def test_normal_law_and_flights_are_told_apart(monkeypatch):
    """A plan that aims above what was asked may be the only one that is missing."""
    monkeypatch.setattr(module, "CLOSE", 1.0)
    monkeypatch.setattr(module, "_verified", lambda largest, *_: largest)
    found = failed(*EXACT, "burns.dv_max_m_s=0.038", "risk.p_chance=0.7", target=0.9)
    out = diagnose(found)
    words = "\n".join(what_would_do(out, found, ()))
    assert out.exact.target == 0.7
    assert "exact risk solves" not in words
    assert "0.7 has a plan under the normal law" in words
    assert "none that flights certify" in words
    assert "risk.p_chance=0.7 --certify no" in words


def test_certified_proposal_promises_less(small_burns, monkeypatch):
    """A certified plan aims higher; where that takes more than there is, less is promised.

    The start is on another grid, as where the plans that were tried had to be made on finer ones.
    """
    found, out = small_burns
    made: list[float] = []

    def certify(mission: Mission, start: Iterate, make: AimedPlanning, _: object) -> Plan:
        made.append(mission.scenario.risk.p_chance)
        of = make(mission, start, float(ndtr(ndtri(made[-1]) + 0.05)))
        return dataclasses.replace(of, certificate=REACHED)

    monkeypatch.setattr(planning, "certify", certify)
    monkeypatch.setattr(module, "make_solution", lambda of: of)
    monkeypatch.setattr(
        module, "verify", lambda _, of: SimpleNamespace(ok=of.certificate is not None)
    )
    start = initial_guess.cold(mission_of())
    chosen = module._verified(out.largest, 0.9, found, start)
    assert chosen.certificate is REACHED
    assert chosen.mission.scenario.risk.p_chance == made[-1] < made[0] <= out.largest.target
    words = "\n".join(what_would_do(dataclasses.replace(out, verified=chosen), found, ()))
    assert f"--set risk.p_chance={made[-1]:g} --certify yes" in words


def test_too_small_burns_bind_without_uncertainty_too():
    found = failed("burns.dv_max_m_s=0.02", COARSE)
    out = diagnose(found)
    assert out.without_uncertainty is Status.INFEASIBLE
    assert out.binds == (SIZE,)
    assert out.largest is None
    (line,) = what_would_do(out, found, ())
    assert "no lower probability helps" in line
    larger = mission_of(f"burns.dv_max_m_s={out.burn_m_s + 1e-6}", COARSE)
    p3 = plan(larger, initial_guess.cold(larger), problem="P3")
    assert p3.status is Status.CONVERGED
    unknown = Diagnosis(Status.MAX_ITERATIONS, (), ())
    words = "\n".join([what_binds(unknown), *what_would_do(unknown, found, ())])
    assert "no lower probability helps" not in words
    assert "max_iterations" in words
