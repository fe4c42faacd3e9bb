"""Levels: what the generator decides at a reset, and how an episode starts with it."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from memory_gym_envs.mortar_mayhem.arena import COMMANDS, MOVES, TILE, TORUS_SIZE, tile_tables
from memory_gym_envs.mortar_mayhem.options import VECTOR_ORDER, MortarVariant
from memory_gym_envs.mortar_mayhem.rules import set_target, write_clue
from memory_gym_envs.mortar_mayhem.state import State
from memory_gym_envs.words import pick, sample_below, word_source

VECTOR_INDEX = [VECTOR_ORDER.index(command) for command in COMMANDS]


class Level(NamedTuple):
    """What the generator decides at a reset."""

    tile: int  # where the agent starts: column * arena size + row
    offset: tuple[int, int]  # how far from the tile's centre, x and y in pixels
    commands: list[int]
    show_duration: int
    show_delay: int
    explosion_duration: int
    explosion_delay: int


def sample_level(rng: np.random.Generator, values: dict[str, Any], variant: MortarVariant) -> Level:
    """Samples a level in the original's order, so that its seeds mean the same here."""
    next_word = word_source(rng)
    size = TORUS_SIZE if variant.endless else values["arena_size"]
    tile = sample_below(next_word, size * size)
    offset = (sample_below(next_word, 4) - 2, sample_below(next_word, 4) - 2) if variant.jitter else (0, 0)
    if variant.endless:
        kinds = values["allowed_commands"]
        commands = [sample_below(next_word, kinds) for _ in range(values["initial_command_count"])]
    else:
        count = pick(next_word, values["command_count"])
        commands = sample_walk(next_word, tile, count, size, values["allowed_commands"])
    show_duration = pick(next_word, values["command_show_duration"]) if variant.clue else 0
    show_delay = pick(next_word, values["command_show_delay"]) if variant.clue else 0
    explosion_duration = pick(next_word, values["explosion_duration"])
    explosion_delay = pick(next_word, values["explosion_delay"])
    return Level(tile, offset, commands, show_duration, show_delay, explosion_duration, explosion_delay)


def sample_walk(next_word: Callable[[], int], tile: int, count: int, size: int, kinds: int) -> list[int]:
    """So many commands that lead from the tile through the arena without leaving it.

    tile: column * size + row. kinds: how many kinds of command may occur.
    """
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


def write_level(s: State, lane: int, level: Level, variant: MortarVariant) -> None:
    """Starts the lane's episode at this level."""
    count, tiles = len(level.commands), tile_tables()
    start = int(s.calm_floor[lane]) + 1 + level.tile  # FLOORS has an arena's calm floor before its tiles
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
        s.vector[lane] = 0.0
        for step, command in enumerate(level.commands):
            s.vector[lane, len(COMMANDS) * step + VECTOR_INDEX[command]] = 1.0
