"""The network is table 6.2's, and takes what Gymnasium offers."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import ppo_gru
import ppo_trxl
from ppo_gru import Agent, Args, AtariCNN, action_branches, observation_spaces, to_env_actions

PIXELS = gym.spaces.Box(0, 255, (84, 84, 3), np.uint8)


def test_parameter_count_of_the_gru_agent_on_endless_mystery_path():
    agent = Agent(PIXELS, gym.spaces.Discrete(4), Args())
    assert sum(p.numel() for p in agent.parameters()) == 4_048_549  # thesis 6.1.1: about 4.05 million


def test_parameter_counts_of_the_transformers():
    """Thesis 6.1.1 has 2.8 million, with projections of a head's width that all heads share, and 9.4 with gates."""
    agents = [ppo_trxl.Agent(PIXELS, gym.spaces.Discrete(4), ppo_trxl.Args(trxl_gate=gate)) for gate in ("none", "gru")]
    assert [sum(p.numel() for p in agent.parameters()) for agent in agents] == [4_226_597, 9_537_317]


def test_sizes_of_table_6_2():
    agent = Agent(PIXELS, gym.spaces.MultiDiscrete([3, 3]), Args())
    assert agent.encoder.cnns[0](torch.zeros(2, 84, 84, 3, dtype=torch.uint8)).shape == (2, 3136)
    assert (agent.encoder.embedding.in_features, agent.encoder.embedding.out_features) == (3136, 512)
    assert (agent.memory.rnn.input_size, agent.memory.rnn.hidden_size, agent.memory.rnn.num_layers) == (512, 512, 1)
    both = gym.spaces.Dict(visual_observation=PIXELS, vector_observation=gym.spaces.Box(0, 1, (180,), np.float32))
    agent = Agent(both, gym.spaces.Discrete(4), Args())
    assert (agent.encoder.mlp.in_features, agent.encoder.mlp.out_features) == (180, 128)
    assert agent.encoder.embedding.in_features == 3264


def test_fourier_features_of_a_vector():
    x, root = torch.tensor([[0.25, 1.0]]), 0.5**0.5
    wanted = torch.tensor([[0.25, 1.0, root, 1.0, 0.0, 0.0, root, 0.0, -1.0, 1.0]])
    torch.testing.assert_close(ppo_gru.with_frequencies(x, 2), wanted, atol=1e-6, rtol=0)
    assert ppo_gru.with_frequencies(x, 0).equal(x)
    vector = gym.spaces.Box(0, 1, (16,), np.float32)
    agent = Agent(vector, gym.spaces.Discrete(4), Args(vector_frequencies=4))
    assert agent.encoder.mlp.in_features == 144


def test_defaults_are_the_final_column_of_table_6_1():
    args = Args()
    final = {
        "num_levels": 100_000, "num_envs": 32, "num_steps": 512, "gamma": 0.995, "gae_lambda": 0.95,
        "update_epochs": 3, "num_minibatches": 8, "norm_adv": False, "clip_coef": 0.1, "vf_coef": 0.5,
        "init_lr": 2.75e-4, "final_lr": 1e-5, "init_ent_coef": 1e-4, "final_ent_coef": 1e-6, "max_grad_norm": 0.25,
        "num_layers": 1, "memory": "gru", "hidden_size": 512, "anneal_steps": 163_840_000,
    }  # fmt: skip
    assert {name: getattr(args, name) for name in final} == final


def test_chunks_do_not_change_the_features():
    torch.manual_seed(0)
    cnn, pixels = AtariCNN(3), torch.randint(0, 256, (10, 84, 84, 3), dtype=torch.uint8)
    whole = cnn(pixels)
    cnn.chunk = 3
    torch.testing.assert_close(cnn(pixels), whole)


def test_rows_are_rounded_up_in_bfloat16_and_change_nothing():
    torch.manual_seed(0)
    agent = Agent(PIXELS, gym.spaces.Discrete(4), Args(hidden_size=32, head_size=32))
    pixels = torch.zeros(16, 84, 84, 3, dtype=torch.uint8)
    pixels[:5] = torch.randint(0, 256, (5, 84, 84, 3))
    taken, found = [], []
    agent.encoder.cnns[0].register_forward_pre_hook(lambda _, inputs: taken.append(len(inputs[0])))
    for rows in (5, 16):
        agent.zero_grad()
        with torch.autocast("cpu", torch.bfloat16):
            policy, values, features = agent.heads(agent.encoder({"observation": pixels[:rows]}))
        assert [len(part) for part in (policy[0].logits, values, features)] == [rows, rows, rows]
        parts = [part[:5] for part in (policy[0].logits, values, features)]
        sum(part.float().square().sum() for part in parts).backward()
        gradients = [parameter.grad for name, parameter in agent.named_parameters() if "memory" not in name]
        found.append([*parts, *gradients])
    assert taken == [16, 16]
    for got, want in zip(*found, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=0)
    assert len(ppo_gru.rounded_up(pixels[:5])) == 5, "float32 kernels take any size"


def test_bytes_are_scaled_to_one():
    assert AtariCNN.scale(torch.full((1, 2, 4, 3), 255, dtype=torch.uint8)).max() == 1
    assert AtariCNN.scale(torch.zeros(1, 2, 4, 3, dtype=torch.uint8)).shape == (1, 3, 2, 4)


def test_actions_as_the_environments_take_them():
    actions = torch.tensor([[2], [0]])
    assert to_env_actions(actions, gym.spaces.Discrete(3)).tolist() == [2, 0]
    assert to_env_actions(actions, gym.spaces.Discrete(3, start=5)).tolist() == [7, 5]
    assert to_env_actions(torch.tensor([[2, 1]]), gym.spaces.MultiDiscrete([3, 2])).tolist() == [[2, 1]]
    assert action_branches(gym.spaces.MultiDiscrete([3, 2])) == [3, 2]


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Discrete(3),
        gym.spaces.Box(0, 1, (84, 84), np.float32),
        gym.spaces.Box(0, 255, (20, 20, 3), np.uint8),
        gym.spaces.Box(0, 255, (84, 84, 3), np.float32),
        gym.spaces.Dict(a=gym.spaces.Text(3)),
    ],
)
def test_unsupported_observations(space):
    with pytest.raises(ValueError, match="is not supported; use pixels"):
        observation_spaces(space)


@pytest.mark.parametrize("space", [gym.spaces.Box(-1, 1, (2,)), gym.spaces.MultiBinary(3)])
def test_unsupported_actions(space):
    with pytest.raises(ValueError, match="is not supported; use Discrete"):
        action_branches(space)
