"""Models and checkpoints: what a file holds, how it is written and read, and how a run goes on from it.

A model has a script's name, its arguments, the weights and the step; a checkpoint also has everything that the run
needs to go on, in tensors and plain values, which torch.load(weights_only=True) takes.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import random
import re
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from ppo_utils.environments import load_state, save_state, with_options
from ppo_utils.evaluation import are_trained_on, first_after, make_agent
from ppo_utils.flags import RunArgs, as_flags, flag
from ppo_utils.processes import all_gather, rank_and_size
from ppo_utils.run import Run
from ppo_utils.terminal import tell
from ppo_utils.wrappers import WRAPPERS

T = TypeVar("T")  # a script's Args
# Names that flags and weights have in older files.
RENAMED = {"head_size": "trunk_size"}
RENAMED_WEIGHTS = {
    ".norm_items.": ".norm_memory.",
    ".norm_output.": ".norm_projection.",
    ".merge_output.": ".merge_projection.",
}
# What a flag stood for in files that are older than it, where its default is another one now.
FORMER_DEFAULTS = {"value_init_gain": 1.0, "vector_frequencies": 0}
CHECKPOINTS_KEPT = 2
SCRIPT_NAME = r"ppo_\w+"  # of what a file may import


# ---- writing ----
def model_of(args: RunArgs, run: Run) -> dict[str, Any]:
    """Return what a model's file holds, which is a part of what a checkpoint holds."""
    saved = {"script": run.script, "args": asdict(replace(args, resume=None)), "step": run.step}
    return saved | {"weights": run.agent.state_dict()}


def save_checkpoint(args: RunArgs, run: Run) -> None:
    """Write all that a run goes on with, and keep the checkpoint before it.

    Raises what `write_file` raises, and RunError if another process has ended.
    """
    processes = all_gather(state_of_process(run))
    if run.writer is None:
        return
    run.writer.flush()  # a checkpoint means that the curves are there too
    for path in run.folder.glob("events.*"):
        # For Windows it has to be open for writing. A file that may not be written has not changed.
        with contextlib.suppress(PermissionError), path.open("rb+") as file:
            os.fsync(file.fileno())
    saved = {"seconds": run.seconds, "returns": list(run.returns), "lengths": list(run.lengths)}
    saved["optimizers"] = [optimizer.state_dict() for optimizer in run.optimizers]
    saved["processes"] = map_nested(processes, np.ndarray, torch.from_numpy)  # weights_only loads no arrays
    write_file(model_of(args, run) | saved, run.folder / f"checkpoint-{run.step}.pt")
    for path in checkpoints_in(run.folder)[:-CHECKPOINTS_KEPT]:
        path.unlink()


def state_of_process(run: Run) -> dict[str, Any]:
    """Return what each process goes on with: environments, memory and generators, in arrays, tensors and numbers."""
    return {
        "environments": save_state(run.envs),
        "carry": vars(run.carry),
        "return_scale": vars(run.return_scale),
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state(run.device) if run.device.type == "cuda" else None,
        "numpy": np.random.get_state(),  # noqa: NPY002 (it and Python's: environments of other packages may use them)
        "python": random.getstate(),
    }


def write_file(saved: dict[str, Any], path: Path) -> None:
    """Write a model or a checkpoint, in the first process, atomically: the file is whole, or it is not there.

    Raises FloatingPointError, and writes nothing, if a weight is not finite; OSError if it cannot be written.
    """
    if rank_and_size()[0] > 0:
        return
    if not all(weight.isfinite().all() for weight in saved["weights"].values()):
        raise FloatingPointError(f"{path} is not written, since weights are not finite; try a lower --init-lr")
    part, content = Path(f"{path}.part"), io.BytesIO()
    torch.save(saved, content)  # to a file, it would raise RuntimeError where the disk is full
    try:
        with part.open("wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())  # on the disk before it has its name
        os.replace(part, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        with contextlib.suppress(OSError):  # the error of writing is being raised already
            part.unlink(missing_ok=True)


def map_nested(value: Any, kind: type, function: Callable) -> Any:
    """Apply a function to all values of a kind in nested dicts, lists and tuples."""
    if isinstance(value, dict):
        return {name: map_nested(each, kind, function) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map_nested(each, kind, function) for each in value)
    return function(value) if isinstance(value, kind) else value


# ---- reading ----
def checkpoints_in(folder: str | Path) -> list[Path]:
    """Return the checkpoints of a run, the latest last."""
    steps = {path: path.stem.removeprefix("checkpoint-") for path in Path(folder).glob("checkpoint-*.pt")}
    found = {int(step): path for path, step in steps.items() if step.isdecimal()}
    return [found[step] for step in sorted(found)]


def read_checkpoint(folder: str | Path) -> dict[str, Any]:
    """Read a run's last checkpoint, which has all that `read_model` returns and more.

    Raises ValueError if it is not whole, OSError if there is none.
    """
    if not os.path.isdir(folder):
        raise OSError(f"--resume {folder}: there is no such folder; give a run's, runs/RUN")
    if not (found := checkpoints_in(folder)):
        raise OSError(f"--resume {folder}: there is no checkpoint-STEP.pt in this folder")
    try:
        return read_model(found[-1])
    except ValueError as error:
        before = f"go on from {found[-2]}" if len(found) > 1 else "begin again"
        raise ValueError(f"{error}; remove it to {before}") from None


def read_model(path: str | Path) -> dict[str, Any]:
    """Read a model or a checkpoint to the CPU: a dict with script, args, weights, and all else that the file holds.

    Raises ValueError if it is not such a file, OSError if it cannot be read.
    """
    if os.path.isdir(path):
        raise OSError(f"{path} is a folder; give a file in it, as {Path(path) / 'model.pt'}")
    if not os.path.isfile(path):
        raise OSError(f"there is no file {path}; --save-model writes model.pt to the run folder")
    content = io.BytesIO(Path(path).read_bytes())
    try:
        saved = torch.load(content, map_location="cpu", weights_only=True)
        args = {RENAMED.get(name, name): value for name, value in saved["args"].items()}
        weights = dict(saved["weights"])
        for before, now in RENAMED_WEIGHTS.items():
            weights = {name.replace(before, now): weight for name, weight in weights.items()}
        return {**saved, "script": saved["script"], "args": args, "weights": weights}
    except Exception:  # torch.load raises many kinds of errors for a wrong file, and none tells more
        raise ValueError(f"{path} is cut short, or neither a model nor a checkpoint") from None


def saved_args(kind: type[T], saved: dict[str, Any]) -> T:
    """Return the arguments, of a script's Args, in what `read_model` read.

    A flag that is newer has the value that it stood for before it was one, or its default; one that no longer exists is
    left out.
    """
    known = {each.name for each in fields(kind)}
    return kind(**{name: value for name, value in (FORMER_DEFAULTS | saved["args"]).items() if name in known})


def import_script(saved: dict[str, Any], path: str | Path) -> ModuleType:
    """Import the script that wrote a file, which lies beside the program that runs or in the current folder.

    Raises ValueError if it is not there, or not named ppo_NAME.
    """
    name = str(saved["script"])
    if "" not in sys.path:
        sys.path.append("")  # the current folder, after all others
    try:
        script = importlib.import_module(name) if re.fullmatch(SCRIPT_NAME, name) else None
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        script = None
    if not hasattr(script, "Args"):
        raise ValueError(f"{path} was trained by {name}.py, which is not here; run this beside that script")
    return script


def load_weights(agent: nn.Module, saved: dict[str, Any], path: str | Path) -> None:
    """Give the agent the weights in what `read_model` read; auxiliary heads may be added to it or left out.

    Raises ValueError if they are another network's, or not finite.
    """
    try:
        missing, unexpected = agent.load_state_dict(saved["weights"], strict=False)
        if not {name.partition(".")[0] for name in (*missing, *unexpected)} <= {*agent.auxiliary}:
            raise RuntimeError
    except (RuntimeError, TypeError):
        names = ("env_id", "obs_type", *WRAPPERS, "embedding", "trunk_size")
        theirs = {name: saved["args"][name] for name in names if name in saved["args"]}
        raise ValueError(f"{path} holds the weights of another network, trained with {as_flags(theirs)}") from None
    if not all(weight.isfinite().all() for weight in saved["weights"].values()):
        raise ValueError(f"{path} holds weights that are not finite: the training diverged")


@dataclass
class Checkpoint:
    """What a model or a checkpoint holds of a trained agent, read once."""

    path: str | Path
    script: ModuleType  # that trained it
    saved: dict[str, Any]  # script, args and weights
    step: int | None  # of the training, at which it was written; None if the file does not tell
    args: Any  # the script's Args

    @classmethod
    def read(cls, path: str | Path, env_options: str | None = None) -> Checkpoint:
        """Read a file, to play with further reset options, JSON.

        Raises ValueError if it is no checkpoint, its script is not here or its environment does not have the options,
        OSError without a file.
        """
        saved = read_model(path)
        script = import_script(saved, path)
        # A file to resume from holds much more, which would stay in memory.
        needed = {name: saved[name] for name in ("script", "args", "weights")}
        args = with_options(saved_args(script.Args, saved), env_options)
        return cls(path, script, needed, saved.get("step"), args)

    def arguments(self) -> dict[str, Any]:
        """Return the arguments by name, with the script's name, and the step if it is known."""
        step = {} if self.step is None else {"step": self.step}
        return {"script": self.script.__name__, **asdict(self.args), **step}

    def agent(self, envs: VectorEnv, infos: dict[str, Any]) -> nn.Module:
        """Return the agent, on the CPU, for environments; infos are those of a reset.

        Raises ValueError for weights that do not fit, and what `make_agent` raises.
        """
        agent = make_agent(self.script.Agent, envs, infos, self.args)
        load_weights(agent, self.saved, self.path)
        return agent


# ---- going on ----
def check_resumed(args: RunArgs, saved: dict[str, Any], script: str) -> None:
    """Raise ValueError if the arguments are not those of the run that --resume goes on with.

    Those that are None until the run's others are known become the run's.
    """
    if saved["script"] != script:
        raise ValueError(f"--resume {args.resume}: this run is {saved['script']}.py's, not {script}.py's")
    if "processes" not in saved:
        raise ValueError(f"--resume {args.resume}: its last checkpoint holds weights alone; --load-model takes these")
    theirs = saved_args(type(args), saved)
    if gone := saved["args"].keys() - asdict(theirs).keys():
        names = " ".join(map(flag, sorted(gone)))
        tell(f"--resume {args.resume}: it goes on without {names}, which no longer exist")
    for name in ("anneal_steps", "vector_frequencies"):
        if getattr(args, name) is None:  # as it was when the run began; `check_args` replaces it
            setattr(args, name, getattr(theirs, name))
    for name in (each.name for each in fields(args) if each.name not in ("resume", "total_timesteps")):
        if getattr(args, name) != getattr(theirs, name):
            raise ValueError(
                f"{flag(name)} is {getattr(args, name)}, but the run in {args.resume} has {getattr(theirs, name)}; "
                "leave the flag out, or begin another run"
            )
    if args.total_timesteps < theirs.total_timesteps:
        raise ValueError(
            f"--total-timesteps is {args.total_timesteps}, but the run in {args.resume} has {theirs.total_timesteps}; "
            "it may be extended only"
        )
    before, processes = len(saved["processes"]), rank_and_size()[1]
    if before != processes:
        raise ValueError(f"--resume {args.resume}: this run has {before} processes, not {processes}; start as many")


def load_model(args: RunArgs, agent: nn.Module, script: str) -> None:
    """Give the agent the weights of --load-model; say so if they were trained on levels of this run's evaluations.

    Raises ValueError if another script, or one with other flags of the network, trained them; OSError without a file.
    """
    path = args.load_model
    saved = read_model(path)
    if saved["script"] != script:
        raise ValueError(f"{path} was trained by {saved['script']}.py, not by {script}.py")
    theirs = saved_args(type(args), saved)
    flags = (*agent.memory.flags, "frame_stack")  # a stack of three gray images is as large as an image of three colors
    differ = [name for name in flags if getattr(args, name) != getattr(theirs, name)]
    if differ:
        ours, theirs = (as_flags({name: getattr(each, name) for name in differ}) for each in (args, theirs))
        raise ValueError(f"{path} was trained with {theirs}, not with {ours}")
    load_weights(agent, saved, path)
    first, beyond = first_after(args), first_after(theirs)
    met = are_trained_on(theirs, first, args.eval_levels)
    if met and theirs.env_id == args.env_id and rank_and_size()[0] == 0:
        tell(
            f"{path} was trained on levels {theirs.start_level} to {beyond - 1}, and evaluations of this run play "
            f"levels {first} to {first + args.eval_levels - 1}; with --start-level {beyond}, they play others"
        )


def load_learner(run: Run, saved: dict[str, Any], folder: str | Path) -> None:
    """Set the agent, the optimizers and what is counted to what a folder's checkpoint holds.

    Raises ValueError if weights or optimizers do not fit, or if the checkpoint is of another version.
    """
    load_weights(run.agent, saved, folder)
    try:
        for optimizer, state in zip(run.optimizers, saved["optimizers"], strict=True):
            optimizer.load_state_dict(state)
        if any("lr_ratio" not in optimizer.param_groups[0] for optimizer in run.optimizers):
            raise KeyError
        shapes = {name: part.shape for name, part in run.carry.memory.items()}
        for process in saved["processes"]:
            theirs = {name: part.shape for name, part in process["carry"]["memory"].items()}
            if theirs != shapes or "return_scale" not in process:
                raise KeyError
    except (KeyError, ValueError):
        raise ValueError(
            f"{folder}: its checkpoint is of another version, and training cannot go on from it; --load-model takes "
            "its weights"
        ) from None
    run.step, run.seconds = saved["step"], saved["seconds"]
    run.returns.extend(saved["returns"])
    run.lengths.extend(saved["lengths"])


@torch.no_grad()
def load_process(run: Run, saved: dict[str, Any]) -> None:
    """Set environments, memory and generators to what `state_of_process` returned: the run goes on from there.

    Environments of other packages begin new episodes, with a line that says so. Raises ValueError if the state is one
    of other environments.
    """
    rank = rank_and_size()[0]
    state = saved["processes"][rank]
    vars(run.return_scale).update(state["return_scale"])
    random.setstate(state["python"])
    torch.set_rng_state(state["torch"])
    if state["cuda"] is not None and run.device.type == "cuda":
        torch.cuda.set_rng_state(state["cuda"], run.device)
    memory = {name: part.to(run.carry.memory[name].device) for name, part in state["carry"].pop("memory").items()}
    arrays = map_nested({name: state[name] for name in ("environments", "carry", "numpy")}, Tensor, Tensor.numpy)
    np.random.set_state(arrays["numpy"])  # noqa: NPY002
    if arrays["environments"] is None:
        run.return_scale.discounted = None
        if rank == 0:
            tell(f"{run.envs.spec.id} has no state to save: every environment begins a new episode")
        return
    load_state(run.envs, arrays["environments"])
    run.carry = replace(run.carry, memory=memory, **arrays["carry"])
