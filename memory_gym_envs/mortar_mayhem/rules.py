"""Rules: what a step does to the state, and to `rewards` and `terminated`, (N,) each, which are changed in place."""

import numpy as np

from memory_gym_envs.base import ALL
from memory_gym_envs.mortar_mayhem.arena import TILE, tile_tables
from memory_gym_envs.mortar_mayhem.state import BLANK, State
from memory_gym_envs.state import Lanes, make_room


def write_clue(s: State, lane: int, commands: list[int]) -> None:
    """Plans the lane's next clue: each command is shown for show_duration steps, then nothing for show_delay steps."""
    duration = int(s.show_duration[lane])
    period = duration + int(s.show_delay[lane])
    end = period * len(commands)
    clue = s.clue[lane]  # (L,)
    clue[: end + 1] = BLANK
    for start, command in zip(range(0, end, period), commands, strict=True):
        clue[start : start + duration] = 1 + command
    s.clue_end[lane] = end


def show_clue(s: State, first_step: np.ndarray) -> np.ndarray:
    """Shows the next step of every clue. Returns which lanes' clues are over, so that the agent may act: (N,) bool.

    first_step: (N,) where each lane's clue starts in the flattened State.clue.
    """
    s.clue_step += 1
    np.minimum(s.clue_step, s.clue_end, out=s.clue_step)
    s.symbol = s.clue.take(first_step + s.clue_step)
    return s.clue_step == s.clue_end


def on_target(s: State, lanes: Lanes) -> np.ndarray:
    """(n,) bool: whether the agent's centre is on the target tile."""
    # Negative differences are huge as unsigned numbers, so one comparison checks both ends.
    inside = (s.pos[lanes] - s.target_corner[lanes]).view(np.uint64) < TILE  # (n, 2)
    return inside[:, 0] & inside[:, 1]


def ignite_tiles(s: State, lanes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sets all tiles but the target on fire and checks the command: rewards, and whose sequence is over, (n,) each."""
    s.current[lanes] += 1
    s.burning[lanes] = True
    s.timer[lanes] = s.explosion_duration[lanes]
    red = lanes[s.visual_feedback[lanes]]
    s.floor[red] = s.target[red]
    success = on_target(s, lanes)
    s.completed[lanes] += success
    sequence_over = s.current[lanes] >= s.count[lanes]
    return (s.reward_success[lanes] + s.reward_new_command[lanes] * sequence_over) * success, sequence_over


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


def burn_agents(s: State, acting: np.ndarray, rewards: np.ndarray, terminated: np.ndarray) -> None:
    """Ends the episodes of agents on burning tiles. acting: who may act, (N,) or one bool for all."""
    in_danger = s.burning & acting
    if np.count_nonzero(in_danger):
        failed = in_danger & ~on_target(s, ALL)
        # Not added: the original overwrites what the step had earned.
        np.copyto(rewards, s.reward_failure, where=failed)
        terminated |= failed


def extend_sequence(s: State, lane: int, command: int) -> None:
    """Appends a command to the lane's sequence and shows it from the next step on."""
    length = int(s.count[lane])
    if length == s.commands.shape[1]:
        make_room(s, "C", 2 * length)
    s.commands[lane, length] = command
    s.count[lane], s.current[lane] = length + 1, 0
    write_clue(s, lane, [command])
    s.clue_step[lane] = -1
