"""The summary of flights: the file as before and the plan's hash, read as written or refused."""

import json
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scp_recon.cli.commands import montecarlo
from scp_recon.errors import InputError
from scp_recon.jobs.job import here
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightTally, fly_many, narrow
from scp_recon.monte_carlo.limits import ALL, SCIENCE
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import (
    COMPONENTS,
    FILE_NAME,
    SCHEMA,
    WIDER,
    Summary,
    missed_by_law,
    read_summary,
)
from scp_recon.monte_carlo.whole_flight import SampledFlights
from scp_recon.results.solution import Solution
from scp_recon.verification.causes import shortfalls
from scp_recon.verification.probabilities import (
    joint_probabilities,
    required_probability,
    wider_than_law,
)
from tests import reliability
from tests.helpers import usually
from tests.scp_recon.support import file_of, mission_of, numbers, with_value

Data = dict[str, Any]


@pytest.fixture(scope="module")
def flown(mission, solution) -> FlightTally:
    """Few flights: a single batch, whose means have no interval."""
    return fly_many(Flyer(mission, solution.burns_m_s), samples=40)


@pytest.fixture(scope="module")
def summary(flown, solution) -> Summary:
    return summarise(flown, solution)


@pytest.fixture(scope="module")
def data(summary, tmp_path_factory) -> Data:
    path = summary.write(tmp_path_factory.mktemp("written"))
    parsed: Data = json.loads(path.read_text("utf-8"))
    return parsed


def refused(path: Path, content: str) -> InputError:
    path.write_text(content, "utf-8")
    with pytest.raises(InputError) as caught:
        read_summary(path)
    assert str(path) in caught.value.entry
    reliability.count(reliability.BAD_INPUTS)
    return caught.value


def test_file_has_known_keys_and_plan_hash(data, solution):
    assert list(data) == [
        *("schema", "plan_hash", "samples", "seed", "truth", "planned_gravity", "flown_gravity"),
        *("errors", "policy", "confidence"),
        *("planned_dv_m_s", "window_s", "held_s", "entry_s", "exit_s", "probability"),
        *("whole_flight", "closest_m", "executed_dv_m_s", "terminal"),
    ]
    assert data["schema"] == SCHEMA == "scp_recon.montecarlo/1"
    assert data["plan_hash"] == solution.plan_hash
    assert set(data["held_s"]) == {*SCIENCE, ALL}
    assert all(sum(held["histogram"]["count"]) == 40 for held in data["held_s"].values())
    assert set(data["terminal"]["sigma_ratio"]) == set(COMPONENTS)


def test_flights_of_another_plan_are_not_summarised(mission, solution, flown):
    doubled = Flyer(mission, 2.0 * solution.burns_m_s)
    with pytest.raises(ValueError, match="another plan"):
        summarise(fly_many(doubled, samples=20), solution)
    risk = solution.scenario.risk.model_copy(update={"p_chance": 0.8})
    scenario = solution.scenario.model_copy(update={"risk": risk})
    with pytest.raises(ValueError, match="another plan"):
        summarise(flown, replace(solution, scenario=scenario))


def test_round_trip_through_file_and_folder(summary, tmp_path):
    path = summary.write(tmp_path)
    assert path == tmp_path / FILE_NAME
    assert read_summary(path) == read_summary(tmp_path) == summary
    before = path.read_bytes()
    assert read_summary(tmp_path).write(tmp_path).read_bytes() == before


def test_every_number_is_a_number(tmp_path, data):
    places = list(numbers(data))
    assert len(places) > 100
    for where, value in zip(
        usually(places[::5] + places, 25), cycle([True, False, "1", [1.0], True]), strict=False
    ):
        wrong = json.dumps(with_value(data, where, value))
        assert str(where[0]) in refused(tmp_path / FILE_NAME, wrong).entry


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("truth",), "otherwise"),
        (("plan_hash",), 5),
        (("window_s",), [1.0]),
        (("held_s",), {}),
        (("probability",), {}),
        (("entry_s",), {"samples": 3}),
        (("held_s", ALL, "histogram", "count"), []),
        (("held_s", ALL, "mean", "note"), 1.0),
        (("terminal", "normality", "x", "levels"), [0.5]),
    ],
)
def test_parts_that_do_not_fit_together_are_refused(tmp_path, data, path, value):
    wrong = json.dumps(with_value(data, path, value))
    assert path[0] in str(refused(tmp_path / FILE_NAME, wrong))


@pytest.fixture(scope="module")
def many(mission, solution) -> Summary:
    return summarise(fly_many(Flyer(mission, solution.burns_m_s), samples=1000), solution)


@pytest.mark.slow
def test_flights_tell_what_the_verification_tells(mission, solution, many):
    """The safety distance too, which counts in the whole flight: here nearest after the window."""
    names = [one.name for one in joint_probabilities(mission, solution.burns_m_s)[0]]
    assert [*many.probability] == [*names, ALL]
    nearer = mission.changed({"safety.radius_min_m": 750.0})
    config = Flyer(nearer, solution.burns_m_s)
    flown = fly_many(config, samples=1000)
    at, lowest = flown.worst_probability("safety_radius")
    assert at > nearer.observed_s[1]
    sampled = SampledFlights(nearer, solution.burns_m_s)
    draws = Flyer(nearer, solution.burns_m_s).draws(0)
    kept = sampled.judged(draws).kept["safety_radius"][1].sum(axis=1)
    assert lowest.value == pytest.approx(kept.min() / 1000, abs=2e-3)
    assert flown.whole <= kept.min()
    _, in_strata = narrow(config, 1000, 0.03, 11_000, here)["safety_radius"]
    assert 1.0 - in_strata.failed == pytest.approx(lowest.value, abs=0.05)


def requiring(solution: Solution, p: float) -> Solution:
    return replace(solution, scenario=solution.scenario.replace({"risk.p_chance": p}))


@pytest.mark.slow
@pytest.mark.parametrize(("until", "status"), [("30%", 0), ("5%", 4)])
def test_an_interval_that_stays_too_wide_is_told(until, status, solution, tmp_path, capsys):
    """Where the flights allowed are too few to narrow it."""
    solution.write(tmp_path)
    assert montecarlo.main([str(tmp_path), "--samples", "300", "--until", until]) == status
    said = " ".join(capsys.readouterr().out.split())
    assert ("%, required 5 %" in said) == bool(status)


def test_shortfalls_name_value_and_requirement(many, solution):
    assert shortfalls(many, solution) == []
    found = shortfalls(many, requiring(solution, 0.99))
    short = {n for n, p in many.probability.items() if p.estimate.value < 0.99} - {ALL}
    assert "site_distance" in short
    assert {line.split()[0] for line in found} == short
    assert all(line.endswith("required 0.99") for line in found)
    certain = replace(requiring(solution, 0.99), problem="P3")
    assert required_probability(certain) is None
    assert shortfalls(many, certain) == []
    infeasible = replace(solution, status="infeasible")
    assert shortfalls(many, infeasible) == ["the plan is infeasible, required converged"]


@pytest.mark.parametrize("entry", ["gm_m3_s2=4", "reference_radius_m=280", "j2=0.01", "name"])
def test_packaged_field_refuses_another_body(entry, mission, solution):
    """Even where all the figures of another body are Bennu's."""
    if entry == "name":
        other, words = (
            Mission.from_scenario(file_of(solution.scenario, {}, "Vesta")),
            "nothing for Vesta",
        )
    else:
        other, words = mission_of(f"body.{entry}"), f"body.{entry}".replace("=", " ")
    with pytest.raises(InputError, match=words):
        Flyer(other, solution.burns_m_s, truth="harmonics")
    Flyer(mission, solution.burns_m_s, truth="harmonics")


def test_spread_beyond_linear_law_names_its_axis():
    assert missed_by_law({"x": 0.5, "vy": WIDER}) is None
    told = missed_by_law({"x": 1.0, "vz": 1.87, "vx": 1.26})
    assert "vz 1.87, vx 1.26 in J2000" in told
    assert "x 1.00" not in told


def test_verification_and_flights_miss_the_same_axes(mission, solution):
    """The covariance stored for the end is halved along one velocity: both see it there."""
    covariance = [list(map(list, rows)) for rows in solution.nodes.covariance]
    for i in range(6):
        covariance[-1][4][i] *= 0.5
        covariance[-1][i][4] *= 0.5
    nodes = replace(solution.nodes, covariance=covariance)
    narrowed = replace(solution, nodes=nodes)
    flown = fly_many(Flyer(mission, solution.burns_m_s), samples=1000)
    _, ends = joint_probabilities(mission, solution.burns_m_s)
    stored = np.array([covariance[-1], solution.nodes.covariance[-1]])
    assert "vy" in wider_than_law(ends, stored[0])
    assert "vy" not in wider_than_law(ends, stored[1])
    assert "vy" in summarise(flown, narrowed).terminal.missed
