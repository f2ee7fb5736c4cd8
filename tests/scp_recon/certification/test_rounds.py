"""Rounds of certification: as high as asked and no higher, the best kept whatever comes after."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr, ndtri

from scp_recon.certification.certify import ROUNDS_MAX, Aiming, certify
from scp_recon.errors import InputError
from scp_recon.monte_carlo.estimates import FIRST_SEED, flights_needed
from scp_recon.planning.plan import Plan
from scp_recon.scp.status import Status
from tests.scp_recon.certification.support import Reached, World, a_plan

ASKED = 0.9
AIMING = Aiming(ASKED, flights_needed(ASKED))
NEEDED, ERROR = AIMING.needed, AIMING.error


@pytest.fixture(scope="module")
def real() -> Plan:
    return a_plan(ASKED)


def certified(world: World, patch: pytest.MonkeyPatch) -> Plan:
    world.enter(patch)
    return certify(world.real.mission, world.start, world.make_plan)


def scripted(*reached: float) -> tuple[dict[int, Reached], int]:
    return {FIRST_SEED + k: (r, r) for k, r in enumerate(reached)}, len(reached)


def low(plan: Plan) -> float:
    assert plan.certificate is not None
    return plan.certificate.low


def later(ending: Status) -> Callable[[float, str], Status]:
    """How all rounds but the first end."""
    return lambda _, start: Status.CONVERGED if start == "given" else ending


def test_what_reaches_more_than_sampling_explains_aims_lower(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flights that reach more than the law says: three standard errors, always."""
    gain = ndtri(NEEDED + 3.0 * ERROR) - ndtri(NEEDED)

    def reach(target: float, _: int) -> Reached:
        return (share := float(ndtr(ndtri(target) + gain))), share

    world = World(real, reach)
    found = certified(world, monkeypatch)
    assert found.target == world.aims[-1] < world.aims[0]
    assert len(world.aims) == 2
    assert low(found) >= ASKED
    assert found.certificate is not None
    assert found.certificate.reached < NEEDED + 0.2 * ERROR


def test_what_falls_short_aims_higher(real: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    def reach(target: float, _: int) -> Reached:
        return (share := float(ndtr(ndtri(target) - 0.1))), share

    found = certified(World(real, reach), monkeypatch)
    assert low(found) >= ASKED
    assert found.certificate is not None
    assert found.certificate.rounds == 2
    assert found.certificate.reached < NEEDED + 0.3 * ERROR


def test_a_plan_that_reaches_it_is_not_replaced_by_a_worse_one(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second round is to be cheaper, and falls short; and so do all after it."""
    table, _ = scripted(NEEDED + 3.0 * ERROR)
    world = World(real, lambda _, seed: table.get(seed, (0.5, 0.5)))
    found = certified(world, monkeypatch)
    assert len(world.aims) > 1
    assert found.target == world.aims[0]
    assert low(found) >= ASKED


def test_the_cheapest_of_those_that_reach_it_is_kept(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = certified(world := World(real, lambda *_: (0.95, 0.95)), monkeypatch)
    assert len(world.aims) == ROUNDS_MAX
    assert found.target == min(world.aims)


def test_where_none_reaches_it_the_nearest_is_told(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    table, _ = scripted(0.6, 0.88, 0.7, 0.65, 0.5, 0.6)
    found = certified(world := World(real, lambda _, seed: table[seed]), monkeypatch)
    assert found.status is Status.CONVERGED
    assert found.certificate is not None
    assert found.certificate.reached == pytest.approx(0.88)
    assert low(found) < ASKED
    assert found.target == world.aims[1]


def test_what_is_lost_between_nodes_counts_once(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nodes give it back, so that the aim need not make up for it too."""
    between = real.times_s[70] + 20.0

    def reach(target: float, seed: int) -> Reached:
        return target, target - 0.05 * (seed == FIRST_SEED)

    world = World(real, reach, touched_s=(between,))
    found = certified(world, monkeypatch)
    assert world.aims[1] < world.aims[0] + 0.2 * ERROR
    assert round(between) in found.times_s
    assert round(between) not in world.missions[0].times_s
    assert low(found) >= ASKED
    assert found.certificate is not None
    assert found.certificate.rounds == 2


def test_where_nothing_binds_a_lower_aim_is_not_tried(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would save nothing, whatever flights reach."""
    world = World(real, lambda *_: (1.0, 1.0), slack=2.0)
    found = certified(world, monkeypatch)
    assert len(world.aims) == 1
    assert low(found) >= ASKED


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_flights_that_all_fail_or_all_hold_leave_an_aim(
    real: Plan, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    world = World(real, lambda *_: (share, share))
    certified(world, monkeypatch)
    assert len(world.aims) > 1
    assert all(0.5 < target < 1.0 for target in world.aims)


def test_ctrl_c_among_flights_keeps_what_there_is(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reach(_: float, seed: int) -> Reached:
        if seed == stop:
            raise KeyboardInterrupt
        return 0.95, 0.95

    stop = FIRST_SEED
    world = World(real, reach)
    first = certified(world, monkeypatch)
    assert (first.status, first.target) == (Status.INTERRUPTED, world.aims[0])
    assert first.certificate is None

    stop = FIRST_SEED + 1
    world = World(real, reach)
    second = certified(world, monkeypatch)
    assert (second.status, second.target) == (Status.INTERRUPTED, world.aims[0])
    assert low(second) >= ASKED


def test_ctrl_c_in_a_later_plan_keeps_the_one_before(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(real, lambda *_: (0.5, 0.5), later(Status.INTERRUPTED))
    found = certified(world, monkeypatch)
    assert (found.status, found.target) == (Status.INTERRUPTED, world.aims[0])
    assert low(found) < ASKED


def test_a_round_that_has_no_plan_ends_it(real: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a certificate, unless an earlier round has one."""

    short = certified(World(real, lambda *_: (0.5, 0.5), later(Status.INFEASIBLE)), monkeypatch)
    assert (short.status, short.certificate) == (Status.INFEASIBLE, None)
    more = certified(World(real, lambda *_: (0.95, 0.95), later(Status.INFEASIBLE)), monkeypatch)
    assert more.status is Status.CONVERGED
    assert low(more) >= ASKED


def test_a_round_without_a_verdict_leaves_the_nearest(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(real, lambda *_: (0.89, 0.89), later(Status.MAX_ITERATIONS))
    short = certified(world, monkeypatch)
    assert (short.status, short.target) == (Status.CONVERGED, world.aims[0])
    assert low(short) < ASKED
    first = World(real, lambda *_: (0.89, 0.89), lambda *_: Status.STALLED)
    none = certified(first, monkeypatch)
    assert (none.status, none.certificate) == (Status.STALLED, None)


def test_the_watch_sees_flights_begin_and_end(real: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, bool, int, int]] = []

    def watch(number: int, plan: Plan, samples: int, flown: int = 0) -> None:
        seen.append((number, plan.certificate is not None, samples, flown))

    world = World(real, lambda *_: (NEEDED, NEEDED))
    world.enter(monkeypatch)
    certify(real.mission, world.start, world.make_plan, watch)
    assert seen == [
        *((1, False, 10_000, 0), (1, False, 10_000, 10_000)),
        (1, True, 10_000, 0),
    ]


def test_chance_neither_wastes_much_nor_breaks_the_promise(
    real: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flights drawn from the binomial law, with losses that a plan does not know.

    Whoever stops at the first success ends 0.75 standard errors above what is needed in the mean.
    """
    rng = np.random.default_rng(5)
    excess, broken, none = [], 0, 0
    for case in range(240):
        loss = ndtri(NEEDED) - ndtri(NEEDED - (case % 5 - 1.0) * ERROR)
        samples = flights_needed(ASKED)

        def truth(target: float, loss: float = loss) -> float:
            return float(ndtr(ndtri(target) - loss))

        def reach(target: float, _: int, samples: int = samples) -> Reached:
            return (share := rng.binomial(samples, truth(target)) / samples), share

        with monkeypatch.context() as patch:
            found = certified(World(real, reach), patch)
        assert found.target is not None
        none += low(found) < ASKED
        broken += truth(found.target) < ASKED
        excess.append((truth(found.target) - NEEDED) / ERROR)
    assert -0.2 < np.mean(excess) < 0.55
    assert np.quantile(excess, 0.95) < 1.7
    assert broken <= 2
    assert none <= 3


@given(asked=st.floats(0.5, 0.9996))
def test_flights_are_enough_for_a_few_hundred_failures(asked: float) -> None:
    assert flights_needed(asked) >= max(10_000, 300 / (1.0 - asked)) - 1e-6


def test_a_probability_that_takes_too_many_flights_is_refused() -> None:
    with pytest.raises(InputError) as error:
        flights_needed(1.0 - 1e-7)
    assert error.value.entry == "risk.p_chance"
    assert error.value.given == "0.9999999"
    assert "at most 0.9997, or certify=False" in error.value.allowed
    assert flights_needed(0.9997) == 1_000_000
