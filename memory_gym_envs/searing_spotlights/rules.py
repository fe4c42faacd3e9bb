"""Rules: what a step does to the state, and to `rewards` and `terminated`, (N,) each, which are changed in place."""

from typing import Any

import numpy as np

from memory_gym_envs.base import ALL, NO_LIMIT
from memory_gym_envs.bits import POSITION_0, POSITIONS
from memory_gym_envs.character import radius_of
from memory_gym_envs.drawing import SCREEN
from memory_gym_envs.searing_spotlights.state import (
    AGENT,
    BEND,
    COIN,
    EXIT,
    GONE,
    NO_KEY,
    NO_SPOT,
    RADIUS,
    REACH,
    SIGHT,
    SPEED,
    START,
    TIME,
    TOWARD,
    State,
)
from memory_gym_envs.state import make_room


def set_rules(s: State, lanes: np.ndarray, values: dict[str, Any]) -> None:
    """Writes what the options mean for the rules to the state of these lanes, (n,)."""
    s.coin_limit[lanes] = values["steps_per_coin"] if values.get("coin_enabled") else -1
    waits = ("spawn_interval", "initial_spawn_interval", "spawn_interval_threshold")
    s.spawn_interval[lanes] = max(1, sum(values.get(name, 0) for name in waits))
    radius = radius_of(values["agent_scale"])
    coin, exit_ = int(10 * values["coin_scale"]), 10 * values.get("exit_scale", 0.0)
    s.touch_squared[lanes, COIN:], s.touch_squared[lanes, EXIT] = (coin + radius) ** 2, (exit_ + radius) ** 2
    s.touch_squared[lanes, AGENT] = -1.0


# ---- spotlights ----


def add_spot(s: State, lane: int, spot: list[float], delay: int) -> None:
    """Adds a spotlight, a column of State.spots, to the lane's. delay: steps added to the wait for the next one."""
    at = int(s.num_spots[lane])
    if at == s.spot_key.shape[1]:
        # Every step reads all slots, so there are few spare ones, unless so many are in use that growing costs more.
        make_room(s, "S", at + max(2, at // 8))
    s.spots[:, lane, at] = spot
    s.spot_key[lane, at] = spot[RADIUS] * POSITIONS + POSITION_0
    s.num_spots[lane] = at + 1
    s.spawns_left[lane] -= 1
    start_wait(s, lane, delay)


def start_wait(s: State, lane: int, delay: int) -> None:
    """Starts the wait for the lane's next spotlight, of the interval and so many steps more."""
    # Always the first interval of the original's list, as its spawns remove the last one.
    s.spawn_wait[lane] = s.spawn_interval[lane] + delay if s.spawns_left[lane] else NO_LIMIT


def spot_positions(spots: np.ndarray) -> np.ndarray:
    """Where spotlights (11, N, S) are on their paths, x and y in pixels: (2, N, S) float64."""
    positions = spots[TIME] * spots[BEND]
    positions += spots[TOWARD]
    positions *= spots[TIME]
    positions += spots[START]
    return positions


def move_spots(s: State) -> np.ndarray:
    """Moves the spotlights on; (N,) bool whose agent is in the light."""
    pausing = remove_finished(s) if np.count_nonzero(s.spots[TIME] >= 1.0) else None
    time = s.spots[TIME]  # (N, S)
    spot = spot_positions(s.spots)  # (2, N, S)
    key = spot.astype(np.int64)
    key += s.spot_key
    spot -= s.bodies[:, :, :1]
    spot *= spot
    distance = spot[0] + spot[1]  # (N, S) squared
    if pausing is None:
        time += s.spots[SPEED]
    else:
        held = time[pausing]
        time += s.spots[SPEED]
        time[pausing], distance[pausing], key[(ALL, *pausing)] = held, np.inf, 0
    s.spot_place, s.near_light = key, (distance <= s.spots[SIGHT]).any(axis=1)
    return (distance <= s.spots[REACH]).any(axis=1) if np.count_nonzero(s.near_light) else s.near_light


def remove_finished(s: State) -> tuple[np.ndarray, np.ndarray]:
    """Removes the spotlights that are through: lanes and slots, each (n,), of those that pause in this step.

    The original removes them from the list that it iterates over, so the one behind each is skipped: it neither moves
    nor shines in that step.
    """
    lanes, slots = [], []
    for lane in np.flatnonzero((s.spots[TIME] >= 1.0).any(axis=1)).tolist():
        through = s.spots[TIME, lane] >= 1.0
        remaining, pausing, at = list(range(int(s.num_spots[lane]))), [], 0
        while at < len(remaining):
            if through[remaining[at]]:
                del remaining[at]
                pausing += remaining[at : at + 1]
            at += 1
        left = len(remaining)
        s.spots[:, lane, :left], s.spot_key[lane, :left] = s.spots[:, lane, remaining], s.spot_key[lane, remaining]
        s.spots[:, lane, left:], s.spot_key[lane, left:] = NO_SPOT[:, None], NO_KEY
        s.num_spots[lane] = left
        slots += [remaining.index(each) for each in pausing]
        lanes += [lane] * len(pausing)
    return np.array(lanes, np.intp), np.array(slots, np.intp)


def burn(s: State, lanes: np.ndarray, rewards: np.ndarray, terminated: np.ndarray) -> None:
    """Damages the agents of these lanes (n,), which are in the light."""
    s.health[lanes] -= s.damage[lanes]
    s.floor[lanes] += 1
    lost = 1 - s.health[lanes] / s.full_health[lanes]
    # Truncated to whole pixels and to the lowest 32 bits, as in the original, which draws nothing for negative widths.
    width = (SCREEN // 2 * lost).astype(np.int64).astype(np.int32)
    s.lost_width[lanes] = np.maximum(s.lost_width[lanes], np.minimum(width, SCREEN))
    terminated[lanes] = dead = s.health[lanes] <= 0
    rewards[lanes] = s.reward_inside[lanes] + s.reward_death[lanes] * dead


# ---- coins, exit and the end of a step ----


def touched_bodies(s: State) -> np.ndarray:
    """(N, B) bool: which bodies the agents touch."""
    gap = s.bodies - s.bodies[:, :, :1]  # (2, N, B)
    gap *= gap
    return gap[0] + gap[1] <= s.touch_squared


def take_coins(s: State, lane: int, touched: np.ndarray) -> int:
    """Takes the lane's coins that are touched, (B,) bool, and returns how many those are."""
    taken, skip = 0, False
    for coin in np.flatnonzero(s.bodies[0, lane, COIN:] != GONE) + COIN:
        if skip:  # the coin behind a taken one is skipped for this step, as in the original
            skip = False
        elif touched[coin]:
            s.bodies[:, lane, coin] = GONE
            taken, skip = taken + 1, True
    s.coins_left[lane] -= taken
    s.is_open[lane] = s.coins_left[lane] == 0
    s.collected[lane] += taken
    update_targets(s, lane)
    return taken


def coin_show_limit(values: dict[str, Any], first: bool) -> int:
    """The age until which coins are visible in the dark, in steps. first: of an episode's first coins, or the next."""
    if values["coins_visible"]:
        return NO_LIMIT
    return values.get("coin_show_duration", 0) if first or values["coin_feedback"] else 0


def put_coin(s: State, lane: int, coin: tuple[int, int], values: dict[str, Any]) -> None:
    """Puts the endless task's next coin there, x and y in pixels."""
    s.bodies[:, lane, COIN] = coin
    s.coins_left[lane], s.coin_age[lane], s.coin_show_limit[lane] = 1, 0, coin_show_limit(values, first=False)
    update_targets(s, lane)


def update_targets(s: State, lane: int) -> None:
    """Makes the first coin left the lane's target."""
    coins = np.flatnonzero(s.bodies[0, lane, COIN:] != GONE)
    s.targets[lane, :2] = s.bodies[:, lane, COIN + coins[0]] if coins.size else 0.0


def leave(s: State, touched: np.ndarray, rewards: np.ndarray, terminated: np.ndarray) -> None:
    """Ends the episodes whose agent stands at the open exit or, without an exit, has just taken the last coin."""
    has_exit = s.bodies[0, :, EXIT] != GONE
    done = (s.coins_left == 0) & np.where(has_exit, touched[:, EXIT], s.num_coins > 0)
    rewards += s.reward_exit * (done & has_exit)
    s.success[:] = done & ~terminated
    terminated |= done


def count_step(s: State, rewards: np.ndarray, terminated: np.ndarray, shown: dict[int, float], endless: bool) -> None:
    """Counts the step. shown: by lane, rewards that the top bar shows instead of the lane's own."""
    if endless:
        s.coin_age += 1
        terminated |= s.coin_age == s.coin_limit
    s.shown_gain, s.last_gain = s.last_gain, (rewards > 0) + 1
    for lane, reward in shown.items():
        s.last_gain[lane] = 1 + (reward > 0)
