"""Plan a flyby, look at it, fly it, check it, and compare it with another: run it from anywhere."""

from __future__ import annotations

import tempfile
from pathlib import Path

import scp_recon as sr

scenario = sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8})
plan = sr.plan(scenario)  # init="cold", "warm", a file, a table of states
print(plan)  # status, delta-v, burns, margins

print("\nfinal position, m:", plan.states[-1, :3].round(3))
print("its 1 sigma, m:   ", plan.covariances[-1].diagonal()[:3].__pow__(0.5).round(1))

flights = sr.fly(plan, samples=2_000, seed=0)
emission = flights.probability["emission"]
print(f"P(emission) {emission.value:.4f}, 95 % interval {emission.low:.4f} to {emission.high:.4f}")

print("verified:", sr.verify(plan).ok)

other = sr.plan(scenario.replace({"polytopes.ball": "tangent"}), init="warm")
print(sr.compare(plan, other))

with tempfile.TemporaryDirectory() as folder:
    print("written:", sr.save(plan, Path(folder) / "mine").name)
