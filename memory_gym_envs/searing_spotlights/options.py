"""The ids of Searing Spotlights: their reset options and the entries of their vectors."""

from dataclasses import replace
from typing import Any

from memory_gym_envs.entries import Entries
from memory_gym_envs.options import Option
from memory_gym_envs.variant import AGENT_SCALE, AGENT_SPEED, MAX_STEPS, Variant, applicable

SPOT_RADII = (1, 42)  # pixels; the largest spotlight is as wide as the screen
MOST_COINS = 20
LONGEST_DELAY = 1000  # steps


def light_rows(endless: bool) -> list[tuple[bool, Option]]:
    """The options of time and light, each with whether the id has it."""
    finite, (small, large) = not endless, SPOT_RADII
    deadline = "steps to collect a coin in; -1: no limit"
    delay = "steps added to an interval between spotlights, sampled for each"
    return [
        (True, replace(MAX_STEPS, default=-1 if endless else 256)),
        (endless, Option("steps_per_coin", 160, "int", 1, None, deadline, also=(-1,))),
        (True, Option("initial_spawns", 3 if endless else 4, "int", 0, 100, "spotlights at the start")),
        (finite, Option("num_spawns", 30, "int", 0, None, "spotlights that follow")),
        (finite, Option("initial_spawn_interval", 30, "int", 0, None, "steps between them; the threshold is added")),
        (finite, Option("spawn_interval_threshold", 10, "int", 0, None, "steps added to initial_spawn_interval")),
        (finite, Option("spawn_interval_decay", 0.95, "float", 0.0, 1.0, "factor of the interval", ignored=True)),
        (endless, Option("spawn_interval", 50, "int", 1, None, "steps between the spotlights that follow")),
        (True, Option("spawn_delay", (0,), "ints", 0, LONGEST_DELAY, delay)),
        (True, Option("spot_min_radius", 7.5, "float", small, large, "smallest radius of a spotlight, rounded down")),
        (True, Option("spot_max_radius", 13.75, "float", small, large, "largest radius; at least the smallest")),
        (True, Option("spot_min_speed", 0.0025, "float", 0.0, 1.0, "slowest spotlight, in passages a step")),
        (True, Option("spot_max_speed", 0.0075, "float", 0.0, 1.0, "fastest spotlight; at least the slowest")),
        (True, Option("spot_damage", 1.0, "float", 0.0, None, "health lost in a step in the light")),
        (True, Option("visual_feedback", True, "bool", None, None, "redden the floor while the agent is in the light")),
        (True, Option("black_background", False, "bool", None, None, "black floor; spotlights have white rims")),
        (True, Option("hide_chessboard", False, "bool", None, None, "white floor, which never reddens")),
        (True, Option("light_dim_off_duration", 6, "int", 0, 255, "steps in which the light goes out; 0: it is out")),
        (True, Option("light_threshold", 255, "int", 0, 255, "dimming ends when darkness exceeds this; 255: black")),
    ]


def body_rows(endless: bool) -> list[tuple[bool, Option]]:
    """The options of coins, exit, agent and rewards, likewise."""
    finite, shown = not endless, "frames that show the first coin in the dark; each later one: one frame less"
    feedback = "false: later coins appear in the dark, and the top bar doesn't show rewards for coins"
    rewarded = "show in the top bar whether the step before the last was rewarded"
    return [
        (finite, Option("num_coins", (1,), "ints", 0, MOST_COINS, "coins to collect", empty=True)),
        (True, Option("coin_scale", 0.375, "float", 0.1, 2.0, "size of a coin; 0.375: 6 pixels wide")),
        (endless, Option("coin_show_duration", 6, "int", 0, None, shown)),
        (endless, Option("coin_feedback", True, "bool", None, None, feedback)),
        (True, Option("coins_visible", False, "bool", None, None, "coins are visible in the dark")),
        (endless, Option("coin_enabled", True, "bool", None, None, "false: no coins, and no time limit for them")),
        (finite, Option("use_exit", True, "bool", None, None, "false: the last coin ends the episode")),
        (finite, Option("exit_scale", 0.5, "float", 0.1, 2.0, "size of the exit; 0.5: 10 pixels wide")),
        (finite, Option("exit_visible", False, "bool", None, None, "the exit is visible in the dark")),
        (True, AGENT_SPEED),
        (True, Option("agent_health", 10 if endless else 5, "int", 1, None, "health at the start")),
        (True, AGENT_SCALE),
        (True, Option("agent_visible", False, "bool", None, None, "the agent is visible in the dark")),
        (True, Option("sample_agent_position", True, "bool", None, None, "false: the agent starts in the middle")),
        (True, Option("show_last_action", True, "bool", None, None, "show the action before the last in the top bar")),
        (True, Option("show_last_positive_reward", True, "bool", None, None, rewarded)),
        (True, Option("reward_inside_spotlight", 0.0, "float", None, None, "reward for each step in the light")),
        (True, Option("reward_outside_spotlight", 0.0, "float", None, None, "reward for each step in the dark")),
        (True, Option("reward_death", 0.0, "float", None, None, "reward added when no health is left")),
        (finite, Option("reward_exit", 1.0, "float", None, None, "reward for leaving")),
        (finite, Option("reward_max_steps", 0.0, "float", None, None, "reward at the time limit", ignored=True)),
        (True, Option("reward_coin", 0.25, "float", None, None, "reward for each coin")),
    ]


def entry_rows(endless: bool) -> tuple[Entries, ...]:
    """The entries of an id's vector."""
    action = "the action in the bar, one-hot: none, {}, {}; zeros: hidden"
    body = "{}: visible pixels / 144, at most 1; x and y of their middle, / 84"
    tiles = "of each tile of 12 x 12 pixels, row by row, the share that is {}, without the bar's pixels"
    table: list[tuple[Any, ...]] = [
        (True, "health", 1, "share of the bar's left half that is green"),
        (True, "horizontal", 3, action.format("left", "right")),
        (True, "vertical", 3, action.format("up", "down")),
        (True, "rewarded", 1, "1 where the bar shows a positive reward"),
        (True, "agent", 3, body.format("the agent")),
        (not endless, "exit", 3, body.format("the exit without its black frame")),
        (True, "coin", 3, body.format("the coin, or all of them")),
        (True, "facing", 8, "the agent's facing where all of it is visible, one-hot"),
        (not endless, "exit_open", 1, "1 where an open exit is visible"),
        (not endless, "coins", 49, tiles.format("coins")),
        (True, "light", 49, tiles.format("bright floor or, with a black background, rims of spotlights")),
        (True, "dusk", 1, "brightness of the floor outside of the light, while any is visible"),
        (True, "alarm", 1, "1 where red floor is visible"),
    ]
    return tuple(Entries(*row) for has_it, *row in table if has_it)


def make_variant(endless: bool) -> Variant:
    """The finite id, or the endless one: one coin after the other, no exit. The original's options are in its order."""
    options = applicable(light_rows(endless) + body_rows(endless))
    return Variant(25, options, entry_rows(endless), endless=endless)


VARIANTS = {
    "SearingSpotlights-v0": make_variant(endless=False),
    "Endless-SearingSpotlights-v0": make_variant(endless=True),
}
