"""The errors of a training that are not Python's own."""

import contextlib
from collections.abc import Iterator


class RunError(RuntimeError):
    """Training cannot go on for a reason outside of it, such as a full disk; the message is one line that names it."""


class LaneError(RuntimeError):
    """What an environment raised, and which environment it was."""


@contextlib.contextmanager
def report_unusable_policy() -> Iterator[None]:
    """Raise RunError if actions cannot be sampled, since the network's outputs are not finite."""
    try:
        yield
    except RuntimeError as error:
        if "probability tensor" not in str(error):  # what torch.multinomial says
            raise
        hint = "weights, observations or rewards are too large; try a lower --init-lr, or smaller rewards"
        raise RunError(f"the policy is not finite: {hint}") from None
