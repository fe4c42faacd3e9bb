"""The errors of a training that are not Python's own."""


class RunError(RuntimeError):
    """Training cannot go on for a reason outside of it, such as a full disk; the message is one line that names it."""


class LaneError(RuntimeError):
    """What an environment raised, and which environment it was."""
