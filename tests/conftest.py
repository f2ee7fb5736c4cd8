"""Hypothesis profiles: `HYPOTHESIS_PROFILE=nightly` looks harder."""

from __future__ import annotations

import os

from hypothesis import Phase, settings

settings.register_profile("default", max_examples=60, deadline=None, derandomize=False)
settings.register_profile("nightly", max_examples=1000, deadline=None, derandomize=False)
# For mutation testing: fast and repeatable, and a failure needs no simple example.
settings.register_profile(
    "mutation",
    max_examples=20,
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))
