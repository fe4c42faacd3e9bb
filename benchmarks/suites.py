"""Tasks and agents that learning.py and claims.py train, by the names that tables and pictures have for them."""

import json
import re
from dataclasses import dataclass, field, replace

from ppo_utils.scores import own_metric

# What --preset laptop was when the older results were made.
EARLY = "--value-init-gain 1 --no-attend-commands"
# What it was until Muon: the agents of the suites small and full have these settings.
ADAMW = f"{EARLY} --optimizer adamw --no-norm-reward --num-envs 32 --update-epochs 4 --num-minibatches 8"
ADAMW += " --init-lr 1e-3 --final-lr 1e-4 --init-ent-coef 5e-4 --final-ent-coef 5e-5"
GRU = f"ppo_gru.py {ADAMW}"
BEFORE = "ppo_trxl.py --init-lr 1e-3 --gamma 0.99 --vf-coef 0.5"  # what --preset laptop had for the transformer
ADAMW_TRXL = f"{BEFORE} {ADAMW} --trxl-num-layers 2 --trxl-dim 64 --trxl-memory-length 128"
TRXL = f"{ADAMW_TRXL} --no-trxl-query-position --no-trxl-memory-gradient"  # the thesis', where the preset differs
MEMORIES = {
    "GRU": f"{GRU} --memory gru",
    "LSTM": f"{GRU} --memory lstm",
    "TrXL": TRXL,
    "GTrXL": f"{TRXL} --trxl-gate gru",
}
# The thesis' exploration bonus, with the weights that suit it on these tasks; the preset has the log barrier.
ENTROPY = "--exploration-bonus entropy --init-ent-coef 1e-3 --final-ent-coef 1e-4"
MUON = {  # --preset laptop, with what all agents have (learning.COMMON)
    "no memory, Muon": f"ppo_gru.py --memory none {EARLY}",
    "stack of 16, Muon": f"ppo_gru.py --memory none --frame-stack 16 {EARLY}",
    "GRU, Muon": f"ppo_gru.py {EARLY}",
    "TrXL, Muon": f"{BEFORE} {EARLY}",
}
# Muon with what the thesis has: smaller steps, a longer horizon, rewards as they are.
LOW_RATE = "--init-lr 3e-4 --gamma 0.995 --clip-coef 0.1 --no-norm-reward"
LOW_RATE += " --exploration-bonus entropy --init-ent-coef 1e-4 --final-ent-coef 1e-5"
AGENTS = {
    "no memory": f"{GRU} --memory none",
    "stack of 4": f"{GRU} --memory none --frame-stack 4",
    "stack of 16": f"{GRU} --memory none --frame-stack 16",
    "step encoding": f"{GRU} --memory none --step-encoding",
    **MEMORIES,
    "TrXL, preset": ADAMW_TRXL,
    **MUON,
    "TrXL, laptop": BEFORE,
    # --preset laptop as it is.
    "GRU, laptop": "ppo_gru.py",
    "TrXL+": "ppo_trxl.py",
    **{f"{name}, low rate": f"{flags} {LOW_RATE}" for name, flags in MUON.items()},
    **{f"{name}, entropy": f"{flags} {ENTROPY}" for name, flags in MEMORIES.items()},
    **{f"{name}, refreshed": f"{flags} --refresh-memory" for name, flags in MEMORIES.items()},
    **{f"{name}, gradient": f"{MEMORIES[name]} --trxl-memory-gradient" for name in ("TrXL", "GTrXL")},
    **{
        f"{name}, gradient, refreshed": f"{MEMORIES[name]} --trxl-memory-gradient --refresh-memory"
        for name in ("TrXL", "GTrXL")
    },
}


@dataclass(frozen=True)
class Task:
    """A task, and how it is learned."""

    env_id: str
    total_timesteps: int
    options: dict = field(default_factory=dict)
    trxl_flags: str = ""  # the transformer's own

    @property
    def title(self) -> str:
        """Return the environment's id, and the reset options if they are not the default ones."""
        return f"{self.env_id} {json.dumps(self.options)}" if self.options else self.env_id

    @property
    def best_score(self) -> float | None:
        """Return the best score that is possible, None where there is no bound."""
        return None if self.env_id.startswith("Endless") else 1.0

    @property
    def score(self) -> str:
        """Return the name of the score by which agents are compared: the family's own metric (6.1.3)."""
        return own_metric(self.env_id)


SMALL = {
    "mortar-mayhem": Task(
        "MortarMayhem-Grid-v0",
        1_000_000,
        # Four commands instead of ten, each shown for one step, and two thirds of the time to carry one out.
        {
            "command_count": [4],
            "command_show_duration": [1],
            "command_show_delay": [0],
            "explosion_delay": [4],
            "explosion_duration": [2],
        },
    ),
    "mystery-path": Task(
        "MysteryPath-Grid-v0",
        1_500_000,
        # All paths begin at the left, and each of their tiles pays a tenth of the goal's reward when first reached:
        # without this, chance finds too few goals.
        {"cardinal_origin_choice": [0], "reward_path_progress": 0.1},
        # Where the agent fell matters, not when.
        trxl_flags="--trxl-positional-encoding none",
    ),
    "endless-mortar-mayhem": Task(
        "Endless-MortarMayhem-v0",
        1_000_000,
        # A step crosses a tile, as on the grid; a new command is shown for one step, and carrying one out takes four:
        # an episode with twenty commands carried out has about ninety steps.
        {
            "agent_speed": 14,
            "allowed_commands": 5,
            "explosion_delay": [3],
            "explosion_duration": [1],
            "command_show_duration": [1],
            "command_show_delay": [0],
        },
    ),
}
FULL = {  # trained for what two cores can do in a day, all agents and seeds together; few agents converge
    env_id: Task(env_id, 1_000_000 * millions)
    for env_id, millions in {
        "MortarMayhem-v0": 3,
        "MortarMayhem-Grid-v0": 6,
        "MortarMayhemB-v0": 2,
        "MortarMayhemB-Grid-v0": 1,
        "Endless-MortarMayhem-v0": 6,
        "MysteryPath-v0": 3,
        "MysteryPath-Grid-v0": 3,
        "Endless-MysteryPath-v0": 3,
        "SearingSpotlights-v0": 3,
        "Endless-SearingSpotlights-v0": 3,
    }.items()
}
# With --preset laptop: until an agent comes to rest, or as far as is affordable.
LAPTOP = {
    env_id: replace(FULL[env_id], total_timesteps=int(1_000_000 * millions))
    for env_id, millions in {
        "MortarMayhem-v0": 12,
        "MortarMayhem-Grid-v0": 6,
        "MortarMayhemB-v0": 6,
        "MortarMayhemB-Grid-v0": 6,
        "Endless-MortarMayhem-v0": 9,
        "MysteryPath-v0": 6,
        "MysteryPath-Grid-v0": 15,
        "Endless-MysteryPath-v0": 3,
        "SearingSpotlights-v0": 6,
        "Endless-SearingSpotlights-v0": 9,
    }.items()
}
# In the full tasks, transformers have about as many parameters as the GRU.
WIDE = "--trxl-dim 96 --trxl-memory-length 256 --init-lr 5e-4"
TASKS = SMALL | FULL
SUITES = {  # tasks and agents
    "small": (
        SMALL,
        ("no memory", "stack of 4", "stack of 16", "GRU", "TrXL", "TrXL, preset"),
    ),
    "full": (
        FULL,
        (
            *("no memory", "stack of 4", "stack of 16", "step encoding", "GRU", "LSTM"),
            *(f"{name} {WIDE}" for name in ("TrXL", "GTrXL", "TrXL, preset")),
        ),
    ),
    "laptop": (LAPTOP, ("no memory, Muon", "stack of 16, Muon", "GRU, Muon", "TrXL, Muon")),
}
COLORS = {  # an agent has the same in every picture
    "no memory": "tab:gray",
    "stack of 4": "tab:olive",
    "stack of 16": "tab:brown",
    "step encoding": "tab:pink",
    "GRU": "tab:blue",
    "LSTM": "tab:cyan",
    "TrXL": "tab:orange",
    "GTrXL": "tab:purple",
    "TrXL+": "tab:red",
}
COLORS |= {
    f"{name}, Muon{rate}": COLORS[name]
    for name in ("no memory", "stack of 16", "GRU", "TrXL+")
    for rate in ("", ", low rate")
}


def short(agent: str) -> str:
    """Return an agent's name for tables: its flags in words, without those that make a transformer wide."""
    name = agent.replace(f" {WIDE}", "").replace("TrXL, preset", "TrXL+").replace("TrXL, Muon", "TrXL+, Muon")
    return re.sub(r" --(?:trxl-)?([\w-]+)", lambda found: f", {found[1].replace('-', ' ')}", name)
