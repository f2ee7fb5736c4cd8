import json

import numpy as np

import scp_recon as sr


def acceleration(r, v, t, p):  # noqa: ARG001
    return [3.0 * p[0] ** 2 * r[0] + 2.0 * p[0] * v[1], -2.0 * p[0] * v[0], -(p[0] ** 2) * r[2]]


times = np.linspace(0.0, 5556.0, 37)
flow = sr.ExpressionFlow(acceleration, times, parameters=[2.0 * np.pi / 5556.0], substeps=4)
ball, axis = sr.Ball([0.0, 0.0, 0.0], 150.0), [0.0, 1.0, 0.0]
cone = sr.Cone(apex=[0.0, 0.0, 0.0], axis=axis, half_angle=np.pi / 6.0)
plan = sr.ImpulsiveProblem(
    flow,
    [0, 12, 24, 36],
    [-300.0, -1000.0, 200.0, 0.0, 0.4, 0.0],
    [0.0, 200.0, 0.0, 0.0, 0.0, 0.0],
    dv_max=2.0,
    initial_covariance=np.diag([2.0, 2.0, 2.0, 0.001, 0.001, 0.001]) ** 2,
    errors=sr.GatesErrors(0.0, 0.005, 0.0, 0.005),
    regions=[
        sr.Keep("out", ball, range(1, 25), "ball"),
        sr.Keep("in", cone, range(30, 37), "cone"),
    ],
    probability=0.95,
    scope="flight",
).solve()
whole = plan.fly(500).whole.value
answer = {"ok": plan.ok, "cost": plan.cost, "burns": plan.burns.tolist(), "whole": whole}
print(json.dumps(answer))
