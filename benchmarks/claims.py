"""Do the thesis' claims hold here? Train the agents that claims of its chapters 6 and 7 compare.

    python benchmarks/claims.py --seeds 1 2 3 4 5 --report --results benchmarks/results
    python benchmarks/claims.py --claims query-position gate-bias

Tasks, runs and results are those of benchmarks/learning.py: small networks, vector observations, minutes of training.

A claim compares pairs of agents: each that is said to have the higher number (A in the table) with each that is said to
have the lower one (B). A pair is decided as in the tables of results (`tables.Comparison`): by Welch's t-test over
seeds and levels. The claim holds if all of its pairs are decided its way; it does not hold if one is decided the other
way, with its p-value multiplied by the number of pairs; else it is not decided, and the table has the 95 % intervals of
the differences that are not decided its way, each of a pair alone, so that it can leave out 0. Where the thesis says
that agents are no better than others, it does not hold if one of them is ahead, with p as before, and is not decided
else. Where no agent of a row scores higher than those without memory, or all have less than a quarter of what is
possible (in endless tasks, of what the thesis' transformer has), or where falls are counted and one has less than nine
tenths, the task has not been learned, and there is no verdict.

With so many rows, some verdicts come by chance. A star marks those that also stand at a family-wise error of 5 % (Holm,
1979). A row of several pairs has the largest of their p-values where all of them are needed, else the smallest times
their number.

With --report nothing is trained; claims of which runs are missing stand in a table of their own.
"""

import itertools
import signal
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import learning
import suites
import tables
from ppo_utils.run_logs import RunLog, align
from ppo_utils.terminal import one_line_exit
from suites import Task
from tables import ALPHA, Comparison

ALL_VISIBLE = {"agent_visible": True, "coins_visible": True, "exit_visible": True}
ENDS_SHOWN = {"show_origin": True, "show_goal": True}
TASKS = {
    **suites.FULL,
    **{
        f"{env_id}-{steps // 1_000_000}M": replace(suites.FULL[env_id], total_timesteps=steps)
        for env_id, steps in suites.LONGER.items()
    },
    "ends-shown": Task("MysteryPath-Grid-v0", 6_000_000, ENDS_SHOWN, gru_flags=suites.LOW_RATE),
    "all-visible": Task("SearingSpotlights-v0", 2_000_000, ALL_VISIBLE),
    "flat-list": Task("MortarMayhemB-Grid-v0", 6_000_000),
    "small-endless": replace(suites.SMALL["endless-mortar-mayhem"], total_timesteps=3_000_000),
}
# Of a task's aim, what one of a row's agents has, if the task has been learned; all of them, where falls are counted,
# since those that fail fall for other reasons.
SHARE, SHARE_OF_FALLS = 0.25, 0.9


# What is compared beside metrics of the final weights: of each seed, on each level, (R, M).
def area(task: Task, runs: list[RunLog]) -> np.ndarray:
    """Return the means of the curves on development levels: they are higher where fewer samples are needed."""
    return align([run.curves[f"eval/{task.score}"] for run in runs])[1].mean((0, -1))


def gradient_norm(task: Task, runs: list[RunLog]) -> np.ndarray:
    """Return the mean norms of the gradients before they are clipped, (R, 1)."""
    return np.array([[run.curves["losses/grad_norm"][1].mean()] for run in runs])


@dataclass(frozen=True)
class Claim:
    """What the thesis says: that each agent of `higher` has a higher number than each of `lower`.

    Or, if `expects_difference` is false, that it does not.
    """

    task: str
    higher: tuple[str, ...]
    lower: tuple[str, ...]
    measure: str | Callable[[Task, list[RunLog]], np.ndarray] = ""  # a metric, by default the task's own, or a function
    flags: str = ""  # of all agents
    expects_difference: bool = True
    times: float = 1.0  # how many times as high as each of `lower`
    needs_memory: bool = True  # else nobody has to score higher than an agent without memory

    @property
    def agents(self) -> tuple[str, ...]:
        """Return all that are compared."""
        return (*self.higher, *self.lower)

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Return each agent of `higher` with each of `lower`."""
        return [*itertools.product(self.higher, self.lower)]

    def plans(self, config: learning.Training, agent: str) -> list[learning.Plan]:
        """Return the trainings of one of the agents, or of another one, one for each seed."""
        flags = f"{agent} {self.flags}".strip()
        return [learning.plan(config, TASKS[self.task], flags, seed) for seed in config.seeds]

    def numbers(self, runs: list[RunLog]) -> np.ndarray:
        """Return what is compared, (R, M)."""
        task = TASKS[self.task]
        if callable(self.measure):
            return self.measure(task, runs)
        return tables.final_scores(self.measure or task.score, runs).mean(-1)


@dataclass(frozen=True)
class Statement:
    """What the thesis says, and the claims that it makes about tasks here."""

    text: str  # with its section
    thesis: str  # its figures, as far as its text has them
    claims: dict[str, Claim] = field(default_factory=dict)  # none where nothing was run


def claims_of(prefix: str, tasks: str, higher: tuple[str, ...], lower: tuple[str, ...], **others) -> dict[str, Claim]:
    """Return the same claim about each of some tasks; a name is the prefix and the task's name."""
    return {f"{prefix}-{task}": Claim(task, higher, lower, **others) for task in tasks.split()}


in_endless = partial(Claim, "small-endless")
GRU, TRXL, PLUS, GATED = ("GRU",), ("TrXL",), ("TrXL+",), ("GTrXL+",)
SAME = ("TrXL+, before",)  # with the GRU's learning rate, discount factor and weight of the value
MEMORY, FRAMES = ("GRU", "TrXL+"), ("no memory", "16 frames")
FEW_FRAMES = ("no memory", "4 frames", "step encoding")
FLAT_LIST = ("step encoding", "16 frames")  # without memory; others were not trained with a flat list
LONG_ROLLOUTS = ("GRU --num-envs 32 --num-steps 512",)  # as the thesis has them
QUERY_POSITION, GROUND_TRUTH = "TrXL --trxl-query-position", "TrXL --ground-truth-coef 0.1"
NORMALIZED = "GRU --norm-adv minibatch"
QUICK_DECAY = "--anneal-steps 600000"  # as in the thesis, the rate is at its final value after a fifth of the training
MORTAR_MAYHEMS = "MortarMayhem-Grid-v0 MortarMayhem-v0"
MYSTERY_PATHS = "MysteryPath-Grid-v0 MysteryPath-v0"
ENDLESS = "Endless-MortarMayhem-v0 Endless-MysteryPath-v0 Endless-SearingSpotlights-v0"
STATEMENTS = (
    Statement("6.2.1 Mortar Mayhem needs memory", "", claims_of("memory", MORTAR_MAYHEMS, MEMORY, FRAMES)),
    Statement("6.2.1 Mystery Path needs memory", "", claims_of("memory", MYSTERY_PATHS, MEMORY, FRAMES)),
    Statement(
        "6.2.1 Searing Spotlights needs memory (here, there is some success without)",
        "no success without",
        claims_of("memory", "SearingSpotlights-v0", MEMORY, FRAMES),
    ),
    Statement(
        "6.2.1 Memory is best in the act task",
        "10 commands; step encoding 9.5, 16 frames nearly 8, 4 frames nearly 5",
        claims_of("memory", "MortarMayhemB-Grid-v0", MEMORY, (*FEW_FRAMES, "16 frames"))
        | claims_of("memory", "flat-list", ("GRU", *SAME), ("no memory", *FLAT_LIST), flags="--no-attend-commands"),
    ),
    Statement(
        "6.2.1 Frames or the step help in the act task",
        "no memory is ineffective",
        claims_of("frames", "MortarMayhemB-Grid-v0", ("step encoding", "4 frames", "16 frames"), ("no memory",))
        | claims_of("frames", "flat-list", FLAT_LIST, ("no memory",), flags="--no-attend-commands"),
    ),
    Statement(
        "6.2.1 With its ends shown, 16 frames are enough in Mystery Path (memory: figure 6.1); 4 or the step help",
        "4 frames, step encoding 0.40, no memory 0.11",
        claims_of("memory", "ends-shown", MEMORY, FEW_FRAMES)
        | claims_of("16-frames", "ends-shown", ("16 frames",), FEW_FRAMES)
        | claims_of("frames", "ends-shown", FEW_FRAMES[1:], ("no memory",)),
    ),
    Statement(
        "6.2.2 TrXL needs fewer samples than GRU in Mortar Mayhem Grid",
        "",
        claims_of("samples", "MortarMayhem-Grid-v0", PLUS, GRU, measure=area)
        | claims_of("same-samples", "MortarMayhem-Grid-v0", SAME, GRU, measure=area),
    ),
    Statement(
        "6.2.2 TrXL carries out more in Mortar Mayhem",
        "GRU 6 commands, TrXL more",
        claims_of("score", "MortarMayhem-v0", PLUS, GRU) | claims_of("same-score", "MortarMayhem-v0", SAME, GRU),
    ),
    Statement(
        "6.2.2 In Mortar Mayhem, TrXL needs reconstruction, and GRU is worse with it", "GRU 6, with it 5 commands"
    ),
    Statement(
        "6.2.2 TrXL needs fewer samples in Mystery Path",
        "",
        claims_of("samples", MYSTERY_PATHS, PLUS, GRU, measure=area)
        | claims_of("same-samples", MYSTERY_PATHS, ("TrXL+, low rate",), GRU, measure=area),
    ),
    Statement(
        "6.2.2 GRU needs fewer in Searing Spotlights, the act task, Mystery Path with ends shown",
        "",
        claims_of("samples", "SearingSpotlights-v0 MortarMayhemB-Grid-v0 ends-shown", GRU, PLUS, measure=area)
        | claims_of("same-samples", "SearingSpotlights-v0", GRU, SAME, measure=area)
        | claims_of("same-samples", "MortarMayhemB-Grid-v0", GRU, (f"{SAME[0]} --value-init-gain 0.01",), measure=area),
    ),
    Statement(
        "6.2.3 LSTM is behind GRU in Mortar Mayhem (here its grid)",
        "LSTM 3 commands",
        claims_of("lstm-score", "MortarMayhem-Grid-v0", GRU, ("LSTM",)),
    ),
    Statement(
        "6.2.3 LSTM needs more samples than GRU elsewhere, in Mystery Path than TrXL, too",
        "slightly more in Searing Spotlights; full success in Mystery Path",
        claims_of("lstm-samples", "SearingSpotlights-v0", GRU, ("LSTM",), measure=area)
        | claims_of("lstm-samples", "MysteryPath-Grid-v0", MEMORY, ("LSTM",), measure=area),
    ),
    Statement(
        "6.2.3 GTrXL is behind TrXL in Mortar Mayhem (here its grid)",
        "GTrXL 2 commands",
        claims_of("gates-score", "MortarMayhem-Grid-v0", PLUS, GATED),
    ),
    Statement(
        "6.2.3 GTrXL needs more samples than TrXL elsewhere",
        "",
        claims_of("gates-samples", "MysteryPath-Grid-v0 SearingSpotlights-v0", PLUS, GATED, measure=area),
    ),
    Statement(
        "6.2.3 In Mystery Path (here its grid), gate bias 0 is better than 2",
        "0.94, 0.81 (unstable); in Mortar Mayhem, both 2 commands",
        {"gate-bias": Claim("MysteryPath-Grid-v0", GATED, ("GTrXL+ --trxl-gate-bias 2",))},
    ),
    Statement(
        "6.3 GRU is ahead of TrXL in endless tasks",
        "120, 18 commands; return 2.65, 2.02, a narrower gap; about 20, 6 coins",
        claims_of("score", f"{ENDLESS} Endless-MortarMayhem-v0-20M", GRU, PLUS)
        | claims_of("rollout", "Endless-MortarMayhem-v0-20M", LONG_ROLLOUTS, PLUS)
        | claims_of("score", "small-endless", GRU, TRXL)
        | claims_of("same-score", f"{ENDLESS} Endless-MortarMayhem-v0-20M Endless-MysteryPath-v0-9M", GRU, SAME),
    ),
    Statement(
        "6.3 GRU's endless episodes are longer",
        "3,462 (at its peak), 288 steps; 600, 400; 600, 200",
        claims_of("length", f"{ENDLESS} Endless-MortarMayhem-v0-20M", GRU, PLUS, measure="length")
        | claims_of("same-length", f"{ENDLESS} Endless-MortarMayhem-v0-20M", GRU, SAME, measure="length"),
    ),
    Statement(
        "6.3 After 819 M steps, GRU still learns in Endless Searing Spotlights, both in Endless Mystery Path, "
        "GRU faster",
        "TrXL converges to 6 coins after 200 M",
    ),
    Statement(
        "6.3 In Endless Mystery Path, agents fall off after much progress, and need steps to regain it ([how episodes "
        "end](results.md#for-longer))",
        "",
    ),
    Statement("6.3 TrXL is worse with reconstruction in Endless Mortar Mayhem", "18, with it 10 commands"),
    Statement(
        "6.4 An iteration of GRU takes less time ([here, too](running.md#speed))",
        "on an A100, Endless Mortar Mayhem 4.11, 5.53 s; Mystery Path 5.19, 7.39 s",
    ),
    Statement(
        "6.4 In Mystery Path, an iteration takes less time with GTrXL than with TrXL, and with LSTM than with GRU, "
        "since they reset less often",
        "table 6.4",
    ),
    Statement(
        "6.4 In equal time, GRU is ahead in endless tasks, and as good as TrXL in Mystery Path",
        "a training of 57, 77 hours; figure 6.4",
    ),
    Statement("6.4 Compiled, an iteration of TrXL takes less time", "compiled 5.53, else 7.97 s"),
    Statement(
        "6.4 The query's step, reconstruction and ground truth add little time, HELM much",
        "TrXL 77, with the step 78, with reconstruction 80, with step, final rate and ground truth 81 hours; HELM at "
        "least 5 times as long as GRU",
    ),
    Statement(
        "6.5.1 TrXL's blocks attend to different steps ([one block here](results.md#what-the-transformer-attends-to))",
        "clue task: two to each command's first step, the last to the episode's; act task: the last to the due "
        "command's and, little, to earlier successes, others to recent steps",
    ),
    Statement(
        "6.5.2 TrXL's first block attends to falls, later ones to where it was 20 steps before",
        "figures 6.7, 6.8, one episode",
    ),
    Statement("6.5.2 In Mystery Path, agents first head for the opposite side", ""),
    Statement(
        "6.5.2 GRU falls off more often in Mystery Path",
        "5.65, 4.87 times",
        claims_of("falls", MYSTERY_PATHS, GRU, PLUS, measure="num_fails"),
    ),
    Statement(
        "6.5.3 In Endless Searing Spotlights, agents wait for spotlights to pass, GRU and TrXL differently in one case",
        "",
    ),
    Statement(
        "7.1.1 A larger TrXL stays behind GRU",
        "",
        {"capacity": in_endless(GRU, ("TrXL --trxl-dim 192", "TrXL --trxl-num-layers 3"))},
    ),
    Statement(
        "7.1.1 A window of 256 steps should be long enough for TrXL",
        "384, 512 explored, no result told",
        {
            "window": Claim(
                "Endless-MortarMayhem-v0-20M", ("TrXL+ --trxl-memory-length 512",), PLUS, expects_difference=False
            )
        },
    ),
    Statement(
        "7.1.1 TrXL gets to 5 commands in a row, 15 in all, and looks back 124 steps; GRU 386, fewer than TrXL could",
        "figure 7.1",
    ),
    Statement(
        "7.1.2 Estimating the ground truth helps TrXL",
        "50 (unstable, 20 to 50), 18 commands",
        {"ground-truth": in_endless((GROUND_TRUTH,), TRXL)},
    ),
    Statement("7.1.2 With a higher final learning rate, reconstruction harms TrXL", "below 24"),
    Statement(
        "7.1.2 A higher final learning rate helps TrXL",
        "24, 18",
        {"learning-rate": in_endless(TRXL, ("TrXL --final-lr 1e-5",), flags=QUICK_DECAY)},
    ),
    Statement(
        "7.1.3 The step in the query helps TrXL a little",
        "19, 18",
        {"query-position": in_endless((QUERY_POSITION,), TRXL)},
    ),
    Statement(
        "7.1.3 GRU stays ahead of TrXL with that step or the ground truth",
        "140 at its peak; 19, 50",
        {"below-gru": in_endless(GRU, (QUERY_POSITION, GROUND_TRUTH))},
    ),
    Statement(
        "7.1.3 Final rate, step in the query and ground truth together help less than ground truth alone",
        "33 (unstable), 50 commands; GRU 140",
        {
            "together": in_endless(
                (f"{GROUND_TRUTH} --final-lr 1e-5",),
                (f"{GROUND_TRUTH} --trxl-query-position",),
                flags=QUICK_DECAY,
            )
        },
    ),
    Statement("7.1.3 The previous output of the last block in the query harms", '"catastrophic"'),
    Statement(
        "7.1.4 Stale memory may harm TrXL (refreshed here: [the rollout's](memory.md))",
        "not tested",
        {"stale": in_endless(("TrXL --refresh-memory",), TRXL)},
    ),
    Statement("7.1.4 Refreshing memory takes time ([here, too](memory.md)) and space", ""),
    Statement("7.1.4 With ground truth, TrXL's episodes get longer than 1,200 steps", ""),
    Statement(
        "7.1.5 Learned or relative positions are no better than absolute ones",
        "",
        {
            "encodings": in_endless(
                tuple(f"TrXL --trxl-positional-encoding {kind}" for kind in ("learned", "relative")),
                TRXL,
                expects_difference=False,
            )
        },
    ),
    Statement(
        "7.1.5 Absolute encodings of length 1,024 and 2,048 fail in Mortar Mayhem",
        "1 to 2 commands; in Endless Mortar Mayhem, with 2,048, over 20",
    ),
    Statement("7.1.5 One seed of five with relative positions stands out, one fails", "more than 60, 13 commands"),
    Statement("7.2 With the old settings, GRU fails in Searing Spotlights, also with all visible", "all visible 0.43"),
    # Large steps are what the thesis suspects, and --target-kl would prevent them.
    Statement(
        "7.2 Normalized advantages make GRU worse in Searing Spotlights, all visible",
        "1.00, 0.43",
        claims_of("normalized", "all-visible", GRU, (NORMALIZED,), flags="--target-kl None", needs_memory=False),
    ),
    Statement(
        "7.2 With normalized advantages, no memory is ahead of GRU",
        "0.96, 0.43",
        {
            "normalized-no-memory": Claim(
                "all-visible",
                ("no memory --norm-adv minibatch",),
                (NORMALIZED,),
                flags="--target-kl None",
                needs_memory=False,
            )
        },
    ),
    Statement(
        "7.2 Normalized advantages make gradients over 12 times larger",
        "0.38, 0.02",
        {
            "normalized-gradients": Claim(
                "all-visible",
                (NORMALIZED,),
                GRU,
                gradient_norm,
                flags="--target-kl None",
                times=12,
                needs_memory=False,
            )
        },
    ),
    Statement(
        "7.2 Normalized advantages make agents worse in Mortar Mayhem (here its grid), Mystery Path",
        "",
        claims_of("normalized", "MortarMayhem-Grid-v0 MysteryPath-Grid-v0", GRU, (NORMALIZED,)),
    ),
    Statement("7.2 Normalized advantages are of another scale", "raw 2e-4, normalized above 5"),
    Statement(
        "7.2 Table 7.1, success with one new setting among old ones: health, transformer, speed, clip range, length, "
        "reconstruction, gradient norm",
        "0.79, 0.69, 0.58, 0.52, 0.48, 0.39, 0.36",
    ),
    Statement(
        "7.2 In BossFight, with the old settings, spotlights harm GRU, not an agent without memory; in Searing "
        "Spotlights, without normalized advantages, they do not",
        "figure 7.4",
    ),
    Statement(
        "7.3.1 In Searing Spotlights, episodes are too short for spotlights to threaten much (also 6.5.3)",
        "optimal: 33 steps",
    ),
    Statement("7.4.1 Vectors usually take less time than images ([here, too](environments.md#speed))", ""),
)
CLAIMS = {name: claim for statement in STATEMENTS for name, claim in statement.claims.items()}
HEADING = """
| statement | thesis | A | B | M steps | verdict | `--claims` |
|---|---|---|---|---:|---|---|"""
NOT_TESTED = """
| not tested | thesis | `--claims` |
|---|---|---|"""


@dataclass
class Config(learning.Training):
    """Which claims to test."""

    claims: tuple[str, ...] = tuple(CLAIMS)
    """names in the last column of the table of docs/thesis.md"""


@dataclass(frozen=True)
class Verdict:
    """A verdict on a claim, and the p-value of what it says; 1 where it says nothing."""

    text: str
    p_value: float = 1.0
    intervals: tuple[str, ...] = ()  # of the differences that are not decided the claim's way

    def __str__(self) -> str:
        if self.p_value == 1:
            return "; ".join([self.text, *self.intervals])
        return f"{self.text}, p {f'= {self.p_value:.3f}' if self.p_value >= 0.0005 else '< 0.001'}"


def verdict(claim: Claim, pairs: list[Comparison]) -> Verdict:
    """Return the verdict on a claim, from the comparisons of its pairs, in the order of `Claim.pairs`.

    One about a multiple has no intervals.
    """
    above = [pair.p_value for pair in pairs if pair.errors > 0]
    below = [pair.p_value for pair in pairs if pair.errors < 0]
    against = below if claim.expects_difference else above
    # That one pair of several is decided is as likely as Bonferroni says, that all are, as the least sure one.
    for found in (
        Verdict("does not hold", min(1, len(pairs) * min(against, default=1))),
        Verdict("holds", max(above) if claim.expects_difference and len(above) == len(pairs) else 1),
    ):
        if found.p_value < ALPHA:
            return found
    names = ["A - B"] if len(pairs) == 1 else [f"{short(one)} - {short(other)}" for one, other in claim.pairs]
    intervals = [
        "{}: [{:.2g}, {:.2g}]".format(name, *pair.interval)
        for name, pair in zip(names, pairs, strict=True)
        if pair.interval and claim.times == 1 and not (claim.expects_difference and pair.is_ahead)
    ]
    return Verdict("not decided", intervals=tuple(intervals))


def aim_of(name: str) -> float | None:
    """Return a task's best possible score; in an endless task what the thesis' transformer has, None if it is small."""
    task, thesis = TASKS[name], tables.read_thesis()
    is_open = task.best_score is None and not task.options
    return float(thesis[task.env_id]["TrXL"]) if is_open else task.best_score


def is_learned(claim: Claim, runs: dict[str, list[RunLog]], without: list[RunLog]) -> bool:
    """Return whether an agent of the claim has its share of the aim, and any scores higher than one without memory.

    Where falls are counted, all need the share. The latter is asked if there are seeds of that; if an agent without
    memory is one of the claim's, another has to pass it.
    """
    name, aim = TASKS[claim.task].score, aim_of(claim.task)
    scores = {agent: tables.final_scores(name, members).mean(-1) for agent, members in runs.items()}
    share, which = (SHARE_OF_FALLS, min) if claim.measure == "num_fails" else (SHARE, max)
    if aim is not None and which(each.mean() for each in scores.values()) < share * aim:
        return False
    if len(without) < 2:
        return True
    base = tables.final_scores(name, without).mean(-1)
    return any(Comparison.of(scores[agent], base).is_ahead for agent in runs if not agent.startswith("no memory"))


def short(agent: str) -> str:
    """Return an agent's name for the table: without TrXL, of which most are variants."""
    return suites.short(agent).removeprefix("TrXL, ")


def mean_and_error(numbers: np.ndarray) -> str:
    """Return the mean of numbers (R, M) with its standard error, without spaces: cells hold several."""
    return tables.mean_and_error(numbers[..., None]).replace(" ", "")


def row(name: str, runs: dict[str, list[RunLog]], found: str, said: tuple[str, str]) -> str:
    """Return a claim's row: what is said, and in the thesis; the agents' means with standard errors; the verdict."""
    claim = CLAIMS[name]
    agents = [
        ", ".join(f"{short(agent)}: {mean_and_error(claim.numbers(runs[agent]))}" for agent in side)
        for side in (claim.higher, claim.lower)
    ]
    steps = f"{int(runs[claim.higher[0]][0].args['total_timesteps']) / 1e6:.4g}"
    flags = f" (`{claim.flags}`)" if claim.flags else ""
    return f"| {' | '.join([*said, *agents, steps, found, f'`{name}`{flags}'])} |"


def judge(claim: Claim, runs: dict[str, list[RunLog]], without: list[RunLog]) -> Verdict:
    """Return the verdict on a claim, from the runs of its agents and, if it needs memory, of one without."""
    if not is_learned(claim, runs, without):
        return Verdict("not learned")
    numbers = {agent: claim.numbers(members) for agent, members in runs.items()}
    return verdict(claim, [Comparison.of(numbers[one], claim.times * numbers[other]) for one, other in claim.pairs])


def finished(config: Config, plans: list[learning.Plan], results: dict) -> list[RunLog]:
    """Return the runs that are there; `results` keeps what has been read, by the plans' commands."""
    for plan in plans:
        if plan.command not in results:
            results[plan.command] = learning.result_of(config, plan)
    return [results[plan.command] for plan in plans if results[plan.command] is not None]


def share_that_holds(texts: list[str]) -> str:
    """Return in which of a statement's rows it holds, by their verdicts: all, some or none; open if none is decided."""
    if "holds" in texts:
        return "all" if set(texts) == {"holds"} else "some"
    return "none" if "does not hold" in texts else "open"


def print_tables(runs: dict[str, dict[str, list[RunLog]]], verdicts: dict[str, Verdict]) -> None:
    """Print how many rows there are, a row for each claim with a verdict, and one for each statement that was not run.

    runs: of each claim that was asked for, by its agents.
    """
    stars = dict(zip(verdicts, tables.holm([each.p_value for each in verdicts.values()]), strict=True))
    tested, rest, shares, mixed, lacks = [HEADING], [NOT_TESTED], Counter(), 0, 0
    for statement in STATEMENTS:
        said = statement.text, statement.thesis  # once, above rows that say the same of other tasks
        names = [name for name in statement.claims if name in verdicts]
        for name in names:
            tested.append(row(name, runs[name], str(verdicts[name]) + " \\*" * stars[name], said))
            said = "", ""
        if names:
            found = [verdicts[name].text for name in names]
            shares[share_that_holds(found)] += 1
            mixed += {"holds", "does not hold"} <= {*found}
        lacking = [f"`{name}`" for name in statement.claims if name in runs and name not in verdicts]
        # What no claim was made of has a row all the same, unless only some claims were asked for.
        if lacking or (not statement.claims and runs.keys() == CLAIMS.keys()):
            rest.append(f"| {' | '.join([statement.text, statement.thesis, ', '.join(lacking)])} |")
            lacks += len(lacking) or 1
    counts = Counter(found.text for found in verdicts.values())
    # Equal agents would decide a claim about `times` as high for certain, not by chance.
    by_chance = ALPHA * sum(each.text != "not learned" and CLAIMS[name].times == 1 for name, each in verdicts.items())
    print(
        f"Of {shares.total()} statements tested, {shares['all']} hold in all rows and {shares['some']} in some "
        f"({mixed} of which do not hold in others); "
        f"of the others, {shares['none']} do not hold, {shares['open']} are not decided or not learned."
    )
    print(
        f"Of {counts.total()} rows tested, {counts['holds']} hold and {counts['does not hold']} do not "
        f"({sum(stars.values())} of these {counts['holds'] + counts['does not hold']} with a star), "
        f"{counts['not decided']} are not decided, {counts['not learned']} not learned. {lacks} more were not tested. "
        f"If no agents differed, {by_chance:.1f} of those tested would be decided on average, at most: any without a "
        "star may be one of them."
    )
    for table in (tested, rest):
        if table[1:]:
            print("\n".join(table))


def main(config: Config) -> None:
    """Train what is missing, then print a row for each claim. Raises SystemExit for names that are not in CLAIMS.

    Raises it for what `learning.check` refuses, too.
    """
    learning.check(config)
    if unknown := [name for name in config.claims if name not in CLAIMS]:
        raise SystemExit(f"there is no claim {unknown[0]}; there are {', '.join(CLAIMS)}")
    claims = {name: claim for name, claim in CLAIMS.items() if name in config.claims}
    plans = {name: {agent: claim.plans(config, agent) for agent in claim.agents} for name, claim in claims.items()}
    without = {name: claim.plans(config, "no memory") if claim.needs_memory else [] for name, claim in claims.items()}
    if not config.report:
        wanted = itertools.chain(*without.values(), *(seeds for agents in plans.values() for seeds in agents.values()))
        each_once = {plan.command: plan for plan in wanted}
        learning.train_missing(config, [*each_once.values()])  # claims share runs
    results, runs, verdicts = {}, {}, {}
    for name, claim in claims.items():
        runs[name] = {agent: finished(config, seeds, results) for agent, seeds in plans[name].items()}
        bases = finished(config, without[name], results)
        needed = [*runs[name].values(), *([bases] if claim.needs_memory else [])]
        if all(learning.are_enough(found, config.seeds) for found in needed):
            verdicts[name] = judge(claim, runs[name], bases)
    print_tables(runs, verdicts)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    with one_line_exit(OSError):
        main(tyro.cli(Config))
