"""Hypothesis profiles: `HYPOTHESIS_PROFILE=nightly` looks harder."""

from __future__ import annotations

import os

from hypothesis import settings

settings.register_profile("default", max_examples=60, deadline=None, derandomize=False)
settings.register_profile("nightly", max_examples=1000, deadline=None, derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))
