"""Transfer between two halo orbits about L2 of Earth and Moon: twenty impulses of least total size.

The case is the own test of the solver scocp (0.1.7): the restricted three-body problem in its
nondimensional rotating frame, boundary states on two orbits, both orbits blended as the guess.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import scp_recon as sr

MU = 1.215058560962404e-02
START = [1.0809931218390707, 0.0, -0.20235953267405354, 0.0, -0.19895001215078018, 0.0]
GOAL = [1.1648780946517576, 0.0, -0.11145303634437023, 0.0, -0.20191923237095796, 0.0]
DURATION = (2.3538670417546639 + 3.3031221822879884) / 2.0
BURNS, BETWEEN = 20, 10  # nodes between burns are for the integrator's steps


def acceleration(r: Any, v: Any, t: Any, p: Any) -> list[Any]:
    """Of the restricted three-body problem with the mass ratio p."""
    del t
    x, y, z = r[0], r[1], r[2]
    near = (1.0 - p[0]) / ((x + p[0]) ** 2 + y**2 + z**2) ** 1.5
    far = p[0] / ((x - 1.0 + p[0]) ** 2 + y**2 + z**2) ** 1.5
    return [
        x + 2.0 * v[1] - near * (x + p[0]) - far * (x - 1.0 + p[0]),
        y - 2.0 * v[0] - (near + far) * y,
        -(near + far) * z,
    ]


def halo(flow: Any, start: list[float]) -> Any:
    """States at the nodes of a flight without burns."""
    states = [np.array(start)]
    for arc in range(flow.arcs):
        states.append(flow.propagate(states[-1], arc))
    return np.array(states)


times = np.linspace(0.0, DURATION, (BURNS - 1) * BETWEEN + 1)
flow = sr.ExpressionFlow(acceleration, times, parameters=[MU], substeps=4)
share = np.linspace(0.0, 1.0, len(times))[:, None]
guess = (1.0 - share) * halo(flow, START) + share * halo(flow, GOAL)

nodes = np.arange(0, len(times), BETWEEN)
problem = sr.ImpulsiveProblem(flow, nodes, START, GOAL, dv_max=0.2)
plan = problem.solve(guess)
print(plan)
print(f"cost {plan.cost:.7f}")
