"""At kinks the deciding phase ends where a hull of slopes proves a minimum, and nowhere else.

The violation is the largest of planes with a known least value, and its curvature. As with flights, a
step's model knows the slope at the iterate alone.
"""

from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from formulations.program.subproblem import Step
from scp_recon.scp.loop import Result, Timing, run
from scp_recon.scp.status import Status
from scp_recon.scp.verdict import NEAR, REACH, LeastViolation

N = 3
PROBLEM = SimpleNamespace(controls=lambda burns, gains, times: burns.ravel())  # noqa: ARG005 -- as there


def at(z) -> SimpleNamespace:
    burns = np.reshape(z, (1, -1))
    iterate = SimpleNamespace(burns=burns)
    known = {"problem": PROBLEM, "iterate": iterate, "controls": burns.ravel()}
    return SimpleNamespace(**known, is_dynamically_feasible=True)


class Planes:
    """Merit and subproblem at once; `reach` is None for the slope at the iterate alone."""

    rows, problem = (
        SimpleNamespace(with_factor=False),
        SimpleNamespace(n_burns=1, dv_max=1.0, feedback=None),
    )

    def __init__(self, slopes, values, bend, bundle, reach=None) -> None:
        self.slopes, self.values, self.bend = slopes, values, bend
        self.bundle, self.reach, self.merit = bundle, reach, self

    def __call__(self, lin, *_) -> float:
        z = lin.controls
        heights = self.values + self.slopes @ z
        slope = self.slopes[heights.argmax()] + self.bend * z
        if not any(np.array_equal(z, one) for one, _ in self.bundle):
            self.bundle.insert(0, (z, slope))
        return float(heights.max() + 0.5 * self.bend * (z @ z))

    def violations(self, lin):
        return {"dynamics": np.zeros(1), "planes": np.array([self(lin)])}

    def cost(self, _) -> float:
        return 0.0

    def worst_violation(self, lin) -> float:
        return self(lin)

    def update(self, lin) -> None:
        self.value, z, self.centre = self(lin), lin.controls, lin.controls
        near = [(np.abs(one - z).max(), slope) for one, slope in self.bundle[:12]]
        own = next(slope for one, slope in self.bundle if np.array_equal(one, z))
        self.near = [own, *(s for far, s in near if self.reach and 0.0 < far <= self.reach)]

    def solve(self, radius, _) -> Step:
        cost, limits = np.r_[np.zeros(N), 1.0], [(-radius, radius)] * N + [(0.0, None)]
        rows = np.column_stack([self.near, -np.ones(len(self.near))])
        found = linprog(cost, A_ub=rows, b_ub=np.full(len(rows), -self.value), bounds=limits)
        return Step((self.centre + found.x[:N])[None], found.fun, 0.0, 0.0)


DYNAMICS = SimpleNamespace(
    close_defects=lambda lin, burns, gains, times, misses: at(burns),  # noqa: ARG005 -- as there
    linearise=lambda problem, iterate: at(iterate.burns),  # noqa: ARG005 -- as there
)


def decided(seed: int, *, hull: bool) -> tuple[Result, float, float]:
    """The phase's result, the least violation of planes with 0 in their hull, and the largest slope."""
    rng = np.random.default_rng(seed)
    slopes = rng.normal(size=(N + 1, N))
    slopes -= rng.dirichlet(np.ones(N + 1)) @ slopes
    least, bundle = 10.0 ** rng.uniform(-4.0, -2.0), []
    planes = Planes(slopes, np.full(N + 1, least), rng.uniform(0.0, 2.0), bundle)
    near = Planes(slopes, planes.values, planes.bend, bundle, REACH) if hull else None
    phase = LeastViolation(feasible=1e-5, stationary=1e-7, max_iterations=300, slopes=near)
    start = at(rng.uniform(-NEAR, NEAR, N))
    before = Result(Status.STALLED, start, (), Timing())
    found = run(planes, DYNAMICS, start, phase, lambda _: None, before)
    return found, least, np.abs(slopes).sum(axis=1).max() + N * planes.bend * NEAR


@given(st.integers(0, 2**32 - 1))
def test_a_kinks_minimum_is_found_and_proved(seed):
    found, least, steepest = decided(seed, hull=True)
    last = found.records[-1]
    assert found.status is Status.INFEASIBLE
    promised = last.predicted * NEAR / last.trust_radius
    assert promised <= LeastViolation.LITTLE * last.merit
    # A slope of another point bounds the violation there, and the two differ by twice their reach.
    assert least <= last.merit <= least + promised + 2.0 * REACH * steepest


def test_one_slope_at_a_kink_proves_nothing():
    status = [decided(seed, hull=False)[0].status for seed in range(20)]
    assert Status.STALLED in status
    assert all(one in (Status.STALLED, Status.INFEASIBLE) for one in status)
