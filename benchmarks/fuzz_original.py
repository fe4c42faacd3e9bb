"""Plays random episodes here and in memory-gym, and reports every difference.

    python benchmarks/fuzz_original.py [--original PYTHON] [--minutes M] [--seed S] [--ids ID ...]
    python benchmarks/fuzz_original.py [--original PYTHON] --seed S --first E --episodes 1

An episode is an id, a level, reset options from anywhere in their documented ranges, and actions that are random, held
for a while, or those of a scripted player who stumbles. It is played here first. Then the original, a process of an
interpreter that has memory-gym, plays the same actions in a new environment. Compared are rewards, ends, the final
info, and at every step ground truth, command vector and all pixels of the frame. Without --original such an interpreter
is made for the time of the run, with memory-gym 1.0.2 from the package index. It may also have 1.0.3, from the author's
repository; then its options are drawn, too, and Endless Mystery Path is played by its rule.

Prints how many episodes differ and in what, and of each kind the first, with the options that show it alone. What
docs/environments.md lists as a difference is counted apart. The exit code is 1 if anything else differs.
"""

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
import venv
import zlib
from collections import Counter
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (["gymnasium", "numpy", "pygame"], ["--no-deps", "memory-gym==1.0.2"])
LONGEST = 500  # steps of an episode
KINDS = ("crash", "reward", "end", "info", "ground truth", "command vector", "frame")
LACKS = {"1.0.3": {"coin_feedback", "spawn_delay", "origin_restores_stamina"}}  # options that a version has not
LACKS["1.0.2"] = LACKS["1.0.3"] | {"coin_enabled", "reward_new_command_success", "reward_path_progress_dense"}
AS_IN = {"1.0.2": {}, "1.0.3": {"Endless-MysteryPath-v0": {"origin_restores_stamina": False}}}  # given here alone
NOT_COMPARED = """Left out:
  options that this version lacks
  num_spawns above 1000, of which the original makes a list
  a smallest radius or speed above the largest
  ground truth of ids for which the original has none; debug frames, which show other things here"""


def play(env: gym.Env, seed: int, options: dict[str, Any], act: Callable[[int], Any], theirs: bool) -> dict[str, Any]:
    """Play one episode: what each step gave, or the error that ended it. act: the step's action; None: stop."""
    played: dict[str, Any] = {"seen": [], "rewards": [], "actions": [], "over": False, "info": {}, "error": None}
    try:
        observation, info = env.reset(seed=seed, options=options)
        played["seen"].append(digest(observation, info, theirs))
        while not played["over"] and (action := act(len(played["rewards"]))) is not None:
            played["actions"].append(action)
            observation, reward, terminated, truncated, info = env.step(action)
            played["seen"].append(digest(observation, info, theirs))
            played["rewards"].append(float(reward))
            played.update(over=bool(terminated or truncated), truncated=bool(truncated))
        if played["over"]:
            played["info"] = {name: np.asarray(value).tolist() for name, value in info.items()}
    except Exception as error:
        played["error"] = f"{type(error).__name__}: {error}"
    return played


def digest(observation: Any, info: dict[str, Any], theirs: bool) -> list[Any]:
    """What is compared of one step: ground truth, and checksums of command vector and frame."""
    truth, vector = info.get("ground_truth"), None
    if isinstance(observation, dict):
        vector, observation = zlib.crc32(observation["vector_observation"]), observation["visual_observation"]
    frame = observation.transpose(1, 0, 2) if theirs else observation
    return [None if truth is None else np.asarray(truth).tolist(), vector, zlib.crc32(np.ascontiguousarray(frame))]


# ---- the original's process ----


def serve() -> None:
    """Play the episodes that come in, one JSON line each, and answer each with one."""
    os.environ.update(SDL_VIDEODRIVER="dummy", SDL_AUDIODRIVER="dummy", PYGAME_HIDE_SUPPORT_PROMPT="1")
    answers, sys.stdout = sys.stdout, sys.stderr
    import memory_gym  # noqa: F401 (registers the ids)

    print(json.dumps(metadata.version("memory-gym")), file=answers, flush=True)
    np.seterr(all="ignore")  # a share of no coins
    gym.logger.min_level = gym.logger.ERROR
    for line in sys.stdin:
        env_id, seed, options, actions = json.loads(line)
        env = gym.make(env_id, disable_env_checker=True).unwrapped
        played = play(env, seed, options, dict(enumerate(actions)).get, theirs=True)
        print(json.dumps(played), file=answers, flush=True)


def make_original(folder: str) -> str:
    """An interpreter that has memory-gym, in this folder."""
    venv.create(folder, with_pip=True)
    python = Path(folder) / ("Scripts" if os.name == "nt" else "bin") / "python"
    for packages in PACKAGES:
        subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
    return str(python)


# ---- episodes ----


def sample_options(rng: np.random.Generator, table: tuple[Any, ...], version: str) -> dict[str, Any]:
    """Reset options: each of the table's that the version has, with the same chance, which is drawn as well."""
    table = tuple(option for option in table if option.name not in LACKS[version])
    chance, defaults = rng.choice([0.0, 0.1, 0.3, 1.0]), {option.name: option.default for option in table}
    values = {option.name: sample_value(rng, option) for option in table if rng.random() < chance}
    if "num_spawns" in values:
        values["num_spawns"] = min(values["num_spawns"], 1000)
    for pair in (("spot_min_radius", "spot_max_radius"), ("spot_min_speed", "spot_max_speed")):
        if not values.keys().isdisjoint(pair):
            values |= zip(pair, sorted(values.get(name, defaults[name]) for name in pair), strict=True)
    return values


def sample_value(rng: np.random.Generator, option: Any) -> Any:
    """A value of one option, from anywhere in its range."""
    if option.kind == "bool":
        return bool(rng.integers(2))
    if option.kind == "ints":
        return [sample_number(rng, option) for _ in range(rng.integers(not option.empty, 5))]
    return sample_number(rng, option)


def sample_number(rng: np.random.Generator, option: Any) -> float:
    """An end of the range, anywhere in it, or mostly near its start; maybe a round number or a multiple of a root."""
    if option.also and rng.random() < 0.2:
        return option.also[0]
    low, high = option.bounds
    start = max(low, 0)
    near = start + 10 ** rng.uniform(-3, math.log10(high - start)) * (rng.choice([-1, 1]) if low < 0 else 1)
    value = float(rng.choice([low, high, rng.uniform(low, high), near, near, near]))
    if option.kind != "float":
        return int(min(max(round(value), low), high))
    rounded = (round(value), round(4 * value) / 4, round(value / math.sqrt(2)) / math.sqrt(0.5), value)
    return min(max(rounded[rng.integers(4)], low), high)


def choose_actions(rng: np.random.Generator, env: gym.Env) -> Callable[[int], Any]:
    """The actions of one episode, which are held for so many steps, more or less."""
    from memory_gym_envs.players import stumbling

    stumble, hold, held = np.array([rng.choice([0.0, 0.05, 0.3, 1.0])]), rng.choice([1, 1, 4, 20]), [None]

    def act(step: int) -> Any:
        if step % hold == 0 or rng.random() < 0.1:
            held[0] = stumbling(env.batch, rng, stumble)[0].tolist()
        return held[0] if step < LONGEST else None

    return act


def compare(ours: dict[str, Any], theirs: dict[str, Any], scale: float) -> dict[str, int]:
    """The kinds of difference, each with the first step that has it. scale: of the largest reward."""
    found: dict[str, int] = {}
    for step, (mine, other) in enumerate(zip(ours["seen"], theirs["seen"], strict=False)):
        for kind, left, right in zip(KINDS[4:], mine, other, strict=True):
            if right is not None and not np.allclose(left, right, rtol=0, atol=1e-9):
                found.setdefault(kind, step)
    for step, (mine, other) in enumerate(zip(ours["rewards"], theirs["rewards"], strict=False), 1):
        if abs(mine - other) > 1e-9 * scale:
            found.setdefault("reward", step)
    steps = len(theirs["rewards"])
    if ours["error"] or theirs["error"]:
        found["crash"] = steps
    elif (len(ours["rewards"]), ours["over"]) != (steps, theirs["over"]):
        found["end"] = min(steps, len(ours["rewards"]))
    elif any(not np.allclose(ours["info"][name], value, 1e-9, 1e-9 * scale) for name, value in theirs["info"].items()):
        found["info"] = steps
    return found


def excuse(found: dict[str, int], ours: dict, theirs: dict, env_id: str, options: dict[str, Any]) -> list[str]:
    """Takes out what docs/environments.md lists, and returns its names."""
    coins, error, known = options.get("num_coins", [1]), theirs["error"] or "", []
    if ours.get("truncated"):
        known.append("max_steps truncates here and terminates there")
    if "info" in found and math.isnan(theirs["info"].get("coins_collected", 0)):
        known.append("the share of no coins is NaN there and 1 here")
        del found["info"]
    if "frame" in found and not options.get("coin_enabled", True):
        known.append("coin_enabled=False paints the floor black there")
        del found["frame"]
    crashes = {
        "num_coins=[]": not coins,
        "use_exit=False": not options.get("use_exit", True),
        "show_last_action=False": env_id.startswith("Endless") and not options.get("show_last_action", True),
        "no free pixel for a coin or the exit": "high <= 0" in error and max(coins, default=0) > 1,
    }
    names = [name for name, applies in crashes.items() if applies]
    if error and names and not ours["error"]:
        known.append(f"{names[0]} crashes the original")
        del found["crash"]
    return known


class Fuzz:
    """The environments here, the original's process, and what was found so far."""

    def __init__(self, original: str, seed: int):
        import memory_gym_envs

        # They are never made again: nothing may carry over from one episode to the next.
        self.envs = {env_id: gym.make(env_id, disable_env_checker=True).unwrapped for env_id in memory_gym_envs.IDS}
        command, self.seed = [original, str(Path(__file__).resolve()), "--serve"], seed
        self.original = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.version = json.loads(self.original.stdout.readline() or "null")
        if self.version not in LACKS:
            sys.exit(f"{original} needs memory-gym {' or '.join(LACKS)}; it has {self.version or 'none'}")
        self.counts, self.known, self.differ = Counter(), Counter(), dict.fromkeys(KINDS, 0)

    def episode(self, ids: list[str], number: int) -> None:
        """Play one episode, count what differs, and print what differs for the first time."""
        rng = np.random.default_rng([self.seed, number])
        env_id, level = str(rng.choice(ids or list(self.envs))), int(rng.integers(2**31))
        env = self.envs[env_id]
        options = sample_options(rng, env.batch.variant.options, self.version)
        rule = AS_IN[self.version].get(env_id, {})
        ours = play(env, level, options | rule, choose_actions(rng, env), theirs=False)
        print(json.dumps([env_id, level, options, ours["actions"]]), file=self.original.stdin, flush=True)
        theirs = json.loads(self.original.stdout.readline())
        rewards = [abs(value) for name, value in env.reset_params.items() if name.startswith("reward_")]
        found = compare(ours, theirs, max(1.0, *rewards) * max(1, len(ours["rewards"])))
        self.known.update(excuse(found, ours, theirs, env_id, options))
        self.counts.update(episodes=1, steps=len(theirs["rewards"]), frames=len(theirs["seen"]))
        for kind, step in found.items():
            if not self.differ[kind]:
                print(f"{kind} at step {step}: --seed {self.seed} --first {number} --episodes 1")
                print(f"  {env_id}, level {level}, options {json.dumps(options)}")
                print(f"  errors: here {ours['error']}, there {theirs['error']}", flush=True)
            self.differ[kind] += 1


def executable(path: str) -> str:
    """Return the path of a program that can be run; raise ValueError for another."""
    if shutil.which(path) is None:
        raise ValueError
    return path


def main() -> int:
    """Run for a while, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--original", type=executable, help="an interpreter that has memory-gym (default: one is made)")
    parser.add_argument("--minutes", type=float, default=10.0, help="time of the run (default: 10)")
    parser.add_argument("--episodes", type=int, default=10**9, help="end after so many (default: no limit)")
    parser.add_argument("--seed", type=int, default=0, help="of the draws (default: 0)")
    parser.add_argument("--first", type=int, default=0, help="number of the first episode (default: 0)")
    parser.add_argument("--ids", nargs="+", help="ids to draw from (default: all)")
    args = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    import memory_gym_envs

    if unknown := [each for each in args.ids or () if each not in memory_gym_envs.IDS]:
        parser.error(f"there is no {unknown[0]}; there are {', '.join(memory_gym_envs.IDS)}")
    if min(args.seed, args.first) < 0:
        parser.error("--seed and --first must be 0 or more")
    with tempfile.TemporaryDirectory() as folder:
        fuzz = Fuzz(args.original or make_original(folder), args.seed)
        number, end = args.first, time.monotonic() + 60 * args.minutes
        while number < args.first + args.episodes and time.monotonic() < end:
            fuzz.episode(args.ids, number)
            number += 1
        fuzz.original.communicate()
    print(", ".join(f"{count:,} {name}" for name, count in fuzz.counts.items()))
    print("Episodes that differ: " + ", ".join(f"{count} {kind}" for kind, count in fuzz.differ.items()))
    print("Known differences:" + "".join(f"\n  {count} {name}" for name, count in sorted(fuzz.known.items())))
    print(NOT_COMPARED)
    return int(any(fuzz.differ.values()))


if __name__ == "__main__":
    sys.exit(serve() if "--serve" in sys.argv else main())
