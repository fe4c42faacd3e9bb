"""benchmarks/episode_ends.py: what ended an episode, as the environments' own state has it."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import episode_ends
import evaluate
import ppo_gru
from memory_gym_envs.players import player


def test_falls_that_end_an_episode():
    """The same actions in environments whose ended episodes stay for a step: six of ten are the scripted player's."""
    make = {"id": "Endless-MysteryPath-v0", "num_envs": 200, "obs_type": "vector"}
    watched = episode_ends.LastFalls(gym.make_vec(**make))
    staying = gym.make_vec(**make, autoreset_mode=AutoresetMode.NEXT_STEP)
    watched.reset(seed=1), staying.reset(seed=1)
    s, rng = staying.unwrapped.state, np.random.default_rng(0)
    fell, behind = np.zeros((2, 200), bool)
    while watched.playing.any():
        actions = np.where(rng.random(200) < 0.6, player(watched.unwrapped), rng.integers(0, 4, 200))
        playing, furthest = watched.playing.copy(), s.max_column.copy()
        watched.step(actions)
        _, _, terminated, _, _ = staying.step(actions)
        assert (terminated[playing] == ~watched.playing[playing]).all()
        ended = playing & terminated
        fell |= ended & s.fallen
        behind |= ended & s.fallen & (s.tile[:, 0] < furthest)
    assert (watched.fell == fell).all()
    assert (watched.behind == behind).all()
    assert min(behind.sum(), (fell & ~behind).sum(), (~fell).sum()) > 5


@pytest.mark.parametrize("env_id", episode_ends.ENDS)
def test_what_is_said_of_an_agent(tiny, tmp_path, monkeypatch, capsys, env_id):
    monkeypatch.chdir(tmp_path)
    path = f"{ppo_gru.main(tiny(env_id=env_id, obs_type='vector', save_model=True))}/model.pt"
    play, played = evaluate.evaluate, []
    monkeypatch.setattr(evaluate, "evaluate", lambda *args: played.append((args[1], play(*args))) or played[-1][1])
    capsys.readouterr()
    episode_ends.main(episode_ends.Config((path,), levels=20))
    ((envs, numbers),) = played
    if env_id == "Endless-MysteryPath-v0":
        behind, again = (round(100 * np.mean(each)) for each in (envs.behind, envs.fell & ~envs.behind))
        told = f"{behind} % fall where they came further before, {again} % again at the same place"
    else:
        dead = round(100 * np.mean(numbers["agent_health"] == 0))
        coins, steps = (np.mean(numbers[name]) for name in ("coins_collected", "length"))
        told = f"{dead} % are without health; {coins:.2f} coins in {steps:.0f} steps"
        assert dead > 80
    assert capsys.readouterr().out == f"{path}: {told}\n"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "was trained in MysteryPath-v0; give agents of Endless-MysteryPath-v0 or Endless-SearingSpotlights-v0"),
        ({"checkpoints": ()}, "give agents of Endless-MysteryPath-v0 or Endless-SearingSpotlights-v0"),
        ({"levels": 0}, "--levels is 0; it must be 1 or more"),
    ],
)
def test_what_cannot_be_played(tiny, tmp_path, monkeypatch, changes, message):
    monkeypatch.chdir(tmp_path)
    path = f"{ppo_gru.main(tiny(env_id='MysteryPath-v0', obs_type='vector', save_model=True))}/model.pt"
    with pytest.raises(ValueError, match=message):
        episode_ends.main(episode_ends.Config(**{"checkpoints": (path,), **changes}))
