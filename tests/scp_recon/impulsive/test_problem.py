"""Problems by hand: known optima, every method, flights with errors, and words for bad input."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import scp_recon as sr
from formulations.arrays import Array
from formulations.problem.flow import ArcDerivatives
from scp_recon.errors import InputError
from scp_recon.impulsive.plan import ImpulsivePlan
from scp_recon.planning.method import ALGORITHMS, FORMULATIONS
from scp_recon.scp.status import Status
from tests.helpers import Arcs

RATE, NODES = 2.0 * np.pi / 5556.0, 25
BURNS = [0, 8, 16, 24]
FACES = np.vstack([np.eye(3), -np.eye(3)])
COVARIANCE = np.diag([2.0, 2.0, 2.0, 0.001, 0.001, 0.001]) ** 2


def hill(r: Any, v: Any, t: Any, p: Any) -> list[Any]:
    """With a push along the track that nobody knows well."""
    del t
    w = p[0]
    return [3.0 * w**2 * r[0] + 2.0 * w * v[1], -2.0 * w * v[0] + p[1], -(w**2) * r[2]]


@pytest.fixture(scope="module")
def flow() -> sr.ExpressionFlow:
    times = np.linspace(0.0, 4000.0, NODES)
    return sr.ExpressionFlow(hill, times, parameters=[RATE, 0.0], substeps=3)


@pytest.fixture(scope="module")
def problem(flow) -> sr.ImpulsiveProblem:
    start, goal = [-200.0, -900.0, 100.0, 0.0, 0.3, 0.0], [0.0, 250.0, 0.0, 0.0, 0.0, 0.0]
    return sr.ImpulsiveProblem(flow, BURNS, start, goal, dv_max=1.0)


@pytest.fixture(scope="module")
def erring(problem) -> sr.ImpulsiveProblem:
    """Out of a ball to the end of its third leg."""
    ball = sr.Keep("out", sr.Ball(np.zeros(3), 250.0), range(1, 17), "ball")
    return replace(
        problem,
        initial_covariance=COVARIANCE,
        errors=sr.GatesErrors(0.0005, 0.005, 0.0005, 0.005),
        regions=[ball],
        probability=0.95,
    )


def test_without_regions_cost_is_the_least(problem):
    """Of two of the burns alone there is one choice: so many of all four can only cost less."""
    plan = problem.solve()
    assert plan.ok
    assert plan.states[-1] == pytest.approx(np.array(problem.final_state), abs=2e-3)
    two = replace(problem, burn_nodes=[0, 24]).solve()
    assert plan.cost <= two.cost * (1.0 + 1e-6)
    other = replace(problem, units=(500.0, 1500.0)).solve()
    assert other.cost == pytest.approx(plan.cost, rel=1e-5)
    flown = np.array(problem.initial_state)
    for node in range(NODES):
        flown = flown if node == 0 else problem.flow.propagate(flown, node - 1)
        if node in BURNS:
            flown[3:] += plan.burns[BURNS.index(node)]
    assert flown == pytest.approx(plan.states[-1], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("formulation", "algorithm"),
    [*((name, "scvx") for name in FORMULATIONS), *(("condensed", name) for name in ALGORITHMS)],
)
def test_every_formulation_and_algorithm_finds_the_optimum(problem, formulation, algorithm):
    plan = problem.solve(formulation=formulation, algorithm=algorithm)
    assert plan.ok
    assert plan.cost == pytest.approx(problem.solve().cost, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("scope", ["node", "flight", "uniform"])
def test_flights_keep_a_region_as_probably_as_planned(erring, scope):
    """Hill's equations are linear: the normal law is exact, but for errors of Gates' products."""
    plan = replace(erring, scope=scope).solve()
    assert plan.ok
    flights = plan.fly(4000)
    reached = flights.whole if scope == "flight" else flights.kept["ball"]
    assert reached.high > 0.95
    if scope != "uniform":
        assert reached.low < 0.96
    spread = np.cov((flights.final - plan.states[-1]).T)
    scale = np.sqrt(np.diag(plan.covariances[-1]))
    assert spread / scale / scale[:, None] == pytest.approx(
        plan.covariances[-1] / scale / scale[:, None], abs=0.1
    )


@pytest.mark.slow
def test_certified_plan_reaches_its_probability_in_flight(erring):
    own = replace(erring, probability=0.9)
    seen: list[tuple[str, int, int]] = []
    stages = set[str]()
    plan = own.certify(
        observe=lambda stage, _: stages.add(stage), watch=lambda *one: seen.append(one)
    )
    aimed = own.solve()
    assert stages == {stage.name for stage in plan.stages}
    assert seen[0][0] == "calibration 1"
    assert seen[-1][0].startswith("test")
    assert seen[-1][1] == seen[-1][2]
    assert plan.certificate.certifies(0.9)
    assert plan.fly(4000, 7).kept["ball"].high > 0.9
    assert 0.9 < plan.certificate.reached < 0.92  # and no more than sampling explains
    assert plan.target > 0.9
    assert plan.cost > aimed.cost
    with pytest.raises(InputError, match="node or flight"):
        replace(own, scope="uniform").certify()


def around(sizes: Array) -> list[sr.Keep]:
    """One region of each kind to be kept in or out of, none of which forbids the way."""
    return [
        sr.Keep("in", sr.Polytope(FACES, [1500.0, 1500.0, 300.0, 1500.0, 1500.0, 300.0])),
        sr.Keep("out", sr.Polytope(FACES, np.tile(sizes, 2)), range(1, 17), "box"),
        sr.Keep("in", sr.Ellipsoid([0.0, -300.0, 0.0], np.diag([1 / 900, 1 / 1200, 1 / 400]))),
        sr.Keep("out", sr.Ellipsoid([0.0, 0.0, 0.0], np.diag(0.9 / sizes)), range(1, 17), "egg"),
        sr.Keep("in", sr.Halfspaces([0.0, 1.0, 0.0], 1000.0)),
    ]


@pytest.mark.parametrize("scope", ["node", "flight", "uniform", None])
def test_every_kind_of_region_is_kept(erring, scope):
    regions = around(np.array([120.0, 160.0, 100.0]))
    own = replace(erring, regions=regions, scope=scope or "node")
    if scope is None:
        own = replace(own, initial_covariance=None, errors=None)
    plan = own.solve()
    assert plan.ok, plan
    if scope is None:
        assert min(plan.margins.values()) > -1e-3
        return
    flights = plan.fly(2000)
    assert set(flights.kept) == {"polytope 1", "box", "ellipsoid 3", "egg", "halfspaces 5"}
    assert min(estimate.high for estimate in flights.kept.values()) > 0.95


@pytest.mark.slow
def test_corrected_burns_fly_as_planned(erring):
    measured = np.diag([1.0, 1.0, 1.0, 0.001, 0.001, 0.001])[None]
    feedback = sr.Feedback(np.array([2]), np.array([15]), measured, "dv99", 0.99)
    own = replace(erring, feedback=feedback, final_sigma=(30.0, None))
    plan = own.solve()
    assert plan.ok, plan
    flights = plan.fly(8000)
    assert flights.dv99 == pytest.approx(plan.cost, rel=0.02)
    assert flights.kept["ball"].high > 0.95
    spread = np.cov((flights.final - plan.states[-1]).T)
    assert np.sqrt(np.trace(spread[:3, :3])) == pytest.approx(30.0, rel=0.05)


@dataclass(frozen=True, eq=False)
class Off:
    """A flow whose derivatives are changed."""

    flow: sr.ExpressionFlow
    change: Callable[[ArcDerivatives], Any]

    @property
    def arcs(self) -> int:
        return self.flow.arcs

    def propagate(self, state: Array, arc: int) -> Array:
        return self.flow.propagate(state, arc)

    def differentiate(self, state: Array) -> Any:
        return self.change(self.flow.differentiate(state))


BALL = np.zeros(3), 100.0
BAD_REGIONS: list[tuple[Callable[[], Any], str]] = [
    (lambda: sr.Ball(BALL[0], -1), "radius: got -1; must be 0 or more"),
    (lambda: sr.Ball(BALL[0], np.inf), "radius: got inf"),
    (lambda: sr.Ellipsoid(BALL[0], np.eye(3), -1.0), "radius: got -1.0"),
    (lambda: sr.Cone(BALL[0], FACES[0], 2.0), "half_angle: got 2.0"),
    (lambda: sr.Cone(BALL[0], FACES[0], -0.1), "half_angle: got -0.1"),
    (lambda: sr.Keep("outside", sr.Ball(*BALL)), "ball: side: got 'outside'; must be one of in"),
    (lambda: sr.Ball(BALL[0], "x"), "radius: got 'x'"),
    (lambda: sr.GatesErrors(0.1, 0.1, 0.1, -0.1), "pointing_proportional.*: got -0.1; must be 0"),
    (lambda: sr.GatesErrors(np.nan, 0.1, 0.1, 0.1), "magnitude_fixed: got nan"),
    (lambda: sr.ComponentwiseErrors(-0.1), "fraction: got -0.1"),
    (lambda: sr.Ball(["a", 0, 0], 1.0), "center: got .*must be three finite numbers"),
    (lambda: sr.Ball([0, 0], 1), r"center: got \[0, 0\]; must be three finite numbers"),
    (lambda: sr.Ball([np.nan, 0, 0], 1), "center: got .*must be three finite numbers"),
    (lambda: sr.Ball(0.0, 1), "center: got 0.0; must be three"),
    (lambda: sr.Ball(BALL[0], True), "radius: got True"),
    (lambda: sr.Ball(BALL[0], np.nan), "radius: got nan"),
    (lambda: sr.Cone([0, 0], FACES[0], 0.3), "apex: got"),
    (lambda: sr.Cone(BALL[0], [1, 0], 0.3), "axis: got"),
    (lambda: sr.Ellipsoid(BALL[0], np.eye(2)), "matrix: got .*three finite"),
    (lambda: sr.Halfspaces([1, 0], 2.0), "normal: got"),
    (lambda: sr.Polytope(np.ones((6, 2)), np.ones(6)), "normal: got"),
    *(
        (lambda nodes=nodes: sr.Keep("in", sr.Ball(*BALL), nodes), "ball: nodes: got")
        for nodes in ("x", [2, 1], [-1], [], 3, [0.5], [[1], [2, 3]])
    ),
    (lambda: sr.Keep("in", BALL), "region: got .*must be a Ball"),
    (lambda: sr.Keep("in", sr.Ball(BALL[0], 0.0)), "ball: got radius 0.0; must have points"),
    (lambda: sr.Keep("in", sr.Ball(np.zeros((3, 3)), 1.0), [1, 2]), r"or \(2, 3\)"),
    (lambda: sr.Keep("in", sr.Halfspaces(BALL[0], 2.0)), "a normal other than zero"),
    (lambda: sr.Keep("in", sr.Ellipsoid(BALL[0], np.diag([1, 1, 0]))), "must have points"),
    (lambda: sr.Keep("out", sr.Polytope(FACES, -np.ones(6))), "half-spaces that meet"),
]


@pytest.mark.parametrize(("make", "says"), BAD_REGIONS)
def test_bad_region_is_refused_where_it_is_made(make, says):
    with pytest.raises(ValueError, match=says) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("nodes", [None, range(1, 4)])
def test_region_may_differ_from_node_to_node(nodes):
    centres, axes = np.arange(9.0).reshape(3, 3), np.tile([0.0, 0.0, 2.0], (3, 1))
    kept = [sr.Ball(centres, 1.0), sr.Cone(BALL[0], axes, 0.3), sr.Ellipsoid(centres, np.eye(3))]
    for region in (*kept, sr.Halfspaces(axes[0], np.arange(3.0))):
        assert sr.Keep("in", region, nodes).region is region


I6 = np.eye(6)[None]


def corrected(burns: Any, cut_offs: Any, measurement: Any = I6, **more: Any) -> dict[str, Any]:
    """Changes to burns that are corrected."""
    given = {"cost": "dv99", "probability": 0.9} | more
    return {"feedback": sr.Feedback(burns, cut_offs, measurement, **given)}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"initial_state": [1.0, 2.0]},
            r"initial_state: got shape \(2,\); must be finite, of shape",
        ),
        ({"final_state": [np.nan] * 6}, "final_state: got numbers that are not finite"),
        ({"burn_nodes": [0, 8]}, "burn_nodes: .*the last 24"),
        ({"burn_nodes": [8, 0, 24]}, "burn_nodes: .*must ascend"),
        ({"dv_max": 0.0}, "dv_max: got 0.0; must be positive"),
        ({"probability": 0.3}, "probability: got 0.3"),
        ({"scope": "nodes"}, "scope: got 'nodes'"),
        ({"units": (0.0, 1.0)}, "units: "),
        ({"units": 3.0}, "units: .*a length and a time"),
        ({"dv_max": "2"}, "dv_max: got '2'; must be positive"),
        ({"probability": "a"}, "probability: got 'a'"),
        ({"initial_state": ["a"] * 6}, "initial_state: .*must be numbers"),
        ({"final_sigma": 3.0}, "final_sigma: got 3.0; must be two"),
        ({"regions": sr.Ball(*BALL)}, "regions: got Ball.*list of Keep"),
        ({"flow": None}, "flow: got None; must be a flow"),
        ({"initial_covariance": np.eye(3)}, r"initial_covariance: got shape \(3, 3\)"),
        ({"initial_covariance": -np.eye(6)}, "initial_covariance: got a matrix that is no"),
        ({"regions": [sr.Keep("in", sr.Ball(*BALL), [30])]}, "ball 1: nodes: .*at most 24"),
        ({"regions": [sr.Keep("in", sr.Ball(*BALL), name="a")] * 2}, "regions: .*must differ"),
        (corrected([1], [9]), "feedback.cut_offs: .*not be after"),
        (corrected([1], [8], np.eye(3)), "feedback.measurement: got shape"),
        (corrected([4], [8]), "feedback.burns: .*from 0 to 3"),
        (corrected([1, 2], [8, 3], np.tile(I6, (2, 1, 1))), "feedback.cut_offs: .*must ascend"),
        (corrected([1], [8], cost="dv95"), "feedback.cost"),
        (corrected([1], [8], probability=9), "feedback.probability"),
        (
            corrected([1, 2], [3, 8], np.tile(I6, (2, 1, 1)))
            | {"errors": sr.GatesErrors(0.0, 0.01, 0.0, 0.01, 0.02)},
            "errors: .*magnitude_bias 0.02 with 2 corrected burns",
        ),
        ({"final_sigma": (5.0, None)}, "final_sigma: .*goes with errors"),
        ({"final_sigma": (-5.0, None)}, "final_sigma: .*positive"),
        ({"regions": [sr.Ball(*BALL)]}, "regions: .*list of Keep"),
        ({"errors": 0.01}, "errors: .*GatesErrors"),
        ({"units": (1.0, 1.0, 1.0)}, "units: "),
        (lambda a: Arcs(a.state[:, :3], a.stm, a.tensor), "flow: got state of shape"),
        (lambda a: Arcs(a.state, a.stm[1:], a.tensor), "flow: got stm of shape"),
        (lambda a: Arcs(a.state + 1.0, a.stm, a.tensor), "where `propagate` ends"),
        (lambda a: Arcs(a.state, 1.1 * a.stm, a.tensor), "an STM that is not its map's"),
        (lambda a: Arcs(a.state, a.stm, a.tensor + 1.0), "a tensor that is not its STM's"),
    ],
)
def test_bad_input_has_one_message_each(problem, flow, change, says):
    if not isinstance(change, dict):
        change = {"flow": Off(flow, change)}
    with pytest.raises(InputError, match=says):
        replace(problem, **change).solve()


def test_a_plan_tells_what_it_is(problem):
    plan = problem.solve()
    assert isinstance(plan, ImpulsivePlan)
    assert repr(plan).startswith("<ImpulsivePlan: converged, cost ")
    assert str(plan).count("node") == len(BURNS)
    assert plan.violations == {}
    with pytest.raises(InputError, match=r"guess: got shape \(3, 6\)"):
        problem.solve(np.zeros((3, 6)))
    closed = replace(problem, initial_covariance=COVARIANCE, **corrected([1], [8]))
    with pytest.raises(InputError, match="feedback: got corrected burns"):
        closed.solve(formulation="frozen-stm")


def test_infeasible_plan_names_what_is_violated(problem):
    """A burn too small for the transfer, and a region that the way has to cross, each with its unit."""
    far = sr.Keep("out", sr.Ball([2000.0, 2000.0, 0.0], 10.0), name="debris")
    weak = replace(problem, dv_max=1e-2, units=(900.0, 900.0), regions=[far]).solve()
    assert weak.status is Status.INFEASIBLE
    assert set(weak.violations) <= {"position", "velocity", "dv_max"}
    name, (size, unit) = max(weak.violations.items(), key=lambda item: item[1][0])
    assert f"{name}: violated by {size:.6g} ({unit})" in str(weak)
    assert f"debris: margin {weak.margins['debris']:+.6g} (length)" in str(weak)
    assert "p_chance" not in str(weak)
    wall = sr.Keep("in", sr.Halfspaces([0.0, -1.0, 0.0], -600.0), [24], "wall")
    barred = replace(problem, regions=[wall]).solve()
    assert barred.status is Status.INFEASIBLE
    size, unit = barred.violations["wall"]
    assert (size, unit) == (pytest.approx(-barred.margins["wall"], rel=1e-6), "length")
    off = abs(barred.states[-1, 1] - 600.0)
    assert size == pytest.approx(off, rel=1e-6)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"seed": -1}, "seed: got -1; must be "),
        ({"seed": 2**63}, "seed: got "),
        ({"seed": 0.5}, "seed: got 0.5; must be "),
        ({"samples": 0}, "samples: got 0; must be "),
        ({"samples": "many"}, "samples: got 'many'; must be "),
    ],
)
def test_flights_refuse_numbers_out_of_range(given, says, problem):
    with pytest.raises(InputError, match=says):
        problem.solve().fly(**given)


PARAMETERS = np.diag([0.03 * RATE, 2e-5]) ** 2
"""Of the rate, 3 %, and of the push, which alone moves a flight by 160 m."""


@pytest.fixture(scope="module")
def unknown(erring) -> sr.ImpulsiveProblem:
    return replace(erring, errors=None, parameter_covariance=PARAMETERS)


def law_flown(plan: ImpulsivePlan) -> Array:
    """Final sigmas by the law, which flights bear out."""
    flown, factor = plan.fly(4000, seed=3), plan.final.result.lin.factor[-1]
    law = np.linalg.norm(factor, axis=1) * plan.unit
    assert flown.kept["ball"].high > 0.95
    assert (flown.final.std(axis=0) / law)[:3] == pytest.approx(np.ones(3), abs=0.06)
    return law


@pytest.mark.slow
def test_plans_keep_probability_with_uncertain_parameters(unknown):
    """The plan that knows them does not, and costs less."""
    known, plan = replace(unknown, parameter_covariance=None).solve(), unknown.solve()
    assert plan.ok
    assert plan.cost > 1.02 * known.cost
    assert np.all(law_flown(plan)[:2] > 50.0)


@pytest.mark.slow
def test_filters_learn_parameters_of_any_flow(unknown):
    """Measurements before burns 2 and 3 leave less of the push unknown, and the end nearer."""
    measurement = np.tile(np.diag([1.0, 1.0, 1.0, 0.001, 0.001, 0.001]), (2, 1, 1))
    feedback = sr.Feedback(np.array([1, 2]), np.array([7, 15]), measurement, "expected", 0.99)
    plan = replace(unknown, feedback=feedback).solve()
    assert plan.ok
    lin = plan.final.result.lin
    before = np.linalg.norm(lin.spread.leg_errors[0][6:], axis=1)
    after = np.linalg.norm(lin.spread.leg_errors[-1][6:], axis=1)
    assert after[1] < 0.2 * before[1]
    law_flown(plan)


def test_bad_covariances_of_parameters_are_named(problem, flow):
    for covariance, words in (
        (np.diag([1.0, -1.0]), "no covariance"),
        (np.eye(3), "parameter_covariance"),
    ):
        with pytest.raises(InputError, match=words):
            replace(problem, parameter_covariance=covariance)
    with pytest.raises(InputError, match="an ExpressionFlow"):
        replace(problem, flow=Off(flow, lambda a: a), parameter_covariance=PARAMETERS)
