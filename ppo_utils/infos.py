"""What a training counts and logs of the infos of its environments: ground truth, ended episodes, final observations.

Shape letters: N environments, G entries of the ground truth.
"""

import functools
import math
from collections import defaultdict
from typing import Any

import numpy as np

from ppo_utils.errors import RunError
from ppo_utils.flags import RunArgs
from ppo_utils.lanes import OWN
from ppo_utils.terminal import tell

# Mortar Mayhem keeps these as the original has them: an agent that fails at the last command has 1 in both. What counts
# is `carried_out`.
COUNT_A_FAILED_COMMAND = ("commands_completed", "success")


def ground_truth_of(infos: dict[str, Any], args: RunArgs, before: np.ndarray | None = None) -> np.ndarray | None:
    """Return the ground truth (N, G) that --ground-truth-coef estimates, None where it is 0.

    before: that of the step before, if there is one. Raises RunError if an environment reports none, or other than G
    finite numbers.
    """
    if not args.ground_truth_coef:
        return None
    wanted = "--ground-truth-coef needs ground_truth in every info, of every reset and step"
    truths = ground_truths(infos)
    for lane, truth in enumerate(truths if isinstance(truths, list) else ()):
        if truth is None:
            number = infos[OWN][lane][1].number if OWN in infos else lane
            raise RunError(f"{wanted}; environment {number} reports none; use 0")
    try:
        truth = np.asarray(truths, np.float32)
    except (TypeError, ValueError):
        truth = np.zeros(())
    if truth.ndim != 2 or not np.isfinite(truth).all() or (before is not None and truth.shape != before.shape):
        raise RunError(f"{wanted}: an array of numbers, as many in all environments and always, and finite; use 0")
    return truth


def ground_truths(infos: dict[str, Any]) -> Any:
    """Return the environments' ground truths: a batch, or a list where some may report none, which is None there."""
    if OWN in infos:  # of environments that are made one by one
        return [info.get("ground_truth") for info, _ in infos[OWN]]
    truths, reported = infos.get("ground_truth", [None]), infos.get("_ground_truth", True)
    if np.all(reported):
        return truths
    return [truth if there else None for truth, there in zip(truths, reported, strict=True)]


def add_ended(episodes: defaultdict[str, list[float]], infos: dict[str, Any], done: np.ndarray) -> None:
    """Add to lists by name what the episodes report that ended, done (N,): nothing where none did.

    charts/episodic_return, charts/episodic_length, and episode/* for every number in the environment's final info.
    """
    if done.any():
        episodes["charts/episodic_return"] += infos["episode"]["r"][done].tolist()
        episodes["charts/episodic_length"] += infos["episode"]["l"][done].tolist()
        for name, values in final_numbers(infos, done).items():
            episodes[f"episode/{name}"] += values[~np.isnan(values)].tolist()


def final_numbers(infos: dict[str, Any], ended: np.ndarray) -> dict[str, np.ndarray]:
    """Return the numbers in the final infos of ended episodes by name, (N,) float64 each, NaN where a lane has none.

    What is no finite number is left out, and a line on stderr says so, once for each name. ended: (N,) bool.
    """
    numbers = {}
    for lane in np.flatnonzero(ended).tolist():
        info = final_info_of(infos, lane)
        left_out = COUNT_A_FAILED_COMMAND if "carried_out" in info else ()
        left_out += ("is_success",) if "success" in info else ()  # the same once more, for Stable-Baselines3
        info = {name: value for name, value in info.items() if name not in left_out}
        for name, value in info.items():
            number = as_number(value)
            if number is not None:
                numbers.setdefault(str(name), np.full(len(ended), np.nan))[lane] = number
            elif name != "ground_truth":
                tell_left_out(name)
    return numbers


def final_info_of(infos: dict[str, Any], lane: int) -> dict[str, Any]:
    """Return the last info of a lane's episode that just ended, however its environments batch infos."""
    final = infos.get("final_info", {})
    if isinstance(final, np.ndarray):  # a dict for each lane
        return final[lane] or {}
    if OWN in final:
        return final[OWN][lane][0]
    found = {}
    for name, values in final.items():
        reported = final.get(f"_{name}", True)
        if not str(name).startswith("_") and (reported if np.ndim(reported) == 0 else reported[lane]):
            found[name] = values[lane] if np.ndim(values) else values
    return found


def as_number(value: Any) -> float | None:
    """Return a finite number, or an array of one, as a float; None for all else."""
    try:
        if hasattr(value, "item"):
            value = value.item()
        number = None if isinstance(value, (str, bytes)) else float(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):  # RuntimeError: torch's
        return None
    return number if number is not None and math.isfinite(number) else None


@functools.cache
def tell_left_out(name: str) -> None:
    """Say once that something in the infos is not logged."""
    tell(f"{name}, in the info that ends an episode, is no finite number there, and is left out")


def final_observations(
    observations: dict[str, np.ndarray], infos: dict[str, Any], ended: np.ndarray
) -> dict[str, np.ndarray]:
    """Return copies of observations (N, ...) that hold the last one of an episode where one has just ended.

    ended: (N,) bool.
    """
    observations = {name: part.copy() for name, part in observations.items()}
    for lane in np.flatnonzero(ended):
        for name, part in infos["final_obs"][lane].items():
            observations[name][lane] = part
    return observations
