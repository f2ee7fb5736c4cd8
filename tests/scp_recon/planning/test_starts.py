"""Several starts: both optima of P3 are found, the best is kept, and processes change no bit."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import scp_recon as sr
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.planning.stages import contradicts_itself
from scp_recon.planning.starts import local_optima, plan_from_several, random_flight
from scp_recon.results.solution import make_solution
from scp_recon.scp.status import Status
from tests.scp_recon.support import flight_beyond

THREE = partial(plan_from_several, make_plan=partial(plan, problem="P3"), starts=3)
"""Of which the third, by seed 0, flies beyond the cone of the least emission."""


@pytest.fixture(scope="module")
def found(mission: Mission) -> Plan:
    return THREE(mission, initial_guess.cold(mission))


def test_both_optima_of_p3_are_found_and_the_better_one_is_kept(
    mission: Mission, found: Plan
) -> None:
    near, far = found.starts.optima
    assert near.total_dv_m_s == pytest.approx(0.107723, rel=1e-4)
    assert far.total_dv_m_s == pytest.approx(0.159273, rel=1e-4)
    assert (near.starts, far.starts) == ((0, 1), (2,))
    assert found.total_dv_m_s == min(near.total_dv_m_s, found.total_dv_m_s)
    sizes = np.linalg.norm(far.burns_m_s, axis=1)
    assert sizes.sum() == pytest.approx(far.total_dv_m_s)
    burns = np.array(far.burns_m_s)
    ends = initial_guess.from_burns(mission, burns).mean[-1]
    assert ends == pytest.approx(mission.problem.final_state, abs=1e-6)


def test_neither_plan_nor_optima_depend_on_the_processes(mission: Mission, found: Plan) -> None:
    split = THREE(mission, initial_guess.cold(mission), workers=2)
    assert split == found
    assert split.starts == found.starts


def test_another_seed_draws_other_flights(mission: Mission) -> None:
    one, same, number, seed = (random_flight(mission, *k) for k in ((0, 1), (0, 1), (0, 2), (1, 1)))
    np.testing.assert_array_equal(one.mean, same.mean)
    for other in (number, seed):
        assert np.abs(one.mean - other.mean).max() > 0.01


@pytest.mark.parametrize("number", range(1, 4))
def test_a_random_flight_obeys_the_dynamics_and_ends_where_it_should(
    mission: Mission, number: int
) -> None:
    flight = random_flight(mission, 3, number)
    lin = mission.dynamics.linearise(mission.problem, flight)
    assert lin.is_dynamically_feasible
    assert not contradicts_itself(lin)
    flown = initial_guess.from_burns(mission, flight.burns * mission.units.speed_m_s)
    np.testing.assert_allclose(flown.mean, flight.mean, atol=1e-8)


def test_what_p2_finds_infeasible_is_listed_and_not_kept(
    mission: Mission, default_plan: Plan
) -> None:
    """From the far optimum there is no way; with `once` it begins nowhere else."""
    far = plan(mission, flight_beyond(mission), once=True)
    assert {stage.name.partition(".")[0] for stage in far.stages} == {"P3", "P2"}
    assert far.status is Status.INFEASIBLE
    optima = local_optima([far, default_plan])
    assert [(o.problem, o.status, o.starts) for o in optima] == [
        ("P3", "converged", (1,)),
        ("P3", "converged", (0,)),
        ("P2", "converged", (1,)),
        ("P2", "infeasible", (0,)),
    ]


def test_an_interrupt_keeps_the_best_start_so_far(mission: Mission) -> None:
    def stop(number: int, _: Plan) -> None:
        if number == 1:
            raise KeyboardInterrupt

    found = THREE(mission, initial_guess.cold(mission), seen=stop)
    assert found.status is Status.INTERRUPTED
    assert found.total_dv_m_s == pytest.approx(0.107723, rel=1e-4)
    assert [o.starts for o in found.starts.optima] == [(0, 1)]


def test_an_interrupt_before_any_start_is_no_plan(mission: Mission) -> None:
    def stop(*_: object, **__: object) -> Plan:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        plan_from_several(mission, initial_guess.cold(mission), stop, starts=2)


def test_the_front_door_and_the_file_list_the_optima() -> None:
    found = sr.plan(problem="P3", starts=3, seed=0)
    assert "local optima of 3 starts, seed 0" in str(found)
    listed = make_solution(found).starts
    assert [o.starts for o in listed.optima] == [(0, 1), (2,)]
    assert (listed.number, listed.seed) == (3, 0)


@pytest.mark.parametrize(
    ("argument", "given"), [("starts", 0), ("starts", 1.5), ("seed", -1), ("workers", 0)]
)
def test_the_front_door_refuses_what_is_no_number_of_starts(argument: str, given: object) -> None:
    arguments: dict[str, object] = {argument: given}
    with pytest.raises(InputError, match=argument):
        sr.plan(**arguments)  # type: ignore[arg-type]
