"""Flights that correct their burns, or plan them again: the closed loop's law, and what is known."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import Iterate
from formulations.program.subproblem import MeritFunction
from formulations.rows.uniform import DeterministicRows
from scp_recon.api.plan_verbs import fly
from scp_recon.cli.commands import montecarlo
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo import closed_loop as module
from scp_recon.monte_carlo.closed_loop import Replan, replans
from scp_recon.monte_carlo.flights import fly_many
from scp_recon.monte_carlo.sampling import BLOCK, FlightLog, Flyer, draw
from scp_recon.monte_carlo.strata import Law
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import read_summary
from scp_recon.monte_carlo.whole_flight import SampledFlights
from scp_recon.planning.plan import Plan, Provenance, Stage, StageSpec
from scp_recon.results.policy import Policy, policy_of
from scp_recon.results.solution import Solution, make_solution
from scp_recon.scp.loop import Result, Timing
from scp_recon.scp.status import Status
from tests.helpers import usually
from tests.scp_recon.support import mission_of

SIGMAS = "navigation.sigma_position_m=0.5", "navigation.sigma_velocity_m_s=3e-5"
BLOCKS = 8
SPREAD = 0.08
"""Of sampled variances of six components over the true ones: three standard deviations of the extreme
ones among so many flights."""


class Case(NamedTuple):
    """A mission of small errors, a linearisation with gains, and their policy."""

    mission: Mission
    lin: Linearisation
    burns_m_s: Array
    policy: Policy

    def fly(self, times_s: Array, block: int = 0) -> FlightLog:
        mission, burns = self.mission, self.burns_m_s
        return Flyer(mission, burns, self.policy).fly_block(times_s, block)


def case_of(
    lead_s: float,
    solution: Solution,
    *words: str,
    size: float = 0.03,
    kind: str = "feedback",
    measured: Sequence[str] = SIGMAS,
    errors: str = "uncertainty.execution_error=3e-4",
) -> Case:
    """With random gains, whose corrections have `size` of the errors' usual effect.

    The lead of 17,500 s has a cut-off before an earlier burn, that of 8000 s one at departure.
    """
    mission = mission_of(
        *("uncertainty.initial_sigma_fraction=1e-4", errors),
        *measured,
        *(f"policy.kind={kind}", f"navigation.lead_s={lead_s}"),
        *("boundary.final_sigma_velocity_m_s=1", "risk.allocation=exact", *words),
    )
    problem, speed = mission.problem, mission.units.speed_m_s
    burns = solution.burns_m_s / speed
    count = 0 if problem.feedback is None else problem.feedback.size
    gains = size * 1e-3 / speed * np.random.default_rng(1).normal(size=count)
    mean = mission.dynamics.rollout(problem.initial_state, burns)
    lin = mission.dynamics.linearise(problem, Iterate(burns, mean, gains))
    return Case(mission, lin, solution.burns_m_s, policy_of(mission, lin))


def whitened(sampled: Array, factor: Array) -> Array:
    """Eigenvalues of sampled deviations' (n, 6) covariance over that of a factor (6, c)."""
    root = np.linalg.cholesky(factor @ factor.T)
    values: Array = np.linalg.svd(np.linalg.solve(root, sampled.T), compute_uv=False)
    return values**2 / len(sampled)


GATES = {
    "errors": "uncertainty.gates={magnitude_fixed_m_s=0, magnitude_proportional=4e-4, "
    "pointing_fixed_m_s=0, pointing_proportional_rad=2e-4}"
}
"""Those along a correction are the larger ones, so that no bound stands in for their law."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lead_s", "how"),
    usually(
        [
            *((3600.0, {}), (8000.0, {}), (17_500.0, {}), (3600.0, GATES)),
            *((0.0, {"kind": "open"}), (0.0, {})),
        ],
        5,
    ),
)
def test_small_errors_have_closed_loop_mean_and_covariance(lead_s, how, solution):
    case = case_of(lead_s, solution, **how)
    mission, lin = case.mission, case.lin
    nodes = [*mission.window_nodes[[0, -1]], mission.burn_nodes[2], len(mission.times_s) - 1]
    times = mission.times_s[nodes]
    flown = [case.fly(times, block) for block in range(BLOCKS)]
    states = np.concatenate([one.states for one in flown], axis=1) / mission.units.state
    commanded = np.concatenate([one.commanded_m_s for one in flown]) - case.burns_m_s
    for row, node in enumerate(nodes):
        off, factor = states[row] - lin.iterate.mean[node], lin.factor[node]
        np.testing.assert_allclose(whitened(off, factor), 1.0, atol=SPREAD)
        mean = np.linalg.solve(np.linalg.cholesky(factor @ factor.T), off.mean(axis=0))
        assert np.abs(mean).max() < 5.0 / np.sqrt(len(off))
    for j, one in enumerate(case.policy):
        gains = lin.problem.gains_of(lin.iterate, j) * mission.units.speed_m_s
        found = whitened(commanded[:, one.burn], gains)
        np.testing.assert_allclose(found, 1.0, atol=SPREAD)


@pytest.mark.parametrize("correlated", [False, True])
def test_law_has_the_draws_of_corrected_flights(solution, correlated):
    """Positions by its columns are those flown, but for what executing corrections adds."""
    along = np.diag([0.5, 0.2, 1.0, 3e-5, 1e-5, 6e-5]) ** 2
    along[0, 4] = along[4, 0] = -0.9 * np.sqrt(along[0, 0] * along[4, 4])
    case = case_of(3600.0, solution)
    if correlated:
        words = f"navigation.covariance={along.tolist()}"
        case = case_of(3600.0, solution, words, measured=())
    mission, law = case.mission, Law.of(case.mission, case.lin)
    draws = Flyer(mission, case.burns_m_s, case.policy).draws(0)[:50]
    assert draws.shape[1] == law.sources
    flights = SampledFlights(mission, case.burns_m_s, case.policy)
    flown = flights.positions(draws) / law.length_m - law.mean[:, None]
    linear = np.einsum("nic,fc->nfi", law.factor, draws)
    np.testing.assert_allclose(flown, linear, atol=0.03 * np.abs(linear).max())


def test_zero_gains_fly_bit_identical_to_open_loop(solution):
    """Measurements draw from a stream of their own."""
    case = case_of(3600.0, solution, size=0.0)
    assert len(case.policy) == 3
    mission, burns, times = case.mission, case.burns_m_s, case.mission.times_s
    corrected = case.fly(times)
    alone = Flyer(mission, burns).fly_block(times, 0)
    np.testing.assert_array_equal(corrected.states, alone.states)
    np.testing.assert_array_equal(corrected.burns_m_s, alone.burns_m_s)
    sources = Flyer(mission, burns).sources
    draws = Flyer(mission, burns, case.policy, seed=5).draws(2)
    assert draws.shape == (BLOCK, sources + 18)
    np.testing.assert_array_equal(draws[:, :sources], draw(5, 2, sources))
    assert len(np.unique(draws)) == draws.size


def test_execution_errors_follow_the_commanded_burn(solution):
    case = case_of(3600.0, solution, size=300.0)
    mission, burns = case.mission, case.burns_m_s
    flown = case.fly(mission.times_s[-1:])
    model = mission.problem.execution_errors
    first, sources = mission.initial_factor.shape[1], Flyer(mission, burns).sources
    executed = model.execute(flown.commanded_m_s, draw(0, 0, sources)[:, first:])
    np.testing.assert_array_equal(flown.burns_m_s, executed)
    assert np.ptp(flown.commanded_m_s[:, 0], axis=0).max() == 0.0
    assert np.std(flown.commanded_m_s[:, 1:], axis=0).min() > 1e-3


def test_flights_count_what_corrected_burns_break(solution):
    """Each limit and each burn for itself; a burn beyond its limit is flown as it is commanded."""
    largest = float(np.linalg.norm(solution.burns_m_s[2]))
    case = case_of(3600.0, solution, f"burns.dv_max_m_s={largest}", size=0.3)
    mission, burns = case.mission, case.burns_m_s
    flown = fly_many(Flyer(mission, burns, policy=case.policy), samples=BLOCK)
    commanded = case.fly(mission.times_s[-1:]).commanded_m_s
    sizes = np.linalg.norm(commanded, axis=2)
    kept = (sizes <= largest).sum(axis=0)[[1, 2, 3]]
    np.testing.assert_array_equal(flown.limits["dv_max"], kept)
    assert 0 < kept[1] < BLOCK
    toward = np.einsum("nmi,mi->nm", commanded, mission.problem.sun) / sizes
    inside = np.abs(toward) > np.cos(mission.problem.dv_cone)
    np.testing.assert_array_equal(flown.limits["dv_battery"], BLOCK - inside.sum(axis=0)[[1, 2, 3]])
    total = sizes.sum(axis=1)
    tally = flown.tallies["commanded_dv_m_s"]
    assert tally.mean().value == pytest.approx(total.mean())
    quantile = tally.quantile(0.99)
    assert quantile.low < np.quantile(total, 0.99) < quantile.high


@pytest.fixture(scope="module")
def corrected(solution) -> Solution:
    case = case_of(3600.0, solution)
    merit = MeritFunction(case.lin.problem, DeterministicRows(case.lin.problem))
    result = Result(Status.CONVERGED, case.lin, (), Timing())
    stage = Stage(StageSpec("P2", merit.rows), result, merit, 1e-6)
    provenance = Provenance("condensed", "scvx", "clarabel", "given")
    return make_solution(
        Plan(case.mission, provenance, 0.0, stages=(stage,), final=stage, timing=Timing())
    )


@pytest.mark.slow
def test_the_command_flies_what_the_file_stores(corrected, tmp_path, capsys):
    corrected.write(tmp_path)
    montecarlo.main([str(tmp_path), "--samples=2000"])
    shown = capsys.readouterr().out
    assert "dv_battery" in shown
    assert "commanded delta-v mm/s" in shown
    commanded = read_summary(tmp_path).commanded
    assert [burn.burn for burn in commanded.burns] == [2, 3, 4]
    mission, burns = corrected.mission, corrected.burns_m_s
    blocks = [
        Flyer(mission, burns, corrected.corrections).fly_block(mission.times_s[-1:], block)
        for block in range(2)
    ]
    flown = [np.linalg.norm(one.commanded_m_s, axis=2).sum(axis=1) for one in blocks]
    assert commanded.mean_dv_m_s.value == pytest.approx(np.mean(flown), rel=1e-9)
    assert commanded.dv99_m_s.value == pytest.approx(np.quantile(flown, 0.99), abs=2e-5)
    assert commanded.dv99_m_s.low < np.quantile(flown, 0.99) < commanded.dv99_m_s.high


def test_flights_of_other_gains_are_another_plans(corrected):
    """Without gains they are the plan's own, flown open loop."""
    mission, burns, policy = corrected.mission, corrected.burns_m_s, corrected.corrections
    for other in (policy[:1], (replace(policy[0], gains=2.0 * policy[0].gains), *policy[1:])):
        with pytest.raises(ValueError, match="another plan"):
            summarise(fly_many(Flyer(mission, burns, policy=other), samples=20), corrected)
    open_loop = summarise(fly_many(Flyer(mission, burns), samples=20), corrected)
    assert (open_loop.policy, open_loop.commanded) == ("open", None)


MEASURED = "navigation.sigma_position_m=10", "navigation.sigma_velocity_m_s=5e-4"


def flown(solution: Solution, flights: int, *words: str) -> tuple[FlightLog, tuple[Replan, ...]]:
    mission, burns = mission_of(*MEASURED, *words), solution.burns_m_s
    again = replans(mission, burns)
    times = np.array([*(one.cut_off_s for one in again), mission.times_s[-1]])
    return Flyer(mission, burns, again).fly_block(times, 0, flights=flights), again


@pytest.mark.parametrize("lead_s", [3600.0, 7000.0])
def test_knowledge_at_cut_offs_matches_planners_filter(solution, lead_s):
    """By rows of innovations, without corrections."""
    case = case_of(lead_s, solution, size=0.0)
    found = replans(case.mission, case.burns_m_s)
    assert [one.cut_off_s for one in found] == [one.cut_off_s for one in case.policy]
    for one, expected in zip(found, case.policy, strict=True):
        assert one.burn == expected.burn
        sigma = np.sqrt(np.diag(expected.estimate_covariance))
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(
            one.estimate_covariance / scale, expected.estimate_covariance / scale, atol=1e-5
        )
        known = one.mission.initial_factor @ one.mission.initial_factor.T
        np.testing.assert_allclose(known / scale, one.estimate_covariance / scale, atol=1e-6)


def test_failed_replan_flies_the_last_plan(solution, monkeypatch):
    """Where the first replan finds burns for half of the flights, and the others none."""
    found: list[Array] = []

    def for_some(one: Replan, states: Array) -> Array:
        burns = np.full((len(states), *one.burns_m_s.shape), np.nan)
        if not found:
            burns[::2] = one.burns_m_s + 1e-4
        found.append(burns)
        return burns

    monkeypatch.setattr(module, "_plan_again", for_some)
    flights, _ = flown(solution, 20)
    np.testing.assert_array_equal(flights.failed.sum(axis=1), [10, 20, 20])
    np.testing.assert_allclose(flights.commanded_m_s[::2, 1:] - solution.burns_m_s[1:], 1e-4)
    alone = Flyer(mission_of(*MEASURED), solution.burns_m_s).fly_block(np.zeros(1), 0, flights=20)
    np.testing.assert_array_equal(flights.burns_m_s[1::2], alone.burns_m_s[1::2])


@pytest.mark.slow
def test_the_command_flies_a_plan_by_any_policy(solution, tmp_path, capsys):
    """Another policy than the plan's has a file of its own. What is planned again meets the end."""
    replace(solution, scenario=mission_of(*MEASURED).scenario).write(tmp_path)
    montecarlo.main([str(tmp_path), "--samples=20", "--policy=replan"])
    shown = capsys.readouterr().out
    assert "policy replan" in shown
    assert "failed replans" in shown
    again = read_summary(tmp_path / "montecarlo_replan.json")
    assert again.policy == "replan"
    assert [(burn.burn, burn.failed) for burn in again.commanded.burns] == [(2, 0), (3, 0), (4, 0)]
    assert not (tmp_path / "montecarlo.json").exists()
    montecarlo.main([str(tmp_path), "--samples=20"])
    alone = read_summary(tmp_path)
    assert alone.policy == "open"
    sizes = again.terminal.sigma_position_m.estimate, alone.terminal.sigma_position_m.estimate
    assert sizes[0].high < 0.25 * sizes[1].low


@pytest.mark.parametrize(
    ("policy", "words", "told"),
    [
        ("feedback", MEASURED, "without gains"),
        ("replan", (), "without a measurement"),
        ("replan", (*MEASURED, "navigation.lead_s=20000"), "cut-off of burn 3 precedes"),
    ],
)
def test_policies_that_a_plan_cannot_fly_are_refused(solution, policy, words, told):
    given = replace(solution, scenario=mission_of(*words).scenario)
    with pytest.raises(InputError, match=told):
        fly(given, samples=20, policy=policy)  # type: ignore[arg-type]
