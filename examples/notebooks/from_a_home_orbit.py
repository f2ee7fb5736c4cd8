# %% [markdown]
# # From a home orbit
#
# A whole pass: when to leave an orbit of 1 km about Bennu, where to burn, and when to be back.
# The packaged scenario `nightingale` leaves all of it free, and takes a minute. Here times are
# given, and phases are sought in 30 degrees each.

# %%
import scp_recon as sr

scenario = sr.load_scenario("nightingale").replace(
    {
        "design.departure_s": [0.0, 0.0],
        "design.arrival_s": [34842.0, 34842.0],
        "design.burn_times": "given",
        "boundary.home.departure_deg": [150.0, 180.0],
        "boundary.home.arrival_deg": [330.0, 360.0],
    }
)
design = sr.design(scenario)
design

# %% [markdown]
# What was tried: a map without uncertainty first, then descents with it, the last with the true
# probability.

# %%
tried = design.to_frame()
tried.groupby("step", sort=False)["dv_m_s"].describe()[["count", "min", "max"]].round(5)

# %% [markdown]
# The best pass as a scenario of its own, planned and certified by flights. It needs less than a
# fifth of Reconnaissance B's delta-v, whose boundary states were given.

# %%
plan = design.plan
print(plan)
print(plan.certificate)
assert plan.certificate.low >= 0.7
assert plan.total_dv_m_s < 0.2 * sr.plan("recon_b").total_dv_m_s

# %%
plan.plot()

# %% [markdown]
# Where each burn may be moved, the others kept, and the attitude modes between them.

# %%
plan.plot("timeline")
