"""Mortar Mayhem: memorise a sequence of commands, then carry them out in time (thesis 4.3).

Shape letters: N lanes, n some of them, C commands that fit, L steps that the longest clue needs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from memory_gym_envs.appearance import (
    LARGEST_RADIUS,
    AppearanceTables,
    View,
    agent_entries,
    covered,
    make_appearance_tables,
    write_agent_entries,
)
from memory_gym_envs.base import ALL, DEBUG_ZOOM, NO_LIMIT, MemoryGymVectorEnv, numbered, widened
from memory_gym_envs.character import (
    FACINGS,
    PAD,
    SPAN,
    STRIDES,
    Figure,
    agent_tables,
    free_controls,
    grid_controls,
    radius_of,
    sprites,
    walk,
)
from memory_gym_envs.drawing import ROW, SCREEN, Sheet, paste, ring, turned
from memory_gym_envs.entries import Entries, vector_slices
from memory_gym_envs.options import Option
from memory_gym_envs.words import below, pick, words

TILE = 14  # pixels
ARENA_SIZES = range(2, 7)  # tiles along one side of the arena
TORUS_SIZE = 6  # fills the screen

# In the original's order: allowed_commands=k allows the first k.
COMMANDS = ("right", "down", "left", "up", "stay", "right_down", "right_up", "left_down", "left_up")
MOVES = np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])  # (9, 2) tiles
VECTOR_ORDER = ("stay", "right", "left", "up", "down", "right_down", "right_up", "left_down", "left_up")
VECTOR_AT = [VECTOR_ORDER.index(command) for command in COMMANDS]
VECTOR_COMMANDS = 20  # commands that the command vector has room for
BLANK = 0  # what a clue shows between commands; 1 + command otherwise

EVERY_LANE: Any = np.True_  # a mask, when no lane has to be left out


# ---- configuration ----


@dataclass(frozen=True)
class Variant:
    """What tells one Mortar Mayhem id from another."""

    grid: bool  # turn and walk tile by tile, instead of free movement
    clue: bool  # commands are shown one by one before the act task, instead of given as a vector
    endless: bool  # one more command after each completed sequence, on a torus
    jitter: bool  # the agent starts up to two pixels off its tile's centre
    render_fps: int
    options: tuple[Option, ...]
    entries: tuple[Entries, ...]  # of a vector observation


def _options(grid: bool, clue: bool, endless: bool) -> tuple[Option, ...]:
    """The reset options of an id, in the original's order of names."""
    fuse, burn = ((6,), (2,)) if grid else ((18,), (6,))
    size, note = "size of the agent; 0.25: 12 pixels wide", "; ignored, as in the original" if grid else ""
    rows = [
        (endless, Option("max_steps", -1, "int", 1, None, "steps until truncation; -1: no limit", also=(-1,))),
        (True, Option("agent_scale", 0.25, "float", 0.04, 1.0, size + note)),
        (not grid, Option("agent_speed", 3.0, "float", 0.0, 84.0, "pixels that the agent walks in a step")),
        (
            not endless,
            Option("arena_size", 5, "int", ARENA_SIZES[0], ARENA_SIZES[-1], "tiles along one side of the arena"),
        ),
        (True, Option("allowed_commands", 5 if grid else 9, "int", 4, 9, "how many kinds of command may occur")),
        (not endless, Option("command_count", (10,), "ints", 1, 100 if clue else VECTOR_COMMANDS, "commands to do *")),
        (endless, Option("initial_command_count", 1, "int", 1, 100, "commands in the first sequence")),
        (clue, Option("command_show_duration", (3,), "ints", 1, 100, "steps that a command is shown *")),
        (clue, Option("command_show_delay", (1,), "ints", 0, 100, "blank steps after a shown command *")),
        (True, Option("explosion_duration", burn, "ints", 1, 1000, "steps that the tiles burn *")),
        (True, Option("explosion_delay", fuse, "ints", 1, 1000, "steps to carry out a command in *")),
        (True, Option("visual_feedback", True, "bool", None, None, "show burning tiles in red")),
        (True, Option("reward_command_failure", 0.0, "float", None, None, "reward for standing on a burning tile")),
        (True, Option("reward_command_success", 0.1, "float", None, None, "reward for each command carried out")),
        (not endless, Option("reward_episode_success", 0.0, "float", None, None, "added with the last command's")),
    ]
    return tuple(option for present, option in rows if present)


def _entries(clue: bool, endless: bool) -> tuple[Entries, ...]:
    """What a vector observation of an id is made of."""
    command = f"the command that is shown, one-hot: {', '.join(COMMANDS)}; zeros: none"
    rest = f"the commands, as in vector_observation: {VECTOR_COMMANDS} by 9 one-hot, {', '.join(VECTOR_ORDER)}"
    around = LARGEST_RADIUS // 2 + 1 if endless else 0  # how far beyond the screen's edge an agent may be
    return (
        *agent_entries(-around, SCREEN + around),
        Entries("arena", 1, f"tiles along one side of the arena, / {ARENA_SIZES[-1]}; 0: an agent hides all of it"),
        Entries("fire", 1, "1: tiles burn, and it shows"),
        Entries("safe", 2, "the centre of the tile that does not burn, x and y, / 84 pixels; zeros: none, or hidden"),
        Entries("command", len(COMMANDS), command) if clue else Entries("commands", VECTOR_COMMANDS * 9, rest),
    )


def _variant(fps: int, grid: bool = False, clue: bool = True, endless: bool = False) -> Variant:
    jitter = endless or not (clue or grid)
    return Variant(grid, clue, endless, jitter, fps, _options(grid, clue, endless), _entries(clue, endless))


VARIANTS = {
    "MortarMayhem-v0": _variant(25),
    "MortarMayhem-Grid-v0": _variant(6, grid=True),
    "MortarMayhemB-v0": _variant(25, clue=False),
    "MortarMayhemB-Grid-v0": _variant(1, grid=True, clue=False),
    "Endless-MortarMayhem-v0": _variant(25, endless=True),
}


# ---- state ----


@dataclass
class State:
    """One array a field, one row a lane. Positions are stored with PAD added, tiles are rows of floors()."""

    pos: np.ndarray  # (N, 2) the agent's centre, x and y
    facing: np.ndarray  # (N,)
    figure: np.ndarray  # (N,) which of the batch's figures the agent is
    size: np.ndarray  # (N,) tiles along one side
    calm_floor: np.ndarray  # (N,) picture of the arena when nothing burns, a row of floors()
    floor: np.ndarray  # (N,) picture of the arena now
    target: np.ndarray  # (N,) the tile to reach
    target_corner: np.ndarray  # (N, 2) the first pixel of that tile, with PAD
    truth: np.ndarray  # (N, 2) float64: that tile, divided by arena size - 1
    commands: np.ndarray  # (N, C)
    count: np.ndarray  # (N,) length of the sequence
    current: np.ndarray  # (N,) commands checked so far, in this round of the sequence
    completed: np.ndarray  # (N,) commands carried out so far, in the episode
    clue: np.ndarray  # (N, L) uint8: what is shown at each step of the clue; BLANK at its end and after
    clue_step: np.ndarray  # (N,) the step that is being shown
    clue_end: np.ndarray  # (N,) the first step without a clue, where the agent may act
    symbol: np.ndarray  # (N,) what the frame shows: BLANK or 1 + command
    timer: np.ndarray  # (N,) acting steps until the tiles are lit or put out
    burning: np.ndarray  # (N,) bool: all tiles but the target burn
    explosion_delay: np.ndarray  # (N,) this episode's explosion_delay
    explosion_duration: np.ndarray  # (N,) this episode's explosion_duration
    show_duration: np.ndarray  # (N,) this episode's command_show_duration
    show_delay: np.ndarray  # (N,) this episode's command_show_delay
    length: np.ndarray  # (N,) steps so far
    episode_return: np.ndarray  # (N,) float64: sum of rewards so far
    vector: np.ndarray  # (N, 180) float32: the commands as one-hot rows
    # Options that the rules need at every step.
    visual_feedback: np.ndarray  # (N,) bool
    step_limit: np.ndarray  # (N,) steps until truncation
    reward_success: np.ndarray  # (N,) float64
    reward_failure: np.ndarray  # (N,) float64
    reward_episode: np.ndarray  # (N,) float64


def empty_state(lanes: int) -> State:
    """The state of N lanes before their first reset."""
    shapes = {"pos": (2,), "target_corner": (2,), "truth": (2,), "commands": (1,), "clue": (1,)}
    shapes["vector"] = (VECTOR_COMMANDS * len(COMMANDS),)
    kinds = {"burning": bool, "visual_feedback": bool, "clue": np.uint8, "vector": np.float32}
    rewards = ("reward_success", "reward_failure", "reward_episode")
    kinds |= dict.fromkeys(("truth", "episode_return", *rewards), np.float64)
    names = State.__dataclass_fields__
    return State(**{name: np.zeros((lanes, *shapes.get(name, ())), kinds.get(name, np.int64)) for name in names})


# ---- levels ----


class Level(NamedTuple):
    """What the generator decides at a reset."""

    tile: int  # column * arena size + row
    offset: tuple[int, int]
    commands: list[int]
    show_duration: int
    show_delay: int
    explosion_duration: int
    explosion_delay: int


def sample_level(rng: np.random.Generator, values: dict[str, Any], variant: Variant) -> Level:
    """Samples a level in the original's order, so that its seeds mean the same here."""
    word = words(rng)
    size = TORUS_SIZE if variant.endless else values["arena_size"]
    tile = below(word, size * size)
    offset = (below(word, 4) - 2, below(word, 4) - 2) if variant.jitter else (0, 0)
    if variant.endless:
        kinds = values["allowed_commands"]
        commands = [below(word, kinds) for _ in range(values["initial_command_count"])]
    else:
        commands = sample_walk(word, tile, pick(word, values["command_count"]), size, values["allowed_commands"])
    show = pick(word, values["command_show_duration"]) if variant.clue else 0
    gap = pick(word, values["command_show_delay"]) if variant.clue else 0
    burn = pick(word, values["explosion_duration"])
    return Level(tile, offset, commands, show, gap, burn, pick(word, values["explosion_delay"]))


def sample_walk(word: Callable[[], int], tile: int, count: int, size: int, kinds: int) -> list[int]:
    """Commands that lead from the tile through the arena without leaving it."""
    steps = _valid_commands(size, kinds)
    commands = []
    for _ in range(count):
        valid = steps[tile]
        command, tile = valid[below(word, len(valid))]
        commands.append(command)
    return commands


@cache
def _valid_commands(size: int, kinds: int) -> list[list[tuple[int, int]]]:
    """For every tile the commands that stay inside the arena, each with the tile it leads to."""
    moves = list(enumerate(MOVES[:kinds].tolist()))
    return [
        [
            (command, (x + dx) * size + y + dy)
            for command, (dx, dy) in moves
            if 0 <= x + dx < size and 0 <= y + dy < size
        ]
        for x in range(size)
        for y in range(size)
    ]


def write_level(s: State, lane: int, level: Level, variant: Variant) -> None:
    """Starts the lane's episode at this level."""
    count, tiles, start = len(level.commands), tile_tables(), int(s.calm_floor[lane]) + 1 + level.tile
    s.pos[lane] = tiles.corner[start] + TILE // 2
    if variant.jitter:
        s.pos[lane] += level.offset
    set_target(s, lane, tiles.next[start, level.commands[0]])
    s.facing[lane] = s.current[lane] = s.completed[lane] = s.length[lane] = s.episode_return[lane] = 0
    s.burning[lane] = False
    s.floor[lane] = s.calm_floor[lane]
    s.count[lane] = count
    s.commands[lane, :count] = level.commands
    s.explosion_delay[lane], s.explosion_duration[lane] = level.explosion_delay, level.explosion_duration
    s.show_duration[lane], s.show_delay[lane] = level.show_duration, level.show_delay
    s.timer[lane] = level.explosion_delay + 1  # the first command has a step more than the others
    if variant.clue:
        write_clue(s, lane, level.commands)
        s.clue_step[lane] = 0
        s.symbol[lane] = s.clue[lane, 0]
    else:
        row = s.vector[lane]  # (180,)
        row.fill(0.0)
        for step, command in enumerate(level.commands):
            row[len(COMMANDS) * step + VECTOR_AT[command]] = 1.0


def write_clue(s: State, lane: int, commands: list[int]) -> None:
    """Plans what the lane sees at each step of a clue: every command for a while, then nothing for a while."""
    show = int(s.show_duration[lane])
    period = show + int(s.show_delay[lane])
    end = period * len(commands)
    plan = s.clue[lane]  # (L,)
    plan[: end + 1] = BLANK
    for start, command in zip(range(0, end, period), commands, strict=True):
        plan[start : start + show] = 1 + command
    s.clue_end[lane] = end


# ---- drawing ----

BLUE, LIGHT_BLUE = (21, 43, 77), (29, 60, 107)
RED, LIGHT_RED = (81, 18, 26), (112, 24, 36)
GREEN = (0, 255, 0)
SYMBOL, SYMBOL_AT = 24, 31  # width of the symbols' square, and its first pixel on both axes


# The rows of floors(): every arena in blue, and then burning around each tile. Such a row stands for that tile, too.
FLOORS = [(size, tile) for size in ARENA_SIZES for tile in (None, *((x, y) for x in range(size) for y in range(size)))]


@cache
def floors() -> np.ndarray:
    """(F, FRAME) uint8, read-only: every arena, blue or burning around each possible target."""
    blue, red = (np.tile(np.array(color, np.uint8), (TILE, TILE, 1)) for color in (LIGHT_BLUE, LIGHT_RED))
    blue[1:-1, 1:-1], red[1:-1, 1:-1] = BLUE, RED
    table: np.ndarray = np.zeros((len(FLOORS), SCREEN, SCREEN, 3), np.uint8)
    for frame, (size, target) in zip(table, FLOORS, strict=True):
        origin = SCREEN // 2 - TILE * size // 2
        for x in range(size):
            for y in range(size):
                top, left = origin + TILE * y, origin + TILE * x
                frame[top : top + TILE, left : left + TILE] = blue if target in (None, (x, y)) else red
    table = table.reshape(len(FLOORS), -1)
    table.flags.writeable = False
    return table


class Tiles(NamedTuple):
    """What there is to know of tiles, by row of floors()."""

    corner: np.ndarray  # (F, 2) the first pixel, with PAD
    truth: np.ndarray  # (F, 2) column and row, divided by arena size - 1
    next: np.ndarray  # (F, 9) the tile that each command leads to, on a torus


@cache
def tile_tables() -> Tiles:
    """The tables of all tiles. Where a row is no tile, they hold those of the arena's first."""
    rows = {floor: row for row, floor in enumerate(FLOORS)}
    places = [(size, *(tile or (0, 0))) for size, tile in FLOORS]
    size, x, y = np.array(places).T[..., None]  # (F, 1) each
    corner = SCREEN // 2 - TILE * size // 2 + PAD + TILE * np.hstack([x, y])
    ahead = [[rows[size, ((x + dx) % size, (y + dy) % size)] for dx, dy in MOVES.tolist()] for size, x, y in places]
    return Tiles(corner, np.hstack([x, y]) / (size - 1), np.array(ahead))


@cache
def symbols() -> np.ndarray:
    """(10, SYMBOL, 3 * SYMBOL) uint8, read-only: nothing, then the commands. White on black, so `or` draws them."""
    arrow, circle = arrow_mask(), ring(22, 10, 10, 10, 2)
    circle[9:11, :20] = True
    # A turned arrow's square is larger. It keeps the top left corner, so it sits lower and further to the right.
    masks = {"stay": circle}
    for quarter, (straight, slanted) in enumerate(
        [("right", "right_up"), ("up", "left_up"), ("left", "left_down"), ("down", "right_down")]
    ):
        masks[straight], masks[slanted] = np.rot90(arrow, quarter), turned(arrow, 45 + 90 * quarter, 31)
    table: np.ndarray = np.zeros((1 + len(COMMANDS), SYMBOL, SYMBOL, 3), np.uint8)
    for command, name in enumerate(COMMANDS):
        mask = masks[name][:SYMBOL, :SYMBOL]
        table[1 + command, : len(mask), : len(mask)][mask] = 255
    table = table.reshape(-1, SYMBOL, 3 * SYMBOL)
    table.flags.writeable = False
    return table


def arrow_mask() -> np.ndarray:
    """(22, 22) an arrow to the right, two pixels thick: a shaft and a head of two 45-degree strokes."""
    rows, columns = np.indices((22, 22))
    aside = np.abs(rows - 10)
    head = (aside <= 10) & (columns + aside >= 20) & (columns + aside <= 21)
    return head | ((rows >= 10) & (rows <= 11) & (columns <= 20))


def draw(s: State, sheet: Sheet, lanes: np.ndarray | slice) -> np.ndarray:
    """Fresh frames of the lanes, (n, 84, 84, 3) uint8, from the state alone."""
    frames = floors().take(s.floor[lanes], axis=0)  # (n, FRAME)
    paste(frames, sheet, s.figure[lanes] * FACINGS + s.facing[lanes], s.pos[lanes])
    symbol = s.symbol[lanes]
    if np.count_nonzero(symbol):
        square = frames.reshape(-1, SCREEN, ROW)[:, SYMBOL_AT : SYMBOL_AT + SYMBOL, 3 * SYMBOL_AT :][..., : 3 * SYMBOL]
        square |= symbols().take(symbol, axis=0)  # (n, SYMBOL, 3 * SYMBOL)
    return frames.reshape(-1, SCREEN, SCREEN, 3)


# ---- vector observations ----

COMMAND_ENTRIES = np.eye(1 + len(COMMANDS), dtype=np.float32)[:, 1:]  # for every symbol; BLANK: zeros
CORNERS = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])  # (4, 2)


@cache
def floor_entries() -> np.ndarray:
    """(F, 4) float32: arena, fire and safe tile, for every row of floors()."""
    size, fire = np.array([(size / ARENA_SIZES[-1], tile is not None) for size, tile in FLOORS]).T
    safe = (tile_tables().corner - PAD + TILE // 2) / SCREEN * fire[:, None]
    return np.column_stack([size, fire, safe]).astype(np.float32)


@cache
def symbol_masks() -> np.ndarray:
    """(10, SCREEN, SCREEN) bool: where each symbol is drawn."""
    masks = np.zeros((len(symbols()), SCREEN, SCREEN), bool)
    square = slice(SYMBOL_AT, SYMBOL_AT + SYMBOL)
    masks[:, square, square] = symbols()[:, :, ::3] > 0
    return masks


@lru_cache(maxsize=16)
def appearance_tables(figures: tuple[Figure, ...], clue: bool) -> AppearanceTables:
    """What can be seen of these figures behind every symbol, where symbols are shown."""
    views = []
    for figure in figures:
        around = (figure.reach + 1) // 2 if figure.torus else 0
        reach = range(PAD - around, PAD + SCREEN + around + 1)
        image, solid = sprites(figure.scale)
        free = ~symbol_masks() if clue else ~symbol_masks()[:1]
        views += [View(figure.scale, image, solid, each, reach, reach) for each in free]
    return make_appearance_tables(views)


def hide_floor(
    out: np.ndarray, s: State, lanes: np.ndarray | slice, sprite: np.ndarray, tables: AppearanceTables
) -> None:
    """Clears the floor's entries (n, 4) of what large agents hide, in place.

    What shows is decided by some pixels alone, which no two floors have in common: the arena's corners and the tile's.
    """
    first, size = SCREEN // 2 - TILE * s.size[lanes] // 2 + PAD, s.size[lanes]
    arena = first[:, None, None] + CORNERS * (TILE * size - 1)[:, None, None]  # (n, 4, 2)
    tile = s.target_corner[lanes][:, None] + CORNERS * (TILE - 1)  # (n, 4, 2)
    points = np.concatenate([arena, tile], axis=1)  # (n, 8, 2)
    x, y = np.moveaxis(points - PAD, -1, 0)
    shown = ~covered(tables, sprite, s.pos[lanes], points) & ~symbol_masks()[s.symbol[lanes][:, None], y, x]  # (n, 8)
    shows_fire = shown[:, :4] & (arena != tile).any(axis=-1)
    out[:, 0] *= shown[:, :4].any(axis=1)
    out[:, 1:] *= shows_fire.any(axis=1)[:, None]
    out[:, 2:] *= shown[:, 4:].any(axis=1)[:, None]


# ---- rules ----


def show_clue(s: State, first_step: np.ndarray) -> np.ndarray:
    """The next step of every clue: what is shown, and (N,) bool which lanes have none left and may act.

    first_step: (N,) where each lane's plan starts in the flattened State.clue.
    """
    s.clue_step += 1
    np.minimum(s.clue_step, s.clue_end, out=s.clue_step)
    s.symbol = s.clue.take(first_step + s.clue_step)
    return s.clue_step == s.clue_end


def on_target(s: State, lanes: np.ndarray | slice) -> np.ndarray:
    """(n,) bool: whose centre is on its target tile."""
    # Places before the tile are negative, which is huge as an unsigned number.
    ahead = (s.pos[lanes] - s.target_corner[lanes]).view(np.uint64) < TILE  # (n, 2)
    return ahead[:, 0] & ahead[:, 1]


def ignite_tiles(s: State, lanes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sets all tiles but the target on fire: who carried the command out, and whose sequence is through, both (n,)."""
    s.current[lanes] += 1
    s.burning[lanes] = True
    s.timer[lanes] = s.explosion_duration[lanes]
    seen = lanes[s.visual_feedback[lanes]]
    s.floor[seen] = s.target[seen]
    hit = on_target(s, lanes)
    s.completed[lanes] += hit
    return hit, s.current[lanes] >= s.count[lanes]


def extinguish_tiles(s: State, lanes: np.ndarray) -> None:
    """Puts the fire out and moves the target on by the next command."""
    s.floor[lanes] = s.calm_floor[lanes]
    s.burning[lanes] = False
    s.timer[lanes] = s.explosion_delay[lanes]
    set_target(s, lanes, tile_tables().next[s.target[lanes], s.commands[lanes, s.current[lanes]]])


def set_target(s: State, lanes: np.ndarray | int, tile: np.ndarray | int) -> None:
    """Makes these tiles the targets of the lanes."""
    s.target[lanes] = tile
    s.target_corner[lanes] = tile_tables().corner[tile]
    s.truth[lanes] = tile_tables().truth[tile]


class MortarMayhem(MemoryGymVectorEnv):
    """Mortar Mayhem (thesis 4.3): memorise a sequence of commands, then carry them out in time.

    ## Description

    Commands are shown one by one while the agent cannot move (the clue). Then it has `explosion_delay` steps to carry
    out each: move to the neighbouring tile it names, or stay. Then all tiles but the right one burn for
    `explosion_duration` steps, and whoever stands on a burning one has failed.

    - `MortarMayhem-v0`: 10 commands on a 5 x 5 arena. `MortarMayhem-Grid-v0`: the same, tile by tile, no diagonals.
    - `MortarMayhemB-v0`, `MortarMayhemB-Grid-v0`: the act task alone, the commands given as a vector, no clue.
    - `Endless-MortarMayhem-v0`: a 6 x 6 torus that fills the screen. One command is shown, then all so far are carried
      out from where the agent is; a completed sequence grows by one command, which alone is shown.

    ## Action Space

    `MultiDiscrete([3, 3])`:

    | value | horizontal | vertical |
    |---|---|---|
    | 0 | none | none |
    | 1 | left | up |
    | 2 | right | down |

    `Discrete(4)`, Grid ids:

    | value | action |
    |---|---|
    | 0 | nothing |
    | 1 | turn left |
    | 2 | turn right |
    | 3 | one tile forward |

    Actions are ignored while a clue is shown.

    ## Observation Space

    `Box(0, 255, (84, 84, 3), uint8)`, rows first. The B ids: `Dict` of `visual_observation`, that Box, and
    `vector_observation` (180,) float32: 20 commands by 9 one-hot entries in the order of VECTOR_ORDER, zeros after the
    last command. With obs_type="vector" a flat float32 vector: `docs/vectors.md`, `VARIANTS[id].entries`.

    ## Rewards

    `reward_command_success` (0.1) when a command is checked and carried out, `reward_command_failure` (0) on a burning
    tile, `reward_episode_success` (0) when the last command was.

    ## Episode End

    Terminated by failure, or by the last command's check (not in the endless id). Truncated after `max_steps` steps
    (the endless id; a failure at that very step counts as termination). With default options an episode takes 58 to
    274 steps (table 4.4), Grid 46 to 118, B 19 to 235, B-Grid 7 to 79. The B bounds are one above the thesis' formula
    (18 to 234, 6 to 78), because the first command has explosion_delay + 1 steps; behind a clue that step is made up
    for: the reset already shows the clue's first step.

    ## Info

    `ground_truth` (2,): the target tile's column and row, divided by arena size - 1. At an episode's end also `reward`,
    `length`, `commands_completed` and `success` (in the endless id `max_command_sequence`, the length of the longest
    completed sequence). commands_completed is a share of the sequence, in the endless id a number of commands.

    ## Arguments

    `gym.make(id, ...)` and `gym.make_vec(id, num_envs=N, ...)` take

    | name | default | meaning |
    |---|---|---|
    | `render_mode` | None | "rgb_array": what the agent sees; "debug_rgb_array": 336 x 336, with the ground truth |
    | `num_levels`, `start_level` | None, 0 | resets without a seed play one of so many levels, from the first on |
    | `obs_type` | "pixels" | or "vector" |
    | `options` | None | reset parameters that are the environment's defaults |
    | `max_episode_steps` | None | truncates longer episodes |
    | `autoreset_mode` | SAME_STEP | of `make_vec` alone: when an episode that ended is reset |

    `reset(options={...})` takes the same reset parameters, a single environment for one episode. `docs/options.md` and
    `VARIANTS[id].options` list them. Those marked * are lists, one entry of which is sampled at every reset.

    ## Version History

    - v0: as in memory-gym 1.0.2, but for what follows.

    ## References

    Marco Pleines: Memory-based Deep Reinforcement Learning in Endless Imperfect Information Games. Dissertation, TU
    Dortmund University. Marco Pleines, Matthias Pallasch, Frank Zimmer, Mike Preuss: Memory Gym, arXiv:2309.17207.

    ## Kept from the original, and differences

    Kept from the original: the command that ends the episode counts as uncompleted, even if it had been checked and
        the agent then walked into the fire; failing at the very last command counts as success and completes all
        commands, though only the failure's reward is paid; the sequence grows even if its last command failed, so
        max_command_sequence then counts it as completed; walking into the fire overwrites what the step had earned.
        In the endless id the tiles stay lit while a clue is shown, positions are rounded to the nearest pixel
        (elsewhere steps are cut off, a diagonal one to 2 pixels at the default speed), and an agent whose centre is
        beyond the screen's edge is on no tile. Grid ids ignore agent_scale.
    Differences from the original: images are rows first; max_steps truncates; every id reports ground truth; an
        episode's first frames show this episode's agent, not the last one's; wrong options raise ValueError.
    """

    variants = VARIANTS
    growing = ("commands", "clue")
    tables = ("_agent_tables", "_appearance")
    kept = (*MemoryGymVectorEnv.kept, "_clues_open")

    def spaces(self) -> tuple[gym.Space, gym.Space]:
        """The observation space of one lane with pixels, and its action space."""
        image = gym.spaces.Box(0, 255, (SCREEN, SCREEN, 3), np.uint8)
        vector = gym.spaces.Box(0.0, 1.0, (VECTOR_COMMANDS * len(COMMANDS),), np.float32)
        both = gym.spaces.Dict({"visual_observation": image, "vector_observation": vector})
        actions = gym.spaces.Discrete(4) if self.variant.grid else gym.spaces.MultiDiscrete([3, 3])
        return image if self.variant.clue else both, actions

    def allocate(self) -> None:
        """Makes the state of N lanes."""
        self.state = empty_state(self.num_envs)
        self.figures = (self._figure(self.defaults),)  # all that differ, of all lanes
        self._clues_open = False  # whether any lane may still have a clue to see
        self.place_tables()

    def configure(self, lanes: np.ndarray) -> None:
        """Takes over the options of the lanes, and the tables that all lanes' options need."""
        s, variant, values = self.state, self.variant, self.settings[int(lanes[0])]
        s.size[lanes] = values.get("arena_size", TORUS_SIZE)
        s.calm_floor[lanes] = FLOORS.index((values.get("arena_size", TORUS_SIZE), None))
        s.visual_feedback[lanes] = values["visual_feedback"]
        s.reward_success[lanes] = values["reward_command_success"]
        s.reward_failure[lanes] = values["reward_command_failure"]
        s.reward_episode[lanes] = values.get("reward_episode_success", 0.0)
        limit = values.get("max_steps", -1)
        s.step_limit[lanes] = NO_LIMIT if limit == -1 else limit
        count = values["initial_command_count"] if variant.endless else max(values["command_count"])
        s.commands = widened(s.commands, count + 1)
        if variant.clue:
            period = max(values["command_show_duration"]) + max(values["command_show_delay"])
            s.clue = widened(s.clue, count * period + 1)
        self.figures, s.figure[:] = numbered([self._figure(each) for each in self.settings])
        self.place_tables()

    def _figure(self, values: dict[str, Any]) -> Figure:
        half = TILE * values.get("arena_size", TORUS_SIZE) // 2
        low, high = SCREEN // 2 - half, SCREEN // 2 + half
        if self.variant.grid:
            return Figure(0.25, TILE, low, high, TILE // 2, False)
        scale = values["agent_scale"]
        return Figure(scale, values["agent_speed"], low, high, radius_of(scale), self.variant.endless)

    def place_tables(self) -> None:
        """The flat tables that step() looks things up in, and where each lane's rows start in them."""
        self._agent_tables = agent_tables(self.figures)
        self._controls = grid_controls() if self.variant.grid else free_controls()
        self._lane_walk = self.state.figure[:, None] * (STRIDES * SPAN)  # (N, 1)
        self._lane_clue = np.arange(self.num_envs) * self.state.clue.shape[1]  # (N,)
        if self.obs_type == "vector":
            self._appearance = appearance_tables(self.figures, self.variant.clue)
            views = len(symbols()) if self.variant.clue else 1
            self._lane_sprites = self.state.figure * (views * FACINGS)  # (N,)
            self._at = vector_slices(self.variant.entries)
            # An agent that is no wider than a tile cannot hide one.
            self._large = any(2 * figure.reach > TILE for figure in self.figures)

    def begin(self, lanes: np.ndarray) -> None:
        """Samples the lanes' next levels and starts their episodes."""
        for lane in lanes.tolist():
            level = sample_level(self._rngs[lane], self.settings[lane], self.variant)
            write_level(self.state, lane, level, self.variant)
        self._clues_open = self.variant.clue

    def advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One step of the rules: clue, walk, check, burn."""
        s, variant = self.state, self.variant
        rewards, terminated = np.zeros(self.num_envs), np.zeros(self.num_envs, bool)
        s.length += 1
        acting = self._acting_lanes()
        if np.count_nonzero(acting):
            self._move(actions, acting)
            s.timer -= acting
            due = s.timer == 0  # only a lane that acts gets there
            if np.count_nonzero(due):
                self._change_tiles(due.nonzero()[0], rewards, terminated)
            in_danger = s.burning & acting
            if np.count_nonzero(in_danger):
                failed = in_danger & ~on_target(s, ALL)
                # Not added: the original overwrites whatever this step had earned.
                np.copyto(rewards, s.reward_failure, where=failed)
                terminated |= failed
            s.episode_return += rewards
        truncated = (s.length == s.step_limit) & ~terminated if variant.endless else np.zeros(self.num_envs, bool)
        return rewards, terminated, truncated

    def _acting_lanes(self) -> np.ndarray:
        """Shows the clues' next step; (N,) bool which lanes may act, or just True when all have been acting."""
        if not self._clues_open:
            return EVERY_LANE
        acting = show_clue(self.state, self._lane_clue)
        self._clues_open = bool(np.count_nonzero(acting) < self.num_envs)
        return acting

    def _move(self, actions: np.ndarray, acting: np.ndarray) -> None:
        s = self.state
        action = actions if self.variant.grid else actions[:, 0] * 3 + actions[:, 1]  # (N,)
        if acting is not EVERY_LANE:
            action = np.where(acting, action, self._controls.actions - 1)
        s.facing, s.pos = walk(s.facing, s.pos, action, self._lane_walk, self._controls, self._agent_tables.walk)

    def _change_tiles(self, lanes: np.ndarray, rewards: np.ndarray, terminated: np.ndarray) -> None:
        """Lights the lanes' tiles and checks their command, or puts the tiles out."""
        s = self.state
        burnt_out = s.burning[lanes]
        if np.count_nonzero(burnt_out):
            extinguish_tiles(s, lanes[burnt_out])
            lanes = lanes[~burnt_out]
        if lanes.size:
            hit, through = ignite_tiles(s, lanes)
            rewards[lanes] = s.reward_success[lanes] * hit
            if self.variant.endless:
                for lane in lanes[through].tolist():
                    self._extend_sequence(lane)
            else:
                # Whether or not the last command was carried out, as in the original; a failure overwrites the reward.
                rewards[lanes] += s.reward_episode[lanes] * through
                terminated[lanes] = through

    def _extend_sequence(self, lane: int) -> None:
        """Appends a command to the lane's completed sequence and shows it from the next step on."""
        s = self.state
        command = below(words(self._rngs[lane]), self.settings[lane]["allowed_commands"])
        length = int(s.count[lane])
        if length == s.commands.shape[1]:
            s.commands = widened(s.commands, 2 * length)
        s.commands[lane, length] = command
        s.count[lane], s.current[lane] = length + 1, 0
        write_clue(s, lane, [command])
        s.clue_step[lane] = -1
        self._clues_open = True

    def pixels(self, lanes: np.ndarray | slice) -> Any:
        """Fresh observations of the lanes with pixels: an act task's are a Dict."""
        if self.variant.clue:
            return self.frames(lanes)
        vector = self.state.vector[lanes]
        return {"visual_observation": self.frames(lanes), "vector_observation": vector.copy()}

    def vectors(self, lanes: np.ndarray | slice) -> np.ndarray:
        """Fresh vector observations of the lanes, (n, V) float32."""
        s, at = self.state, self._at
        sprite = self._lane_sprites[lanes] + s.facing[lanes]  # (n,)
        out = np.empty((len(sprite), *(self.single_observation_space.shape or ())), np.float32)
        if self.variant.clue:
            symbol = s.symbol[lanes]
            sprite += symbol * FACINGS
            out[:, at["command"]] = COMMAND_ENTRIES.take(symbol, axis=0)
        else:
            out[:, at["commands"]] = s.vector[lanes]
        write_agent_entries(out[:, at["size"].start : at["facing"].stop], self._appearance, sprite, s.pos[lanes])
        floor = out[:, at["arena"].start : at["safe"].stop]
        floor[:] = floor_entries().take(s.floor[lanes], axis=0)
        if self._large:
            hide_floor(floor, s, lanes, sprite, self._appearance)
        return out

    def frames(self, lanes: np.ndarray | slice) -> np.ndarray:
        """Fresh frames of the lanes, (n, 84, 84, 3)."""
        return draw(self.state, self._agent_tables.sheet, lanes)

    def ground_truth(self) -> np.ndarray:
        """A fresh (N, 2): the target's column and row, divided by arena size - 1."""
        return self.state.truth.copy()

    def summary(self, lanes: np.ndarray) -> dict[str, np.ndarray]:
        """The lanes' ended episodes in numbers."""
        s = self.state
        numbers = {"reward": s.episode_return[lanes], "length": s.length[lanes]}
        if self.variant.endless:
            return numbers | {"commands_completed": s.completed[lanes], "max_command_sequence": s.count[lanes] - 1}
        success = (s.current[lanes] >= s.count[lanes]).astype(np.int64)
        share = (s.current[lanes] - 1 + success) / s.count[lanes]
        return numbers | {"success": success, "commands_completed": share}

    def annotate(self, frame: np.ndarray, lane: int) -> None:
        """Circles the target tile."""
        x, y = ((self.state.target_corner[lane] - PAD) * DEBUG_ZOOM + TILE * DEBUG_ZOOM // 2).tolist()
        frame[ring(len(frame), x, y, TILE * DEBUG_ZOOM // 2, 2 * DEBUG_ZOOM)] = GREEN
