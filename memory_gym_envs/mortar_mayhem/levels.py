"""Levels: what the generator decides at a reset.

All is sampled in the original's order, so that a seed means the same level here.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from memory_gym_envs.mortar_mayhem.arena import COMMANDS, MOVES, TILE, tile_tables
from memory_gym_envs.mortar_mayhem.options import VECTOR_ORDER, MortarVariant
from memory_gym_envs.mortar_mayhem.rules import set_target, write_clue
from memory_gym_envs.mortar_mayhem.state import State
from memory_gym_envs.words import pick, sample_below, word_source

VECTOR_INDEX = [VECTOR_ORDER.index(command) for command in COMMANDS]


def start_episode(
    s: State, lane: int, rng: np.random.Generator, values: dict[str, Any], variant: MortarVariant
) -> None:
    """Starts the lane's next episode, with these reset options."""
    next_word, tiles, size = word_source(rng), tile_tables(), int(s.size[lane])
    tile = sample_below(next_word, size * size)  # column * arena size + row
    start = int(s.calm_floor[lane]) + 1 + tile  # FLOORS has an arena's calm floor before its tiles
    s.pos[lane] = tiles.corner[start] + TILE // 2
    if variant.endless or not (variant.clue or variant.grid):  # up to two pixels off the tile's centre
        s.pos[lane] += sample_below(next_word, 4) - 2, sample_below(next_word, 4) - 2
    if variant.endless:
        kinds = values["allowed_commands"]
        commands = [sample_below(next_word, kinds) for _ in range(values["initial_command_count"])]
    else:
        count = pick(next_word, values["command_count"])
        commands = sample_walk(next_word, tile, count, size, values["allowed_commands"])
    if variant.clue:
        s.show_duration[lane] = pick(next_word, values["command_show_duration"])
        s.show_delay[lane] = pick(next_word, values["command_show_delay"])
    s.explosion_duration[lane] = pick(next_word, values["explosion_duration"])
    s.explosion_delay[lane] = delay = pick(next_word, values["explosion_delay"])
    s.timer[lane] = delay + 1  # the first command has a step more than the others
    set_target(s, lane, tiles.next[start, commands[0]])
    s.facing[lane] = s.current[lane] = s.completed[lane] = s.length[lane] = s.episode_return[lane] = 0
    s.burning[lane] = False
    s.floor[lane] = s.calm_floor[lane]
    s.count[lane] = len(commands)
    s.commands[lane, : len(commands)] = commands
    if variant.clue:
        write_clue(s, lane, commands)
        s.clue_step[lane] = 0
        s.symbol[lane] = s.clue[lane, 0]
    else:
        s.vector[lane] = 0.0
        for step, command in enumerate(commands):
            s.vector[lane, len(COMMANDS) * step + VECTOR_INDEX[command]] = 1.0


def sample_walk(next_word: Callable[[], int], tile: int, count: int, size: int, kinds: int) -> list[int]:
    """So many of the first `kinds` of command that lead from the tile, column * size + row, and stay in the arena."""
    moves = moves_inside(size, kinds)
    commands = []
    for _ in range(count):
        valid = moves[tile]
        command, tile = valid[sample_below(next_word, len(valid))]
        commands.append(command)
    return commands


@cache
def moves_inside(size: int, kinds: int) -> list[list[tuple[int, int]]]:
    """For every tile the commands that stay inside the arena, each with the tile it leads to."""
    moves, side = list(enumerate(MOVES[:kinds].tolist())), range(size)
    return [
        [(command, (x + dx) * size + y + dy) for command, (dx, dy) in moves if x + dx in side and y + dy in side]
        for x in side
        for y in side
    ]
