"""Tasks and agents that learning.py and claims.py train, by the names that tables and pictures have for them."""

import json
import re
from dataclasses import dataclass, field

from ppo_utils.scores import own_metric

NO_MEMORY = "ppo_gru.py --memory none"
PRESET = {  # --preset laptop
    "no memory": NO_MEMORY,
    "4 frames": f"{NO_MEMORY} --frame-stack 4",
    "16 frames": f"{NO_MEMORY} --frame-stack 16",
    "step encoding": f"{NO_MEMORY} --step-encoding",
    "GRU": "ppo_gru.py",
    "LSTM": "ppo_gru.py --memory lstm",
    "TrXL": "ppo_trxl.py --no-trxl-query-position --no-trxl-memory-gradient",  # the thesis', where the preset differs
    "TrXL+": "ppo_trxl.py",
    "GTrXL+": "ppo_trxl.py --trxl-gate gru",
}
# What suits ppo_gru.py in Mystery Path, as far as it learns there: smaller steps, a longer horizon, raw rewards.
LOW_RATE = "--init-lr 3e-4 --gamma 0.995 --clip-coef 0.1 --no-norm-reward"
LOW_RATE += " --exploration-bonus entropy --init-ent-coef 1e-4 --final-ent-coef 1e-5"
AGENTS = {
    **PRESET,
    # What the preset was for the transformer until 2026-11.
    "TrXL+, before": "ppo_trxl.py --init-lr 1e-3 --gamma 0.99 --vf-coef 0.5 --value-init-gain 1",
    "TrXL+, low rate": f"ppo_trxl.py --vf-coef 0.5 --value-init-gain 1 {LOW_RATE}",
}


@dataclass(frozen=True)
class Task:
    """A task, and how it is learned."""

    env_id: str
    total_timesteps: int
    options: dict = field(default_factory=dict)
    gru_flags: str = ""  # of the agents of ppo_gru.py

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
FULL = {  # until an agent comes to rest, or as far as is affordable
    env_id: Task(env_id, 1_000_000 * millions, gru_flags=flags)
    for env_id, millions, flags in (
        ("MortarMayhem-v0", 12, ""),
        ("MortarMayhem-Grid-v0", 6, ""),
        ("MortarMayhemB-v0", 6, ""),
        ("MortarMayhemB-Grid-v0", 3, ""),
        ("Endless-MortarMayhem-v0", 9, ""),
        ("MysteryPath-v0", 6, LOW_RATE),
        ("MysteryPath-Grid-v0", 15, LOW_RATE),
        ("Endless-MysteryPath-v0", 3, ""),
        ("SearingSpotlights-v0", 6, ""),
        ("Endless-SearingSpotlights-v0", 9, ""),
    )
}
LONGER = {  # steps of longer trainings
    "MortarMayhemB-v0": 12_000_000,
    "Endless-MortarMayhem-v0": 20_000_000,
    "MysteryPath-v0": 24_000_000,
    "Endless-MysteryPath-v0": 9_000_000,
}
TASKS = SMALL | FULL
SUITES = {  # tasks and agents
    "small": (SMALL, ("no memory", "4 frames", "16 frames", "GRU", "TrXL", "TrXL+")),
    "full": (FULL, ("no memory", "16 frames", "GRU", "TrXL+")),
}
SEEDS = (1, 2, 3, 4, 5)  # of the tables; some agents have only the first three
CHOOSING_SEEDS = SEEDS[:3]  # by which settings were chosen
COLORS = {  # an agent has the same in every picture
    "no memory": "tab:gray",
    "4 frames": "tab:olive",
    "16 frames": "tab:brown",
    "step encoding": "tab:pink",
    "GRU": "tab:blue",
    "LSTM": "tab:cyan",
    "TrXL": "tab:orange",
    "GTrXL+": "tab:purple",
    "TrXL+": "tab:red",
}
COLORS |= {f"TrXL+, {settings}": "tab:green" for settings in ("before", "low rate")}


def short(agent: str) -> str:
    """Return an agent's name for tables: its flags in words."""
    return re.sub(r" --(?:trxl-)?([\w-]+)", lambda found: f", {found[1].replace('-', ' ')}", agent)
