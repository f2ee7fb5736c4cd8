# %% [markdown]
# # Comparing solvers
#
# One problem, by several formulations, algorithms and solvers. Who is right? Whoever agrees with
# the others and is verified.

# %%
import pandas as pd

import scp_recon as sr

WAYS = {
    "SCvx, condensed (default)": {},
    "SCvx, lifted": {"formulation": "lifted"},
    "SCvx, STM frozen": {"formulation": "frozen-stm"},
    "penalised trust region": {"algorithm": "ptr"},
    "SCvx*": {"algorithm": "scvx-star"},
    "IPOPT, tuned": {"method": "ipopt"},
}
plans = {name: sr.plan("recon_b", facet_rounds=0, **options) for name, options in WAYS.items()}

# %% [markdown]
# Seconds are of this run, with everything compiled on the way: measure with `python -m
# benchmarks`.

# %%
rows = [
    {
        "way": name,
        "status": plan.status.value.name,
        "delta-v (m/s)": plan.total_dv_m_s,
        "iterations": sum(len(stage.result.records) for stage in plan.stages),
        "seconds": plan.total_s,
    }
    for name, plan in plans.items()
]
pd.DataFrame(rows).set_index("way")

# %% [markdown]
# With the full linearisation all end at the same delta-v. What holds the STMs of the iterate
# before ends beside it, as it does not see that a burn changes them.

# %%
assert all(plan.status.value.name == "converged" for plan in plans.values())
costs = {name: plan.total_dv_m_s for name, plan in plans.items()}
frozen = costs.pop("SCvx, STM frozen")
assert max(costs.values()) < 1.0001 * min(costs.values()) < frozen

# %% [markdown]
# How two of them got there: merit, its changes, violation and trust radius by iteration, P3
# first.

# %%
default, ptr = plans["SCvx, condensed (default)"], plans["penalised trust region"]
sr.compare(default, ptr).plot("convergence")

# %% [markdown]
# And where they are: the last row is the distance between the paths.

# %%
sr.compare(default, plans["IPOPT, tuned"])
