"""The Mystery Path environments. base.py and walking.py describe the methods that have no docstring here."""

import gymnasium as gym
import numpy as np

from memory_gym_envs.appearance import VectorTables, vector_tables
from memory_gym_envs.base import DEBUG_ZOOM
from memory_gym_envs.character import FACINGS, PAD, radius_of
from memory_gym_envs.drawing import magnify
from memory_gym_envs.mystery_path import drawing, levels, rules, vectors
from memory_gym_envs.mystery_path.options import SEGMENT, SIDE, TILE, VARIANTS
from memory_gym_envs.mystery_path.state import MAP_STRIDES, NO_CELL, PIT, PIT_ROWS, ROWS, State, tiles_of
from memory_gym_envs.state import Lanes, empty
from memory_gym_envs.walking import WalkingVectorEnv, numbered

TRUTHS = (np.eye(4), np.eye(4, 3))  # one-hot directions: all, and all but west


class MysteryPath(WalkingVectorEnv):
    """Mystery Path (thesis 4.4): follow an invisible path by remembering where the agent fell off.

    ## Description

    A path leads over a grid of 7 x 7 tiles, from a random tile of one side to one of the opposite side. Neither the
    path nor the grid is visible. An agent that steps off the path falls into a pit, which a red cross shows, and the
    next step puts it back to the path's origin, whatever its action.

    - `MysteryPath-v0`: free movement. `MysteryPath-Grid-v0`: tile by tile.
    - `Endless-MysteryPath-v0`: the path goes on to the right without end, in segments of 7 columns and a transition
      tile. The camera moves with the agent, which sees the path behind it but cannot walk left.

    ## Action Space

    | space | 0 | 1 | 2 | 3 |
    |---|---|---|---|---|
    | `MultiDiscrete([3, 3])`, horizontal | none | left | right | |
    | and vertical | none | up | down | |
    | `Discrete(4)`, Grid id | nothing | turn left | turn right | one tile forward |
    | `Discrete(4)`, endless id | nothing | right | up | down |

    ## Observation Space

    `Box(0, 255, (84, 84, 3), uint8)`, rows first. Other values of `obs_type` change that: see Arguments.

    ## Rewards

    `reward_goal` (1) at the goal, `reward_path_progress` (0.1, Grid 0) when any tile of the path but the origin and the
    goal is reached for the first time, `reward_fall_off` (0) in the pit, and `reward_step` (0) at every step.
    Endless id: also `reward_path_progress_dense` (0) at a tile's first visit since the last fall, the origin apart.

    ## Episode End

    Terminated at the goal. The endless id: terminated when the agent has reached no new tile for `stamina_level` (20)
    steps (all tiles are new again after a fall), falls off in a column left of the rightmost one that it reached, or
    falls off at the same tile again. Truncated after `max_steps` steps (512, Grid 128, endless no limit), unless the
    same step terminates.

    ## Info

    `ground_truth`: one-hot, the direction of the path's next tile from where the agent last was on the path: east,
    north, south, west, (4,); at the goal, the direction that led there. Endless id: east, north, south, (3,); where the
    path goes west, the direction stays as it was. At an episode's end also `reward`, `length`, `num_fails`,
    `success` and `is_success`; in the endless id, instead of these two, `tiles_visited` and `max_x`, the rightmost
    column of the path that the agent reached.

    ## Kept from the original

    - The agent starts its radius away from the left and upper edge of its tile, so one of scale 0.48 or more starts
      beside the origin.
    - The Grid id ignores `agent_scale`, the endless id `show_origin`.
    - Steps are cut off to whole pixels, a diagonal one to 2 pixels at the default speed. In the endless id the camera's
      fraction of a pixel is cut off, and the background jumps at speeds that do not divide 12.
    - In the endless id the origin restores stamina. In 1.0.3 it does not, as with `origin_restores_stamina=False`.
    - In the endless id the tiles where the agent fell off count until the episode ends. Where the path goes left, the
      agent cannot follow it.
    - Of the path's leftmost column that is shown behind the agent, only one tile is drawn, and nothing is drawn while
      the agent is in the first column.
    """

    variants = VARIANTS
    tile = TILE

    def spaces(self) -> tuple[gym.Space, gym.Space]:
        image, actions = super().spaces()
        return image, gym.spaces.Discrete(4) if self.variant.endless else actions

    def allocate(self) -> None:
        segments = levels.FIRST_SEGMENTS + 1 if self.variant.endless else 1
        self.state = empty(State, N=self.num_envs, P=SIDE * SIDE + 1, M=segments * SEGMENT * ROWS, T=0)
        self.state.path_cell[:, PIT] = NO_CELL

    def configure(self, lanes: np.ndarray) -> None:
        """Takes over the agent's size, and in the endless id what the camera and what moves with it depend on."""
        s, values = self.state, self.settings[int(lanes[0])]
        s.radius[lanes] = radius_of(self.scale_of(values))
        s.extras[lanes] = (s.show_origin | s.show_goal | s.show_ground | s.show_stamina)[lanes]
        if self.variant.endless:
            drawing.set_camera(s, lanes, values)

    def place_tables(self) -> None:
        endless = self.variant.endless
        every = [vectors.view_options_of(values, self.scale_of(values), endless) for values in self.settings]
        self.view_options, self.state.view[:] = numbered(every)
        super().place_tables()
        self._index_lanes()

    def _index_lanes(self) -> None:
        """Computes where each lane's cells and steps start in the flattened state, which may have grown."""
        self._lane_map = np.arange(self.num_envs) * self.state.step_at.shape[1] + PIT_ROWS  # (N,)
        self._lane_path = np.arange(self.num_envs) * self.state.path_cell.shape[1]  # (N,)

    def vector_tables(self) -> VectorTables:
        appearance, scales = vectors.appearance_tables(self.view_options), [view.scale for view in self.view_options]
        return vector_tables(self.variant.entries, appearance, self.state.view * (2 * FACINGS), scales, TILE)

    def begin(self, lanes: np.ndarray) -> None:
        rules.forget_trails(self.state, lanes)
        for lane in lanes.tolist():
            levels.start_episode(self.state, lane, self._rngs[lane], self.settings[lane], self.variant.endless)
        self._index_lanes()

    def apply_rules(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Walks, and enters a tile or falls off: rewards and terminations, (N,) each."""
        s, endless = self.state, self.variant.endless
        if np.count_nonzero(s.fallen):
            action = rules.put_back(s, action)
        if endless:
            rules.walk_endless(s, action)
            s.tile = (s.pos - PAD) // TILE  # (N, 2)
            self._extend_paths()
        else:
            self.move_agents(action)
            s.tile = rules.TILE_AT.take(s.pos)  # (N, 2)
        cell = s.tile.dot(MAP_STRIDES) + self._lane_map  # (N,)
        before, s.path_step = s.path_step, s.step_at.take(cell)
        s.fallen = s.path_step == PIT
        rewards = s.reward_step.copy()
        landed = int(np.count_nonzero(s.path_step != before))
        if landed:
            rules.enter_tiles(s, self._lane_path, rewards, endless)
        terminated = rules.spend_stamina(s, cell, landed) if endless else s.path_step == s.path_length
        if not endless and np.count_nonzero(terminated):
            rewards += terminated * s.reward_goal
        return rewards, terminated

    def _extend_paths(self) -> None:
        """Appends a segment to the paths whose last segment the agent just entered."""
        s = self.state
        entered = s.tile[:, 0] >= (s.segments - 1) * SEGMENT
        if np.count_nonzero(entered):
            for lane in np.flatnonzero(entered).tolist():
                levels.append_segment(s, lane, self._rngs[lane])
            self._index_lanes()

    def vectors(self, lanes: Lanes) -> np.ndarray:
        return vectors.make_vectors(self.state, self._vector_tables, lanes, self.variant.endless)

    def frames(self, lanes: Lanes) -> np.ndarray:
        return drawing.draw(self.state, self._agent_tables.sheet, lanes, self.variant.endless)

    def ground_truth(self) -> np.ndarray:
        """The direction of the path's next tile: a fresh one-hot (N, 4), endless (N, 3)."""
        return TRUTHS[self.variant.endless].take(self.state.next_direction, axis=0)

    def summary(self, lanes: np.ndarray) -> dict[str, np.ndarray]:
        s, numbers = self.state, super().summary(lanes)
        if self.variant.endless:
            numbers |= {"num_fails": s.fails[lanes]}
            return numbers | {"max_x": s.max_column[lanes], "tiles_visited": s.visited[lanes]}
        success = s.path_step[lanes] == s.path_length[lanes]
        return numbers | {"success": success.astype(np.int64), "num_fails": s.fails[lanes], "is_success": success}

    def oracle(self) -> dict[str, np.ndarray]:
        """The whole task in plain numbers, fresh arrays (N, ...). Besides `seed`, `length` and `position`:

        `tile` (N, 2), the agent's column and row; `next_tile` (N, 2), the path's next one from where the agent last was
        on it; `path` (N, P, 2), its tiles so far, -1 after the last; `falls` (N,); in the finite ids `goal_tile` (N, 2)
        and `tiles_left` (N,), how many follow on the path. In the endless id, columns and x are counted along the path.
        """
        s, lanes = self.state, np.arange(self.num_envs)
        step = np.maximum(s.last_path_step, 1)
        following = s.path_cell[lanes, np.minimum(step + 1, s.path_length)]
        numbers = super().oracle() | {"tile": s.tile.copy(), "next_tile": tiles_of(following)}
        over = np.arange(s.path_cell.shape[1] - 1) >= s.path_length[:, None]
        numbers["path"] = np.where(over[..., None], -1, tiles_of(s.path_cell[:, 1:]))
        numbers["falls"] = s.fails.copy()
        if not self.variant.endless:
            numbers["goal_tile"] = tiles_of(s.path_cell[lanes, s.path_length])
            numbers["tiles_left"] = s.path_length - step
        return numbers

    def annotate(self, frame: np.ndarray, lane: int) -> None:
        """Draws the path in white, its origin and transition tiles blue, its goal green, walls red, then the agent."""
        truth = drawing.draw_truth(self.state, self._agent_tables.sheet, lane, self.variant.endless)
        frame[:] = magnify(truth, DEBUG_ZOOM)
