"""Seeds: different ones give different numbers, and those of today stay."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.campaigns.axes import Cases
from scp_recon.jobs.job import WORD, generator

seeds = st.integers(0, 2**63 - 1) | st.integers(0, 3).map(lambda high: high * WORD)
places = st.lists(st.integers(0, 4), min_size=1, max_size=3)


@given(seeds, seeds, places, places)
def test_different_seeds_or_places_share_no_numbers(one, other, here, there):
    """Places beyond the first are streams, which begin at one: a list of words ends in no zero."""
    here, there = ([at[0], *(stream + 1 for stream in at[1:])] for at in (here, there))
    same = np.array_equal(generator(one, *here).random(4), generator(other, *there).random(4))
    assert same == ((one, here) == (other, there))


@given(st.integers(0, 2**62), st.integers(0, 2000))
def test_a_seed_a_word_above_repeats_no_block(seed, block):
    """The second word of a seed was once taken for the block."""
    numbers = {
        tuple(generator(one, at).random(4))
        for one in (seed, seed + 1, seed + WORD)
        for at in (block, block + 1)
    }
    assert len(numbers) == 6


def test_campaigns_of_different_seeds_repeat_no_case():
    axes = ([{}] * 4,)
    seeds = [case.seed for k in range(3) for case in Cases(axes, k * WORD)]
    assert len(set(seeds)) == 12
    assert seeds[1] == 2918264622725855778  # as ever


@given(st.integers(0, WORD - 1), places)
def test_seeds_of_one_word_draw_as_before(seed, at):
    expected = np.random.default_rng([seed, *at]).random(4)
    assert np.array_equal(generator(seed, *at).random(4), expected)
