"""Flags of the scripts: their types with bounds, their spelling, and the checks that need no environment."""

import contextlib
import shlex
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from ppo_utils.processes import rank_and_size

LARGEST = 3.4e38  # of weights: in float32, what is larger is infinite


class Bounds(NamedTuple):
    """The numbers that a flag takes: low to high, both included unless `above`, which leaves out low."""

    low: float
    high: float = float("inf")
    above: bool = False

    def __str__(self) -> str:
        if self.high >= LARGEST:
            return f"above {self.low}" if self.above else f"{self.low} or more"
        return f"above {self.low} and at most {self.high}" if self.above else f"{self.low} to {self.high}"

    def include(self, number: float) -> bool:
        """Return whether a number is within the bounds; NaN never is."""
        return self.low < number <= self.high if self.above else self.low <= number <= self.high


def bounded(kind: type, *bounds: float, **more: bool) -> Any:
    """Return the type of a flag with these `Bounds`: --help shows them, and `check_args` enforces them."""
    bounds = Bounds(*bounds, **more)
    metavar = f"{kind.__name__.upper()} ({bounds})"
    if kind is not int:
        return Annotated[kind, bounds, tyro.conf.arg(metavar=metavar)]
    return Annotated[int, bounds, PrimitiveConstructorSpec(1, metavar, whole_number, is_whole, lambda n: [str(n)])]


def whole_number(text: list[str]) -> int:
    """Parse an integer, which may be written 1e6 or 1_000_000 too. Raises ValueError for other numbers."""
    with contextlib.suppress(ValueError):
        return int(text[0])
    with contextlib.suppress(ValueError):
        if (number := float(text[0])).is_integer():
            return int(number)
    raise ValueError(f"{text[0]} is no whole number")


def is_whole(value: Any) -> bool:
    """Return whether a default is an integer."""
    return isinstance(value, int) and not isinstance(value, bool)


PositiveInt = bounded(int, 1)
NonNegativeInt = bounded(int, 0)
PositiveFloat = bounded(float, 0, above=True)
NonNegativeFloat = bounded(float, 0, LARGEST)
UnitInterval = bounded(float, 0, 1)


def flag(name: str) -> str:
    """Return the command line's spelling of a field of Args."""
    return "--" + name.replace("_", "-")


def as_flags(values: dict[str, Any]) -> str:
    """Return values of fields of Args as a command line."""
    return " ".join(
        flag(name if value else f"no_{name}") if isinstance(value, bool) else f"{flag(name)} {shlex.quote(str(value))}"
        for name, value in values.items()
    )


def check_bounds(args: Any) -> None:
    """Raise ValueError, naming the flag and what it may be, for a dataclass' first number that is out of bounds."""
    for name, kind in get_type_hints(type(args), include_extras=True).items():
        value = getattr(args, name)
        for part in (kind, *get_args(kind)):  # float | None has its bounds in a part
            bounds = next((each for each in getattr(part, "__metadata__", ()) if isinstance(each, Bounds)), None)
            if bounds is not None and value is not None and not bounds.include(value):
                raise ValueError(f"{flag(name)} is {value}; it must be {bounds}")
        if isinstance(value, int) and value >= 2**63:  # torch and NumPy take no more
            raise ValueError(f"{flag(name)} is {value}; it must be below 2 ** 63")


def check_args(args: Any) -> None:
    """Raise ValueError, naming the flag and what it may be, for the first value or combination that cannot work.

    An integer that is given for a float in Python becomes one, so that logs spell both alike.
    """
    plain = get_type_hints(type(args))
    for name, kind in get_type_hints(type(args), include_extras=True).items():
        value = getattr(args, name)
        is_choice = get_origin(kind) is Literal
        kinds = (str,) if is_choice else get_args(plain[name]) or (plain[name],)  # float | None has two
        # Two checks for what is given in Python; tyro has them for the command line. A file with a Path, or with a
        # number of NumPy's, could not be read again.
        if type(value) is int and float in kinds:
            value = float(value)
            setattr(args, name, value)
        if type(value) not in kinds:
            raise ValueError(f"{flag(name)} is {value!r}; it must be of type {kinds[0].__name__}")
        if is_choice and value not in get_args(kind):
            raise ValueError(f"{flag(name)} is {value!r}; it must be one of {', '.join(get_args(kind))}")
    check_bounds(args)
    if not args.exp_name or set(args.exp_name) & set("/\\"):
        raise ValueError(f"--exp-name is {args.exp_name!r}; it must be a name without slashes")
    for name in ("reconstruction", "ground_truth"):
        if getattr(args, f"{name}_detach") and not getattr(args, f"{name}_coef"):
            raise ValueError(f"{flag(f'{name}_detach')} needs {flag(f'{name}_coef')} above 0")
    if args.optimizer != "muon" and args.muon_lr_ratio != type(args).muon_lr_ratio:
        raise ValueError(f"--muon-lr-ratio needs --optimizer muon; it is {args.optimizer}")
    if args.refresh_memory and args.update_epochs == 1:
        raise ValueError("--refresh-memory needs --update-epochs above 1: the first epoch has fresh memory")
    batch_size = args.num_envs * args.num_steps
    if args.total_timesteps < batch_size:
        raise ValueError(
            f"--total-timesteps is {args.total_timesteps}, less than one iteration of {batch_size} steps "
            f"(--num-envs {args.num_envs} x --num-steps {args.num_steps})"
        )
    if args.num_envs % rank_and_size()[1]:
        raise ValueError(f"--num-envs is {args.num_envs}; it must be a multiple of the {rank_and_size()[1]} processes")


def check_minibatches(args: Any, longest_piece: int) -> None:
    """Raise ValueError if a minibatch could be empty; longest_piece: steps that a piece of a rollout may have."""
    steps = args.num_envs * args.num_steps // rank_and_size()[1]
    if args.num_minibatches * longest_piece > steps:
        raise ValueError(
            f"--num-minibatches is {args.num_minibatches}, but an iteration may have only {steps // longest_piece} "
            f"sequences (up to {longest_piece} of {steps} steps each); use at most that many, or more environments "
            "(--num-envs)"
        )
