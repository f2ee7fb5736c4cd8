"""Rounds aim as high as a test takes and no higher, and only tests judge, by the binomial law."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr, ndtri
from scipy.stats import binom

from scp_recon.certification import flights
from scp_recon.certification.certify import Aiming, certify
from scp_recon.certification.flights import certificate_of
from scp_recon.errors import InputError
from scp_recon.monte_carlo import estimates
from scp_recon.monte_carlo.estimates import (
    FIRST_SEED,
    TESTS_MAX,
    Estimate,
    flights_needed,
    flights_of_test,
    seed_of_test,
    successes_needed,
)
from scp_recon.monte_carlo.whole_flight import KeptCounts
from scp_recon.planning.plan import Plan
from scp_recon.scp.status import Status
from tests.scp_recon.certification.support import Reached, World, a_plan

ASKED = 0.9
ROUND, TEST = flights_needed(ASKED), flights_of_test(ASKED)
AIMING = Aiming(ASKED, ROUND, TEST)
NEEDED, ERROR = AIMING.needed, AIMING.error
AIMED = AIMING.next()
"""What the first plan aims at."""
TEST_SEEDS = [seed_of_test(number + 1) for number in range(TESTS_MAX)]


@pytest.fixture(scope="module")
def real() -> Plan:
    return a_plan(ASKED)


def certified(world: World, patch) -> Plan:
    world.enter(patch)
    return certify(world.real.mission, world.start, world.make_plan)


def losing(deviations: float) -> Callable[[float, int], Reached]:
    """Flights that reach less than the law says, always by as much."""

    def reach(target: float, _: int) -> Reached:
        return (share := float(ndtr(ndtri(target) - deviations))), share

    return reach


def reaching(*tests: float, rounds: float = AIMED) -> Callable[[float, int], Reached]:
    """Flights that reach as much in all rounds, and so much in each test."""
    table = dict(zip(TEST_SEEDS, tests, strict=False))
    return lambda _, seed: (share := table.get(seed, rounds), share)


def low(plan: Plan) -> float:
    return plan.certificate.low


def steps(plan: Plan) -> tuple[int, int]:
    """Rounds and tests of a certificate."""
    return plan.certificate.rounds, plan.certificate.tests


def later(ending: Status) -> Callable[[float, str], Status]:
    """How all plans but the first end."""
    return lambda _, start: Status.CONVERGED if start == "given" else ending


GAIN = float(ndtri(AIMED + 3.0 * ERROR) - ndtri(AIMED))
"""Standard deviations that are three standard errors of a round."""


@pytest.mark.slow
@pytest.mark.parametrize("lost", [-GAIN, 0.1])
def test_target_moves_against_the_measured_loss(real, monkeypatch, lost):
    """Flights that reach more than the law says, or less, always."""
    found = certified(world := World(real, losing(lost)), monkeypatch)
    assert found.target == world.aims[-1]
    assert (found.target > world.aims[0]) == (lost > 0.0)
    assert steps(found) == (2, 1)
    assert low(found) >= ASKED
    assert found.certificate.reached == pytest.approx(AIMED, abs=0.6 * ERROR)


@pytest.mark.parametrize(
    ("reach", "slack"),
    [(losing(0.0), 0.0), (reaching(1.0), 0.0), (losing(-99.0), 2.0), (losing(-99.0), 40.0)],
)
def test_settled_target_is_tested_unchanged(real, monkeypatch, reach, slack):
    """Whatever the test reaches: who picks the cheapest of several that pass picks the luckiest.

    Where nothing binds a lower aim would save nothing, however sure the law is.
    """
    found = certified(world := World(real, reach, slack=slack), monkeypatch)
    assert world.aims == [found.target]
    assert world.seeds == [FIRST_SEED, TEST_SEEDS[0]]
    assert steps(found) == (1, 1)
    assert low(found) >= ASKED


def test_loss_between_nodes_counts_once(real, monkeypatch):
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
    assert steps(found) == (2, 1)


def test_failed_test_raises_target_for_the_last(real, monkeypatch):
    world = World(real, reaching(NEEDED - ERROR, NEEDED + ERROR))
    found = certified(world, monkeypatch)
    assert world.seeds == [FIRST_SEED, *TEST_SEEDS]
    assert found.target == world.aims[1] > world.aims[0]
    assert (found.certificate.seed, steps(found)) == (TEST_SEEDS[1], (1, 2))
    assert low(found) >= ASKED


@pytest.mark.parametrize("tests", [(0.89, 0.88), (0.88, 0.89)])
def test_two_failed_tests_leave_the_nearest_plan(real, monkeypatch, tests):
    """Whose certificate says that it certifies nothing, though rounds had reached enough."""
    found = certified(world := World(real, reaching(*tests)), monkeypatch)
    assert world.seeds == [FIRST_SEED, *TEST_SEEDS]
    assert found.status is Status.CONVERGED
    assert found.certificate.reached == pytest.approx(0.89)
    assert not found.certificate.certifies(ASKED)
    assert found.target == world.aims[tests.index(0.89)]


@pytest.mark.slow
def test_chance_neither_wastes_much_nor_breaks_the_promise(real, monkeypatch):
    """Flights drawn from the binomial law, with losses that a plan does not know."""
    rng = np.random.default_rng(5)
    excess, rounds, first, broken, none = [], [], 0, 0, 0
    cases = 1000
    for case in range(cases):
        loss = float(ndtri(AIMED) - ndtri(AIMED - (case % 5 - 1.0) * ERROR))

        def truth(target: float, loss: float = loss) -> float:
            return float(ndtr(ndtri(target) - loss))

        def reach(target: float, seed: int) -> Reached:
            samples = TEST if seed in TEST_SEEDS else ROUND
            return (share := rng.binomial(samples, truth(target)) / samples), share

        with monkeypatch.context() as patch:
            found = certified(World(real, reach), patch)
        assert found.target is not None
        passed = low(found) >= ASKED
        first += passed and steps(found)[1] == 1
        none += not passed
        broken += truth(found.target) < ASKED
        rounds.append(steps(found)[0])
        excess.append((truth(found.target) - ASKED) / ERROR)
    assert 0.93 <= first / cases <= 0.97
    assert none <= 6
    assert broken == 0
    assert np.mean(rounds) < 2.1
    assert 3.2 < np.mean(excess) < 3.6
    assert np.quantile(excess, 0.95) < 4.9


def stopped_at(seed: int) -> Callable[[float, int], Reached]:
    def reach(target: float, flown: int) -> Reached:
        if flown == seed:
            raise KeyboardInterrupt
        return target, target

    return reach


@pytest.mark.parametrize(
    ("reach", "ending", "looked"),
    [
        (stopped_at(FIRST_SEED), Status.CONVERGED, False),
        (stopped_at(TEST_SEEDS[0]), Status.CONVERGED, False),
        (losing(2.0), Status.INTERRUPTED, False),
        (reaching(0.89), Status.INTERRUPTED, True),
    ],
)
def test_ctrl_c_keeps_earlier_plan_and_its_test(real, monkeypatch, reach, ending, looked):
    """Among the flights of a round or of the first test no certificate stands behind it."""
    found = certified(world := World(real, reach, later(ending)), monkeypatch)
    assert (found.status, found.target) == (Status.INTERRUPTED, world.aims[0])
    assert (found.certificate is not None) == looked
    assert not looked or low(found) < ASKED


def test_an_aim_that_has_no_plan_ends_it(real, monkeypatch):
    """Without a certificate, unless the plan of an aim before passes its test."""
    ended = later(Status.INFEASIBLE)
    short = certified(world := World(real, reaching(0.5, rounds=0.88), ended), monkeypatch)
    assert (short.status, short.certificate) == (Status.INFEASIBLE, None)
    assert world.seeds == [FIRST_SEED, TEST_SEEDS[0]]
    more = certified(world := World(real, reaching(0.91, rounds=0.88), ended), monkeypatch)
    assert (more.status, more.target) == (Status.CONVERGED, world.aims[0])
    assert low(more) >= ASKED
    after = certified(World(real, reaching(0.89), ended), monkeypatch)
    assert (after.status, after.certificate) == (Status.INFEASIBLE, None)


def test_an_aim_without_a_verdict_leaves_the_nearest(real, monkeypatch):
    for rounds in (0.88, AIMED):
        world = World(real, reaching(0.89, rounds=rounds), later(Status.MAX_ITERATIONS))
        short = certified(world, monkeypatch)
        assert (short.status, short.target) == (Status.CONVERGED, world.aims[0])
        assert low(short) < ASKED
    first = World(real, losing(0.0), lambda *_: Status.STALLED)
    none = certified(first, monkeypatch)
    assert (none.status, none.certificate) == (Status.STALLED, None)
    assert first.seeds == []


@pytest.mark.parametrize(
    ("last", "lost", "ending"),
    [
        (0.5 * (NEEDED + AIMED), 0.0, Status.CONVERGED),
        (0.5 * (NEEDED + AIMED), 0.1, Status.INFEASIBLE),
        (ASKED - 0.01, 0.0, Status.INFEASIBLE),
    ],
    ids=["passes", "fails", "none may suffice"],
)
def test_largest_feasible_target_is_tested(real, monkeypatch, last, lost, ending):
    """The first target has no plan; one test judges the plan for the largest that has one."""

    def status(target: float, _: str) -> Status:
        return Status.INFEASIBLE if target > last else Status.CONVERGED

    found = certified(world := World(real, losing(lost), status), monkeypatch)
    assert found.status is ending
    assert world.seeds == TEST_SEEDS[: last > ASKED]
    if ending is Status.CONVERGED:
        assert last - 0.002 < found.target <= last
        assert low(found) >= ASKED
    else:
        assert (found.target, found.certificate) == (AIMED, None)


def test_the_watch_sees_flights_begin_and_end(real, monkeypatch):
    seen: list[tuple[str, int, int, float | None]] = []

    def watch(
        step: str, _: Plan, samples: int, flown: int = 0, reached: Estimate | None = None
    ) -> None:
        seen.append((step, samples, flown, reached and reached.value))

    world = World(real, lambda *_: (AIMED, AIMED))
    world.enter(monkeypatch)
    certify(real.mission, world.start, world.make_plan, watch)
    assert seen == [
        *(("calibration 1", ROUND, 0, None), ("calibration 1", ROUND, ROUND, None)),
        ("calibration 1", ROUND, ROUND, pytest.approx(AIMED, abs=1.0 / ROUND)),
        *(("test 1", TEST, 0, None), ("test 1", TEST, TEST, None)),
        ("test 1", TEST, TEST, pytest.approx(AIMED, abs=1.0 / ROUND)),
    ]


@given(asked=st.floats(0.5, 0.9996))
def test_flights_are_enough_for_a_few_hundred_failures(asked):
    assert flights_needed(asked) >= max(10_000, 300 / (1.0 - asked)) - 1e-6


def test_too_many_flights_are_refused():
    with pytest.raises(InputError) as error:
        flights_needed(1.0 - 1e-7)
    assert error.value.entry == "risk.p_chance"
    assert error.value.given == "0.9999999"
    assert "at most 0.9997" in error.value.allowed
    assert flights_needed(0.9997) == 1_000_000


WRONGLY = 0.025
"""Most often that a plan may be certifies which reaches just what was required."""
TAIL = 8.0
"""Standard deviations about the mean within which all numbers of successes are tried."""


def certifies(kept: int, samples: int, required: float) -> bool:
    """Whether a test with so many successes certifies a plan, as the code decides it."""
    return certificate_of(KeptCounts(kept, kept, samples), 1, 1).certifies(required)


def passing(required: float, truth: float) -> float:
    """Probability that a test passes a plan, over every number of successes that may come."""
    n = flights_of_test(required)
    middle, width = n * truth, TAIL * np.sqrt(n * truth * (1.0 - truth))
    counts = range(int(middle - width), min(int(middle + width), n) + 1)
    verdicts = np.array([certifies(k, n, required) for k in counts])
    assert not verdicts[0]
    assert verdicts[-1]
    return float(np.sum(binom.pmf(counts, n, truth), where=verdicts))


def wrongly_certified(required: float) -> float:
    """Probability that one of all tests passes, each at a plan that reaches just what is required."""
    return 1.0 - (1.0 - passing(required, required)) ** TESTS_MAX


@pytest.mark.parametrize("required", [0.7, 0.9, 0.99, 0.999])
def test_plan_at_the_requirement_is_rarely_certified(required, monkeypatch):
    """At most 2.5 times in 100, both tests together; with 97.5 % each, as of a single test, more."""
    assert 0.8 * WRONGLY < wrongly_certified(required) <= WRONGLY
    monkeypatch.setattr(flights, "TEST_CONFIDENCE", estimates.CONFIDENCE)
    assert wrongly_certified(required) > 1.5 * WRONGLY


@pytest.mark.slow
@given(required=st.floats(0.5, 0.999), samples=st.integers(1000, 100_000))
def test_needed_successes_are_the_fewest_that_pass(required, samples):
    needed = successes_needed(required, samples)
    assert needed == samples or certifies(needed, samples, required)
    assert not certifies(needed - 1, samples, required)
