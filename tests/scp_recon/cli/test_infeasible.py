"""The advice on a plan that failed: values that were planned, a limit of time, and what was tried."""

import dataclasses
import shlex
from dataclasses import replace
from io import StringIO
from time import process_time

import numpy as np
import pytest
from rich.console import Console

import scp_recon as sr
from scp_recon.advice import infeasibility as module
from scp_recon.advice import trials
from scp_recon.advice.infeasibility import CONTINUED, FEEDBACK, Diagnosis, diagnose
from scp_recon.advice.trials import CORRECTED, PROBABILITY, SIZE, SPLIT, Case, Remedy, overrides_of
from scp_recon.api import planning
from scp_recon.api.inputs import PlanRequest
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import PlanOutcome, Watch, carry_out, plan_mission
from scp_recon.certification.certify import certify
from scp_recon.cli import plan_view
from scp_recon.cli.commands import replan, solve
from scp_recon.cli.plan_run import advice_on, undoing, what_would_do
from scp_recon.errors import InputError
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan, ended
from scp_recon.planning.planner import plan
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.results.figures import FINAL_POSITION
from scp_recon.results.read import read_solution
from scp_recon.results.verification import BurnLimit, JointProbability
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from scp_recon.verification import reintegration
from scp_recon.verification.causes import next_lines
from tests.helpers import nightly
from tests.scenarios import COARSE
from tests.scp_recon.support import CommandLine, fly_few, from_cold, mission_of, run_solve

pytestmark = pytest.mark.slow

SPLIT_TOO_DEAR = ("--set", "risk.p_chance=0.98", "--set", COARSE, "--starts", "1")
EXACT = ("risk.allocation=exact", COARSE)
NO_FLIGHTS = PlanOptions(certify=False, starts=1)


class Asked(Watch):
    """Keeps a plan with what was asked for."""

    def kept(self, outcome: PlanOutcome, request: PlanRequest) -> tuple[str, ...]:
        self.plan, self.request = outcome.plan, request
        return ()


def case_of(*overrides: str, options: PlanOptions = NO_FLIGHTS, limit_s: float = 60.0) -> Case:
    asked = Asked()
    carry_out(PlanRequest(None, "cold", options, overrides), asked)
    return Case(asked.plan, asked.request, trials.Clock(limit_s))


def said(run: CommandLine) -> str:
    return run.output[run.output.index("what binds") :]


@pytest.fixture(scope="module")
def refused(tmp_path_factory) -> CommandLine:
    with pytest.MonkeyPatch.context() as patch:
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
    assert f"feasible, for {1e3 * solution.total_dv_m_s:.1f} mm/s, with: " in said(refused)


def test_split_is_priced_on_screen_and_page(refused):
    """Exact risk gives up nothing, so nothing else is tried."""
    words, solution = said(refused), read_solution(refused.folder)
    assert words.startswith(f"what binds: {SPLIT}\n")
    assert SIZE not in words
    assert "next: " not in refused.output
    given = solution.mission, solution, solution.verification
    assert next_lines(*given) == solution.advice == tuple(words.splitlines())


def test_what_is_tried_is_shown_with_its_time():
    shown = list[str]()
    clock = trials.Clock(30.0, show=shown.append)
    assert clock.attempt("the limits", clock.check) is None
    assert {*shown} == {"trying the limits: 0 of at most 30 s"}


def test_last_iteration_is_shown_on_terminal_alone(mission):
    ends = {}
    for is_terminal in (True, False):
        console = Console(file=StringIO(), force_terminal=is_terminal, width=100)
        with plan_view.live_progress(console, mission, verbose=False) as observe:
            plan(mission, initial_guess.cold(mission), problem="P3", observe=observe)
        with plan_view.live_line(console) as show:
            show("trying the limits")
        assert isinstance(console.file, StringIO)
        ends[is_terminal] = console.file.getvalue()
    assert ends[False].strip() == ""
    assert "P3, iteration 1: " in ends[True]
    assert "trying the limits" in ends[True]


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
        "--objective probability --dv-budget 0.2",
    ],
)
def test_the_line_goes_with_every_method(own):
    """What the command says against exact risk is undone by what stands after it."""
    words, line = own.split(), ("--set", "risk.allocation=exact", "--certify", "no")
    before = plan_options(solve.parser().parse_args([*words, *line]))
    after = plan_options(solve.parser().parse_args([*words, *undoing(before), *line]))
    scenario = load_scenario(None, ["risk.allocation=exact"])
    if before.objective == "delta-v":
        with pytest.raises(InputError):
            before.check(scenario)
    after.check(scenario)
    assert (after.objective, after.dv_budget_m_s) == ("delta-v", None)


@pytest.fixture(scope="module")
def small_burns() -> tuple[Case, Diagnosis]:
    """Exact risk where the burns may be as large as takes 0.7, and not 0.9."""
    with pytest.MonkeyPatch.context() as patch:
        fly_few(patch)
        patch.setattr(module, "LEAST_S", 20.0)
        patch.setitem(module.SHARES, CORRECTED, 0.0)
        case = case_of(*EXACT, "burns.dv_max_m_s=0.038", "risk.p_chance=0.9")
        assert case.failed.status is Status.INFEASIBLE
        return case, diagnose(case.failed, case.request)


@pytest.mark.parametrize("name", [SIZE, PROBABILITY])
def test_proposed_values_end_verified(small_burns, name, monkeypatch):
    fly_few(monkeypatch)
    case, found = small_burns
    (remedy,) = (one for one in found.remedies if one.name == name)
    asked = Asked()
    sets = overrides_of(remedy.changes)
    outcome = carry_out(case.request.again(sets), asked)
    assert outcome.verification is not None
    assert outcome.verification.ok
    assert outcome.plan.cost_m_s == pytest.approx(remedy.cost_m_s, rel=1e-9)
    line = f"{name}: feasible, for {1e3 * remedy.cost_m_s:.1f} mm/s, with: --set {sets[0]}"
    assert line in advice_on(found, case.failed)
    assert found.without_uncertainty is Status.CONVERGED
    assert remedy.changes.get("risk.p_chance", 0.5) <= found.largest < 0.9


def test_nothing_is_proposed_that_does_not_verify(small_burns, monkeypatch):
    """However well rough plans do."""
    case, _ = small_burns
    monkeypatch.setattr(Case, "command", lambda *_, **__: None)
    found = diagnose(case.failed, case.request)
    assert found.remedies == ()
    assert {SIZE, CORRECTED, PROBABILITY} <= set(found.tried)
    words = "\n".join(advice_on(found, case.failed))
    assert "no values" in words
    assert "with: " not in words


def test_diagnosis_ends_with_its_time(small_burns, monkeypatch):
    """What it did not get to is named."""
    case, _ = small_burns
    monkeypatch.setattr(module, "LEAST_S", 0.2)
    began = process_time()
    found = diagnose(case.failed, case.request, spent_s=0.1)
    assert process_time() - began < 3.0
    assert found.limit_s == pytest.approx(0.3)
    assert {CORRECTED, PROBABILITY} <= set(found.left_out)
    assert "after 0 s" in advice_on(found, case.failed)[-1]


def test_feedback_is_tried_with_what_it_needs(small_burns, monkeypatch):
    case, _ = small_burns
    tried: list[dict[str, object]] = []
    monkeypatch.setattr(Case, "command", lambda _, changes, **__: tried.append(dict(changes)))
    dict(module.relaxations(case, Status.CONVERGED))[CORRECTED](CORRECTED)
    (changes,) = tried
    assert changes == FEEDBACK
    scenario = case.failed.mission.scenario.replace(changes)
    assert (scenario.policy.kind, scenario.navigation.sigma_position_m) == ("feedback", 5.0)


def test_advised_feedback_says_what_its_delta_v_counts():
    sets = overrides_of(FEEDBACK)
    for cost, label in (("expected", "mean commanded"), ("dv99", "99 % of commanded delta-v")):
        made = from_cold(mission_of(*sets, COARSE, f'policy.cost="{cost}"'))
        mean, most = made.commanded
        line = what_would_do(Remedy.of(CORRECTED, FEEDBACK, made))
        counted = 1e3 * {"expected": mean, "dv99": most}[cost]
        assert line.startswith(f"feasible, for {counted:.1f} mm/s ({label}), with: ")
    fixed = Remedy.of(CORRECTED, {}, from_cold(mission_of(COARSE)))
    assert what_would_do(fixed).startswith(f"feasible, for {1e3 * fixed.cost_m_s:.1f} mm/s, with: ")


def test_size_of_burns_is_relaxed_with_the_limits():
    """Two burns leave no choice: neither a larger one nor wider limits suffice alone."""
    few = "burns.times_s=[0.0, 34842.0]", "burns.dv_max_m_s=0.02"
    near, options = "observation.site_distance_max_m", PlanOptions("P3", starts=1)
    case = case_of(*few, f"{near}=520.0", options=options)
    assert case.failed.status is Status.INFEASIBLE
    work = dict(module.relaxations(case, Status.INFEASIBLE))
    names = SIZE, f"{trials.LIMITS}: {near}", f"{trials.LIMITS} together"
    *alone, remedy = (work[name](name) for name in names)
    assert alone == [None, None]
    assert remedy is not None
    assert {*remedy.changes} == {near, "burns.dv_max_m_s"}
    outcome = case.command(remedy.changes)
    assert outcome is not None
    largest = np.linalg.norm(outcome.plan.burns_m_s, axis=1).max()
    assert largest <= remedy.changes["burns.dv_max_m_s"] < 1.3 * largest


@nightly
def test_relaxed_plan_stays_relaxed_on_a_finer_grid(monkeypatch):
    """And without a price of the final state, too."""
    case = case_of("burns.dv_max_m_s=0.02", COARSE)
    monkeypatch.setitem(reintegration.FIGURES, "covariance_error", ("", "", 1e-9))
    free = case.rough({"burns.dv_max_m_s": 2.0})
    assert free is not None
    assert len(free.mission.times_s) > len(case.failed.mission.times_s)
    assert free.mission.scenario.burns.dv_max_m_s == 2.0


def test_too_small_burns_bind_without_uncertainty_too(monkeypatch):
    fly_few(monkeypatch)
    monkeypatch.setattr(module, "LEAST_S", 5.0)
    case = case_of("burns.dv_max_m_s=0.02", COARSE)
    found = diagnose(case.failed, case.request)
    assert found.without_uncertainty is Status.INFEASIBLE
    assert [one.name for one in found.remedies] == [SIZE]
    words = "\n".join(advice_on(found, case.failed))
    assert "no lower probability" in words
    assert not {PROBABILITY, CORRECTED} & {*found.tried, *found.left_out}


def test_missed_target_is_told_with_what_flights_kept(monkeypatch):
    """A lower probability is certified; the certification went on by itself before."""
    fly_few(monkeypatch)
    options = PlanOptions(starts=1)
    asked = case_of(*EXACT, "risk.p_chance=0.9", options=options)
    missed = ended(asked.failed, Status.MAX_ITERATIONS)
    found = diagnose(missed, asked.request)
    assert found.kept == pytest.approx(0.9, abs=0.02)
    assert found.tried[0] == CONTINUED
    assert module.TARGET in [one.name for one in found.remedies]
    assert found.remedies[-1].changes["risk.p_chance"] < 0.9


def test_target_without_verdict_is_certified_from_its_end(monkeypatch):
    """The plan that the continued certification finds is the user's."""
    fly_few(monkeypatch)
    began = list[object]()

    def once_missed(mission, start, *given):
        began.append(start)
        found = certify(mission, start, *given)
        return found if len(began) > 1 else ended(found, Status.STALLED)

    monkeypatch.setattr(planning, "certify", once_missed)
    request = PlanRequest(None, "cold", PlanOptions(starts=1), [*EXACT, "risk.p_chance=0.9"])
    outcome = carry_out(request)
    assert isinstance(began[1], Plan)
    assert began[1].status is Status.STALLED
    assert outcome.plan.status is Status.CONVERGED
    assert outcome.verification.ok


def test_plan_without_verdict_is_continued_by_the_line(tmp_path, monkeypatch):
    """One that has no target: from its file the command ends verified."""
    made = list[Plan]()

    def once_ended(*given, **known):
        found = plan_mission(*given, **known)
        made.append(found if made else ended(found, Status.MAX_ITERATIONS))
        return made[-1]

    monkeypatch.setattr(planning, "plan_mission", once_ended)
    words = ["--problem", "P3", "--set", COARSE]
    first = run_solve(tmp_path / "first", *words)
    assert first.exit_code == Status.MAX_ITERATIONS.value.exit_code
    (line,) = [one for one in first.output.splitlines() if one.startswith(f"{CONTINUED}: ")]
    more = shlex.split(line.rsplit("with: ", 1)[1])
    assert more == ["--init", str(tmp_path / "first" / "solution.json")]
    again = run_solve(tmp_path / "again", *words, *more)
    assert (again.exit_code, again.errors) == (0, "")
    assert f"for {1e3 * read_solution(tmp_path / 'again').total_dv_m_s:.1f} mm/s" in line


@pytest.fixture(scope="module")
def exact() -> Case:
    return case_of(*EXACT)


@pytest.mark.parametrize(
    ("failed", "names"),
    [
        ("P(whole_flight)", {module.CERTIFIED, module.STRICTER}),
        ("certificate", {module.TARGET}),
        ("dv_min of burn 2", {module.EXECUTED}),
        (FINAL_POSITION, {trials.FINAL_SPREAD}),
        ("covariance_error", {module.FINER}),
        ("total_dv_m_s", {CONTINUED}),
        ("P(dv_max of burn 2)", {SIZE, module.UNCORRECTED}),
        ("status", {CONTINUED, module.FINER, module.TARGET}),
    ],
)
def test_each_failed_check_has_its_trials(failed, names, exact, verification):
    p = JointProbability(name="whole_flight", worst_t_s=0.0, estimate=0.6, low=0.6, high=0.6)
    limits = (BurnLimit(2, "dv_max", 8000.0, 0.5),)
    checked = replace(
        verification, failed=[failed], ok=False, probabilities=(p,), burn_limits=limits
    )
    checked = replace(checked, covariance_error=1.7e-5)
    assert dict(module.repairs(exact, checked)).keys() == names


def test_certification_is_advised_once_it_verified(exact, verification, monkeypatch):
    fly_few(monkeypatch)
    p = JointProbability(name="whole_flight", worst_t_s=0.0, estimate=0.6, low=0.6, high=0.6)
    failed = replace(verification, failed=["P(whole_flight)"], ok=False, probabilities=(p,))
    found = diagnose(exact.failed, exact.request, verification=failed)
    assert [(one.name, one.certify) for one in found.remedies] == [
        (module.CERTIFIED, True),
        (module.STRICTER, None),
    ]
    lines = advice_on(found, exact.failed)
    assert lines[0].endswith("mm/s, with: --certify yes")
    monkeypatch.setattr(Case, "command", lambda *_, **__: None)
    nothing = diagnose(exact.failed, exact.request, verification=failed)
    assert advice_on(nothing, exact.failed) == (
        "no values were found with which this command ends verified",
        f"tried, and not sufficient alone: {module.CERTIFIED}, {module.STRICTER}",
    )


def test_added_burns_are_advised_only_after_a_try(default_plan, tmp_path, capsys):
    """A lost flight: what is said to save it does."""
    home = tmp_path / "flown"
    sr.save(default_plan, home)
    off = 20.0 * np.array([40.0, -40.0, 20.0, 2e-3, 2e-3, -1e-3])
    state = predict(FlownPlan.of(default_plan), 26_000.0, {}).state + off
    given = [str(home), "--at", "26000", "--state", *map(repr, state.tolist())]
    code = replan.main([*given, "--out", str(tmp_path / "lost")])
    out = capsys.readouterr().out
    assert code == Status.LOST.value.exit_code
    (line,) = [line for line in out.splitlines() if line.startswith(f"{trials.MORE_BURNS}: ")]
    more = shlex.split(line.rsplit("with: ", 1)[1])
    assert replan.main([*given, *more, "--out", str(tmp_path / "saved")]) == 0
