"""What tells one id from another: its reset options and the entries of its vector observation."""

from dataclasses import dataclass, replace

from memory_gym_envs.appearance import agent_entries
from memory_gym_envs.character import LARGEST_RADIUS
from memory_gym_envs.drawing import SCREEN
from memory_gym_envs.entries import Entries
from memory_gym_envs.mortar_mayhem.arena import ARENA_SIZES, COMMANDS
from memory_gym_envs.options import Option
from memory_gym_envs.variant import AGENT_SCALE, AGENT_SPEED, MAX_STEPS, Variant, applicable

VECTOR_ORDER = ("stay", "right", "left", "up", "down", "right_down", "right_up", "left_down", "left_up")
VECTOR_COMMANDS = 20  # commands that the command vector has room for


@dataclass(frozen=True)
class MortarVariant(Variant):
    """A Mortar Mayhem id. `endless`: one more command after each completed sequence, on a torus."""

    clue: bool = True  # commands are shown one by one before the act task, instead of given as a vector


def option_rows(grid: bool, clue: bool, endless: bool) -> tuple[Option, ...]:
    """The reset options of an id, in the original's order."""
    delay, duration = ((6,), (2,)) if grid else ((18,), (6,))
    smallest, largest = ARENA_SIZES[0], ARENA_SIZES[-1]
    most = 100 if clue else VECTOR_COMMANDS
    last_command = "reward added with the last command's"
    new_command = "reward added when the newest command, a sequence's last, is carried out"
    rows = [
        (endless, MAX_STEPS),
        (True, replace(AGENT_SCALE, ignored=grid)),
        (not grid, AGENT_SPEED),
        (not endless, Option("arena_size", 5, "int", smallest, largest, "tiles along one side of the arena")),
        (True, Option("allowed_commands", 5 if grid else 9, "int", 4, 9, "how many kinds of command may occur")),
        (not endless, Option("command_count", (10,), "ints", 1, most, "commands to do")),
        (endless, Option("initial_command_count", 1, "int", 1, 100, "commands in the first sequence")),
        (clue, Option("command_show_duration", (3,), "ints", 1, 100, "steps that a command is shown")),
        (clue, Option("command_show_delay", (1,), "ints", 0, 100, "blank steps after a shown command")),
        (True, Option("explosion_duration", duration, "ints", 1, 1000, "steps that the tiles burn")),
        (True, Option("explosion_delay", delay, "ints", 1, 1000, "steps to carry out a command in")),
        (True, Option("visual_feedback", True, "bool", None, None, "show burning tiles in red")),
        (True, Option("reward_command_failure", 0.0, "float", None, None, "reward for standing on a burning tile")),
        (True, Option("reward_command_success", 0.1, "float", None, None, "reward for each command carried out")),
        (not endless, Option("reward_episode_success", 0.0, "float", None, None, last_command)),
        (endless, Option("reward_new_command_success", 0.0, "float", None, None, new_command)),
    ]
    return applicable(rows)


def entry_rows(clue: bool, endless: bool) -> tuple[Entries, ...]:
    """The entries of an id's vector observation."""
    command = f"the command that is shown, one-hot: {', '.join(COMMANDS)}; zeros: none"
    rest = f"the commands, as in vector_observation: {VECTOR_COMMANDS} by 9 one-hot, {', '.join(VECTOR_ORDER)}"
    around = LARGEST_RADIUS // 2 + 1 if endless else 0  # how far beyond the screen's edge an agent may be
    return (
        *agent_entries(-around, SCREEN + around),
        Entries("arena", 1, f"tiles along one side of the arena, / {ARENA_SIZES[-1]}; 0: an agent hides all of it"),
        Entries("fire", 1, "1: tiles burn, and it is visible"),
        Entries("safe", 2, "the centre of the tile that does not burn, x and y, / 84 pixels; zeros: none, or hidden"),
        Entries("command", len(COMMANDS), command) if clue else Entries("commands", VECTOR_COMMANDS * 9, rest),
    )


def make_variant(fps: int, grid: bool = False, clue: bool = True, endless: bool = False) -> MortarVariant:
    """The id with these properties."""
    return MortarVariant(fps, option_rows(grid, clue, endless), entry_rows(clue, endless), grid, endless, clue)


VARIANTS = {
    "MortarMayhem-v0": make_variant(25),
    "MortarMayhem-Grid-v0": make_variant(6, grid=True),
    "MortarMayhemB-v0": make_variant(25, clue=False),
    "MortarMayhemB-Grid-v0": make_variant(1, grid=True, clue=False),
    "Endless-MortarMayhem-v0": make_variant(25, endless=True),
}
