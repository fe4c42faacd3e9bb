"""Do the thesis' claims hold here? Train the agents that claims of its chapters 6 and 7 compare.

    python benchmarks/claims.py --results benchmarks/results
    python benchmarks/claims.py --claims query-position gate-bias

The thesis trained for up to 819 million steps from pixels. Here networks are small, observations are vectors, and a
training takes minutes, up to an hour in the longer ones, as in benchmarks/learning.py, whose tasks, runs and results
these are; so a verdict is about these tasks. In the small Mystery Path, transformers have no positional encoding, as
there.

A claim compares pairs of agents: each that is said to have the higher number with each that is said to have the lower
one. A pair is decided if the means differ by at least two standard errors of their difference, over seeds and levels.
The claim holds if all of its pairs are decided its way, does not hold if one is decided the other way, and else is not
decided. Where the thesis says that agents are no better than others, that is contradicted if a pair is decided. Where
no agent of a row scores higher than those without memory, the task has not been learned, and there is no verdict.

With so many rows, some verdicts come by chance. A star marks those that also stand at a family-wise error of 5 % (Holm,
1979), by Student's t-distribution with as many degrees of freedom as the pair's seeds leave, four with three each. A
row of several pairs has the largest of their p-values where all of them are needed, else the smallest times their
number.

With --report nothing is trained, and a claim is not tested if runs are missing.
"""

import itertools
import math
import signal
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.stats
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # before other packages that are named evaluate

import evaluate
import learning
import suites
import tables
from suites import TASKS, Task

MORTAR_MAYHEM, MYSTERY_PATH = TASKS["mortar-mayhem"], TASKS["mystery-path"]
FULL_MORTAR_MAYHEM, FREE_MORTAR_MAYHEM = TASKS["MortarMayhem-Grid-v0"], TASKS["MortarMayhem-v0"]
FULL_MYSTERY_PATH, FULL_SPOTLIGHTS = TASKS["MysteryPath-v0"], TASKS["SearingSpotlights-v0"]
FULL_MYSTERY_PATH_GRID = TASKS["MysteryPath-Grid-v0"]
ENDLESS = TASKS["endless-mortar-mayhem"]
LONG_ENDLESS = replace(ENDLESS, total_timesteps=12_000_000)
FULL_ENDLESS = TASKS["Endless-MortarMayhem-v0"]
ENDLESS_MYSTERY_PATH, ENDLESS_SPOTLIGHTS = TASKS["Endless-MysteryPath-v0"], TASKS["Endless-SearingSpotlights-v0"]
COMMANDS_IN_VIEW = replace(
    MORTAR_MAYHEM,
    env_id="MortarMayhemB-Grid-v0",
    options={"command_count": [4], "explosion_delay": [4], "explosion_duration": [2]},
)
GOAL_IN_VIEW = replace(MYSTERY_PATH, options=MYSTERY_PATH.options | {"show_origin": True, "show_goal": True})
ALL_IN_VIEW = Task(
    "SearingSpotlights-v0", 1_000_000, dict.fromkeys(("agent_visible", "coins_visible", "exit_visible"), True)
)
DECIDED = 2.0  # standard errors of a difference
FEW_FRAMES = ("no memory", "stack of 4", "step encoding")
# With about as many parameters as the GRU: the thesis' transformer and GTrXL, and one whose queries know their step.
WIDE_TRXL, WIDE_GTRXL = f"TrXL {suites.WIDE}", f"GTrXL {suites.WIDE}"
WIDE_QUERY_POSITION = f"TrXL --trxl-query-position {suites.WIDE}"
# The thesis' learning rate is at its final value after a fifth of the training: of the steps of ENDLESS, unless
# --steps-scale changes them.
TO_1E_4, TO_1E_5 = "TrXL --anneal-steps 200000", "TrXL --anneal-steps 200000 --final-lr 1e-5"
# Large steps are what the thesis suspects, and --target-kl would prevent them.
NOT_NORMALIZED, NORMALIZED = "GRU --target-kl None", "GRU --target-kl None --norm-adv minibatch"


# What is compared, (R, M): of each seed, on each level.
def score(task: Task, runs: list[evaluate.RunLog]) -> np.ndarray:
    """Return the scores of the final weights."""
    return tables.final_scores(task.score, runs).mean(-1)


def area(task: Task, runs: list[evaluate.RunLog]) -> np.ndarray:
    """Return the means of the learning curves: they are higher where fewer samples are needed."""
    return evaluate.align([run.curves[f"eval/{task.score}"] for run in runs])[1].mean((0, -1))


def falls(task: Task, runs: list[evaluate.RunLog]) -> np.ndarray:
    """Return how often the final weights fall off."""
    return tables.final_scores("num_fails", runs).mean(-1)


def gradient_norm(task: Task, runs: list[evaluate.RunLog]) -> np.ndarray:
    """Return the mean norms of the gradients before they are clipped, (R, 1)."""
    return np.array([[run.curves["losses/grad_norm"][1].mean()] for run in runs])


@dataclass(frozen=True)
class Claim:
    """What the thesis says: that each agent of `higher` has a higher number than each of `lower`.

    Or, if `expects_difference` is false, that it does not.
    """

    section: str
    text: str
    task: Task
    higher: tuple[str, ...]
    lower: tuple[str, ...]
    measure: Callable[[Task, list[evaluate.RunLog]], np.ndarray] = score
    expects_difference: bool = True


CLAIMS = {
    "memory-mortar-mayhem": Claim(
        "6.2.1", "only agents with a memory solve Mortar Mayhem Grid", MORTAR_MAYHEM,
        ("GRU", "TrXL"), (*FEW_FRAMES, "stack of 16"),
    ),
    "memory-full-mortar-mayhem": Claim(
        "6.2.1", "agents with a memory complete more commands than all others in the full Mortar Mayhem Grid",
        FULL_MORTAR_MAYHEM,
        ("GRU", WIDE_TRXL), (*FEW_FRAMES, "stack of 16"),
    ),
    "memory-free-mortar-mayhem": Claim(
        "6.2.1", "the same in the full Mortar Mayhem with free movement", FREE_MORTAR_MAYHEM,
        ("GRU", WIDE_TRXL), (*FEW_FRAMES, "stack of 16"),
    ),
    "memory-commands-in-view": Claim(
        "6.2.1", "with all commands in view, knowing the time or some frames helps", COMMANDS_IN_VIEW,
        ("step encoding", "stack of 4", "stack of 16"), ("no memory",),
    ),
    "memory-best-in-view": Claim(
        "6.2.1", "even with all commands in view, agents with a memory are best", COMMANDS_IN_VIEW,
        ("GRU", "TrXL"), (*FEW_FRAMES, "stack of 16"),
    ),
    "memory-mystery-path": Claim(
        "6.2.1", "agents with a memory succeed more often than all others in Mystery Path Grid", MYSTERY_PATH,
        ("GRU", "TrXL"), (*FEW_FRAMES, "stack of 16"),
    ),
    "memory-full-mystery-path": Claim(
        "6.2.1", "agents with a memory succeed more often than all others in the full Mystery Path", FULL_MYSTERY_PATH,
        ("GRU", WIDE_TRXL), (*FEW_FRAMES, "stack of 16"),
    ),
    "memory-full-mystery-path-grid": Claim(
        "6.2.1", "the same in the full Mystery Path Grid", FULL_MYSTERY_PATH_GRID,
        ("GRU", WIDE_TRXL), (*FEW_FRAMES, "stack of 16"),
    ),
    "stack-goal-in-view": Claim(
        "6.2.1", "with origin and goal in view, memory or a stack of 16 solves Mystery Path Grid, fewer frames do not",
        GOAL_IN_VIEW, ("stack of 16", "GRU", "TrXL"), FEW_FRAMES,
    ),
    "memory-full-spotlights": Claim(
        "6.2.1", "agents with a memory succeed more often than all others in the full Searing Spotlights",
        FULL_SPOTLIGHTS,
        ("GRU", WIDE_TRXL), (*FEW_FRAMES, "stack of 16"),
    ),
    "samples-mortar-mayhem": Claim(
        "6.2.2", "TrXL takes fewer samples than GRU in Mortar Mayhem Grid", MORTAR_MAYHEM, ("TrXL",), ("GRU",), area
    ),
    "samples-small-values": Claim(
        "6.2.2", "the same, with fresh values near 0 (`--value-init-gain 0.01`)", MORTAR_MAYHEM,
        ("TrXL --value-init-gain 0.01",), ("GRU --value-init-gain 0.01",), area,
    ),
    "samples-mystery-path": Claim(
        "6.2.2", "TrXL takes fewer samples than GRU in Mystery Path Grid", MYSTERY_PATH, ("TrXL",), ("GRU",), area
    ),
    "samples-commands-in-view": Claim(
        "6.2.2", "GRU takes fewer samples than TrXL in Mortar Mayhem Act Grid", COMMANDS_IN_VIEW,
        ("GRU",), ("TrXL",), area,
    ),
    "samples-goal-in-view": Claim(
        "6.2.2", "GRU takes fewer samples than TrXL in Mystery Path Grid with origin and goal in view", GOAL_IN_VIEW,
        ("GRU",), ("TrXL",), area,
    ),
    "samples-full-mortar-mayhem": Claim(
        "6.2.2", "TrXL takes fewer samples than GRU in the full Mortar Mayhem Grid", FULL_MORTAR_MAYHEM,
        (WIDE_TRXL,), ("GRU",), area,
    ),
    "score-free-mortar-mayhem": Claim(
        "6.2.2", "TrXL completes more commands than GRU in Mortar Mayhem with free movement", FREE_MORTAR_MAYHEM,
        (WIDE_TRXL,), ("GRU",),
    ),
    "samples-full-mystery-path": Claim(
        "6.2.2", "TrXL takes fewer samples than GRU in the full Mystery Path", FULL_MYSTERY_PATH,
        (WIDE_TRXL,), ("GRU",), area,
    ),
    "samples-full-spotlights": Claim(
        "6.2.2", "GRU takes fewer samples than TrXL in the full Searing Spotlights", FULL_SPOTLIGHTS,
        ("GRU",), (WIDE_TRXL,), area,
    ),
    "lstm-mortar-mayhem": Claim(
        "6.2.3", "LSTM completes fewer commands than GRU in Mortar Mayhem Grid", MORTAR_MAYHEM, ("GRU",), ("LSTM",)
    ),
    "lstm-mystery-path": Claim(
        "6.2.3", "LSTM takes more samples than GRU in Mystery Path", MYSTERY_PATH, ("GRU",), ("LSTM",), area
    ),
    "gates-mortar-mayhem": Claim(
        "6.2.3", "GTrXL completes fewer commands than TrXL in Mortar Mayhem Grid", MORTAR_MAYHEM, ("TrXL",), ("GTrXL",)
    ),
    "gates-mystery-path": Claim(
        "6.2.3", "GTrXL takes more samples than TrXL in Mystery Path", MYSTERY_PATH, ("TrXL",), ("GTrXL",), area
    ),
    "lstm-full-mortar-mayhem": Claim(
        "6.2.3", "LSTM completes fewer commands than GRU in the full Mortar Mayhem Grid", FULL_MORTAR_MAYHEM,
        ("GRU",), ("LSTM",),
    ),
    "lstm-free-mortar-mayhem": Claim(
        "6.2.3", "LSTM completes fewer commands than GRU in Mortar Mayhem with free movement", FREE_MORTAR_MAYHEM,
        ("GRU",), ("LSTM",),
    ),
    "lstm-full-mystery-path": Claim(
        "6.2.3", "LSTM takes more samples than GRU in the full Mystery Path", FULL_MYSTERY_PATH,
        ("GRU",), ("LSTM",), area,
    ),
    "lstm-full-spotlights": Claim(
        "6.2.3", "LSTM takes more samples than GRU in the full Searing Spotlights", FULL_SPOTLIGHTS,
        ("GRU",), ("LSTM",), area,
    ),
    "gates-full-mortar-mayhem": Claim(
        "6.2.3", "GTrXL completes fewer commands than TrXL in the full Mortar Mayhem Grid", FULL_MORTAR_MAYHEM,
        (WIDE_TRXL,), (WIDE_GTRXL,),
    ),
    "gates-free-mortar-mayhem": Claim(
        "6.2.3", "GTrXL completes fewer commands than TrXL in Mortar Mayhem with free movement", FREE_MORTAR_MAYHEM,
        (WIDE_TRXL,), (WIDE_GTRXL,),
    ),
    "gates-full-mystery-path": Claim(
        "6.2.3", "GTrXL takes more samples than TrXL in the full Mystery Path", FULL_MYSTERY_PATH,
        (WIDE_TRXL,), (WIDE_GTRXL,), area,
    ),
    "gates-full-spotlights": Claim(
        "6.2.3", "GTrXL takes more samples than TrXL in the full Searing Spotlights", FULL_SPOTLIGHTS,
        (WIDE_TRXL,), (WIDE_GTRXL,), area,
    ),
    "gate-bias": Claim(
        "6.2.3", "a gate bias of 0 is better than one of 2 in Mystery Path", MYSTERY_PATH,
        ("GTrXL",), ("GTrXL --trxl-gate-bias 2",),
    ),
    "endless": Claim(
        "6.3", "GRU completes more commands than TrXL in Endless Mortar Mayhem", ENDLESS, ("GRU",), ("TrXL",)
    ),
    "endless-long": Claim(
        "6.3, 7.1.3", "the same after 12 million steps, TrXL with more parameters and the step in the query",
        LONG_ENDLESS, ("GRU",), (WIDE_QUERY_POSITION,),
    ),
    "endless-full": Claim(
        "6.3", "GRU completes more commands than TrXL in the full Endless Mortar Mayhem", FULL_ENDLESS,
        ("GRU",), (WIDE_TRXL,),
    ),
    "endless-mystery-path": Claim(
        "6.3", "GRU has a higher return than TrXL in Endless Mystery Path", ENDLESS_MYSTERY_PATH,
        ("GRU",), (WIDE_TRXL,),
    ),
    "endless-spotlights": Claim(
        "6.3", "GRU collects more coins than TrXL in Endless Searing Spotlights", ENDLESS_SPOTLIGHTS,
        ("GRU",), (WIDE_TRXL,),
    ),
    "falls": Claim(
        "6.5.2", "TrXL falls off less often than GRU in Mystery Path", MYSTERY_PATH, ("GRU",), ("TrXL",), falls
    ),
    "falls-full-mystery-path": Claim(
        "6.5.2", "TrXL falls off less often than GRU in the full Mystery Path", FULL_MYSTERY_PATH,
        ("GRU",), (WIDE_TRXL,), falls,
    ),
    "capacity": Claim(
        "7.1.1", "more width, blocks or window do not bring TrXL to GRU's level", ENDLESS, ("GRU",),
        ("TrXL --trxl-dim 96", "TrXL --trxl-num-layers 3", "TrXL --trxl-memory-length 256"),
    ),
    "ground-truth": Claim(
        "7.1.2", "estimating the ground truth helps TrXL", ENDLESS, ("TrXL --ground-truth-coef 0.1",), ("TrXL",)
    ),
    "learning-rate": Claim("7.1.2", "a higher final learning rate helps TrXL", ENDLESS, (TO_1E_4,), (TO_1E_5,)),
    "query-position": Claim(
        "7.1.3", "the step's encoding in the query helps TrXL, a little", ENDLESS,
        ("TrXL --trxl-query-position",), ("TrXL",),
    ),
    "query-position-gru": Claim(
        "7.1.3", "it does not bring TrXL to GRU's level", ENDLESS, ("GRU",),
        ("TrXL --trxl-query-position", "TrXL --trxl-query-position --trxl-dim 96"),
    ),
    "query-output": Claim(
        "7.1.3", "the last output in the query is catastrophic", ENDLESS, ("TrXL",), ("TrXL --trxl-query-output",)
    ),
    "stale": Claim(
        "7.1.4", "stored items that are refreshed help TrXL (a hypothesis)", ENDLESS, ("TrXL, refreshed",), ("TrXL",)
    ),
    "encodings": Claim(
        "7.1.5", "learned and relative encodings are no better than the absolute one", ENDLESS,
        ("TrXL --trxl-positional-encoding learned", "TrXL --trxl-positional-encoding relative"), ("TrXL",),
        expects_difference=False,
    ),
    "normalized": Claim(
        "7.2", "normalized advantages spoil GRU in Searing Spotlights with all in view, an agent without memory less",
        ALL_IN_VIEW, (NOT_NORMALIZED, "no memory --target-kl None --norm-adv minibatch"), (NORMALIZED,),
    ),
    "normalized-gradients": Claim(
        "7.2", "normalized advantages make gradients larger", ALL_IN_VIEW,
        (NORMALIZED,), (NOT_NORMALIZED,), gradient_norm,
    ),
    "normalized-mortar-mayhem": Claim(
        "7.2", "Mortar Mayhem is learned better without normalized advantages", MORTAR_MAYHEM,
        ("GRU",), ("GRU --norm-adv minibatch",),
    ),
    "normalized-mystery-path": Claim(
        "7.2", "Mystery Path is learned better without normalized advantages", MYSTERY_PATH,
        ("GRU",), ("GRU --norm-adv minibatch",),
    ),
}  # fmt: skip


@dataclass
class Config(learning.Training):
    """Which claims to test."""

    claims: tuple[str, ...] = tuple(CLAIMS)
    """of those that this program knows"""


@dataclass(frozen=True)
class Comparison:
    """Two agents' numbers: by how many standard errors the first one's mean is higher, and how surely it is another."""

    errors: float
    p_value: float  # two-sided

    @classmethod
    def of(cls, higher: np.ndarray, lower: np.ndarray) -> "Comparison":
        """Compare numbers (R, M) of the seeds of two agents, which played the same M levels.

        The variance of the difference has a part of each agent's seeds, and one of the levels' differences.
        """
        seeds = sum(each.mean(1).var(ddof=1) / len(each) for each in (higher, lower))
        levels = higher.mean(0) - lower.mean(0)  # (M,)
        if len(levels) > 1:
            seeds += levels.var(ddof=1) / len(levels)
        difference = levels.mean()
        errors = difference / math.sqrt(seeds) if seeds else math.copysign(math.inf, difference) if difference else 0.0
        return cls(errors, 2 * scipy.stats.t.sf(abs(errors), len(higher) + len(lower) - 2))


@dataclass(frozen=True)
class Verdict:
    """A verdict on a claim, and the p-value of what it says; 1 where it says nothing."""

    text: str
    p_value: float = 1.0


def verdict(claim: Claim, pairs: list[Comparison]) -> Verdict:
    """Return the verdict on a claim, from the comparisons of its pairs."""
    above = [pair.p_value for pair in pairs if pair.errors >= DECIDED]
    below = [pair.p_value for pair in pairs if pair.errors <= -DECIDED]
    if not claim.expects_difference:
        return Verdict("contradicted", min(1, len(pairs) * min(above))) if above else Verdict("not contradicted")
    if below:
        return Verdict("does not hold", min(1, len(pairs) * min(below)))
    return Verdict("holds", max(above)) if len(above) == len(pairs) else Verdict("not decided")


def is_learned(claim: Claim, runs: dict[str, list[evaluate.RunLog]], without: list[evaluate.RunLog]) -> bool:
    """Return whether any agent of the claim scores higher than one without memory, if there are runs of that.

    An agent without memory that is one of the claim's has to be passed by another.
    """
    if not without:
        return True
    base = score(claim.task, without)
    scores = [score(claim.task, members) for agent, members in runs.items() if not agent.startswith("no memory")]
    return any(Comparison.of(each, base).errors >= DECIDED for each in scores)


def holm(p_values: list[float], level: float = 0.05) -> list[bool]:
    """Return which of these p-values stand at this family-wise error (Holm, 1979)."""
    order = np.argsort(p_values)
    limits = level / np.arange(len(order), 0, -1)
    passed = np.cumprod(np.array(p_values)[order] <= limits).astype(bool)  # from the smallest to the first that fails
    return passed[np.argsort(order)].tolist()


def row(name: str, runs: dict[str, list[evaluate.RunLog]], found: str) -> str:
    """Return a claim's row of the table, from the seeds of its agents: their means and standard errors."""
    claim = CLAIMS[name]

    def cell(agents: tuple[str, ...]) -> str:
        numbers = {suites.short(agent): claim.measure(claim.task, runs[agent])[..., None] for agent in agents}
        return ", ".join(f"{agent} {tables.mean_and_error(each)}" for agent, each in numbers.items())

    measure = claim.measure.__name__.replace("_", " ")
    text = f"{claim.text} ({claim.section}; `{name}`)"
    return f"| {text} | {measure} | {cell(claim.higher)} | {cell(claim.lower)} | {found} |"


def main(config: Config) -> None:
    """Train what is missing, then print a row for each claim. Raises SystemExit for names that are not in CLAIMS.

    Raises it for what `learning.check` refuses, too.
    """
    learning.check(config)
    if unknown := [name for name in config.claims if name not in CLAIMS]:
        raise SystemExit(f"there is no claim {unknown[0]}; there are {', '.join(CLAIMS)}")
    plans = {}
    for name in config.claims:
        claim = CLAIMS[name]
        runs = itertools.product((*claim.higher, *claim.lower), config.seeds)
        plans[name] = [learning.plan(config, claim.task, agent, seed) for agent, seed in runs]
    each_once = {plan.command: plan for plan in itertools.chain(*plans.values())}  # claims share runs
    if not config.report:
        learning.train_missing(config, [*each_once.values()])
    results = {command: learning.result_of(config, plan) for command, plan in each_once.items()}
    runs, verdicts = {}, {}
    for name in config.claims:
        claim = CLAIMS[name]
        found = {agent: [] for agent in (*claim.higher, *claim.lower)}
        for each in plans[name]:
            found[each.agent] += [run for run in [results[each.command]] if run is not None]
        missing = sum(len(config.seeds) - len(members) for members in found.values())
        if missing:
            print(f"`{name}` is not tested: {missing} of {len(plans[name])} runs are missing")
            continue
        without = [learning.result_of(config, learning.plan(config, claim.task, "no memory", i)) for i in config.seeds]
        runs[name] = found
        pairs = itertools.product(claim.higher, claim.lower)
        measured = {agent: claim.measure(claim.task, members) for agent, members in found.items()}
        verdicts[name] = verdict(claim, [Comparison.of(measured[one], measured[other]) for one, other in pairs])
        if None not in without and not is_learned(claim, found, without):
            verdicts[name] = Verdict("not learned")
    stars = dict(zip(verdicts, holm([each.p_value for each in verdicts.values()]), strict=True))
    print("| claim | measure | expected higher | expected lower | verdict |\n|---|---|---|---|---|")
    for name, found in verdicts.items():
        print(row(name, runs[name], found.text + " \\*" * stars[name]))
    counts = Counter(found.text for found in verdicts.values())
    summary = ", ".join(f"{count} {text}" for text, count in counts.most_common())
    print(f"\nOf {len(verdicts)} rows: {summary}. With a star: {sum(stars.values())}.")


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    try:
        main(tyro.cli(Config))
    except OSError as error:
        sys.exit(f"claims.py: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
