"""The Mortar Mayhem environments. base.py and walking.py describe the methods that have no docstring here."""

from typing import Any

import gymnasium as gym
import numpy as np

from memory_gym_envs.appearance import VectorTables, vector_tables
from memory_gym_envs.base import DEBUG_ZOOM
from memory_gym_envs.character import FACINGS, PAD, Figure
from memory_gym_envs.colors import GREEN
from memory_gym_envs.drawing import ring
from memory_gym_envs.mortar_mayhem import drawing, levels, rules, vectors
from memory_gym_envs.mortar_mayhem.arena import COMMANDS, FLOORS, TILE, TORUS_SIZE, first_pixel
from memory_gym_envs.mortar_mayhem.options import VARIANTS, VECTOR_COMMANDS, MortarVariant
from memory_gym_envs.mortar_mayhem.state import State
from memory_gym_envs.state import Lanes, empty, make_room
from memory_gym_envs.walking import WalkingVectorEnv
from memory_gym_envs.words import sample_below, word_source


class MortarMayhem(WalkingVectorEnv):
    """Mortar Mayhem (thesis 4.3): memorise a sequence of commands, then carry them out in time.

    ## Description

    Commands are shown one by one while the agent cannot move (the clue). Then it has `explosion_delay` steps to carry
    out each: move to the neighbouring tile that it names, or stay. Then all tiles but that one burn for
    `explosion_duration` steps, and an agent on a burning tile fails.

    - `MortarMayhem-v0`: 10 commands on a 5 x 5 arena. `MortarMayhem-Grid-v0`: the same, tile by tile, no diagonals.
    - `MortarMayhemB-v0`, `MortarMayhemB-Grid-v0`: the act task alone, the commands given as a vector, no clue.
    - `Endless-MortarMayhem-v0`: a 6 x 6 torus that fills the screen. One command is shown and carried out. Each
      completed sequence then grows by one command: only the new one is shown, and the agent carries out all of them,
      starting where it is.

    ## Action Space

    | space | 0 | 1 | 2 | 3 |
    |---|---|---|---|---|
    | `MultiDiscrete([3, 3])`, horizontal | none | left | right | |
    | and vertical | none | up | down | |
    | `Discrete(4)`, Grid ids | nothing | turn left | turn right | one tile forward |

    Actions are ignored while a clue is shown.

    ## Observation Space

    `Box(0, 255, (84, 84, 3), uint8)`, rows first. The B ids: `Dict` of `visual_observation`, that Box, and
    `vector_observation` (180,) float32: 20 commands by 9 one-hot entries in the order of VECTOR_ORDER, zeros after the
    last command. Other values of `obs_type` change that: see Arguments.

    ## Rewards

    `reward_command_success` (0.1) for each command that is carried out when it is checked, `reward_command_failure` (0)
    on a burning tile, `reward_episode_success` (0) added when the last command is checked; in the endless id,
    `reward_new_command_success` (0) added when the last command of a sequence, its newest, is carried out.

    ## Episode End

    Terminated by failure, or by the last command's check (not in the endless id). Truncated after `max_steps` steps
    (the endless id; a failure at that very step counts as termination). With default options an episode takes 58 to
    274 steps (table 4.4), Grid 46 to 118, B 19 to 235, B-Grid 7 to 79. The B bounds are one above the thesis' formula
    (18 to 234, 6 to 78), because the first command has explosion_delay + 1 steps. With a clue the total agrees, because
    the reset already shows the clue's first step.

    ## Info

    `ground_truth` (2,): the target tile's column and row, divided by arena size - 1. At an episode's end also `reward`,
    `length`, `commands_completed` and `success` (in the endless id `max_command_sequence`, the length of the longest
    completed sequence). Not in the original: `carried_out`, how many commands' tiles the agent was on when all
    others caught fire, which a failed last command does not raise, and in the finite ids `is_success`, whether that is
    all of them. In the finite ids, commands_completed and carried_out are shares of the sequence.

    ## Kept from the original

    - The command that ends the episode counts as uncompleted, even if it was checked and carried out before the agent
      walked into the fire.
    - Failing at the very last command counts as success and completes all commands, but only the failure's reward is
      paid.
    - The sequence grows even if its last command failed, and max_command_sequence then counts it as completed.
    - Walking into the fire overwrites the reward of the step.
    - In the endless id the tiles stay lit while a clue is shown. Positions are rounded to the nearest pixel there;
      elsewhere steps are cut off, a diagonal one to 2 pixels at the default speed. An agent whose centre is beyond the
      screen's edge is on no tile.
    - Grid ids ignore agent_scale.

    ## Differences from the original

    - An episode's first frames show this episode's agent, not the last one's.
    """

    variants = VARIANTS
    tile = TILE
    kept = (*WalkingVectorEnv.kept, "_clues_open")
    variant: MortarVariant

    def spaces(self) -> tuple[gym.Space, gym.Space]:
        image, actions = super().spaces()
        if self.variant.clue:
            return image, actions
        vector = gym.spaces.Box(0.0, 1.0, (VECTOR_COMMANDS * len(COMMANDS),), np.float32)
        return gym.spaces.Dict({"visual_observation": image, "vector_observation": vector}), actions

    def allocate(self) -> None:
        self.state = empty(State, N=self.num_envs, C=1, L=1)
        self._clues_open = False  # whether any lane may still have a clue to see

    def configure(self, lanes: np.ndarray) -> None:
        """Takes over the arena, and makes room for the commands and for their clue."""
        s, values = self.state, self.settings[int(lanes[0])]
        count = values["initial_command_count"] if self.variant.endless else max(values["command_count"])
        make_room(s, "C", count + 1)
        if self.variant.clue:
            period = max(values["command_show_duration"]) + max(values["command_show_delay"])
            make_room(s, "L", count * period + 1)
        s.size[lanes] = size = values.get("arena_size", TORUS_SIZE)
        s.calm_floor[lanes] = FLOORS.index((size, None))

    def figures_of(self, values: dict[str, Any]) -> tuple[Figure, ...]:
        size = values.get("arena_size", TORUS_SIZE)
        low = first_pixel(size)
        return (self.figure_of(values, low, low + TILE * size, torus=self.variant.endless),)

    def place_tables(self) -> None:
        super().place_tables()
        self._lane_clue = np.arange(self.num_envs) * self.state.clue.shape[1]  # (N,)

    def vector_tables(self) -> VectorTables:
        sprites = FACINGS * (len(drawing.symbols()) if self.variant.clue else 1)  # of each figure
        appearance = vectors.appearance_tables(self.figures, self.variant.clue)
        scales = [figure.scale for figure in self.figures]
        return vector_tables(self.variant.entries, appearance, self.state.figure * sprites, scales, TILE)

    def begin(self, lanes: np.ndarray) -> None:
        for lane in lanes.tolist():
            levels.start_episode(self.state, lane, self._rngs[lane], self.settings[lane], self.variant)
        self._clues_open = self.variant.clue

    def apply_rules(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shows clues, moves the agents and changes the tiles: rewards and terminations, (N,) each."""
        s = self.state
        rewards, terminated = np.zeros(self.num_envs), np.zeros(self.num_envs, bool)
        acting: Any = np.True_  # all lanes, unless a clue is shown
        if self._clues_open:
            acting = rules.show_clue(s, self._lane_clue)  # (N,) bool
            count = np.count_nonzero(acting)
            self._clues_open = bool(count < self.num_envs)
            if not count:
                return rewards, terminated
            action = np.where(acting, action, self._controls.actions - 1)
        self.move_agents(action)
        s.timer -= acting
        due = s.timer == 0  # only a lane that acts gets there
        if np.count_nonzero(due):
            self._change_tiles(due.nonzero()[0], rewards, terminated)
        rules.burn_agents(s, acting, rewards, terminated)
        return rewards, terminated

    def _change_tiles(self, lanes: np.ndarray, rewards: np.ndarray, terminated: np.ndarray) -> None:
        """Puts out the lanes' tiles that burn, and lights those that do not, which checks the command."""
        s = self.state
        burning = s.burning[lanes]
        if np.count_nonzero(burning):
            rules.extinguish_tiles(s, lanes[burning])
            lanes = lanes[~burning]
        if lanes.size:
            rewards[lanes], sequence_over = rules.ignite_tiles(s, lanes)
            if self.variant.endless:
                for lane in lanes[sequence_over].tolist():
                    command = sample_below(word_source(self._rngs[lane]), self.settings[lane]["allowed_commands"])
                    rules.extend_sequence(s, lane, command)
                    self._clues_open = True
            else:
                # Whether or not the last command was carried out, as in the original; a failure overwrites the reward.
                rewards[lanes] += s.reward_episode[lanes] * sequence_over
                terminated[lanes] = sequence_over

    def pixels(self, lanes: Lanes) -> Any:
        if self.variant.clue:
            return self.frames(lanes)
        vector = self.state.vector[lanes]
        return {"visual_observation": self.frames(lanes), "vector_observation": vector.copy()}

    def vectors(self, lanes: Lanes) -> np.ndarray:
        return vectors.make_vectors(self.state, self._vector_tables, lanes)

    def frames(self, lanes: Lanes) -> np.ndarray:
        return drawing.draw(self.state, self._agent_tables.sheet, lanes)

    def ground_truth(self) -> np.ndarray:
        """A fresh (N, 2): the target's column and row, divided by arena size - 1."""
        return self.state.truth.copy()

    def summary(self, lanes: np.ndarray) -> dict[str, np.ndarray]:
        s, numbers = self.state, super().summary(lanes)
        if self.variant.endless:
            completed = s.completed[lanes]  # a failure does not raise it, unlike the share below
            numbers |= {"carried_out": completed, "commands_completed": completed}
            return numbers | {"max_command_sequence": s.count[lanes] - 1}
        success = s.current[lanes] >= s.count[lanes]
        failed = s.burning[lanes] & ~rules.on_target(s, lanes) & ~success
        share = (s.current[lanes] - failed) / s.count[lanes]
        numbers |= {"success": success.astype(np.int64), "commands_completed": share}
        carried_out = s.completed[lanes] / s.count[lanes]
        return numbers | {"carried_out": carried_out, "is_success": carried_out == 1}

    def oracle(self) -> dict[str, np.ndarray]:
        """The whole task in plain numbers, fresh arrays (N, ...). Besides `seed`, `length` and `position`:

        `tile` and `target_tile` (N, 2), column and row of the agent's tile and of the one that the command leads to;
        `command` (N,), its index in COMMANDS; `commands` (N, C), the sequence, -1 after its end; `commands_left` (N,),
        in this round, with the present one; `carried_out` (N,), in this episode.
        """
        s, numbers, side = self.state, super().oracle(), self.state.size[:, None]
        numbers["tile"] = (numbers["position"] - first_pixel(side)) // TILE
        numbers["target_tile"] = np.rint(s.truth * (side - 1)).astype(np.int64)
        numbers["command"] = s.commands[np.arange(self.num_envs), np.minimum(s.current, s.count - 1)]
        numbers["commands"] = np.where(np.arange(s.commands.shape[1]) < s.count[:, None], s.commands, -1)
        return numbers | {"commands_left": s.count - s.current, "carried_out": s.completed.copy()}

    def longest_episode(self, lane: int) -> int:
        if self.variant.endless:
            return super().longest_episode(lane)
        values = {name: max(value) for name, value in self.settings[lane].items() if isinstance(value, tuple)}
        shown = values.get("command_show_duration", 0) + values.get("command_show_delay", 0)
        carried_out = values["explosion_delay"] + values["explosion_duration"]
        return values["command_count"] * (shown + carried_out) - values["explosion_duration"] + 1

    def annotate(self, frame: np.ndarray, lane: int) -> None:
        """Circles the lane's target tile in its magnified frame, in place."""
        radius = TILE * DEBUG_ZOOM // 2
        x, y = ((self.state.target_corner[lane] - PAD) * DEBUG_ZOOM + radius).tolist()
        frame[ring(len(frame), x, y, radius, 2 * DEBUG_ZOOM)] = GREEN
