"""Words of a bit generator make the numbers that NumPy's generator would draw; bits are counted in every NumPy."""

import numpy as np
import pytest
from helpers import check_same
from numpy.random import MT19937, PCG64, PCG64DXSM, SFC64, Generator, Philox

from memory_gym_envs.bits import bit_counts
from memory_gym_envs.words import LOW, PERCENT_AGAIN, WordBuffer, sample_below, word_source

LIMITS = [
    1,
    2,
    3,
    7,
    8,
    49,
    100,
    2**31,
    2**31 + 1,
    2**32 - 1,
]  # one draw in two is repeated for a limit just above 2**31
HALVES = pytest.mark.parametrize("kind", [PCG64, PCG64DXSM, SFC64, Philox])


def twins(kind, seed):
    """Two generators in the same state; with an odd seed, half of a 64-bit number is left over."""
    pair = Generator(kind(seed)), Generator(kind(seed))
    for rng in pair:
        rng.integers(0, 7, 2 + seed % 2)
    return pair


def same_state(one, other):
    return str(one.bit_generator.state) == str(other.bit_generator.state)


@pytest.mark.parametrize("kind", [PCG64, SFC64, Philox, MT19937])
def test_words_make_the_generators_numbers(kind):
    for seed in range(4):
        rng, twin = twins(kind, seed)
        next_word = word_source(rng)
        for limit in LIMITS * 20:
            assert sample_below(next_word, limit) == twin.integers(0, limit)
        assert same_state(rng, twin)


@HALVES
@pytest.mark.parametrize("used", range(6))
def test_a_tape_draws_the_used_words_only(kind, used):
    for seed in range(4):
        rng, twin = twins(kind, seed)
        buffer = WordBuffer(rng, 9)
        assert [buffer() for _ in range(used)] == [twin.integers(0, 1 << 32) for _ in range(used)]
        buffer.close()
        assert same_state(rng, twin)
        assert rng.integers(0, 100) == twin.integers(0, 100)


@HALVES
def test_a_tape_makes_the_generators_numbers(kind):
    for seed in range(4):
        rng, twin = twins(kind, seed)
        buffer = WordBuffer(rng, 2000)
        for limit in LIMITS * 20:
            assert buffer.eighths[buffer.used] == buffer.words[buffer.used] * 8 >> 32
            assert sample_below(buffer, limit) == twin.integers(0, limit)
        things = list(range(24))
        assert buffer.sample_each(things, 33) == [thing for thing in things if twin.integers(0, 100) < 33]
        for count in (0, 1, 4, 23, 24, 25):
            left, expected = things.copy(), things.copy()
            taken = [expected.pop(twin.integers(0, len(expected))) for _ in range(min(count, len(things)))]
            assert buffer.take_random(left, count) == taken
        assert buffer.take_random([], 4) == []
        buffer.close()
        assert same_state(rng, twin)


def loaded(numbers):
    """A buffer of these words, and of some more that are never drawn again."""
    buffer = WordBuffer(np.random.default_rng(0), 2)
    buffer.used = 0
    buffer.load(np.array(numbers + 9 * [12345], np.uint32).tobytes())
    return buffer


@pytest.mark.parametrize("percent", [1, 33, 50, 99])
def test_hits_at_the_edges_of_every_number(percent):
    """Of a hundred words next to each other, which are the last ones of a number, and which are drawn again."""
    edges = [-(-part * (1 << 32) // 100) for part in range(100)]
    for edge in edges:
        for word in ((edge - 1) & LOW, edge, edge + 1):
            buffer, one_by_one = loaded([5, word, 7]), loaded([5, word, 7])
            assert buffer.sample_each([10, 11, 12], percent) == [
                10 + i for i in range(3) if sample_below(one_by_one, 100) < percent
            ]
            assert buffer.used == one_by_one.used == 3 + (word in PERCENT_AGAIN)
    assert len(PERCENT_AGAIN) == (1 << 32) % 100


def test_picks_draw_again():
    """Below six, words are drawn again of which six times as much leaves less than 2**32 % 6 = 4."""
    buffer = loaded([0, 1 << 31, (1 << 31) + 1])
    assert buffer.take_random([0, 1, 2, 3, 4, 5], 1) == [3]
    assert buffer.used == 3


def test_a_tape_needs_64_bit_numbers():
    with pytest.raises(ValueError, match="MT19937"):
        WordBuffer(Generator(MT19937(0)), 4)


@pytest.mark.parametrize("shape", [(0, 42), (3, 8, 42)])
@pytest.mark.parametrize("kind", [np.uint8, np.uint64])
def test_bits_are_counted_alike_in_older_versions_of_numpy(shape, kind, monkeypatch):
    numbers = np.random.default_rng(0).integers(0, np.iinfo(kind).max, shape, kind, endpoint=True)
    wanted = np.bitwise_count(numbers)
    monkeypatch.delattr(np, "bitwise_count")
    check_same(bit_counts(numbers), wanted)
