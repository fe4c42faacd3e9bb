"""Mystery Path's state, and how it stores the map and the path.

The map is a row of cells: the tile at (column, row), counted from the screen's top left, is cell
column * ROWS + PIT_ROWS + row. The path is a list of steps, each of them a cell: step 1 is the origin.
Shape letters: N lanes, M cells of the map, P steps of the path that fit, T tiles of all trails.
"""

from dataclasses import dataclass

import numpy as np

from memory_gym_envs.mystery_path.options import SIDE
from memory_gym_envs.state import array
from memory_gym_envs.walking import WalkingState

# Rows of pit above and below the screen. Nothing stops the agent there in the endless id; the largest and fastest one
# gets nine tiles out.
PIT_ROWS = 9
ROWS = PIT_ROWS + SIDE + PIT_ROWS
MAP_STRIDES = np.array([ROWS, 1])

FAST = 14  # pixels: an agent that walks further in a step can leave the stored positions

PIT = 0  # the step at cells that are not on the path
NO_CELL = -1  # the cell of step PIT
ORIGIN = 1  # the step at the origin
NO_STEP = -1  # the step of an agent that is put back to the origin
UNREWARDED = -1  # in `reached`: the agent was not there yet, and earns nothing for it

EAST, NORTH, SOUTH, WEST = range(4)
DIRECTIONS = np.zeros(2 * ROWS + 1, np.int64)  # by the difference of two cells; a negative one counts from the end
DIRECTIONS[[ROWS, -1, 1, -ROWS]] = EAST, NORTH, SOUTH, WEST


def tiles_of(cell: np.ndarray) -> np.ndarray:
    """(..., 2) the cells' columns and rows."""
    return np.stack([cell // ROWS, cell % ROWS - PIT_ROWS], axis=-1)


@dataclass
class State(WalkingState):
    """The lanes' state. Tiles count from the top left. In the endless id, columns and x are counted along the path."""

    view: np.ndarray = array("N")  # which of the batch's view options it has
    origin: np.ndarray = array("N", 2)  # where the agent starts and is put back to
    tile: np.ndarray = array("N", 2)  # the agent's tile, column and row
    path_step: np.ndarray = array("N")  # the path's step at that tile, PIT or NO_STEP
    last_path_step: np.ndarray = array("N")  # the path's step where the agent last was on the path
    next_direction: np.ndarray = array("N")  # the direction from there to the next step
    fallen: np.ndarray = array("N", dtype=bool)  # in the pit, so the next step puts the agent back
    path_length: np.ndarray = array("N")  # steps of the path; the last one is the goal
    path_cell: np.ndarray = array("N", "P")  # the cell of each step
    direction_at: np.ndarray = array("N", "P")  # the direction from each step to the next
    # 1 + how often the agent had fallen off when it last was at a step; 0: it never was there; or UNREWARDED.
    reached: np.ndarray = array("N", "P")
    step_at: np.ndarray = array("N", "M")  # the inverse of path_cell: the step that is at each cell, or PIT
    # The trail is the part of the path behind the agent that is shown. All lanes' trails are stored one after another.
    shows_trail: np.ndarray = array("N", dtype=bool)
    trail_lane: np.ndarray = array("T")  # the lane that a tile belongs to
    trail_x: np.ndarray = array("T")  # its first pixel, counted along the path
    trail_y: np.ndarray = array("T")
    shows_cross: np.ndarray = array("N", dtype=bool)  # in the pit, and a cross is drawn there
    fell_at: np.ndarray = array("N", "M", dtype=bool)  # the agent has fallen off there
    walls: np.ndarray = array("N", "M", dtype=bool)  # kept free of the path; only the debug view shows them
    segments: np.ndarray = array("N")
    max_column: np.ndarray = array("N")  # the rightmost column of the path that the agent reached
    stamina: np.ndarray = array("N")  # steps left to reach another tile
    fails: np.ndarray = array("N")  # how often the agent fell off
    visited: np.ndarray = array("N")  # tiles reached so far

    # What follows from the options.
    radius: np.ndarray = array("N")  # of the agent's body
    speed: np.ndarray = array("N", 1)  # pixels a step, in the endless id
    show_origin: np.ndarray = array("N", dtype=bool, option="show_origin")
    show_goal: np.ndarray = array("N", dtype=bool, option="show_goal")
    show_past: np.ndarray = array("N", dtype=bool, option="show_past_path")
    show_ground: np.ndarray = array("N", dtype=bool, option="show_background")
    show_stamina: np.ndarray = array("N", dtype=bool, option="show_stamina")
    extras: np.ndarray = array("N", dtype=bool)  # one of these except show_past, or a speed above FAST
    visual_feedback: np.ndarray = array("N", dtype=bool, option="visual_feedback")
    camera: np.ndarray = array("N", dtype=np.float64)  # first pixel of column 0 while the agent is at the origin
    trail_columns: np.ndarray = array("N")  # whole tiles between the screen's left edge and the agent
    ground_period: np.ndarray = array("N")  # pixels after which the background starts again
    figure_x: np.ndarray = array("N")  # where the endless id draws the agent
    cross_x: np.ndarray = array("N")  # and its cross
    cross_fits: np.ndarray = array("N", dtype=bool)  # some of that cross is left of the stamina bar
    stamina_level: np.ndarray = array("N", option="stamina_level")
    origin_restores: np.ndarray = array("N", dtype=bool, option="origin_restores_stamina")  # stamina
    reward_goal: np.ndarray = array("N", dtype=np.float64, option="reward_goal")
    reward_fall_off: np.ndarray = array("N", dtype=np.float64, option="reward_fall_off")
    reward_progress: np.ndarray = array("N", dtype=np.float64, option="reward_path_progress")
    reward_dense: np.ndarray = array("N", dtype=np.float64, option="reward_path_progress_dense")
    reward_step: np.ndarray = array("N", dtype=np.float64, option="reward_step")
