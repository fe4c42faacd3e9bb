"""The ids of Mystery Path: their tiles, reset options and entries of a vector observation."""

from dataclasses import replace

from memory_gym_envs.appearance import agent_entries
from memory_gym_envs.character import LARGEST_RADIUS, PAD, SPAN
from memory_gym_envs.drawing import SCREEN
from memory_gym_envs.entries import Entries
from memory_gym_envs.options import Option
from memory_gym_envs.variant import AGENT_SCALE, AGENT_SPEED, MAX_STEPS, Variant, applicable

TILE = 12  # pixels
SIDE = 7  # tiles along one side of the screen, and of a segment of the endless path
SEGMENT = SIDE + 1  # columns of a segment and the transition tile behind it

# Of the finite ids: what AGaLiTe (Pramanik et al., 2023) calls easy.
EASY = {"show_origin": True, "show_goal": True, "reward_path_progress": 0.1}


def option_rows(grid: bool, endless: bool) -> tuple[Option, ...]:
    """The reset options of an id, in the original's order."""
    steps, progress = -1 if endless else 128 if grid else 512, 0.0 if grid else 0.1
    origin = "show the path's origin in blue"
    refill = "the path's origin restores stamina, as new tiles do; false, as in memory-gym 1.0.3: it does not"
    dense = "reward added for each tile that is new since the last fall"
    sides = "where the path starts: 0 left, 1 right, 2 top, 3 bottom"
    camera = "how many tiles from the screen's left edge the agent is drawn"
    rows = [
        (True, replace(MAX_STEPS, default=steps)),
        (True, replace(AGENT_SCALE, ignored=grid)),
        (not grid, AGENT_SPEED),
        (not endless, Option("cardinal_origin_choice", (0, 1, 2, 3), "ints", 0, 3, sides)),
        (True, Option("show_origin", False, "bool", None, None, origin, ignored=endless)),
        (not endless, Option("show_goal", False, "bool", None, None, "show the path's goal in green")),
        (endless, Option("show_past_path", True, "bool", None, None, "show the path behind the agent in white")),
        (endless, Option("show_background", False, "bool", None, None, "show tiles that move as the agent walks")),
        (endless, Option("show_stamina", False, "bool", None, None, "show how much stamina is left")),
        (True, Option("visual_feedback", True, "bool", None, None, "show a red cross where the agent falls off")),
        (endless, Option("camera_offset_scale", 5.0, "float", 0.0, 5.5, camera)),
        (endless, Option("stamina_level", 20, "int", 1, None, "steps until the agent must have reached a new tile")),
        (endless, Option("origin_restores_stamina", True, "bool", None, None, refill)),
        (not endless, Option("reward_goal", 1.0, "float", None, None, "reward for reaching the goal")),
        (True, Option("reward_fall_off", 0.0, "float", None, None, "reward for falling off the path")),
        (True, Option("reward_path_progress", progress, "float", None, None, "reward for each new tile of the path")),
        (endless, Option("reward_path_progress_dense", 0.0, "float", None, None, dense)),
        (True, Option("reward_step", 0.0, "float", None, None, "reward for every step")),
    ]
    return applicable(rows)


def entry_rows(endless: bool) -> tuple[Entries, ...]:
    """The entries of an id's vector observation."""
    cross = Entries("cross", 1, "1: a red cross is visible, where the agent fell off")
    if not endless:
        ends = [
            Entries(name, 2, f"the centre of the path's {name}, x and y, / 84 pixels; zeros: not shown, or hidden")
            for name in ("origin", "goal")
        ]
        return *agent_entries(0, SCREEN + LARGEST_RADIUS), cross, *ends
    past = (
        "1: a tile of the path behind the agent is visible; by column and then row: 7 rows, and 8 columns of 12 pixels "
        "for the tile's left edge, the first of them left of the screen"
    )
    scroll = "how far right of its column's left edge each of these tiles starts, at most, / 12 pixels"
    return (
        *agent_entries(-PAD, SPAN - 1 - PAD),
        cross,
        Entries("past", SEGMENT * SIDE, past),
        Entries("scroll", 1, scroll),
        Entries("ground", 1, "one more than how far left the background has moved, / 12 pixels; 0: no background"),
        Entries("bar", 1, "1: the stamina bar is visible"),
        Entries("stamina", 1, "share of the stamina bar that is green"),
    )


def make_variant(fps: int, grid: bool = False, endless: bool = False) -> Variant:
    """The id with these properties."""
    return Variant(fps, option_rows(grid, endless), entry_rows(endless), grid, endless)


VARIANTS = {
    "MysteryPath-v0": make_variant(25),
    "MysteryPath-Grid-v0": make_variant(3, grid=True),
    "Endless-MysteryPath-v0": make_variant(25, endless=True),
}
