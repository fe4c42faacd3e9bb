"""Flags of the scripts: their types with bounds, their spelling, and the checks that need no environment."""

import contextlib
import functools
import re
import shlex
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import torch
import tyro
from torch import nn
from tyro.constructors import PrimitiveConstructorSpec

from memory_gym_envs.mystery_path import VARIANTS as MYSTERY_PATH
from ppo_utils.processes import rank_and_size

type_hints = functools.cache(get_type_hints)  # a program that plans hundreds of trainings asks for each
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


@dataclass
class RunArgs:
    """What a script's Args begins with: flags of the run, its environments and evaluations, which it does not read.

    Those of the algorithm follow in the script. Of these, this package reads total_timesteps, num_envs, num_steps,
    num_minibatches, update_epochs, refresh_memory, anneal_steps, amp, and the coefficients of auxiliary losses with
    auxiliary_detach.
    """

    exp_name: str = ""
    """name of the experiment, part of the run folder's name"""
    preset: Literal["thesis", "laptop", "quickstart"] = "thesis"
    """a set of defaults, listed above; explicit flags override it (in Python: Args(**PRESETS["laptop"]))"""
    seed: NonNegativeInt = 1
    """seed of weights, actions and environments; on a CPU with as many threads, a run is repeated bit for bit"""
    cuda: bool = True
    """train on the GPU if there is one"""
    track: bool = False
    """log to Weights and Biases too (extra `track`); WANDB_PROJECT and WANDB_ENTITY name project and team"""
    capture_video: bool = False
    """record some episodes of the first environment (extra `play`)"""
    save_model: bool = False
    """write model.pt to the run folder when training ends"""
    load_model: str | None = None
    """start from the weights in this model.pt or checkpoint; optimizer, step count and scale of --norm-reward start
    afresh"""
    resume: str | None = None
    """continue the run in this folder from its last checkpoint; only --total-timesteps may change, to a larger value"""
    checkpoint_interval: NonNegativeInt = 50
    """iterations between checkpoints, with another one at the end (0: no checkpoints); the last two are kept"""

    env_id: str = "MortarMayhem-Grid-v0"
    """any Gymnasium id with Discrete or MultiDiscrete actions; as module:id if importing a module registers it"""
    env_options: str = "{}"
    """reset options of a Memory Gym environment as JSON, e.g. '{"command_count": [4]}'"""
    env_kwargs: str = "{}"
    """constructor arguments of another package's environment as JSON, e.g. '{"size": 9}'"""
    async_envs: bool = False
    """train in environments that are each a process of their own, for slow ones of other packages"""
    num_levels: NonNegativeInt = 100_000
    """number of levels to train on (0: no limit); in environments of other packages, a level is a seed"""
    start_level: NonNegativeInt = 0
    """the first of these levels"""
    obs_type: Literal["pixels", "grayscale", "vector"] = "pixels"
    """what a Memory Gym environment shows: images in color or in gray, or vectors of what can be seen on them"""
    frame_stack: NonNegativeInt = 0
    """observe the last K images, in grayscale, or the last K vectors (0: the current one, as --obs-type has it)"""
    attend_commands: bool = False
    """read the list of commands of Mortar Mayhem's act tasks row by row, by attention after the memory"""
    step_encoding: bool = False
    """also observe a sinusoidal encoding of the episode's step"""
    observe_last_action: bool = False
    """also observe the last action and the last reward"""
    spotlight_perturbation: bool = False
    """cover the image with a translucent white layer in which moving spotlights leave holes (thesis §7.2)"""
    vector_frequencies: bounded(int, 0, 16) | None = None
    """also observe Fourier features of vectors with entries from 0 to 1, at this many frequencies (None: 4 in Mystery
    Path with --obs-type vector, else 0)"""

    eval_interval: NonNegativeInt = 0
    """iterations between evaluations on other levels, with another one at the end (0: no evaluations)"""
    eval_levels: PositiveInt = 50
    """number of levels of an evaluation, which follow those of the training; each is played three times"""
    eval_max_steps: PositiveInt = 10_000
    """an evaluation cuts episodes off after this many steps"""


def flag(name: str) -> str:
    """Return the command line's spelling of a field of Args."""
    return "--" + name.replace("_", "-")


def as_flags(values: dict[str, Any]) -> str:
    """Return values of fields of Args as a command line."""
    return " ".join(
        flag(name if value else f"no_{name}") if isinstance(value, bool) else f"{flag(name)} {shlex.quote(str(value))}"
        for name, value in values.items()
    )


def check_bounds(args: RunArgs) -> None:
    """Raise ValueError, naming the flag and what it may be, for a dataclass' first number that is out of bounds."""
    for name, kind in type_hints(type(args), include_extras=True).items():
        value = getattr(args, name)
        for part in (kind, *get_args(kind)):  # float | None has its bounds in a part
            bounds = next((each for each in getattr(part, "__metadata__", ()) if isinstance(each, Bounds)), None)
            if bounds is not None and value is not None and not bounds.include(value):
                limit = f" and at most {LARGEST}, where float32 ends" if value > LARGEST == bounds.high else ""
                raise ValueError(f"{flag(name)} is {value}; it must be {bounds}{limit}")
        if isinstance(value, int) and value >= 2**63:  # torch and NumPy take no more
            raise ValueError(f"{flag(name)} is {value}; it must be below 2 ** 63")


def check_args(args: RunArgs) -> None:
    """Raise ValueError, naming the flag and what it may be, for the first value or combination that cannot work.

    An integer that is given for a float in Python becomes one, so that logs spell both the same way.
    """
    plain = type_hints(type(args))
    for name, kind in type_hints(type(args), include_extras=True).items():
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
        if isinstance(value, str) and value != value.encode(errors="replace").decode():
            raise ValueError(f"{flag(name)} is {value!r}, no UTF-8 text; start Python with -X utf8")
        if is_choice and value not in get_args(kind):
            raise ValueError(f"{flag(name)} is {value!r}; it must be one of {', '.join(get_args(kind))}")
    check_bounds(args)
    if not args.exp_name or set(args.exp_name) & set("/\\"):
        raise ValueError(f"--exp-name is {args.exp_name!r}; it must be a name without slashes")
    if args.auxiliary_detach and not (args.reconstruction_coef or args.ground_truth_coef):
        raise ValueError("--auxiliary-detach needs --reconstruction-coef or --ground-truth-coef above 0")
    if args.anneal_steps is None:
        args.anneal_steps = args.total_timesteps
    if args.vector_frequencies is None:  # an agent that remembers tiles has to tell neighbours apart
        *package, bare = re.split("[:/]", args.env_id)
        is_ours = {*package} <= {"memory_gym_envs"} and bare in MYSTERY_PATH
        args.vector_frequencies = 4 if is_ours and args.obs_type == "vector" else 0
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


def check_minibatches(args: RunArgs, memory: nn.Module) -> None:
    """Raise ValueError if a minibatch could be empty, in a rollout in which no episode ends."""
    longest_piece = int(memory.cut(torch.zeros(args.num_steps, 1, dtype=torch.bool)).length.max())
    steps = args.num_envs * args.num_steps // rank_and_size()[1]
    if args.num_minibatches * longest_piece > steps:
        raise ValueError(
            f"--num-minibatches is {args.num_minibatches}, but an iteration may have only {steps // longest_piece} "
            f"sequences (up to {longest_piece} of {steps} steps each); use at most that many, or more environments "
            "(--num-envs)"
        )
