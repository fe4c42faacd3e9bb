"""What is rendered, for agents and for people, in every id, Mortar Mayhem and Searing Spotlights."""

import gymnasium as gym
import numpy as np
import pytest
from helpers import EACH, MORTAR, SPOTLIGHTS, make, picture, roll

from memory_gym_envs.players import player


@EACH
def test_render(env_id):
    env, envs = gym.make(env_id, render_mode="rgb_array"), make(env_id, render_mode="rgb_array")
    observation, _ = env.reset(seed=2)
    assert np.array_equal(env.render(), picture(observation))
    envs.reset(seed=2)
    for step in range(30):
        ((observations, *_),) = roll(envs, 1, seed=step)
        frames = envs.render()
        assert isinstance(frames, tuple)
        assert np.array_equal(np.stack(frames), picture(observations))


@EACH
def test_no_render_mode_warns(env_id):
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


# ---- Mortar Mayhem ----


@MORTAR
def test_debug_render_circles_the_target(env_id):
    env = gym.make(env_id, render_mode="debug_rgb_array").unwrapped
    observation, info = env.reset(seed=2)
    for _ in range(10):
        for _ in range(4):
            observation, _, over, _, info = env.step(env.action_space.sample())
            if over:
                observation, info = env.reset()
        frame = env.render()
        assert frame.shape == (336, 336, 3)
        assert frame.dtype == np.uint8
        circle = (frame == (0, 255, 0)).all(axis=-1)
        size = 6 if "Endless" in env_id else 5
        tile = info["ground_truth"] * (size - 1)
        x, y = 168 - 28 * size + 56 * tile + 28  # the target's middle
        rows, columns = circle.nonzero()
        assert abs(rows.mean() + 0.5 - y) < 1
        assert abs(columns.mean() + 0.5 - x) < 1
        assert np.ptp(rows) == np.ptp(columns) == 55
        assert np.array_equal(frame[~circle], picture(observation).repeat(4, 0).repeat(4, 1)[~circle])


def test_clue_shows_every_command_and_hides_it_again():
    """Nine symbols, each its own, for show_duration steps; then a blank."""
    env = gym.make("MortarMayhem-v0", disable_env_checker=True).unwrapped
    observation, _ = env.reset(seed=0, options={"command_count": [40], "arena_size": 6})
    state, shapes = env.batch.state, {}
    for step in range(160):
        white = (observation == 255).all(axis=-1)
        assert white.any() == (step % 4 != 3)
        if step % 4 != 3:
            shapes.setdefault(int(state.commands[0, step // 4]), set()).add(white.tobytes())
        observation, *_ = env.step([1, 1])
    assert len(shapes) == 9
    assert all(len(seen) == 1 for seen in shapes.values())
    assert len(set.union(*shapes.values())) == 9


def test_visual_feedback():
    red = (112, 24, 36)
    for feedback in (True, False):
        env = gym.make("MortarMayhemB-v0").unwrapped
        env.reset(seed=1, options={"visual_feedback": feedback})
        seen = 0
        for _ in range(60):
            observation, *_ = env.step(player(env.batch)[0])
            seen += bool((observation["visual_observation"] == red).all(axis=-1).any())
        assert seen == (12 if feedback else 0)  # two fires of six steps


# ---- Searing Spotlights ----


def colors_of(frame):
    numbers = np.unique(frame.reshape(-1, 3) @ np.array([1 << 16, 1 << 8, 1]))
    return {(number >> 16, number >> 8 & 255, number & 255) for number in numbers.tolist()}


@SPOTLIGHTS
def test_debug_render_lights_everything(env_id):
    """Floor, agent, coin and exit show in the dark; green circles are where the agent's view is lit."""
    env = gym.make(env_id, render_mode="debug_rgb_array").unwrapped
    env.reset(seed=2, options={"spot_damage": 0, "light_dim_off_duration": 0})
    for step in range(12):
        for _ in range(4):
            observation, _, _, _, info = env.step([0, 0])
        frame = env.render()
        assert frame.shape == (336, 336, 3)
        assert frame.dtype == np.uint8
        view = observation.repeat(4, 0).repeat(4, 1)
        assert np.array_equal(frame[:16], view[:16])  # the bar
        circle = (frame == (0, 255, 0)).all(axis=-1)
        circle[:16] = False
        seen = (view[16:] > 0).any(axis=-1) & ~circle[16:]
        assert np.array_equal(frame[16:][seen], view[16:][seen])
        floor_shows = (observation[4:] == 255).all(axis=-1).sum() > 20
        assert circle.any() or not floor_shows
        for x, y in (info["ground_truth"] * 336).reshape(-1, 2):
            thing = frame[round(y) - 4 : round(y) + 4, round(x) - 4 : round(x) + 4].reshape(-1, 3)
            floor = {(255, 255, 255), (0, 0, 255), (255, 0, 0), (0, 255, 0)}
            assert {tuple(pixel) for pixel in thing.tolist()} - floor, step


def test_spotlights_show_what_they_light():
    """With a black floor, only the agent, the coin, the exit and the white rims of spotlights can be seen."""
    env = gym.make("SearingSpotlights-v0").unwrapped
    options = {"black_background": True, "spot_damage": 0, "initial_spawns": 12, "light_dim_off_duration": 0}
    env.reset(seed=3, options=options)
    colors = set()
    for _ in range(120):
        observation, *_ = env.step([0, 0])
        colors |= colors_of(observation[4:])
    rim, body, hand, coin, door = (255, 255, 255), (250, 204, 153), (50, 50, 50), (255, 165, 0), (55, 55, 55)
    assert colors <= {(0, 0, 0), rim, body, hand, coin, door}
    assert colors >= {(0, 0, 0), rim, body}


def test_nothing_painted_black_or_white_stays():
    """In the original, black_background and hide_chessboard last for as long as the environment."""
    env, fresh = gym.make("SearingSpotlights-v0"), gym.make("SearingSpotlights-v0")
    for option in ("black_background", "hide_chessboard"):
        first, _ = env.reset(seed=1, options={option: True})
        assert not (first[4:] == (0, 0, 255)).all(axis=-1).any()
        assert np.array_equal(env.reset(seed=2)[0], fresh.reset(seed=2)[0])


@SPOTLIGHTS
def test_visible_in_the_dark(env_id):
    """What the options make visible is drawn over the darkness, every step."""
    names = ["agent_visible", "coins_visible"] + ["exit_visible"] * ("Endless" not in env_id)
    env = gym.make(env_id).unwrapped
    env.reset(seed=4, options={**dict.fromkeys(names, True), "initial_spawns": 0})
    for _ in range(30):
        observation, _, over, _, _ = env.step([0, 0])
    colors = colors_of(observation[4:])
    assert not over
    assert colors >= {(0, 0, 0), (250, 204, 153), (255, 165, 0)}
    assert ((55, 55, 55) in colors) == ("exit_visible" in names)
