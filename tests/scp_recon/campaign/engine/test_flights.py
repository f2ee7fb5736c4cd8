"""Monte Carlo on the runners of campaigns: the same tallies to the last bit, however it is split."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import fields
from functools import partial

import numpy as np
import pytest

from scp_recon.campaign.engine.flights import in_order
from scp_recon.campaign.rows.case import DIED, Case, Done, Runner, Work, attempt, trouble
from scp_recon.campaign.runners.here import here
from scp_recon.campaign.runners.processes import Processes
from scp_recon.errors import InputError
from scp_recon.monte_carlo.flights import FlightConfig, FlightTally, fly_many
from scp_recon.planning.plan import Plan
from tests.scp_recon.campaign.support import LIMITS

SAMPLES = 3_400


def backwards(work: Work, cases: Iterable[Case]) -> Generator[Done, None, None]:
    yield from (attempt(work, case) for case in reversed(list(cases)))


def failing(work: Work, cases: Iterable[Case]) -> Generator[Done, None, None]:
    for case in cases:
        done = attempt(work, case)
        yield done._replace(found=trouble(DIED, "of hunger")) if case.number == 2 else done


def same(one: FlightTally, other: FlightTally) -> bool:
    names = [field.name for field in fields(FlightTally) if field.name != "config"]
    return all(_equal(getattr(one, name), getattr(other, name)) for name in names)


def _equal(a: object, b: object) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_equal(a[key], b[key]) for key in a)
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)  # type: ignore[arg-type]
    return repr(a) == repr(b)


@pytest.fixture(scope="module")
def config(default_plan: Plan) -> FlightConfig:
    return FlightConfig(default_plan.mission, default_plan.burns_m_s, seed=3)


@pytest.fixture(scope="module")
def alone(config: FlightConfig) -> FlightTally:
    return fly_many(config, samples=SAMPLES)


@pytest.mark.parametrize("runner", [here, backwards, Processes(2, LIMITS)])
def test_tallies_are_the_same_for_any_split(
    runner: Runner, config: FlightConfig, alone: FlightTally
) -> None:
    assert same(fly_many(config, samples=SAMPLES, blocks=partial(in_order, runner)), alone)


def test_what_was_begun_is_continued(config: FlightConfig, alone: FlightTally) -> None:
    begun = fly_many(config, samples=2_000)
    flown = fly_many(config, samples=SAMPLES, blocks=partial(in_order, here), begun=begun)
    assert same(flown, alone)


def test_it_stops_on_the_width_of_the_intervals(config: FlightConfig) -> None:
    flown = fly_many(config, samples=10**7, until=0.03, blocks=partial(in_order, here))
    assert same(flown, fly_many(config, samples=10**7, until=0.03))
    assert flown.widest_interval() <= 0.03
    assert flown.samples < SAMPLES


def test_a_block_that_cannot_be_flown_is_told(config: FlightConfig) -> None:
    with pytest.raises(InputError, match="block 2, died: of hunger"):
        fly_many(config, samples=SAMPLES, blocks=partial(in_order, failing))
