"""Do the thesis' claims hold here? Trains the agents that a claim of its chapters 6 and 7 compares, on small tasks.

    python benchmarks/claims.py --results benchmarks/results
    python benchmarks/claims.py --claims query-position gate-bias

The thesis trained for up to 819 million steps from pixels. Here networks are small, observations are vectors, and tasks
take minutes, as in benchmarks/learning.py, whose runs and results these are; so a verdict is about these tasks. A claim
that one agent is better than another holds if each of its seeds is better than each of the other's, and does not hold
if each is worse; otherwise it is not decided. By chance alone, three seeds against three are apart like that, in a
given direction, once in 20 times. Where the thesis saw no difference, the claim is contradicted if seeds are apart.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import learning
import numpy as np
import tyro
from learning import TASKS, Task

import evaluate

VISIBLE = Task(
    "SearingSpotlights-v0", 1_000_000, {name: True for name in ("agent_visible", "coins_visible", "exit_visible")}
)
MORTAR_MAYHEM, MYSTERY_PATH, ENDLESS = (TASKS[name] for name in learning.SMALL)
ACT = replace(
    MORTAR_MAYHEM,
    env_id="MortarMayhemB-Grid-v0",
    options={"command_count": [4], "explosion_delay": [4], "explosion_duration": [2]},
)
ORIGIN_AND_GOAL = replace(MYSTERY_PATH, options=MYSTERY_PATH.options | {"show_origin": True, "show_goal": True})
WITHOUT_MEMORY = ("no memory", "stack of 4", "stack of 16", "step encoding")


def score(task: Task, run: evaluate.Run) -> float:
    """Return the mean of a run's last evaluation in the family's metric."""
    return run.curves[f"eval/{task.metric}"][1][-1].mean()


def area(task: Task, run: evaluate.Run) -> float:
    """Return the mean of a run's learning curve in the family's metric: sample efficiency."""
    return run.curves[f"eval/{task.metric}"][1].mean()


def few_falls(task: Task, run: evaluate.Run) -> float:
    """Return the mean number of falls in the episodes of a run's last evaluation, negative: more is better."""
    return -run.curves["eval/num_fails"][1][-1].mean()


def speed(task: Task, run: evaluate.Run) -> float:
    """Return a run's steps of training a second: of its median iteration."""
    batch = int(run.args["num_envs"]) * int(run.args["num_steps"])
    return batch / float(np.median(run.seconds("iteration")))


def gradient_norm(task: Task, run: evaluate.Run) -> float:
    """Return the mean norm of a run's gradients before they are clipped."""
    return run.curves["losses/grad_norm"][1].mean()


@dataclass(frozen=True)
class Claim:
    """What the thesis says of agents: that each of `more` has more of something than each of `less`."""

    section: str
    says: str
    task: Task
    more: tuple[str, ...]
    less: tuple[str, ...]
    measure: Callable[[Task, evaluate.Run], float] = score
    apart: bool = True  # or, if the thesis saw no difference, False


CLAIMS = {
    "memory-mortar-mayhem": Claim(
        "6.2.1", "only agents with a memory solve Mortar Mayhem", MORTAR_MAYHEM, ("GRU", "TrXL"), WITHOUT_MEMORY
    ),
    "memory-mortar-mayhem-act": Claim(
        "6.2.1", "with all commands in view, PPO without memory is ineffective", ACT, ("GRU", "TrXL"), ("no memory",)
    ),
    "memory-mystery-path": Claim(
        "6.2.1", "only agents with a memory solve Mystery Path", MYSTERY_PATH, ("GRU", "TrXL"), WITHOUT_MEMORY
    ),
    "stack-mystery-path": Claim(
        "6.2.1", "if origin and goal are visible, a stack of 16 is enough, and one of 4 is not", ORIGIN_AND_GOAL,
        ("stack of 16",), ("stack of 4", "step encoding", "no memory"),
    ),
    "efficiency-mortar-mayhem": Claim(
        "6.2.2", "TrXL takes fewer samples than GRU in Mortar Mayhem Grid", MORTAR_MAYHEM, ("TrXL",), ("GRU",), area
    ),
    "efficiency-mystery-path": Claim(
        "6.2.2", "TrXL takes fewer samples than GRU in Mystery Path", MYSTERY_PATH, ("TrXL",), ("GRU",), area
    ),
    "lstm": Claim("6.2.3", "LSTM completes fewer commands than GRU", MORTAR_MAYHEM, ("GRU",), ("LSTM",)),
    "gtrxl": Claim("6.2.3", "GTrXL completes fewer commands than TrXL", MORTAR_MAYHEM, ("TrXL",), ("GTrXL",)),
    "gate-bias": Claim(
        "6.2.3", "a gate bias of 0 is better than one of 2", MYSTERY_PATH, ("GTrXL",), ("GTrXL --trxl-gate-bias 2",)
    ),
    "endless-mortar-mayhem": Claim(
        "6.3", "GRU completes more commands than TrXL in Endless Mortar Mayhem", ENDLESS, ("GRU",), ("TrXL",)
    ),
    "wall-time": Claim("6.4", "GRU trains faster than TrXL", ENDLESS, ("GRU",), ("TrXL",), speed),
    "falls": Claim(
        "6.5.2", "TrXL falls off less often than GRU in Mystery Path", MYSTERY_PATH, ("TrXL",), ("GRU",), few_falls
    ),
    "capacity": Claim(
        "7.1.1", "wider or more blocks do not bring TrXL to GRU's level", ENDLESS,
        ("GRU",), ("TrXL --trxl-dim 96", "TrXL --trxl-num-layers 3"),
    ),
    "learning-rate": Claim(
        "7.1.2", "a higher final learning rate is better for TrXL", ENDLESS, ("TrXL",), ("TrXL --final-lr 1e-5",)
    ),
    "ground-truth": Claim(
        "7.1.2", "estimating the ground truth helps TrXL", ENDLESS, ("TrXL --ground-truth-coef 0.1",), ("TrXL",)
    ),
    "query-position": Claim(
        "7.1.3", "the step's encoding in the query helps TrXL", ENDLESS, ("TrXL --trxl-query-position",), ("TrXL",)
    ),
    "query-output": Claim(
        "7.1.3", "the last output in the query is catastrophic", ENDLESS, ("TrXL",), ("TrXL --trxl-query-output",)
    ),
    "encodings": Claim(
        "7.1.5", "learned and relative encodings are no better than the absolute one", ENDLESS,
        ("TrXL --trxl-positional-encoding learned", "TrXL --trxl-positional-encoding relative"), ("TrXL",), apart=False,
    ),
    "norm-adv": Claim(
        "7.2", "normalized advantages spoil Searing Spotlights, all of it visible", VISIBLE,
        ("GRU",), ("GRU --norm-adv minibatch",),
    ),
    "norm-adv-gradient": Claim(
        "7.2", "gradients are larger with normalized advantages", VISIBLE,
        ("GRU --norm-adv minibatch",), ("GRU",), gradient_norm,
    ),
}  # fmt: skip


@dataclass
class Config(learning.Training):
    """Which claims to test."""

    claims: tuple[str, ...] = tuple(CLAIMS)
    """of those that this program knows"""


def verdict(claim: Claim, more: np.ndarray, less: np.ndarray) -> str:
    """Return the verdict on a claim, from a number a run: (agents, R) each."""
    higher, lower = more.min() > less.max(), more.max() < less.min()
    if not claim.apart:
        return "contradicted" if higher or lower else "not contradicted"
    return "holds" if higher else "does not hold" if lower else "not decided"


def row(name: str, config: Config) -> str:
    """Return a claim's row of the table."""
    claim = CLAIMS[name]
    numbers = {}
    for agent in (*claim.more, *claim.less):
        runs = [learning.result_of(config, claim.task, agent, seed) for seed in config.seeds]
        numbers[agent] = np.array([claim.measure(claim.task, run) for run in runs])  # (R,)
    told = "; ".join(
        f"{agent} {each.mean():.3g} ({each.min():.3g} to {each.max():.3g})" for agent, each in numbers.items()
    )
    found = verdict(claim, *(np.stack([numbers[agent] for agent in agents]) for agents in (claim.more, claim.less)))
    return f"| {claim.section} | {claim.says} | `{name}` | {claim.measure.__name__}: {told} | {found} |"


def main(config: Config) -> None:
    """Train what is missing, then print a row for each claim."""
    if unknown := [name for name in config.claims if name not in CLAIMS]:
        raise SystemExit(f"there is no claim {unknown[0]}; there are {', '.join(CLAIMS)}")
    wanted = {}  # by its command: several claims may compare the same agent
    for claim in map(CLAIMS.get, config.claims):
        for run in itertools.product([claim.task], (*claim.more, *claim.less), config.seeds):
            wanted[tuple(learning.command(config, *run))] = run
    learning.train_missing(config, [*wanted.values()])
    print("| section | the thesis says | claim | mean of the seeds (least to most) | verdict |\n|---|---|---|---|---|")
    for name in config.claims:
        print(row(name, config))


if __name__ == "__main__":
    main(tyro.cli(Config))
