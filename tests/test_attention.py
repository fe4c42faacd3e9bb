"""benchmarks/attention.py: which steps showed what is looked for, and how much of the attention they get."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import attention
from memory_gym_envs.entries import vector_slices
from memory_gym_envs.players import player
from ppo_utils.checkpoints import Checkpoint
from ppo_utils.environments import envs_for

ROOT = Path(__file__).parents[1]


def agent_of(env_id):
    """The file of the task's transformer."""
    words = re.sub("([a-z])([A-Z])", r"\1-\2", env_id.removesuffix("-v0")).lower()
    return str(ROOT / f"agents/{words}-trxl.pt")


@pytest.mark.parametrize("env_id", attention.SUBJECTS)
def test_what_steps_showed_is_what_an_observer_of_the_vectors_saw(env_id):
    """The scripted player acts, some of the time; the observer counts the commands that were shown."""
    envs = gym.make_vec(env_id, num_envs=50, obs_type="vector")
    at = vector_slices(envs.unwrapped.variant.entries)
    watched = attention.Shown(envs, attention.SUBJECTS[env_id][1])
    obs, _ = watched.reset(seed=[*range(50)])
    seen, rng, found = [], np.random.default_rng(0), 0
    skill = np.linspace(0.2, 1, 50)
    count = np.zeros(50, int)  # commands shown so far
    before = np.zeros(50, bool)
    for _ in range(150):
        if "Mortar" in env_id:
            shows, burns = obs[:, at["command"]].any(1), obs[:, at["fire"]].any(1)
            count += shows & ~before
            seen.append(np.where(shows, count, 0))
            told = watched.unwrapped.oracle()
            length = (told["commands"] >= 0).sum(1)
            acts = (count == length) & ~shows & ~before & ~burns  # a step without a command follows each
            wanted = np.where(acts, length - told["commands_left"] + 1, -1)
            before = shows
        else:
            seen.append(obs[:, at["cross"]][:, 0].astype(int))
            wanted = np.ones(50, int)
        if len(seen) > 1:
            here = (wanted[:, None] == np.array(seen[:-1]).T) & watched.playing[:, None]
            there = watched.wanted_among(len(seen) - 1)
            assert (here == there).all()
            found += here.sum()
        right = player(watched.unwrapped)
        other = rng.integers(0, envs.single_action_space.nvec if right.ndim > 1 else 4, right.shape)
        obs, *_ = watched.step(np.where(rng.random(50) < skill, right.T, other.T).T)
    assert found > 100


@pytest.mark.parametrize("env_id", ["MortarMayhem-Grid-v0", "MysteryPath-Grid-v0"])
def test_shares_of_attention(env_id, monkeypatch):
    """Uniform attention gives what is looked for its share of the steps; a head that looks at nothing else, all."""
    checkpoint = Checkpoint.read(agent_of(env_id))
    envs = attention.Shown(envs_for(checkpoint.args, 20), attention.SUBJECTS[env_id][1])
    levels = [*range(20)]

    def weights(_, x, keys, age, mask):
        uniform = mask / mask.sum(-1, keepdim=True).clip(1)
        wanted = torch.from_numpy(envs.wanted_among(keys.shape[1]))[:, None] & mask
        return torch.stack([uniform, wanted / wanted.sum(-1, keepdim=True).clip(1), 1.0 * (age == 1) * mask], 1)

    monkeypatch.setattr(attention, "attention_weights", weights)
    torch.manual_seed(0)
    share, (heads,) = attention.attended(checkpoint.agent(envs, {}), envs, levels)
    assert heads[:2] == pytest.approx([share, 1.0], abs=1e-6)
    assert 0.02 < share < 0.2
    if "Mortar" in env_id:
        assert heads[2] == 0, "a blank step follows the last command"
    else:
        assert 0 < heads[2] < share, "a fall that has just been shown"


def test_weights_are_those_of_the_agent():
    """With queries of zero, its own attention is uniform."""
    checkpoint = Checkpoint.read(agent_of("MysteryPath-Grid-v0"))
    envs = attention.Shown(envs_for(checkpoint.args, 20), attention.falls)
    agent = checkpoint.agent(envs, {})
    agent.memory.blocks[0].attention.query.weight.data.zero_()
    share, (heads,) = attention.attended(agent, envs, [*range(20)])
    assert heads == pytest.approx([share] * 4, abs=1e-6)


@pytest.mark.slow
def test_what_the_page_says(capsys):
    """Of fewer levels; on other machines, rounding draws other actions, too."""
    page = (ROOT / "docs/results.md").read_text()
    (said,) = re.findall(r"\n(\| agent \| looked for .*?)\n\n", page, re.DOTALL)
    attention.main(attention.Config(tuple(map(agent_of, attention.SUBJECTS)), levels=30))
    here = capsys.readouterr().out.strip()
    numbers = [[int(number) for number in re.findall(r"\b\d+(?=,| %)", text)] for text in (said, here)]
    assert len(numbers[0]) == 30
    assert numbers[1] == pytest.approx(numbers[0], abs=10)
    assert re.sub(r"\d+", "", here) == re.sub(r"\d+", "", said)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ((), "^give agents of MortarMayhem-v0, "),
        (("mortar-mayhem-b-trxl",), "was trained in MortarMayhemB-v0; give agents"),
        (("mystery-path-gru",), "is no transformer; give agents that ppo_trxl.py trained"),
    ],
)
def test_who_cannot_be_asked(config, message):
    with pytest.raises(ValueError, match=message):
        attention.main(attention.Config(tuple(str(ROOT / f"agents/{name}.pt") for name in config)))


def test_levels_without_a_fall():
    checkpoint = Checkpoint.read(agent_of("MysteryPath-Grid-v0"))
    envs = attention.Shown(envs_for(checkpoint.args, 1), lambda s: (np.full(1, -1), np.zeros(1)))
    with pytest.raises(ValueError, match="no step could attend"):
        attention.attended(checkpoint.agent(envs, {}), envs, [0])
