"""Do the thesis' claims hold here? Train the agents that claims of its chapters 6 and 7 compare.

    python benchmarks/claims.py --results benchmarks/results
    python benchmarks/claims.py --claims query-position gate-bias

Tasks, runs and results are those of benchmarks/learning.py: small networks, vector observations, minutes of training.

A claim compares pairs of agents: each that is said to have the higher number (A in the table) with each that is said to
have the lower one (B). A pair is decided as in the tables of results (`tables.Comparison`): by Welch's t-test over
seeds and levels. The claim holds if all of its pairs are decided its way, does not hold if one is decided the other
way, and else is not decided. Where the thesis says that agents are no better than others, that is contradicted if a
pair is decided. Where no agent of a row scores higher than those without memory, or all have less than a quarter of
what is possible (in endless tasks, of what the thesis' transformer has; nine tenths where falls are counted), the task
has not been learned, and there is no verdict.

With so many rows, some verdicts come by chance. A star marks those that also stand at a family-wise error of 5 % (Holm,
1979). A row of several pairs has the largest of their p-values where all of them are needed, else the smallest times
their number.

With --report nothing is trained, and a claim is not tested if runs are missing.
"""

import itertools
import signal
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import learning
import suites
import tables
from ppo_utils.run_logs import RunLog, align
from suites import Task
from tables import LEVEL, Comparison

IN_VIEW = {"command_count": [4], "explosion_delay": [4], "explosion_duration": [2]}
ALL_VISIBLE = {"agent_visible": True, "coins_visible": True, "exit_visible": True}
PATH, ENDLESS = suites.SMALL["mystery-path"], suites.SMALL["endless-mortar-mayhem"]
EARLY = {  # millions of steps with AdamW
    "MortarMayhem-v0": 3,
    "MortarMayhem-Grid-v0": 6,
    "Endless-MortarMayhem-v0": 6,
    "MysteryPath-v0": 3,
    "MysteryPath-Grid-v0": 3,
    "Endless-MysteryPath-v0": 3,
    "SearingSpotlights-v0": 3,
    "Endless-SearingSpotlights-v0": 3,
}
TASKS = {
    **suites.SMALL,
    **{env_id: Task(env_id, 1_000_000 * millions) for env_id, millions in EARLY.items()},
    "commands-in-view": replace(suites.SMALL["mortar-mayhem"], env_id="MortarMayhemB-Grid-v0", options=IN_VIEW),
    "goal-in-view": replace(PATH, options=PATH.options | {"show_origin": True, "show_goal": True}),
    "all-in-view": Task("SearingSpotlights-v0", 1_000_000, ALL_VISIBLE),
    "endless-long": replace(ENDLESS, total_timesteps=12_000_000),
}
# Of a task's aim, what one of a row's agents has, if the task has been learned. Those that fail fall for other reasons.
SHARE, SHARE_OF_FALLS = 0.25, 0.9
WIDE_TASKS = {*EARLY, "endless-long"}  # here, transformers have about as many parameters as the GRU
WIDE = "--trxl-dim 96 --trxl-memory-length 256 --init-lr 5e-4"


# What is compared, (R, M): of each seed, on each of the development levels, which all runs have.
def at_the_end(name: str, runs: list[RunLog]) -> np.ndarray:
    """Return the scores of the final weights, by the name of a metric or score."""
    return align([run.curves[f"eval/{name}"] for run in runs])[1][-1].mean(-1)


def score(task: Task, runs: list[RunLog]) -> np.ndarray:
    """Return the task's scores of the final weights."""
    return at_the_end(task.score, runs)


def area(task: Task, runs: list[RunLog]) -> np.ndarray:
    """Return the means of the learning curves: they are higher where fewer samples are needed."""
    return align([run.curves[f"eval/{task.score}"] for run in runs])[1].mean((0, -1))


def falls(task: Task, runs: list[RunLog]) -> np.ndarray:
    """Return how often the final weights fall off."""
    return at_the_end("num_fails", runs)


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
    measure: Callable[[Task, list[RunLog]], np.ndarray] = score
    flags: str = ""  # of all agents
    expects_difference: bool = True

    @property
    def agents(self) -> tuple[str, ...]:
        """Return all that are compared."""
        return (*self.higher, *self.lower)

    def plans(self, config: learning.Training, agent: str) -> list[learning.Plan]:
        """Return the trainings of one of the agents, one for each seed."""
        name, *own = agent.split(" --", 1)
        wide = [WIDE] if self.task in WIDE_TASKS and "TrXL" in name else []
        trained = " ".join([f"{name}, AdamW", *self.flags.split(), *(f"--{flags}" for flags in own), *wide])
        return [learning.plan(config, TASKS[self.task], trained, seed) for seed in config.seeds]

    def numbers(self, runs: list[RunLog]) -> np.ndarray:
        """Return what is compared, (R, M)."""
        return self.measure(TASKS[self.task], runs)


@dataclass(frozen=True)
class Statement:
    """What the thesis says, and the claims that it makes about tasks here."""

    text: str  # with its section
    thesis: str  # its figures, as far as its text has them
    claims: dict[str, Claim]


def claims_of(prefix: str, tasks: str, higher: tuple[str, ...], lower: tuple[str, ...], **others) -> dict[str, Claim]:
    """Return the same claim about each of some tasks; a name is the prefix and the task's name."""
    return {f"{prefix}-{task}": Claim(task, higher, lower, **others) for task in tasks.split()}


def in_endless(higher: tuple[str, ...], lower: tuple[str, ...], **others) -> Claim:
    """Return a claim about the small Endless Mortar Mayhem."""
    return Claim("endless-mortar-mayhem", higher, lower, **others)


MEMORY, FEW_FRAMES = ("GRU", "TrXL"), ("no memory", "4 frames", "step encoding")
NO_MEMORY = (*FEW_FRAMES, "16 frames")
GRU, TRXL, LSTM, GTRXL = ("GRU",), ("TrXL",), ("LSTM",), ("GTrXL",)
QUERY_POSITION, NORMALIZED = "TrXL --trxl-query-position", "GRU --norm-adv minibatch"
MORTAR_MAYHEMS = "mortar-mayhem MortarMayhem-Grid-v0 MortarMayhem-v0"
STATEMENTS = (
    Statement(
        "6.2.1 Mortar Mayhem needs memory",
        "",
        claims_of("memory", MORTAR_MAYHEMS, MEMORY, NO_MEMORY),
    ),
    Statement(
        "6.2.1 Mystery Path needs memory",
        "",
        claims_of("memory", "mystery-path MysteryPath-Grid-v0 MysteryPath-v0", MEMORY, NO_MEMORY),
    ),
    Statement(
        "6.2.1 Searing Spotlights needs memory",
        "no success without",
        claims_of("memory", "SearingSpotlights-v0", MEMORY, NO_MEMORY),
    ),
    Statement(
        "6.2.1 Memory is best in the act task",
        "10 commands; step encoding 9.5, 16 frames 8, 4 frames 5",
        claims_of("memory", "commands-in-view", MEMORY, NO_MEMORY),
    ),
    Statement(
        "6.2.1 Frames or the step help in the act task",
        "no memory is ineffective",
        claims_of("frames", "commands-in-view", ("step encoding", "4 frames", "16 frames"), ("no memory",)),
    ),
    Statement(
        "6.2.1 With its ends shown, 16 frames are enough in Mystery Path",
        "4 frames, step encoding 0.40, no memory 0.11",
        claims_of("stack", "goal-in-view", ("16 frames", *MEMORY), FEW_FRAMES),
    ),
    Statement(
        "6.2.2 TrXL needs fewer samples than GRU in Mortar Mayhem Grid",
        "",
        {
            **claims_of("samples", "mortar-mayhem MortarMayhem-Grid-v0", TRXL, GRU, measure=area),
            "samples-small-values": Claim("mortar-mayhem", TRXL, GRU, area, flags="--value-init-gain 0.01"),
        },
    ),
    Statement(
        "6.2.2 TrXL carries out more in Mortar Mayhem",
        "GRU 6 commands, TrXL more",
        claims_of("score", "MortarMayhem-v0", TRXL, GRU),
    ),
    Statement(
        "6.2.2 TrXL needs fewer samples in Mystery Path",
        "",
        claims_of("samples", "mystery-path MysteryPath-v0", TRXL, GRU, measure=area),
    ),
    Statement(
        "6.2.2 GRU needs fewer in Searing Spotlights, the act task, Mystery Path with ends shown",
        "",
        claims_of("samples", "SearingSpotlights-v0 commands-in-view goal-in-view", GRU, TRXL, measure=area),
    ),
    Statement(
        "6.2.3 LSTM is behind GRU in Mortar Mayhem",
        "LSTM 3 commands",
        claims_of("lstm-score", MORTAR_MAYHEMS, GRU, LSTM),
    ),
    Statement(
        "6.2.3 LSTM needs more samples than GRU elsewhere",
        "full success in Mystery Path",
        claims_of("lstm-samples", "mystery-path MysteryPath-v0 SearingSpotlights-v0", GRU, LSTM, measure=area),
    ),
    Statement(
        "6.2.3 GTrXL is behind TrXL in Mortar Mayhem",
        "GTrXL 2 commands",
        claims_of("gates-score", MORTAR_MAYHEMS, TRXL, GTRXL),
    ),
    Statement(
        "6.2.3 GTrXL needs more samples than TrXL elsewhere",
        "",
        claims_of("gates-samples", "mystery-path MysteryPath-v0 SearingSpotlights-v0", TRXL, GTRXL, measure=area),
    ),
    Statement(
        "6.2.3 In Mystery Path, gate bias 0 is better than 2",
        "0.94, 0.81",
        {"gate-bias": Claim("mystery-path", GTRXL, ("GTrXL --trxl-gate-bias 2",))},
    ),
    Statement(
        "6.3 GRU is ahead of TrXL in Endless Mortar Mayhem",
        "120, 18 commands",
        claims_of("score", "endless-mortar-mayhem Endless-MortarMayhem-v0", GRU, TRXL),
    ),
    Statement(
        "6.3 GRU is ahead in Endless Mystery Path",
        "return 2.65, 2.02",
        claims_of("score", "Endless-MysteryPath-v0", GRU, TRXL),
    ),
    Statement(
        "6.3 GRU is ahead in Endless Searing Spotlights",
        "about 20, 6 coins",
        claims_of("score", "Endless-SearingSpotlights-v0", GRU, TRXL),
    ),
    Statement(
        "6.5.2 GRU falls off more often in Mystery Path",
        "5.65, 4.87 times",
        claims_of("falls", "mystery-path MysteryPath-v0", GRU, TRXL, measure=falls),
    ),
    Statement(
        "7.1.1 A larger TrXL stays behind GRU",
        "",
        {
            "capacity": in_endless(
                GRU, ("TrXL --trxl-dim 96", "TrXL --trxl-num-layers 3", "TrXL --trxl-memory-length 256")
            )
        },
    ),
    Statement(
        "7.1.2 Estimating the ground truth helps TrXL",
        "50, 18 commands",
        {"ground-truth": in_endless(("TrXL --ground-truth-coef 0.1",), TRXL)},
    ),
    Statement(
        "7.1.2 A higher final learning rate helps TrXL",
        "24, 18",
        # The thesis' rate is at its final value after a fifth of the training.
        {"learning-rate": in_endless(TRXL, ("TrXL --final-lr 1e-5",), flags="--anneal-steps 200000")},
    ),
    Statement(
        "7.1.3 The step in the query helps TrXL a little",
        "19, 18",
        {"query-position": in_endless((QUERY_POSITION,), TRXL)},
    ),
    Statement(
        "7.1.3 GRU stays ahead of TrXL with that step",
        "140 at its peak, 19",
        {
            "query-position-gru": in_endless(GRU, (QUERY_POSITION, f"{QUERY_POSITION} --trxl-dim 96")),
            "endless-long": Claim("endless-long", GRU, (QUERY_POSITION,)),
        },
    ),
    Statement(
        "7.1.4 Refreshed memory may help TrXL",
        "not tested",
        {"stale": in_endless(("TrXL --refresh-memory",), TRXL)},
    ),
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
    # Large steps are what the thesis suspects, and --target-kl would prevent them.
    Statement(
        "7.2 Normalized advantages make GRU worse in Searing Spotlights, all visible",
        "1.00, 0.43",
        claims_of("normalized", "all-in-view", GRU, (NORMALIZED,), flags="--target-kl None"),
    ),
    Statement(
        "7.2 With normalized advantages, no memory is ahead of GRU",
        "0.96, 0.43",
        {
            "normalized-no-memory": Claim(
                "all-in-view", ("no memory --norm-adv minibatch",), (NORMALIZED,), flags="--target-kl None"
            )
        },
    ),
    Statement(
        "7.2 Normalized advantages make gradients larger",
        "over 12 times",
        {"normalized-gradients": Claim("all-in-view", (NORMALIZED,), GRU, gradient_norm, flags="--target-kl None")},
    ),
    Statement(
        "7.2 Normalized advantages make GRU worse in Mortar Mayhem, Mystery Path",
        "",
        claims_of("normalized", "mortar-mayhem mystery-path", GRU, (NORMALIZED,)),
    ),
)
CLAIMS = {name: claim for statement in STATEMENTS for name, claim in statement.claims.items()}
HEADING = """
| statement | thesis | A | B | M steps | verdict | `--claims` |
|---|---|---|---|---:|---|---|"""


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


def verdict(claim: Claim, pairs: list[Comparison]) -> Verdict:
    """Return the verdict on a claim, from the comparisons of its pairs."""
    above = [pair.p_value for pair in pairs if pair.errors > 0]
    below = [pair.p_value for pair in pairs if pair.errors < 0]
    # That one pair of several is decided is as likely as Bonferroni says, that all are, as the least sure one.
    if not claim.expects_difference:
        found = Verdict("contradicted", min(1, len(pairs) * min(above, default=1)))
        return found if found.p_value < LEVEL else Verdict("not contradicted")
    for found in (
        Verdict("does not hold", min(1, len(pairs) * min(below, default=1))),
        Verdict("holds", max(above) if len(above) == len(pairs) else 1),
    ):
        if found.p_value < LEVEL:
            return found
    return Verdict("not decided")


def aim_of(name: str) -> float | None:
    """Return a task's best possible score; in an endless task what the thesis' transformer has, None if it is small."""
    if (best := TASKS[name].best_score) is not None or name not in tables.read_thesis():
        return best
    return float(tables.read_thesis()[name].split(", ")[1])


def is_learned(claim: Claim, runs: dict[str, list[RunLog]], without: list[RunLog]) -> bool:
    """Return whether an agent of the claim has its share of the aim, and any scores higher than one without memory.

    The latter if there are runs of that; if an agent without memory is one of the claim's, another has to pass it.
    """
    task, aim = TASKS[claim.task], aim_of(claim.task)
    share = SHARE_OF_FALLS if claim.measure is falls else SHARE
    if aim is not None and max(score(task, members).mean() for members in runs.values()) < share * aim:
        return False
    if len(without) < 2:
        return True
    base = score(task, without)
    scores = [score(task, members) for agent, members in runs.items() if not agent.startswith("no memory")]
    return any(Comparison.of(each, base).is_ahead for each in scores)


def holm(p_values: list[float]) -> list[bool]:
    """Return which of these p-values stand at a family-wise error of `LEVEL` (Holm, 1979)."""
    order = np.argsort(p_values)
    limits = LEVEL / np.arange(len(order), 0, -1)
    passed = np.cumprod(np.array(p_values)[order] <= limits).astype(bool)  # from the smallest to the first that fails
    return passed[np.argsort(order)].tolist()


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
    """Return the verdict on a claim, from the runs of its agents and, if they are there, of one without memory."""
    if not is_learned(claim, runs, without):
        return Verdict("not learned")
    numbers = {agent: claim.numbers(members) for agent, members in runs.items()}
    pairs = itertools.product(claim.higher, claim.lower)
    return verdict(claim, [Comparison.of(numbers[one], numbers[other]) for one, other in pairs])


def finished(config: Config, plans: list[learning.Plan], results: dict) -> list[RunLog]:
    """Return the runs that are there; `results` keeps what has been read, by the plans' commands."""
    for plan in plans:
        if plan.command not in results:
            results[plan.command] = learning.result_of(config, plan)
    return [results[plan.command] for plan in plans if results[plan.command] is not None]


def main(config: Config) -> None:
    """Train what is missing, then print a row for each claim. Raises SystemExit for names that are not in CLAIMS.

    Raises it for what `learning.check` refuses, too.
    """
    learning.check(config)
    if unknown := [name for name in config.claims if name not in CLAIMS]:
        raise SystemExit(f"there is no claim {unknown[0]}; there are {', '.join(CLAIMS)}")
    claims = {name: claim for name, claim in CLAIMS.items() if name in config.claims}
    plans = {name: {agent: claim.plans(config, agent) for agent in claim.agents} for name, claim in claims.items()}
    if not config.report:
        each_once = {plan.command: plan for agents in plans.values() for seeds in agents.values() for plan in seeds}
        learning.train_missing(config, [*each_once.values()])  # claims share runs
    results, runs, verdicts = {}, {}, {}
    for name, claim in claims.items():
        runs[name] = {agent: finished(config, seeds, results) for agent, seeds in plans[name].items()}
        wanted, found = (sum(map(len, each.values())) for each in (plans[name], runs[name]))
        if found < wanted:
            print(f"`{name}` is not tested: {wanted - found} of {wanted} runs are missing")
            continue
        seeds = [learning.plan(config, TASKS[claim.task], "no memory, AdamW", seed) for seed in config.seeds]
        without = finished(config, seeds, results)
        verdicts[name] = judge(claim, runs[name], without if len(without) == len(seeds) else [])
    stars = dict(zip(verdicts, holm([each.p_value for each in verdicts.values()]), strict=True))
    if verdicts:
        print(HEADING)
    for statement in STATEMENTS:
        said = statement.text, statement.thesis  # once, above rows that say the same of other tasks
        for name in (name for name in verdicts if name in statement.claims):
            print(row(name, runs[name], verdicts[name].text + " \\*" * stars[name], said))
            said = "", ""
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
