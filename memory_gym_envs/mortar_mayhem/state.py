"""The state of N lanes. Axes that grow: C commands, L steps of the longest clue."""

from dataclasses import dataclass

import numpy as np

from memory_gym_envs.mortar_mayhem.arena import COMMANDS
from memory_gym_envs.mortar_mayhem.options import VECTOR_COMMANDS
from memory_gym_envs.state import array
from memory_gym_envs.walking import WalkingState

BLANK = 0  # the symbol that is shown between commands; a command's symbol is 1 + command


@dataclass
class State(WalkingState):
    """The lanes' state. `arena` explains floors and tiles."""

    size: np.ndarray = array("N")  # tiles along one side of the arena
    calm_floor: np.ndarray = array("N")  # the floor that is shown while nothing burns
    floor: np.ndarray = array("N")  # the floor that is shown
    target: np.ndarray = array("N")  # the tile that the command leads to
    target_corner: np.ndarray = array("N", 2)  # that tile's first pixel, x and y
    truth: np.ndarray = array("N", 2, dtype=np.float64)  # that tile's column and row, divided by arena size - 1
    commands: np.ndarray = array("N", "C")  # the sequence
    count: np.ndarray = array("N")  # its length
    current: np.ndarray = array("N")  # commands checked so far, in this round of the sequence
    completed: np.ndarray = array("N")  # commands carried out so far, in the episode
    clue: np.ndarray = array("N", "L", dtype=np.uint8)  # the symbol of each step of the clue; BLANK from its end on
    clue_step: np.ndarray = array("N")  # the step of the clue that is shown
    clue_end: np.ndarray = array("N")  # the first step after the clue, in which the agent may act
    symbol: np.ndarray = array("N")  # the symbol that is shown
    timer: np.ndarray = array("N")  # steps in which the agent acts, until the tiles are lit or put out
    burning: np.ndarray = array("N", dtype=bool)  # all tiles but the target burn
    explosion_delay: np.ndarray = array("N")  # sampled for this episode, as the next three
    explosion_duration: np.ndarray = array("N")
    show_duration: np.ndarray = array("N")
    show_delay: np.ndarray = array("N")
    # The command vector: a one-hot row for each command, flattened.
    vector: np.ndarray = array("N", VECTOR_COMMANDS * len(COMMANDS), dtype=np.float32)
    # Options that the rules need at every step.
    visual_feedback: np.ndarray = array("N", dtype=bool, option="visual_feedback")
    reward_success: np.ndarray = array("N", dtype=np.float64, option="reward_command_success")
    reward_failure: np.ndarray = array("N", dtype=np.float64, option="reward_command_failure")
    reward_episode: np.ndarray = array("N", dtype=np.float64, option="reward_episode_success")
    reward_new_command: np.ndarray = array("N", dtype=np.float64, option="reward_new_command_success")
