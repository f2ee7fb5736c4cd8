# %% [markdown]
# # A first plan
#
# OSIRIS-REx's Reconnaissance B of Bennu's site Nightingale: four burns, whose errors are 8 % of
# their size, and a window of an hour in which the site is lit and has to be seen.

# %%
import scp_recon as sr

plan = sr.plan("recon_b")
plan

# %% [markdown]
# The last lines are margins: zero where a limit binds. Each burn as a row, in J2000:

# %%
plan.to_frame()

# %% [markdown]
# The flight. The tube holds 3 sigma of the planned spread; the thin lines are flights with
# errors.

# %%
plan.plot()

# %% [markdown]
# Distance from the site, emission and phase in the window, with their limits.

# %%
plan.plot("observation")

# %% [markdown]
# The scenario asks for 0.7 of each limit at each instant. Flights with errors say what that comes
# to:

# %%
flights = sr.fly(plan, samples=5_000)
flights.plot()

# %%
flights.to_frame()

# %% [markdown]
# The paper's way to split the risk is cautious: whole flights keep every limit far more often
# than 0.7. Another integrator checks the plan without the solver.

# %%
assert flights.whole_flight.value > 0.85
checked = sr.verify(plan)
assert checked.ok
checked
