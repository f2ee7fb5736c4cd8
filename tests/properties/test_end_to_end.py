"""The command line on random scenarios: verified, or refused in so many words; nothing else."""

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning.planner import plan
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution, make_solution
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import verify
from tests import reliability
from tests.helpers import share_of_examples
from tests.scenarios import FINE, generous, scenarios
from tests.scp_recon.support import CommandLine, run_solve

pytestmark = pytest.mark.slow

NOT_VERIFIED = 4
OPTIONS = st.tuples(
    st.sampled_from([[], ["--init", "warm"]]), st.sampled_from([[], ["--facet-rounds", "1"]])
)
expensive = settings(
    max_examples=share_of_examples(20, usual=1),
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow],
)


@expensive
@given(scenarios(), OPTIONS)
def test_random_scenarios_end_verified_or_honestly_refused(overrides, options):
    with wrong_if_it_fails():
        run, solution = ended(overrides, [*options[0], *options[1]])
        if solution is None:
            assert_barred(run)
        else:
            {0: assert_solved, 3: assert_infeasible}[run.exit_code](run, solution)


@expensive
@given(generous(), OPTIONS)
def test_scenarios_that_are_feasible_by_construction_are_solved(overrides, options):
    with wrong_if_it_fails():
        run, solution = ended(overrides, [*options[0], *options[1]])
        assert run.exit_code == 0
        assert solution is not None
        assert_solved(run, solution)


@contextmanager
def wrong_if_it_fails() -> Iterator[None]:
    try:
        yield
    except BaseException:
        reliability.count(reliability.WRONG)
        raise


def solved(overrides: tuple[str, ...], options: list[str]) -> tuple[CommandLine, Solution | None]:
    """A run without a traceback, and its solution unless the scenario was refused."""
    sets = [argument for override in overrides for argument in ("--set", override)]
    with tempfile.TemporaryDirectory() as name:
        run = run_solve(Path(name), *sets, *options)
        assert "Traceback" not in run.output + run.errors
        if run.exit_code == 2:
            assert list(run.folder.iterdir()) == []
            return run, None
        assert run.errors == ""
        return run, read_solution(run.folder)


def ended(overrides: tuple[str, ...], options: list[str]) -> tuple[CommandLine, Solution | None]:
    """The same, on a finer grid where the verification finds what the nodes do not show."""
    run, solution = solved(overrides, options)
    if solution is None or run.exit_code != NOT_VERIFIED:
        return run, solution
    assert solution.status == Status.CONVERGED.value.name
    assert not solution.verification.ok
    assert "smaller grid.step_max_s" in run.output
    reliability.count(reliability.REFINED)
    return solved((*overrides, FINE), options)


def assert_barred(run: CommandLine) -> None:
    """No plan was begun, one message says why, and nothing is written."""
    assert run.output == ""
    assert run.errors.count("error: ") == 1
    assert run.errors.startswith(("error: observation", "error: burns.times_s"))
    reliability.count(reliability.BARRED)


def assert_solved(run: CommandLine, solution: Solution) -> None:
    assert solution.status == Status.CONVERGED.value.name
    assert solution.verification.ok
    assert solution.verification.failed == []
    assert any(line.startswith("verified") for line in run.output.splitlines())
    assert (solution.violation.max, solution.violation.by_constraint) == (0.0, {})
    # To a tenth of a millimetre: a binding margin is rounded.
    assert min(c.worst_margin for c in solution.constraints) > -1e-3
    asked = solution.scenario.risk.p_chance
    assert min(p.estimate for p in solution.verification.probabilities) >= asked
    largest = np.linalg.norm(solution.burns_m_s, axis=1).max()
    assert largest <= solution.scenario.burns.dv_max_m_s * (1.0 + 1e-5)
    reliability.count(reliability.SOLVED)


def assert_infeasible(run: CommandLine, solution: Solution) -> None:
    assert solution.status == Status.INFEASIBLE.value.name
    assert not solution.verification.ok
    assert solution.violation.max > 0.0
    for name, amount in solution.violation.by_constraint.items():
        assert amount.max > 0.0
        assert re.sub("_(min|max)$", "", name) in run.output
    assert "not verified" in run.output
    assert not others_that_find_a_plan(solution)
    reliability.count(reliability.REFUSED)


def others_that_find_a_plan(solution: Solution) -> list[str]:
    """What solves a scenario, verified, that was called infeasible: by other weights, and by none.

    From the ballistic arc, with the weight that SCvx* finds by itself, and with IPOPT, whose
    constraints are no penalties.
    """
    mission = Mission.from_scenario(solution.scenario)
    try:
        start = initial_guess.ballistic(mission)
    except InputError:
        start = initial_guess.cold(mission)
    ways = {
        "scvx-star": lambda: plan(mission, start, algorithm="scvx-star"),
        "ipopt": lambda: ipopt.plan(mission, start, variant="shooting"),
    }
    return [name for name, way in ways.items() if verify(mission, make_solution(way())).ok]
