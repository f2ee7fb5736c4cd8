"""Verification: it confirms a right solution, and every wrong one is found out."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.results.read import parse_solution
from scp_recon.results.solution import Solution, make_solution
from scp_recon.verification.consistency import inconsistencies
from scp_recon.verification.reintegration import FIGURES, limits_of, not_executed, verify
from tests.helpers import usually
from tests.scp_recon.support import mission_of

pytestmark = pytest.mark.slow

Change = Callable[[dict[str, Any]], object]


def test_default_solution_is_confirmed(mission, solution, verification):
    """Every probability and every constraint is looked at, the same every time."""
    v = verification
    assert (v.ok, v.failed) == (True, [])
    assert v.terminal_position_error_m < 1.0
    assert v.terminal_velocity_error_m_s < 1e-4
    assert v.covariance_error < 1e-6
    assert v.max_defect < 1e-2
    names = {"safety_radius", "site_distance", "emission", "phase", "battery_observation"}
    assert {p.name for p in v.probabilities} == names
    assert all(p.low <= p.estimate <= p.high and p.estimate >= 0.70 for p in v.probabilities)
    margins = {m.name: m for m in v.mean_margins}
    assert set(margins) >= {
        *("safety_radius", "site_distance_min", "site_distance_max", "emission_min"),
        *("emission_max", "phase_min", "battery_observation", "dv_max", "dv_battery"),
    }
    assert all(m.worst_margin > 0.0 for m in margins.values())
    assert 0.0 <= margins["safety_radius"].worst_t_s <= 34_842.0
    assert 13_139.0 <= margins["emission_max"].worst_t_s <= 16_539.0
    assert verify(mission, solution) == v


def test_integration_limits_grow_with_a_large_body(mission):
    """Those of the default mission are centimetres and metres to the last digit."""
    limits = {name: limit for name, (_, _, limit) in FIGURES.items()}
    assert limits_of(mission) == pytest.approx(limits)
    large = replace(mission, units=replace(mission.units, length_m=50.0 * mission.units.length_m))
    grown = {name: limit * (50.0 if FIGURES[name][1] else 1.0) for name, limit in limits.items()}
    assert limits_of(large) == pytest.approx(grown)


@pytest.mark.usefixtures("few_flights")
def test_p3_is_verified_without_probabilities_but_not_p2(mission, p3):
    checked = verify(mission, p3)
    assert checked.ok
    # What P2 is for; an independent prototype's lowest joint probability per node is one half.
    assert min(p.estimate for p in checked.probabilities) == pytest.approx(0.50, abs=0.05)
    as_p2 = verify(mission, replace(p3, problem="P2"))
    assert not as_p2.ok
    assert all(name.startswith("P(") or name == "facets" for name in as_p2.failed)


def changed(solution: Solution, *changes: Change) -> Solution:
    """As its file says after changes by hand."""
    data = json.loads(solution.text())
    for change in changes:
        change(data)
    return parse_solution(data, "changed")


def moved(*path: str | int, by: float = 0.0, times: float = 1.0) -> Change:
    """A number of the file, scaled and shifted."""

    def change(data: Any) -> None:
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = times * data[path[-1]] + by

    return change


FALSIFIED: dict[str, Change] = {
    "a burn's component": moved("burns", 1, "dv_m_s", 0, by=1e-3),
    "a burn's time": moved("burns", 1, "t_s", by=300.0),
    "a node's position": moved("nodes", "state", 70, 1, by=1.0),
    "a node's time": moved("nodes", "t_s", 70, by=20.0),
    "a variance": moved("nodes", "covariance", 70, 0, 0, times=1.001),
    "a correlation": lambda data: [
        moved("nodes", "covariance", 70, i, j, times=-1.0)(data) for i, j in ((0, 1), (1, 0))
    ],
    "a velocity's variance": moved("nodes", "covariance", 70, 5, 5, times=2.0),
    "the first variance": moved("nodes", "covariance", 0, 0, 0, times=1.01),
    "a node's velocity": moved("nodes", "state", 70, 4, by=1e-3),
    "the first node": moved("nodes", "state", 0, 0, by=1.0),
    "the last node": moved("nodes", "state", -1, 0, by=1.0),
    "the total": moved("total_dv_m_s", times=0.5),
}


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize("name", usually([*FALSIFIED], 2))
def test_a_falsified_solution_is_found_out(mission, solution, name):
    checked = verify(mission, changed(solution, FALSIFIED[name]))
    assert not checked.ok
    assert checked.failed


def told(data: dict[str, Any], name: str) -> dict[str, Any]:
    found: dict[str, Any] = next(c for c in data["constraints"] if c["name"] == name)
    return found


def facet_of(data: dict[str, Any], name: str) -> int:
    return int(data["facets"]["constraint"].index(name))


def scaled_normal(data: dict[str, Any], row: int, factor: float) -> None:
    data["facets"]["normal"][row] = [factor * x for x in data["facets"]["normal"][row]]


def amount(largest: float, total: float) -> dict[str, Any]:
    return {"max": largest, "total": total, "unit": "m"}


CONTRADICTING: dict[str, list[Change]] = {
    "constraints": [
        moved("constraints", 3, "worst_margin", by=0.01),
        lambda s: moved("worst_margin", by=1e-6)(told(s, "dv_max")),
        lambda s: s["constraints"].pop(2),
        lambda s: s["constraints"].append({**s["constraints"][2], "name": "moonlight"}),
        lambda s: s["constraints"][3].update(worst_t_s=-99.0),
        lambda s: told(s, "dv_max").update(
            worst_t_s=25_000.0 * (told(s, "dv_max")["worst_t_s"] != 25_000.0)
        ),
        lambda s: s["constraints"][2].update(facets=1 + s["constraints"][2]["facets"]),
        lambda s: s["constraints"][2].update(
            kind={"keep_in": "keep_out"}.get(s["constraints"][2]["kind"], "keep_in")
        ),
        lambda s: s["constraints"][2].update(unit="m/s"),
        lambda s: s["constraints"].append(s["constraints"][2]),
    ],
    "violation": [
        lambda s: s["violation"]["by_constraint"].update(emission_max=amount(1.0, 1.0)),
        lambda s: s["violation"]["by_constraint"].update(emission_max=amount(0.0, 0.0)),
        lambda s: s["violation"].update(max=1.0),
        lambda s: s["violation"].update(total=1.0),
        lambda s: s["violation"].update(total=5e-324),
        # Too small to contradict the margins: but where something is violated nothing has converged.
        lambda s: s.update(
            violation={
                "max": 1e-3,
                "total": 1e-1,
                "by_constraint": {"safety_radius": amount(1e-3, 1e-1)},
            }
        ),
    ],
    "facets": [
        lambda s: s.update(facets=None),
        lambda s: [column.pop(0) for column in s["facets"].values()],
        lambda s: [column.clear() for column in s["facets"].values()],
        moved("facets", "quantile", 5, by=-0.01),
        lambda s: moved("offset_m", facet_of(s, "site_distance_min"), by=0.01)(s["facets"]),
        lambda s: scaled_normal(s, facet_of(s, "emission_min"), -1.0),
        lambda s: scaled_normal(s, 5, 0.5),
        lambda s: [
            column.append("moonlight" if name == "constraint" else column[-1])
            for name, column in s["facets"].items()
        ],
    ],
}


@pytest.mark.parametrize("named", CONTRADICTING)
def test_stated_constraints_are_recomputed(mission, solution, named):
    assert inconsistencies(mission, solution) == []
    for number, change in enumerate(CONTRADICTING[named]):
        assert inconsistencies(mission, changed(solution, change)) == [named], number


@pytest.fixture(scope="module")
def p3(mission) -> Solution:
    return make_solution(plan(mission, initial_guess.cold(mission), problem="P3"))


@pytest.fixture(scope="module")
def infeasible() -> tuple[Mission, Solution]:
    """Burns too small for the flight: buffers of metres and of metres a second hold something."""
    case = mission_of("burns.dv_max_m_s=0.03")
    return case, make_solution(plan(case, initial_guess.cold(case)))


def test_constraints_of_p3_and_infeasible_plans_are_recomputed(mission, p3, infeasible):
    for case, found in ((mission, p3), infeasible):
        assert inconsistencies(case, found) == []


OTHER_UNIT = {"m": "m/s", "m/s": "m"}


def test_inconsistent_violation_is_named(infeasible):
    """Of the whole but for rounding, or of one constraint by more than that."""
    case, found = infeasible
    parts = [("violation", "by_constraint", name) for name in found.violation.by_constraint]
    assert {part.unit for part in found.violation.by_constraint.values()} == {"m", "m/s"}
    changes = [
        moved(*place, figure, times=factor)
        for figure in ("max", "total")
        for factor in (0.0, 1.0 - 1e-6, 1.0 + 1e-6, 1e6)
        for place in [("violation",), *(parts if abs(factor - 1.0) > 0.1 else [])]
    ]
    # Tenfold, in the whole too, so that the sums agree, but not the margins; in the wrong unit.
    tenfold = [moved(*place, "total", times=10.0) for place in [("violation",), *parts]]
    for each in (*([change] for change in changes), tenfold, [in_other_units]):
        assert inconsistencies(case, changed(found, *each)) == ["violation"]


def in_other_units(data: dict[str, Any]) -> None:
    for part in data["violation"]["by_constraint"].values():
        part["unit"] = OTHER_UNIT[part["unit"]]


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize(
    ("override", "named"),
    usually(
        [
            ("risk.p_chance=0.99", "P(emission)"),
            ("uncertainty.execution_error=0.16", "covariance_error"),
            ("burns.dv_max_m_s=0.04", "dv_max"),
            ("battery.delta_v_cone_deg=80", "dv_battery"),
            ("safety.radius_min_m=800", "safety_radius"),
            ("observation.site_distance_max_m=560", "site_distance_max"),
            ("observation.site_distance_min_m=600", "site_distance_min"),
            ("observation.emission_min_deg=30", "emission_min"),
            ("observation.emission_max_deg=35", "emission_max"),
            ("observation.phase_min_deg=85", "phase_min"),
            ("observation.phase_max_deg=60", "phase_max"),
            ("battery.observation_cone_deg=85", "battery_observation"),
        ],
        2,
    ),
)
def test_each_constraint_that_the_plan_breaks_is_named(solution, override, named):
    """The same plan under a stricter limit."""
    checked = verify(mission_of(override), solution)
    assert not checked.ok
    assert named in checked.failed
    assert "P(phase)" not in checked.failed or "phase" in override


@pytest.mark.usefixtures("few_flights")
def test_constraints_are_checked_between_the_nodes(mission, solution):
    """The same plan known only at its burns and the window's edges, where every limit is kept."""
    coarse = mission_of("grid.step_max_s=40000", "observation.emission_max_deg=38")
    keep = np.flatnonzero(np.isin(mission.times_s, coarse.times_s))

    def thin(data: dict[str, Any]) -> None:
        data["nodes"] = {
            name: values and [values[k] for k in keep.tolist()]
            for name, values in data["nodes"].items()
        }

    thinned = changed(solution, thin)
    assert len(thinned.nodes.t_s) == 6
    at = coarse.window_nodes
    site = geometry.track(mission.site, mission.rotation, np.array(thinned.nodes.t_s)[at])
    emission = geometry.emission(np.array(thinned.nodes.state)[at, :3], site)
    assert np.rad2deg(emission).max() < 37.9
    checked = verify(coarse, thinned)
    # The facets of the nodes that are gone are nobody's any more.
    assert checked.failed == ["facets", "emission_max", "P(emission)"]
    (margin,) = (m for m in checked.mean_margins if m.name == "emission_max")
    (probability,) = (p for p in checked.probabilities if p.name == "emission")
    for time in (margin.worst_t_s, probability.worst_t_s):
        assert 13_200.0 < time < 16_500.0


@pytest.mark.usefixtures("few_flights")
def test_burns_too_small_to_execute_fail(mission, solution):
    """Each by its number; a burn of zero or rounding's size, and one just at the limit, do not fail."""
    sizes = np.linalg.norm(solution.burns_m_s, axis=1)
    small = np.flatnonzero((sizes > 0.0) & (sizes < 0.045))
    least = mission.changed({"burns.dv_min_m_s": 0.045})
    checked = verify(least, replace(solution, scenario=least.scenario))
    named = [name for name in checked.failed if name.startswith("dv_min")]
    assert named == [f"dv_min of burn {1 + i}" for i in small]
    assert 0 < len(small) < len(sizes)
    at_limit = mission.changed({"burns.dv_min_m_s": float(sizes[sizes > 0.0].min())})
    assert not_executed(at_limit, replace(solution, scenario=at_limit.scenario)) == []
    tiny = np.where((sizes == sizes.min())[:, None], 1e-9, solution.burns_m_s)
    burns = [replace(b, dv_m_s=tuple(dv)) for b, dv in zip(solution.burns, tiny, strict=True)]
    without = not_executed(least, replace(solution, scenario=least.scenario, burns=burns))
    assert without == [name for name in named if name != f"dv_min of burn {1 + sizes.argmin()}"]
