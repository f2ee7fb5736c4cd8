# %% [markdown]
# # In flight, with feedback
#
# A spacecraft learns where it is. With feedback the second burn is corrected by what was measured
# before it: the plan holds the gains, and knows what the correction will take off the spread.

# %%
import numpy as np

import scp_recon as sr

fixed = sr.load_scenario("recon_b").replace(
    {"risk.allocation": "exact", "risk.scope": "flight", "risk.p_chance": 0.95}
)
feedback = fixed.replace(
    {
        "name": "feedback",
        "policy.kind": "feedback",
        "navigation.lead_s": 0.0,
        "navigation.sigma_position_m": 10.0,
        "navigation.sigma_velocity_m_s": 0.0005,
    }
)
plan = sr.plan(feedback)
plan

# %% [markdown]
# Dispersion with and without the correction, and what is known: the error of the estimate.

# %%
plan.plot("knowledge")

# %%
plan.to_frame("corrections").T

# %% [markdown]
# Flights measure, estimate and correct by the nonlinear dynamics. What they command is a
# distribution:

# %%
plan.plot("commanded")

# %%
flights = sr.fly(plan, samples=5_000)
assert flights.whole_flight.high >= 0.95
assert flights.policy == "feedback"
flights.plot()

# %% [markdown]
# Without feedback the burns are fixed before departure. At 0.95 that costs little more; at 0.99
# it costs an eighth more (docs/feedback.md).

# %%
open_loop = sr.plan(fixed)
assert plan.commanded[1] < open_loop.total_dv_m_s
sr.compare(open_loop, plan)

# %% [markdown]
# ## Planning again
#
# Before a burn orbit determination delivers a state: here some metres off the plan, an hour after
# the first burn. What is left is planned again from there, with feedback as before.

# %%
now = int(np.searchsorted(plan.times_s, 3600.0))
delivered = plan.states[now] + [4.0, -3.0, 2.0, 0.0, 0.0, 0.0]
left = sr.replan(plan, plan.times_s[now], delivered)
left

# %%
assert left.status.value.name == "converged"
assert sr.verify(left).ok
left.plot()
