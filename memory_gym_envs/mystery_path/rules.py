"""Mystery Path's rules: what a step does to the state.

lane_path, (N,), is where each lane's steps start in the flattened State.path_cell.
Shape letters: N lanes, n some of them, K steps back along the path, T tiles of the trails.
"""

import numpy as np

from memory_gym_envs.character import FACINGS, PIXELS
from memory_gym_envs.mystery_path.options import SIDE, TILE
from memory_gym_envs.mystery_path.state import NO_STEP, ORIGIN, PIT_ROWS, ROWS, WEST, State

TILE_AT = PIXELS // TILE  # of stored positions on the screen
# The endless id's actions: 0 nothing, 1 right, 2 up, 3 down.
ENDLESS_MOVES = np.array([(0, 0), (1, 0), (0, -1), (0, 1)])  # (4, 2)
ENDLESS_TURN = np.array([(facing, 6, 0, 4) for facing in range(FACINGS)])  # (8, 4) the next facing
STEPS_BACK = np.arange(1, (2 * SIDE - 1) * SIDE + 1)  # that a trail may have: it lies on less than two segments


def put_back(s: State, action: np.ndarray) -> np.ndarray:
    """Puts the agents that fell off back to the origin. Returns the actions (N,), theirs replaced by 0."""
    action = np.where(s.fallen, 0, action)
    s.pos = np.where(s.fallen[:, None], s.origin, s.pos)
    s.path_step[s.fallen] = NO_STEP  # so they enter a tile now, even if it is the pit again
    return action


def walk_endless(s: State, action: np.ndarray) -> None:
    """Turns and moves the endless id's agents. action: (N,)."""
    s.facing = ENDLESS_TURN.take(s.facing * len(ENDLESS_MOVES) + action)
    s.pos = s.pos + ENDLESS_MOVES.take(action, axis=0) * s.speed


def enter_tiles(s: State, lane_path: np.ndarray, rewards: np.ndarray, endless: bool) -> None:
    """What happens on another tile, or in the pit. Nothing changes for agents that are where they were."""
    s.last_path_step = np.where(s.fallen, s.last_path_step, s.path_step)
    here, now = s.path_step + lane_path, s.fails + 1
    before = s.reached.take(here)
    fresh = before == 0
    if np.count_nonzero(fresh):
        rewards += fresh * s.reward_progress
        s.visited += fresh
    if endless:
        # A tile restores stamina the first time since the last fall. The pit, always new, does as well.
        new, at_origin = before != now, s.path_step == ORIGIN
        np.copyto(s.stamina, s.stamina_level, where=new & (s.origin_restores | ~at_origin))
        rewards += (new & ~s.fallen & ~at_origin) * s.reward_dense
    s.reached.put(here, now)
    if np.count_nonzero(s.fallen):
        rewards += s.fallen * s.reward_fall_off
        s.fails += s.fallen
    s.shows_cross = s.fallen & s.visual_feedback
    direction = s.direction_at.take(s.last_path_step + lane_path)
    if endless:
        # The ground truth has no entry for the west.
        np.copyto(direction, s.next_direction, where=direction == WEST)
        s.shows_trail = s.show_past & (s.tile[:, 0] > 0)
        (lanes,) = s.shows_trail.nonzero()
        if lanes.size:
            s.trail_lane, cell = trail(s, lanes, lane_path)
            column, row = np.divmod(cell, ROWS)
            s.trail_x, s.trail_y = column * TILE, (row - PIT_ROWS) * TILE
    s.next_direction = direction


def spend_stamina(s: State, cell: np.ndarray, landed: int) -> np.ndarray:
    """The endless id: which episodes end, for lack of stamina or by a fall, (N,) bool.

    cell: (N,) the agents' cells in the flattened map. landed: how many agents entered a tile.
    """
    if not landed:
        s.stamina -= 1
        return s.stamina == 0
    over: np.ndarray | bool = False
    if np.count_nonzero(s.fallen):
        over = s.fallen & ((s.tile[:, 0] < s.max_column) | s.fell_at.take(cell))
        # Marked for the whole episode. The original would clear the marks on progress, but compares too early.
        s.fell_at.put(cell[s.fallen], True)
    s.max_column = np.where(s.fallen, s.max_column, np.maximum(s.max_column, s.tile[:, 0]))
    s.stamina -= 1
    return (s.stamina == 0) | over


# ---- trails ----


def trail(s: State, lanes: np.ndarray, lane_path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The path behind the agents of the lanes: for each tile, (T,), its lane and its cell.

    It starts at the step before the agent's last one and goes back to the first step in the leftmost column shown.
    """
    at = s.last_path_step.take(lanes)
    first_column = np.maximum(s.tile[:, 0] - s.trail_columns, 1).take(lanes)  # (n,) the one after the leftmost
    bound = first_column * ROWS  # the cells further left are below this
    back = STEPS_BACK[: int(at.max())]  # (K,)
    # Further back than the pit is another lane's path, but the search ends at the pit: NO_CELL is below every bound.
    cells = s.path_cell.take((at + lane_path.take(lanes))[:, None] - back)  # (n, K)
    count = (cells < bound[:, None]).argmax(axis=1) + 1  # (n,)
    np.minimum(count, at - 1, out=count)
    return lanes.repeat(count), cells[back <= count[:, None]]


def forget_trails(s: State, lanes: np.ndarray) -> None:
    """Removes the trails of the lanes."""
    if np.count_nonzero(s.shows_trail[lanes]):
        s.shows_trail[lanes] = False
        left = s.shows_trail.take(s.trail_lane)
        s.trail_lane, s.trail_x, s.trail_y = s.trail_lane[left], s.trail_x[left], s.trail_y[left]
