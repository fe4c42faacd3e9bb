"""The state of the lanes: agent, coins, exit, spotlights, light, health, and the options that every step needs.

Shape letters: N lanes, S spotlights that fit, B bodies that fit: the agent, the exit and the coins; R = 2 N sceneries.
"""

from dataclasses import dataclass

import numpy as np

from memory_gym_envs.drawing import FRAME
from memory_gym_envs.state import array
from memory_gym_envs.walking import WalkingState

AGENT, EXIT, COIN = 0, 1, 2  # bodies; coins are the last ones
GONE = 180  # the position of bodies that do not exist, in pixels: too far away to be touched or seen
AWAY = -1000  # the position of spotlights that do not exist

# What is known of a spotlight, a row of State.spots. Its position at time t is START + t * (TOWARD + t * BEND).
# It hurts within REACH of the agent's centre and may show a part of it within SIGHT, both squared.
TIME, SPEED, RADIUS, REACH, SIGHT = range(5)
START, TOWARD, BEND = slice(5, 7), slice(7, 9), slice(9, 11)
NO_SPOT = np.array([0.0, 0.0, 0.0, -1.0, -1.0, AWAY, AWAY, 0.0, 0.0, 0.0, 0.0])  # (11,)
NO_KEY = -AWAY  # brings a spotlight that does not exist to key 0

UNDER, BELOW_BAR, ABOVE_BAR = range(3)  # where a body is drawn: under the darkness, or above it and relative to the bar
FADE = 257  # steps after which the darkness no longer changes


@dataclass
class State(WalkingState):
    """The lanes' state. Only `pos` is stored with PAD added."""

    drawn_facing: np.ndarray = array("N")  # the facing that is drawn
    bodies: np.ndarray = array(2, "N", "B", fill=GONE)  # x and y of the agent, the exit and the coins
    touch_squared: np.ndarray = array("N", "B", dtype=np.float64)  # square of the distance at which the agent touches
    coin_sprite: np.ndarray = array("N")  # the sprite of the lane's coin; those of its closed and its open exit follow
    is_open: np.ndarray = array("N")  # 1 if the exit is open
    targets: np.ndarray = array("N", 4, dtype=np.float64)  # x and y of the first coin left and of the exit; 0: none
    num_coins: np.ndarray = array("N")  # in this episode
    coins_left: np.ndarray = array("N")  # of them
    collected: np.ndarray = array("N")  # coins so far
    coin_age: np.ndarray = array("N")  # steps since the coin appeared (endless)
    coin_show_limit: np.ndarray = array("N")  # age until which the coin, or all of them, are visible in the dark
    success: np.ndarray = array("N")  # 1 when the task is done
    # The spotlights, oldest first; rows are TIME .. BEND.
    spots: np.ndarray = array(len(NO_SPOT), "N", "S", dtype=np.float64, fill=NO_SPOT[:, None, None])
    spot_key: np.ndarray = array("N", "S", fill=NO_KEY)  # where the radius begins in spot_stencils(), plus POSITION_0
    num_spots: np.ndarray = array("N")  # spotlights
    spot_place: np.ndarray = array(2, "N", "S")  # where each shines: x and y as keys of these; 0: nowhere
    near_light: np.ndarray = array("N", dtype=bool)  # some of the agent may be in the light
    spawn_wait: np.ndarray = array("N")  # steps until the next spotlight
    spawns_left: np.ndarray = array("N")  # spotlights to follow
    health: np.ndarray = array("N", dtype=np.float64)
    # Each lane's floor, coins and exit in full light: a calm picture, then an alarmed one.
    scenery: np.ndarray = array("R", FRAME, dtype=np.uint8)
    floor: np.ndarray = array("N")  # which row of the scenery shows
    lost_width: np.ndarray = array("N")  # pixels of the top bar that show lost health
    last_action: np.ndarray = array("N")  # 3 * horizontal + vertical
    shown_action: np.ndarray = array("N")  # that of the step before
    last_gain: np.ndarray = array("N")  # 1, or 2 after a positive reward
    shown_gain: np.ndarray = array("N")  # that of the step before; 0 before the first step
    # Options that the rules or the pictures need at every step.
    coin_limit: np.ndarray = array("N")  # steps to collect a coin in; -1: no limit
    spawn_interval: np.ndarray = array("N")  # steps between spotlights, without the delay
    full_health: np.ndarray = array("N", dtype=np.float64, option="agent_health")  # health at the start
    damage: np.ndarray = array("N", dtype=np.float64, option="spot_damage")
    floors: np.ndarray = array("N", 2)  # rows of floors(): while the agent is in the dark, and in the light
    rim: np.ndarray = array("N", dtype=bool, option="black_background")  # spotlights have a white rim
    darkness: np.ndarray = array("N", FADE, dtype=np.uint8)  # opacity of the dark after so many steps
    dark_at: np.ndarray = array("N")  # steps until it is opaque and nothing else
    reddens: np.ndarray = array("N")  # 1 if the floor is red while the agent is in the light
    first_bar: np.ndarray = array("N")  # the first row of bars() that shows what the lane may see
    exit_layer: np.ndarray = array("N")  # UNDER, BELOW_BAR or ABOVE_BAR
    agent_layer: np.ndarray = array("N")  # likewise
    layered: np.ndarray = array("N", dtype=bool)  # either is above the dark
    reward_inside: np.ndarray = array("N", dtype=np.float64, option="reward_inside_spotlight")
    reward_outside: np.ndarray = array("N", dtype=np.float64, option="reward_outside_spotlight")
    reward_death: np.ndarray = array("N", dtype=np.float64, option="reward_death")
    reward_coin: np.ndarray = array("N", dtype=np.float64, option="reward_coin")
    reward_exit: np.ndarray = array("N", dtype=np.float64, option="reward_exit")
