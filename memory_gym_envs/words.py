"""Random integers faster than from NumPy's generator, and the same: it makes them of the words of its bit generator.

A word has 32 bits. `word_source` draws one at a time, `WordBuffer` reads many ahead.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

WORDS = 1 << 32
LOW = WORDS - 1  # the bits of a word
PERCENT_AGAIN = {word for part in range(100) if (word := -(-part * WORDS // 100)) * 100 % WORDS < WORDS % 100}
EIGHTHS = bytes(byte >> 5 for byte in range(256))  # by a word's upper byte


def word_source(rng: np.random.Generator) -> Callable[[], int]:
    """A function that draws the generator's next word. Whoever calls it must keep the generator."""
    source = rng.bit_generator.ctypes
    return partial(source.next_uint32, source.state)


def sample_below(next_word: Callable[[], int], limit: int) -> int:
    """What Generator.integers(0, limit) would draw, for a limit from 1 to 2**32 - 1 (Lemire's method)."""
    if limit == 1:
        return 0
    product = next_word() * limit
    while product & LOW < limit and product & LOW < WORDS % limit:
        product = next_word() * limit
    return product >> 32


def pick(next_word: Callable[[], int], values: tuple[int, ...]) -> int:
    """What Generator.choice would draw of these values. It takes no word where there is but one."""
    return values[sample_below(next_word, len(values))]


class WordBuffer:
    """A generator's next words, read ahead. At the end, `close` leaves it as if it had drawn the used ones only.

    Words are the halves of a bit generator's 64-bit numbers, the lower half first. It keeps the upper half of the last
    one, used or not. Raises ValueError for a bit generator that has no such halves, as MT19937.
    """

    def __init__(self, rng: np.random.Generator, count: int):
        """Reads at least so many words."""
        self.source = rng.bit_generator
        self.state: Any = self.source.state
        if "has_uint32" not in self.state:
            raise ValueError(f"levels need a generator of 64-bit numbers, as PCG64, not {type(self.source).__name__}")
        self.used = 1 - self.state["has_uint32"]
        leftover = self.state["uinteger"].to_bytes(4, "little")  # as a machine of today keeps numbers
        self.load(leftover + self.source.random_raw((count + 1) // 2).tobytes())

    def load(self, data: bytes) -> None:
        """Takes over the words."""
        self.words = memoryview(data).cast("I")
        self.eighths = data[3::4].translate(EIGHTHS)  # what sample_below(buffer, 8) would make of each

    def __call__(self) -> int:
        """The next word."""
        self.used += 1
        return self.words[self.used - 1]

    def sample_each(self, things: list[int], percent: int) -> list[int]:
        """Those things that are hit: for each, a number below 100 is drawn, which must be below percent."""
        drawn = self.words[self.used : self.used + len(things)].tolist()
        if not PERCENT_AGAIN.isdisjoint(drawn):
            return [thing for thing in things if sample_below(self, 100) < percent]
        self.used += len(things)
        limit = -(-percent * WORDS // 100)  # of the words that make such a number
        return [thing for thing, word in zip(things, drawn, strict=True) if word < limit]

    def take_random(self, things: list[int], count: int) -> list[int]:
        """Takes so many out of the list, one by one, or all if there are fewer."""
        drawn, used, taken = self.words, self.used, []
        # The last of all is taken without a draw.
        for limit in range(len(things), max(len(things) - count, 1), -1):
            product = drawn[used] * limit
            used += 1
            while product & LOW < limit and product & LOW < WORDS % limit:
                product = drawn[used] * limit
                used += 1
            taken.append(things.pop(product >> 32))
        self.used = used
        return taken if len(taken) == count else taken + things

    def close(self) -> None:
        """Sets the generator back, and draws the used words."""
        numbers, half = divmod(self.used, 2)
        self.state["has_uint32"], self.state["uinteger"] = 1 - half, self.words[2 * numbers]
        self.source.state = self.state
        self.source.random_raw(numbers)
