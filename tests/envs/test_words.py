"""Integers made of a generator's words are those that the generator itself would draw."""

import numpy as np
import pytest

from memory_gym_envs.words import below, words


@pytest.mark.parametrize("kind", [np.random.PCG64, np.random.MT19937, np.random.Philox])
def test_below_draws_what_the_generator_would(kind):
    limits = [2, 4, 9, 36, 100, 2**31 + 1, 2**32 - 1] * 40  # of the largest, every other word is drawn again
    for seed in range(10):
        ours, theirs = (np.random.Generator(kind(seed)) for _ in range(2))
        if seed % 2:  # half of a 64-bit word is left over
            assert ours.integers(0, 7) == theirs.integers(0, 7)
        word = words(ours)
        assert [below(word, limit) for limit in limits] == [int(theirs.integers(0, limit)) for limit in limits]
        assert ours.integers(0, 1 << 40) == theirs.integers(0, 1 << 40)
        assert ours.integers(0, 7) == theirs.integers(0, 7)
