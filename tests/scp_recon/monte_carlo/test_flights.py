"""Tallies of flights depend on their configuration alone; intervals narrow as promised."""

import json
import pickle
import signal
import threading
from collections.abc import Generator, Iterable, Iterator
from dataclasses import fields, replace

import numpy as np
import pytest

from scp_recon.api import flying as api
from scp_recon.cli.command import asked_to_stop
from scp_recon.cli.commands import montecarlo
from scp_recon.errors import InputError
from scp_recon.jobs.job import DIED, Done, Failure, Job, Work, attempt
from scp_recon.jobs.processes import Processes
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo import flights
from scp_recon.monte_carlo.flights import FlightTally, fly_many
from scp_recon.monte_carlo.limits import ALL
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import FILE_NAME, read_summary
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.reports.flight_tables import flown_probabilities_table
from scp_recon.results.solution import Solution, make_solution
from tests.helpers import usually
from tests.scp_recon.jobs.support import backwards
from tests.scp_recon.monte_carlo.test_closed_loop import case_of
from tests.scp_recon.simulation.short_plan import SHORT, short_plan
from tests.scp_recon.support import mission_of

SAMPLES = 3_400


def test_until_stops_at_the_width_asked(mission, solution):
    config = Flyer(mission, solution.burns_m_s)
    stopped = fly_many(config, samples=20_000, until=0.03)
    assert stopped.widest_interval() <= 0.03
    assert stopped.samples < 20_000
    earlier = fly_many(config, samples=stopped.samples - 1000)
    assert earlier.widest_interval() > 0.03


@pytest.fixture(scope="module")
def certain() -> Mission:
    return mission_of("uncertainty.initial_sigma_fraction=0", "uncertainty.execution_error=0")


def test_certain_flights_have_no_spread(certain, tmp_path, capsys):
    make_solution(plan(certain, initial_guess.cold(certain))).write(tmp_path)
    assert montecarlo.main([str(tmp_path), "--samples", "50"]) == 0

    def no_constant(text: str) -> None:
        raise AssertionError(f"{text} is no JSON")

    text = (tmp_path / FILE_NAME).read_text("utf-8")
    report = json.loads(text, parse_constant=no_constant)
    terminal = report["terminal"]
    assert (terminal.pop("sigma_ratio"), terminal.pop("normality")) == ({}, {})
    assert terminal.keys() == {"sigma_position_m", "sigma_velocity_m_s"}
    # The mean of equal states may differ from each by rounding.
    assert max(max(size.values()) for size in terminal.values()) < 1e-12
    assert "no component spreads" in capsys.readouterr().out


def failing(work: Work, jobs: Iterable[Job]) -> Generator[Done, None, None]:
    for job in jobs:
        done = attempt(work, job)
        yield done._replace(failure=Failure(DIED, "of hunger")) if job.key == 2 else done


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
def config(default_plan) -> Flyer:
    return Flyer(default_plan.mission, default_plan.burns_m_s, seed=3)


@pytest.fixture(scope="module")
def alone(config) -> FlightTally:
    return fly_many(config, samples=SAMPLES)


@pytest.mark.slow
@pytest.mark.parametrize("executor", usually([backwards, Processes(2)], 1))
def test_tallies_are_the_same_for_any_split(executor, config, alone):
    assert same(fly_many(config, samples=SAMPLES, executor=executor), alone)


@pytest.fixture(scope="module")
def narrowed(config) -> Iterator[FlightTally]:
    """Flights to a width that takes some 20,000 plain ones."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "PLAIN", 1_000)
        yield fly_many(config, samples=10_000, until=0.008)


@pytest.mark.slow
def test_few_flights_narrow_what_takes_many(config, narrowed):
    assert narrowed.samples == 1_000
    assert narrowed.widest_interval() <= 0.008
    assert_narrowed(narrowed, fly_many(config, samples=4_000))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "until"), [("other errors", 0.02), ("corrections", 0.004)])
def test_few_flights_narrow_what_errors_and_corrections_change(
    kind, until, config, solution, monkeypatch
):
    monkeypatch.setattr(flights, "PLAIN", 1_000)
    config = replace(config, errors="gates")
    if kind == "corrections":
        case = case_of(3600.0, solution, "uncertainty.execution_error=0.05")
        config = Flyer(case.mission, case.burns_m_s, seed=3, policy=case.policy)
    found = fly_many(config, samples=10_000, until=until)
    assert found.widest_interval() <= until
    assert_narrowed(found, fly_many(config, samples=3_000))


def assert_narrowed(narrowed: FlightTally, plain: FlightTally) -> None:
    """Few of many draws have been flown, and say what plain flights say."""
    for _, counted in narrowed.narrowed.values():
        assert sum(counted.flown) < 0.25 * sum(counted.drawn)
    for name in plain.node_counts:
        (_, one), (_, other) = narrowed.worst_probability(name), plain.worst_probability(name)
        assert max(one.low, other.low) <= min(one.high, other.high)


@pytest.mark.slow
def test_narrowed_probabilities_are_the_same_for_any_split(config, narrowed, monkeypatch):
    def sent(work: Work, jobs: Iterable[Job]) -> Generator[Done, None, None]:
        """As to another process."""
        yield from backwards(pickle.loads(pickle.dumps(work)), jobs)

    monkeypatch.setattr(flights, "PLAIN", 1_000)
    monkeypatch.setattr(flights, "BLOCKS", 7)
    other = fly_many(config, samples=10_000, until=0.008, executor=sent)
    assert other.narrowed == narrowed.narrowed


@pytest.mark.slow
def test_no_interval_is_replaced_by_a_wider_one(config, narrowed):
    """Where hardly a flight fails, the plain ones' is narrower."""
    plain = fly_many(config, samples=narrowed.samples)
    few = {name for name in plain.node_counts if narrowed.is_narrowed(name)}
    assert few == {"site_distance", "emission", ALL}
    for name in plain.node_counts:
        found, before = narrowed.worst_probability(name), plain.worst_probability(name)
        assert found[1].width < before[1].width if name in few else found == before


def test_a_summary_tells_the_flights_that_narrowed_it(solution, narrowed, tmp_path):
    summary = summarise(narrowed, solution)
    summary.write(tmp_path)
    read = read_summary(tmp_path)
    assert read == summary
    assert read.samples == 1_000
    table = flown_probabilities_table(read, 0.7)
    few = f"{read.strata.draws} draws, {read.strata.flights} flown"
    assert {row[0].text: row[-1].text for row in table.rows} == {
        "safety_radius": "1000 flights",
        "site_distance": few,
        "emission": few,
        "phase": "1000 flights",
        "battery_observation": "1000 flights",
        "all at once": few,
        "all limits, whole flight": "1000 flights",
    }
    assert table.note
    assert read.probability["emission"].estimate == narrowed.worst_probability("emission")[1]


@pytest.mark.slow
def test_stopped_or_few_flights_are_not_narrowed(config, monkeypatch):
    monkeypatch.setattr(flights, "PLAIN", 1_000)
    few = fly_many(config, samples=1_500, until=0.008)
    assert (few.samples, few.narrowed) == (1_500, {})
    told: list[int] = []
    stopped = fly_many(
        config, samples=10_000, until=0.008, stop=lambda: told.append(0) or len(told) > 2
    )
    assert (stopped.samples, stopped.narrowed) == (1_000, {})


def test_failed_block_is_named(config):
    with pytest.raises(InputError, match="block 2, died"):
        fly_many(config, samples=SAMPLES, executor=failing)


@pytest.fixture(scope="module")
def tame() -> Solution:
    return short_plan(mission_of(*SHORT))


def test_second_ctrl_c_ends_at_once():
    with asked_to_stop() as stop:
        assert not stop()
        signal.raise_signal(signal.SIGINT)
        assert stop()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    heard: list[bool] = []

    def work() -> None:
        with asked_to_stop() as stop:
            heard.append(stop())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert heard == [False]


def test_interrupted_flights_are_summarised(tame, tmp_path, monkeypatch, capsys):
    tame.write(tmp_path)
    fly = api.fly_many

    def pressed(*given: object, **options: object) -> object:
        signal.raise_signal(signal.SIGINT)
        return fly(*given, **options)

    monkeypatch.setattr(api, "fly_many", pressed)
    assert montecarlo.main([str(tmp_path), "--samples", "2000", "--json"]) == 130
    said = capsys.readouterr()
    assert json.loads(said.out)["samples"] == 1000
    assert "1000 of 2000 flights" in said.err
    whole = fly(Flyer(tame.mission, tame.burns_m_s), samples=1000)
    assert read_summary(tmp_path) == summarise(whole, tame)
