"""The Searing Spotlights environments. base.py and walking.py describe the methods that have no docstring here."""

from typing import Any

import numpy as np

from memory_gym_envs.base import DEBUG_ZOOM
from memory_gym_envs.bits import POSITION_0, POSITIONS, pixel_scratch
from memory_gym_envs.character import PAD, Figure
from memory_gym_envs.colors import GREEN
from memory_gym_envs.drawing import SCREEN, magnify, ring
from memory_gym_envs.searing_spotlights import drawing, levels, rules, vectors
from memory_gym_envs.searing_spotlights.drawing import TOP_BAR
from memory_gym_envs.searing_spotlights.options import VARIANTS
from memory_gym_envs.searing_spotlights.state import AGENT, COIN, EXIT, GONE, RADIUS, State
from memory_gym_envs.state import Lanes, empty, make_room
from memory_gym_envs.walking import WalkingVectorEnv, numbered
from memory_gym_envs.words import pick, word_source


class SearingSpotlights(WalkingVectorEnv):
    """Searing Spotlights (thesis 4.5): collect coins and leave in the dark, away from wandering spotlights.

    ## Description

    The light goes out in the first steps. Spotlights wander over the dark screen and show what is in them; each step in
    one costs the agent health. It has to collect the coins and to leave through the exit, which opens only then.
    It must remember where things were, and where it has walked since it was last visible. A bar at the top shows
    health, the action before the last, and whether the step before the last was rewarded.

    - `SearingSpotlights-v0`: one coin and the exit; a new spotlight every 40 steps.
    - `Endless-SearingSpotlights-v0`: one coin after the other, each visible for a moment and to be collected within 160
      steps; a new spotlight every 50 steps, twice the health, no exit.

    ## Action Space

    | space | 0 | 1 | 2 |
    |---|---|---|---|
    | `MultiDiscrete([3, 3])`, horizontal | none | left | right |
    | and vertical | none | up | down |

    ## Observation Space

    `Box(0, 255, (84, 84, 3), uint8)`, rows first. Other values of `obs_type` change that: see Arguments.

    ## Rewards

    `reward_coin` (0.25) for a coin, `reward_exit` (1) for leaving, and in every step `reward_inside_spotlight` or
    `reward_outside_spotlight` (both 0); `reward_death` (0) is added when no health is left.

    ## Episode End

    Terminated when no health is left, when the agent leaves or, without an exit, takes the last coin; in the endless id
    after `steps_per_coin` steps without a coin. Truncated after `max_steps` steps, unless it terminates in that step.
    An agent that knows everything needs 14 to 63 steps for the finite task, 33 on average (table 4.5).

    ## Info

    `ground_truth` (6,): x and y of the agent, of the first coin left and of the exit; the endless id (4,) without the
    exit. In pixels over 84, so an agent that starts outside the screen has up to 86 / 84; 0 for what is not there. At
    an episode's end also `reward`, `length`, `agent_health` (share left, negative if the last hit took more than that),
    `coins_collected` (a share, 1 if there were none; in the endless id a number) and, in the finite id, `success` and
    `is_success`.

    ## Options

    Radii and speeds of spotlights are sampled between their smallest and largest, `spawn_delay` for each interval.

    ## Kept from the original

    - The bar shows the action and the reward of the step before the last.
    - A spotlight behind one that is removed skips that step, and so does a coin behind a taken one when several are
      touched at once.
    - The wait for the next spotlight is always the first of the planned intervals, as each spawn removes the last one;
      so `spawn_interval_decay` changes nothing, and neither does `reward_max_steps`.
    - All coins but the first are a step old when they are first shown, so in the dark they are visible in one frame
      less than `coin_show_duration` says. An endless task's coin may appear on the agent.
    - Radii of spotlights are whole pixels, from `spot_min_radius` to `spot_max_radius`, both rounded down.
    - The agent may start under the bar or outside the screen and steps inside with its first step; before that it is
      drawn facing up, and no spotlight shines.
    - Dying at the exit is no success, though it pays.
    - Small coins (scale below 0.5) are all rim and small exits all frame. Whether what is visible in the dark is drawn
      above the bar or below it depends on what else is visible.

    ## Differences from the original

    - What an episode drew or painted black or white does not show in the next one.
    - No exit, no coins and a hidden action bar work; the share of no coins is 1, not NaN.
    - Coins for which no free pixel is left are put anywhere.
    - A smallest radius or speed above the largest replaces it.
    - Options that 1.0.2 lacks: `coin_enabled`, new in 1.0.3; `coin_feedback`, as what follows a coin tells the agent
      where it is (thesis 7.3.3, 8.3.1): without it, the next coin stays in the dark until light falls on it, and the
      bar doesn't show the coin's reward; `spawn_delay`, for spotlights at random intervals (7.3.3).
    """

    variants = VARIANTS
    tables = (*WalkingVectorEnv.tables, "_drawing")
    truth_high = (SCREEN + 2) / SCREEN  # an agent may start that far outside of the screen
    kept = (*WalkingVectorEnv.kept, "_unlocked")

    def allocate(self) -> None:
        """Makes the state of N lanes, with room for no coin and one spotlight."""
        self.state = empty(State, N=self.num_envs, S=1, B=COIN, R=2 * self.num_envs)
        self._unlocked: list[int] = []  # lanes without coins, whose exits open in the first step

    def configure(self, lanes: np.ndarray) -> None:
        """Takes over the options of the lanes that mean more than a number, and makes room for the coins."""
        values = self.settings[int(lanes[0])]
        make_room(self.state, "B", COIN + max((1, *values.get("num_coins", ()))))
        rules.set_rules(self.state, lanes, values)
        drawing.set_pictures(self.state, lanes, values)

    def figures_of(self, values: dict[str, Any]) -> tuple[Figure, ...]:
        """The agent's figure as it walks across and as it walks down, where the bar is in its way."""
        return self.figure_of(values, 0, SCREEN), self.figure_of(values, TOP_BAR, SCREEN)

    def place_tables(self) -> None:
        coins = [values["coin_scale"] for values in self.settings]
        exits = [values.get("exit_scale", values["coin_scale"]) for values in self.settings]
        self.scales, scale = numbered([*zip(coins, exits, strict=True)])
        self.state.coin_sprite[:] = np.multiply(scale, 3)
        every = [values[name] for values in self.settings for name in ("spot_min_radius", "spot_max_radius")]
        self._radii = int(min(every)), int(max(every))  # the smallest and the largest
        super().place_tables()
        self._drawing = drawing.DrawingTables(
            spots=drawing.spot_stencils(*self._radii),
            figures=self._agent_tables.sheet,
            coins_and_exits=drawing.coin_and_exit_sheet(self.scales),
            bars=drawing.bars(self.variant.endless),
            scratch=pixel_scratch(self.num_envs),
        )
        self._calm = np.arange(0, 2 * self.num_envs, 2)  # (N,) the scenery's calm rows

    def vector_tables(self) -> vectors.VectorTables:
        figure_scales = tuple(across.scale for across in self.figures[::2])
        return vectors.make_vector_tables(self.state, self.variant, self._radii, figure_scales, self.scales)

    def begin(self, lanes: np.ndarray) -> None:
        s = self.state
        for lane in lanes.tolist():
            levels.start_episode(s, lane, self._rngs[lane], self.settings[lane], self.variant.endless)
            self._draw_scenery(lane)
            if not s.num_coins[lane]:
                self._unlocked.append(lane)

    def apply_rules(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Walks, spawns, shines, burns, collects, leaves: rewards and terminations, (N,) each."""
        s, endless = self.state, self.variant.endless
        self._move(action)
        self._unlock()
        self._spawn()
        hit = rules.move_spots(s)
        rewards, terminated, s.floor = s.reward_outside.copy(), np.zeros(self.num_envs, bool), self._calm.copy()
        if np.count_nonzero(hit):
            rules.burn(s, np.flatnonzero(hit), rewards, terminated)
        touched, shown = rules.touched_bodies(s), {}
        if np.count_nonzero(touched):
            shown = self._collect(touched, rewards)
            if not endless:
                rules.leave(s, touched, rewards, terminated)
        rules.count_step(s, rewards, terminated, shown, endless)
        return rewards, terminated

    def _move(self, action: np.ndarray) -> None:
        s = self.state
        s.shown_action, s.last_action = s.last_action, action
        self.move_agents(action)
        s.drawn_facing = s.facing
        np.subtract(s.pos.T, PAD, out=s.bodies[:, :, AGENT])

    def _unlock(self) -> None:
        """Opens the exits of levels without coins."""
        while self._unlocked:
            lane = self._unlocked.pop()
            self.state.is_open[lane] = self.state.coins_left[lane] == 0
            self._draw_scenery(lane)

    def _spawn(self) -> None:
        """Adds the spotlights that are due."""
        s = self.state
        s.spawn_wait -= 1
        due = s.spawn_wait == 0
        if np.count_nonzero(due):
            for lane in np.flatnonzero(due).tolist():
                rng, values = self._rngs[lane], self.settings[lane]
                rules.add_spot(s, lane, levels.sample_spot(rng, values), pick(word_source(rng), values["spawn_delay"]))

    def _collect(self, touched: np.ndarray, rewards: np.ndarray) -> dict[int, float]:
        """Takes the coins that are touched, (N, B) bool; the endless id then has a new one.

        rewards: (N,), changed in place. Returns those that the top bar shows instead, by lane, without coin_feedback.
        """
        s, shown = self.state, {}
        for lane in np.flatnonzero(touched[:, COIN:].any(axis=1)).tolist():
            last, values = tuple(s.bodies[:, lane, COIN].tolist()), self.settings[lane]
            if self.variant.endless and not values["coin_feedback"]:
                shown[lane] = float(rewards[lane])
            rewards[lane] += s.reward_coin[lane] * rules.take_coins(s, lane, touched[lane])
            if self.variant.endless:
                coin = levels.sample_coin(word_source(self._rngs[lane]), last)
                rules.put_coin(s, lane, coin, values)
            self._draw_scenery(lane)
        return shown

    def _draw_scenery(self, lane: int) -> None:
        """Draws the lane's scenery again. Vectors need none; frames() draws it then."""
        if self.obs_type != "vector":
            drawing.draw_scenery(self.state, self._drawing, lane)

    def frames(self, lanes: Lanes) -> np.ndarray:
        if self.obs_type == "vector":
            for lane in np.arange(self.num_envs)[lanes].tolist():
                drawing.draw_scenery(self.state, self._drawing, lane)
        return drawing.draw(self.state, self._drawing, lanes)

    def vectors(self, lanes: Lanes) -> np.ndarray:
        return vectors.make_vectors(self.state, self._vector_tables, lanes)

    def ground_truth(self) -> np.ndarray:
        """A fresh (N, 6), or (N, 4) in the endless id: the agent's, the coin's and the exit's x and y, over 84."""
        s = self.state
        truth = np.empty((self.num_envs, 4 if self.variant.endless else 6))
        truth[:, :2] = s.bodies[:, :, AGENT].T
        truth[:, 2:] = s.targets[:, : truth.shape[1] - 2]
        truth /= SCREEN
        return truth

    def summary(self, lanes: np.ndarray) -> dict[str, np.ndarray]:
        s, numbers = self.state, super().summary(lanes)
        numbers["agent_health"] = (s.health / s.full_health)[lanes]
        if self.variant.endless:
            return numbers | {"coins_collected": s.collected[lanes]}
        coins = s.num_coins[lanes]
        share = np.where(coins > 0, s.collected[lanes] / np.maximum(coins, 1), 1.0)
        success = s.success[lanes]
        return numbers | {"coins_collected": share, "success": success, "is_success": success == 1}

    def oracle(self) -> dict[str, np.ndarray]:
        """The whole task in plain numbers, fresh arrays (N, ...). Besides `seed`, `length` and `position`:

        `coins` (N, C, 2), where they are in pixels, x and y, NaN where one is gone; `coins_left` and `coins_collected`
        (N,); `health` (N,); in the finite id `exit` (N, 2), NaN where there is none, and `exit_is_open` (N,) bool.
        """
        s = self.state
        positions = np.where(s.bodies == GONE, np.nan, s.bodies).transpose(1, 2, 0)  # (N, B, 2)
        numbers = super().oracle() | {"coins": positions[:, COIN:], "coins_left": s.coins_left.copy()}
        numbers |= {"coins_collected": s.collected.copy(), "health": s.health.copy()}
        if not self.variant.endless:
            numbers |= {"exit": positions[:, EXIT], "exit_is_open": s.is_open == 1}
        return numbers

    def annotate(self, frame: np.ndarray, lane: int) -> None:
        """Lights everything below the bar, and circles the spotlights."""
        s, lanes = self.state, np.array([lane])
        lit = s.scenery.take(s.floor[lanes], axis=0)  # (1, FRAME)
        drawing.draw_agents(s, self._drawing, lanes, lit, True)
        below = slice(TOP_BAR * DEBUG_ZOOM, None)
        frame[below] = magnify(lit.reshape(SCREEN, SCREEN, 3), DEBUG_ZOOM)[below]
        for slot in np.flatnonzero(s.spot_place[0, lane]).tolist():
            radius = int(s.spots[RADIUS, lane, slot])
            x, y = (s.spot_place[:, lane, slot] - radius * POSITIONS - POSITION_0).tolist()
            circle = ring(len(frame), x * DEBUG_ZOOM, y * DEBUG_ZOOM, radius * DEBUG_ZOOM, DEBUG_ZOOM)
            circle[: TOP_BAR * DEBUG_ZOOM] = False
            frame[circle] = GREEN
