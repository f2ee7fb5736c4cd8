"""Make random generators from a seed and the places of what is drawn."""

from __future__ import annotations

import numpy as np

WORD = 2**32
"""A larger seed fills several words, the second of which would be taken for a place."""


def sequence(seed: int, *places: int) -> np.random.SeedSequence:
    """What a seed and some places, such as the number of a block of flights, draw from.

    Different seeds and places give different numbers. A seed below `WORD` and its places are one list
    of words; of a larger seed the places are a spawn key, which numpy sets apart from the seed.
    """
    if seed < WORD:
        return np.random.SeedSequence([seed, *places])
    return np.random.SeedSequence(seed, spawn_key=places)


def generator(seed: int, *places: int) -> np.random.Generator:
    """The generator of a seed at some places: see `sequence`."""
    return np.random.default_rng(sequence(seed, *places))
