"""Steps per second of every id, alone and many in one process, on one core, beside memory-gym's where installed.

    python benchmarks/env_fps.py [--seconds S] [--num-envs N] [--many-envs M] [--ids ID ...]

Prints two Markdown tables, of frames and of vector observations, both beside memory-gym's one environment. Actions are
random, resets included. memory-gym is optional: without it, its columns are empty. Because machines are noisy, seconds
are the processor's time for this process, without that of other programs, the measurements of the two packages take
turns, and each column shows the best of its rounds. Ratios are what to quote.
"""

import argparse
import importlib
import os
import sys
import time
import warnings
from pathlib import Path

os.environ.update(SDL_VIDEODRIVER="dummy", SDL_AUDIODRIVER="dummy", PYGAME_HIDE_SUPPORT_PROMPT="1")
# One core means one thread.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import gymnasium as gym

# memory-gym's classes, from their modules: its ids are ours.
ORIGINALS = {
    "MortarMayhem-v0": ("mortar_mayhem", "MortarMayhemEnv"),
    "MortarMayhem-Grid-v0": ("mortar_mayhem_grid", "GridMortarMayhemEnv"),
    "MortarMayhemB-v0": ("mortar_mayhem_b", "MortarMayhemTaskBEnv"),
    "MortarMayhemB-Grid-v0": ("mortar_mayhem_b_grid", "GridMortarMayhemTaskBEnv"),
    "Endless-MortarMayhem-v0": ("endless_mortar_mayhem", "EndlessMortarMayhemEnv"),
    "MysteryPath-v0": ("mystery_path", "MysteryPathEnv"),
    "MysteryPath-Grid-v0": ("mystery_path_grid", "GridMysteryPathEnv"),
    "Endless-MysteryPath-v0": ("endless_mystery_path", "EndlessMysteryPathEnv"),
    "SearingSpotlights-v0": ("searing_spotlights", "SearingSpotlightsEnv"),
    "Endless-SearingSpotlights-v0": ("endless_searing_spotlights", "EndlessSearingSpotlightsEnv"),
}
COLUMNS = ["id", "memory-gym", "one", "ratio", "{n} lanes", "ratio", "reset, memory-gym", "reset", "ratio"]
VECTOR_COLUMNS = ["id", "memory-gym", "{n} lanes", "ratio", "{m} lanes", "ratio"]
ACTIONS = 256  # sampled before the clock starts
ROUNDS = 8  # in which the packages take turns


def original_classes() -> dict[str, type]:
    """memory-gym's environment classes by id; empty where it is not installed."""
    try:
        return {id_: getattr(importlib.import_module(f"memory_gym.{m}"), c) for id_, (m, c) in ORIGINALS.items()}
    except ImportError:
        return {}


def single_rate(env, seconds: float) -> float:
    """Steps per second of one environment, resets included."""
    actions = [env.action_space.sample() for _ in range(ACTIONS)]
    env.reset(seed=1)
    steps, start = 0, time.process_time()
    while time.process_time() - start < seconds:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        steps += ACTIONS
    return steps / (time.process_time() - start)


def vector_rate(envs, seconds: float) -> float:
    """Steps per second of all lanes together, automatic resets included."""
    actions = [envs.action_space.sample() for _ in range(ACTIONS)]
    envs.reset(seed=1)
    rounds, start = 0, time.process_time()
    while time.process_time() - start < seconds:
        for action in actions[rounds % ACTIONS :][:16]:
            envs.step(action)
        rounds += 16
    return rounds * envs.num_envs / (time.process_time() - start)


def reset_rate(env, seconds: float) -> float:
    """Resets per second of one environment."""
    resets, start = 0, time.process_time()
    while time.process_time() - start < seconds:
        env.reset()
        resets += 1
    return resets / (time.process_time() - start)


def measure(id_: str, original: type | None, lanes: tuple[int, int], seconds: float) -> dict[str, float]:
    """The best rate of every measurement over the rounds.

    lanes: of the vector environment, and of a larger one with vector observations.
    """
    one = gym.make(id_)
    tasks = [("one", single_rate, one), ("lanes", vector_rate, gym.make_vec(id_, num_envs=lanes[0]))]
    tasks.append(("reset", reset_rate, one))
    for name, num_envs in zip(("vectors", "many vectors"), lanes, strict=True):
        tasks.append((name, vector_rate, gym.make_vec(id_, num_envs=num_envs, obs_type="vector")))
    if original:
        theirs = original()
        tasks[1:1] = [("their one", single_rate, theirs), ("their reset", reset_rate, theirs)]
    best: dict[str, float] = {}
    for _ in range(ROUNDS):
        for name, rate, env in tasks:
            best[name] = max(best.get(name, 0.0), rate(env, seconds / ROUNDS))
    for _, _, env in tasks:
        env.close()
    return best


def cells(best: dict[str, float], *names: str) -> list[str]:
    """The rates of these names, and behind each but memory-gym's own its ratio to that."""
    theirs, texts = best.get("their one"), []
    for name in names:
        texts.append(f"{best[name]:,.0f}" if name in best else "")
        if name != "their one":
            texts.append(f"{best[name] / theirs:.1f}" if theirs else "")
    return texts


def row(id_: str, best: dict[str, float]) -> str:
    """One line of the table of frames. Resets are shown as microseconds each."""
    resets = [f"{1e6 / best[name]:,.0f} us" if name in best else "" for name in ("their reset", "reset")]
    resets.append(f"{best['reset'] / best['their reset']:.1f}" if "their reset" in best else "")
    return line(f"`{id_}`", *cells(best, "their one", "one", "lanes"), *resets)


def line(*texts: str) -> str:
    """One line of a Markdown table."""
    return f"| {' | '.join(texts)} |"


def heading(columns: list[str], lanes: tuple[int, int]) -> str:
    """The first two lines of a table."""
    return line(*columns).format(n=lanes[0], m=lanes[1]) + "\n|---" + "|---:" * (len(columns) - 1) + "|"


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=2.0, help="time for each number (default: 2)")
    parser.add_argument("--num-envs", type=int, default=32, help="lanes of the vector environment (default: 32)")
    parser.add_argument("--many-envs", type=int, default=256, help="lanes of a larger one, vectors only (default: 256)")
    parser.add_argument("--ids", nargs="+", default=None, help="ids to measure (default: all)")
    args = parser.parse_args()
    lanes = (args.num_envs, args.many_envs)
    if not 0 < args.seconds < float("inf") or min(lanes) < 1:
        parser.error("--seconds, --num-envs and --many-envs must be positive")
    warnings.filterwarnings("ignore")
    originals = original_classes()
    import memory_gym_envs  # after memory-gym, so that the ids are this package's

    unknown = sorted(set(args.ids or []) - set(memory_gym_envs.IDS))
    if unknown:
        parser.error(f"no such id: {', '.join(unknown)}; the ids are {', '.join(memory_gym_envs.IDS)}")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print("Steps per second; random actions, one process, one core" + ("." if originals else "; no memory-gym here."))
    print(f"\nFrames:\n\n{heading(COLUMNS, lanes)}")
    found = {}
    for id_ in args.ids or memory_gym_envs.IDS:
        found[id_] = measure(id_, originals.get(id_), lanes, args.seconds)
        print(row(id_, found[id_]), flush=True)
    print(f"\nVector observations:\n\n{heading(VECTOR_COLUMNS, lanes)}")
    for id_, best in found.items():
        print(line(f"`{id_}`", *cells(best, "their one", "vectors", "many vectors")))


if __name__ == "__main__":
    main()
