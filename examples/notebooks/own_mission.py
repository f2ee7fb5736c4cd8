# %% [markdown]
# # A mission of your own
#
# A body, a site and a date are enough for a draft: 20 deg north and 150 deg east on Bennu.

# %%
from pathlib import Path
from tempfile import TemporaryDirectory

import scp_recon as sr

with TemporaryDirectory() as folder:
    drafted = sr.new(f"{folder}/mission", "Bennu", (20.0, 150.0), "2020-01-21T20:33:17")
    text = Path(drafted.files[0]).read_text("utf-8")
    scenario = sr.load_scenario(drafted.files[0])

assert drafted.is_verified
print("\n".join(text.splitlines()[:27]))

# %% [markdown]
# Every entry says where it comes from, so that you know which to replace. When is the site lit,
# and where may burns be about each window?

# %%
windows = sr.windows(scenario, span_days=1.0)
windows.to_frame().filter(regex="tdb|incidence|solar")

# %% [markdown]
# Change numbers, not code. Here the camera has to be closer than 680 m, with more certainty.

# %%
closer = scenario.replace(
    {
        "name": "closer",
        "observation.site_distance_max_m": 680.0,
        "risk.p_chance": 0.8,
    }
)
plans = [sr.plan(scenario), sr.plan(closer)]
assert [plan.status.value.name for plan in plans] == ["converged", "converged"]
table = sr.compare(*plans)
table

# %%
table.plot("observation")

# %% [markdown]
# An entry that cannot be is refused at once, with what is allowed.

# %%
try:
    scenario.replace({"risk.p_chance": 1.2})
except sr.InputError as error:
    print(error)
else:
    raise AssertionError("a probability above one was taken")
