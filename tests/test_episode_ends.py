"""benchmarks/episode_ends.py: what ended an episode, as the environments' own state has it."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import episode_ends
import evaluate
import learning
import ppo_gru
from memory_gym_envs.players import player
from ppo_utils.checkpoints import read_model


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
    play, calls = evaluate.evaluate, []

    def spy(agent, envs, levels, max_steps):
        calls.append((agent, envs, levels, play(agent, envs, levels, max_steps)))
        return calls[-1][-1]

    monkeypatch.setattr(episode_ends, "evaluate", spy)
    capsys.readouterr()
    episode_ends.main(episode_ends.Config((path,), levels=20))
    ((agent, envs, levels, played),) = calls
    weights = read_model(path)["weights"]
    assert all(weight.equal(weights[name]) for name, weight in agent.state_dict().items())
    assert levels == [*range(learning.FIRST_TEST_LEVEL, learning.FIRST_TEST_LEVEL + 20)]
    assert played["finished"].all()
    if env_id == "Endless-MysteryPath-v0":
        shares = (envs.behind, envs.fell & ~envs.behind, ~envs.fell)
        behind, again, never = (round(100 * np.mean(each)) for each in shares)
        told = f"{behind} % fall where they came further before, {again} % at the same place again, "
        told += f"{never} % do not fall"
    else:
        dead = round(100 * np.mean(played["agent_health"] == 0))
        coins, steps = (np.mean(played[name]) for name in ("coins_collected", "length"))
        told = f"{dead} % are without health; {coins:.2f} coins in {steps:.0f} steps"
        assert dead > 80
    assert capsys.readouterr().out == f"{path}: {told}\n"


@pytest.mark.slow
def test_what_the_page_says_of_two_agents(capsys):
    """On any machine, whose rounding draws other actions: three standard errors of the length are about 12 steps."""
    root = Path(__file__).parents[1]
    agents = [f"{root}/agents/endless-{task}-gru.pt" for task in ("mystery-path", "searing-spotlights")]
    episode_ends.main(episode_ends.Config(tuple(agents)))
    here = [int(number) for number in re.findall(r" (\d+) (?:%|steps)", capsys.readouterr().out)]
    page = (root / "docs/results.md").read_text()
    section = page[page.index("In Endless Mystery Path, after") : page.index("python benchmarks/episode_ends.py")]
    said = [int(number) for number in re.findall(r"\b(?!600)(\d+)\s(?:%|steps)", section)]
    assert here == pytest.approx(said, abs=12)
    assert len(said) == 5


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"checkpoints": ()}, "give agents of Endless-MysteryPath-v0, Endless-SearingSpotlights-v0"),
        ({"levels": 0}, "--levels is 0; it must be 1 or more"),
        ({}, "was trained in MysteryPath-v0; give agents of Endless-MysteryPath-v0, Endless-SearingSpotlights-v0"),
    ],
)
def test_what_cannot_be_played(config, message):
    path = str(Path(__file__).parents[1] / "agents/mystery-path-gru.pt")
    with pytest.raises(ValueError, match=message):
        episode_ends.main(episode_ends.Config(**{"checkpoints": (path,), **config}))
