"""The network is table 6.2's, and takes what Gymnasium offers."""

import gymnasium as gym
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

import ppo_gru
import ppo_trxl
from ppo_gru import Agent, Args, AtariCNN
from ppo_utils import fast

PICTURE = gym.spaces.Box(0, 255, (84, 84, 3), np.uint8)
PIXELS = gym.spaces.Dict(observation=PICTURE)


def test_parameter_count_of_the_gru_agent_on_endless_mystery_path():
    agent = Agent(PIXELS, [4], Args())
    assert sum(p.numel() for p in agent.parameters()) == 4_048_549  # thesis 6.1.1: about 4.05 million


def test_parameter_counts_of_the_transformers():
    """Thesis 6.1.1 has 2.8 million, mostly since its author's code shares projections among heads; 9.4 with gates."""
    agents = [ppo_trxl.Agent(PIXELS, [4], ppo_trxl.Args(trxl_gate=gate)) for gate in ("none", "gru")]
    assert [sum(p.numel() for p in agent.parameters()) for agent in agents] == [4_226_597, 9_537_317]


@pytest.mark.parametrize("script", [ppo_gru, ppo_trxl])
def test_the_value_s_gain_at_initialization(script):
    """Orthogonal initialization scales one random row, so fresh values are proportional to the gain."""
    values = []
    for gain in (1.0, 0.25, 0.0):
        torch.manual_seed(1)
        agent = script.Agent(PIXELS, [4], script.Args(value_init_gain=gain))
        values.append(agent.heads(torch.linspace(-1, 1, 4 * agent.memory.width).reshape(4, -1), {})[1])
    torch.testing.assert_close(values[1], values[0] / 4)
    assert values[0].any()
    assert not values[2].any()


def test_sizes_of_table_6_2():
    agent = Agent(PIXELS, [3, 3], Args())
    assert agent.encoder.cnns[0](torch.zeros(2, 84, 84, 3, dtype=torch.uint8)).shape == (2, 3136)
    assert (agent.encoder.embedding.in_features, agent.encoder.embedding.out_features) == (3136, 512)
    assert (agent.memory.rnn.input_size, agent.memory.rnn.hidden_size, agent.memory.rnn.num_layers) == (512, 512, 1)
    both = gym.spaces.Dict(visual_observation=PICTURE, vector_observation=gym.spaces.Box(0, 1, (180,), np.float32))
    agent = Agent(both, [4], Args())
    assert (agent.encoder.mlp.in_features, agent.encoder.mlp.out_features) == (180, 128)
    assert agent.encoder.embedding.in_features == 3264


def test_without_an_embedding_the_memory_takes_the_encoded_observation():
    agent = Agent(PIXELS, [3, 3], Args(embedding=False))
    assert agent.encoder.embedding is None
    assert (agent.memory.rnn.input_size, agent.memory.rnn.hidden_size) == (3136, 512)
    agent = Agent(PIXELS, [3, 3], Args(embedding=False, memory="none"))
    assert agent.heads.trunk.in_features == 3136
    with pytest.raises(ValueError, match="--trxl-dim is 384; with --no-embedding it must be 3136 here"):
        ppo_trxl.Agent(PIXELS, [3, 3], ppo_trxl.Args(embedding=False))


def test_defaults_are_the_final_column_of_table_6_1():
    args = Args()
    final = {
        "num_levels": 100_000, "num_envs": 32, "num_steps": 512, "gamma": 0.995, "gae_lambda": 0.95,
        "update_epochs": 3, "num_minibatches": 8, "norm_adv": "none", "clip_coef": 0.1, "vf_coef": 0.5,
        "init_lr": 2.75e-4, "final_lr": 1e-5, "init_ent_coef": 1e-4, "final_ent_coef": 1e-6, "max_grad_norm": 0.25,
        "num_layers": 1, "memory": "gru", "hidden_size": 512, "anneal_steps": 163_840_000,
    }  # fmt: skip
    assert {name: getattr(args, name) for name in final} == final
    trxl = {
        "trxl_num_layers": 3, "trxl_dim": 384, "trxl_num_heads": 4, "trxl_memory_length": 256,
        "trxl_positional_encoding": "absolute", "trxl_layer_norm": "pre", "trxl_gate": "none",
    }  # fmt: skip
    assert {name: getattr(ppo_trxl.Args(), name) for name in trxl} == trxl


@pytest.mark.parametrize("script", [ppo_gru, ppo_trxl])
def test_the_optimizer(tiny, opened, script):
    """AdamW with torch's default decay for all weights, at the first learning rate."""
    run = opened(script, tiny(script, env_id="CueRecall-v0", init_lr=0.125))
    (optimizer,) = run.optimizers
    (group,) = optimizer.param_groups
    assert isinstance(optimizer, torch.optim.AdamW)
    assert {*group["params"]} == {*run.agent.parameters()}
    assert (group["weight_decay"], float(group["lr"]), group["betas"]) == (0.01, 0.125, (0.9, 0.999))
    assert group["eps"] == 1e-8


@pytest.mark.parametrize("script", [ppo_gru, ppo_trxl])
def test_muon_has_the_matrices_between_hidden_layers(tiny, opened, script):
    changes = {"env_id": "MortarMayhemB-Grid-v0", "reconstruction_coef": 0.1, "ground_truth_coef": 0.1}
    changes |= {"attend_commands": True}
    changes |= {"trxl_gate": "gru", "trxl_positional_encoding": "learned"} if script is ppo_trxl else {}
    run = opened(script, tiny(script, optimizer="muon", **changes))
    adamw, muon = run.optimizers
    assert (type(adamw), type(muon)) == (torch.optim.AdamW, fast.Muon)
    names = {weight: name for name, weight in run.agent.named_parameters()}
    (theirs,), (group,) = adamw.param_groups, muon.param_groups
    assert len(theirs["params"]) + len(group["params"]) == len(names)
    assert {*theirs["params"], *group["params"]} == {*names}
    common = {"encoder.embedding.weight", "heads.trunk.weight", "heads.policy.0.weight", "heads.value.0.weight"}
    common |= {"heads.scores.commands.0.weight"}
    blocks = [f"memory.blocks.{k}." for k in range(2)] if script is ppo_trxl else []
    inside = [f"attention.{each}" for each in ("query", "key", "value", "output")] + ["projection"]
    gates = ("merge_attention", "merge_projection")
    gate_layers = [f"{layer}_{of}" for layer in ("reset", "update", "candidate") for of in "xy"]
    inside += [f"{gate}.{each}" for gate in gates for each in gate_layers]
    assert {names[weight] for weight in group["params"]} == common | {f"{b}{i}.weight" for b in blocks for i in inside}
    assert (group["weight_decay"], group["momentum"], group["adjust_lr_fn"]) == (0.01, 0.95, "match_rms_adamw")
    assert (group["nesterov"], group["ns_steps"]) == (True, 5)
    assert (theirs["weight_decay"], theirs["betas"], theirs["eps"]) == (0.01, (0.9, 0.999), 1e-8)


def test_learning_rates(tiny, monkeypatch):
    """Muon's is three times AdamW's, all along its decay."""
    seen = {torch.optim.AdamW: [], fast.Muon: []}
    for kind in seen:
        rates, step = seen[kind], kind.step
        keep = lambda self, rates=rates, step=step: (rates.append(self.param_groups[0]["lr"]), step(self))  # noqa: E731
        monkeypatch.setattr(kind, "step", keep)
    ppo_gru.main(
        tiny(env_id="CueRecall-v0", optimizer="muon", trunk_size=16, init_lr=0.01, final_lr=0.0, anneal_steps=128)
    )
    assert seen[torch.optim.AdamW] == [0.01] * 4 + [0.005] * 4
    assert seen[fast.Muon] == pytest.approx([0.03] * 4 + [0.015] * 4)


@pytest.mark.parametrize("shape", [(8, 8), (24, 8), (8, 24)])
def test_muon_steps_as_the_library_s(shape):
    """Up to what bfloat16 rounds in the library; a shape's matrices at once, those without gradient left alone."""
    torch.manual_seed(0)
    ours, theirs = ([nn.Parameter(torch.zeros(shape)) for _ in range(3)] for _ in range(2))
    how = {"lr": 0.02, "weight_decay": 0.01, "adjust_lr_fn": "match_rms_adamw"}
    optimizers = fast.Muon(ours, **how), torch.optim.Muon(theirs, **how)
    for _ in range(4):
        before = ours[0].detach().clone()
        for mine, other in zip(ours[:2], theirs[:2], strict=True):
            mine.grad = torch.randn(shape)
            other.grad = mine.grad.clone()
        for optimizer in optimizers:
            optimizer.step()
        assert (ours[0] - before).square().mean().sqrt().item() == pytest.approx(0.2 * 0.02, rel=0.3)
    for mine, other in zip(ours[:2], theirs[:2], strict=True):
        assert (mine - other).norm() < 0.03 * other.norm()
    assert ours[2].eq(0).all()


def test_orthogonal_matrices():
    """Singular values near 1, whatever they were; each matrix by itself."""
    torch.manual_seed(0)
    scales = torch.tensor([1e-3, 1.0, 1e3])[:, None, None]
    found = fast.orthogonalize(torch.randn(3, 12, 5) * scales, (3.4445, -4.7750, 2.0315), 5)
    values = torch.linalg.svdvals(found)
    assert ((values > 0.6) & (values < 1.3)).all()


@pytest.mark.parametrize("memory", ["gru", "lstm"])
def test_initialization_of_recurrent_layers(memory):
    """Orthogonal with gain 1 where the matrices of all gates are stacked: columns have norm 1; biases are 0."""
    torch.manual_seed(0)
    rnn = ppo_gru.Memory(Args(memory=memory, hidden_size=64, num_layers=2), 64).rnn
    for name, parameter in rnn.named_parameters():
        if "bias" in name:
            assert parameter.eq(0).all()
        else:
            torch.testing.assert_close(parameter.T @ parameter, torch.eye(64), atol=1e-5, rtol=0)


def test_initialization_of_the_network():
    """Gains: square root of 2, 0.1 for the policy's last layer, 1 for the value's; biases are 0."""
    torch.manual_seed(0)
    agent = Agent(PIXELS, [4], Args())
    gains = {agent.encoder.embedding: 2, agent.heads.trunk: 2, agent.heads.policy[0]: 2, agent.heads.policy[2]: 0.01}
    for layer, square in {**gains, agent.heads.value[0]: 2, agent.heads.value[2]: 1}.items():
        weight = layer.weight if layer.weight.shape[0] <= layer.weight.shape[1] else layer.weight.T
        torch.testing.assert_close(weight @ weight.T, square * torch.eye(len(weight)), atol=1e-4, rtol=0)
        assert layer.bias.eq(0).all()


def test_the_spread_of_a_fresh_learned_encoding():
    """N(0, 1 / D): an encoding has a norm of about 1."""
    torch.manual_seed(0)
    memory = ppo_trxl.Memory(ppo_trxl.Args(trxl_positional_encoding="learned"), 384)
    assert memory.table.shape == (2049, 384)
    assert memory.table.std().item() == pytest.approx(384**-0.5, rel=0.01)


def test_the_gate_by_its_equations():
    """Those of Parisotto et al. (2020), section 3.2, as docs/thesis.md has them."""
    torch.manual_seed(0)
    gate = ppo_trxl.Gate(6, 2.0).double()
    x, y = torch.randn(2, 4, 3, 6, dtype=torch.float64)
    r = 1 / (1 + torch.exp(-(y @ gate.reset_y.weight.T + x @ gate.reset_x.weight.T)))
    z = 1 / (1 + torch.exp(-(y @ gate.update_y.weight.T + x @ gate.update_x.weight.T - 2.0)))
    h = torch.tanh(y @ gate.candidate_y.weight.T + (r * x) @ gate.candidate_x.weight.T)
    torch.testing.assert_close(gate(x, y), (1 - z) * x + z * h, atol=1e-12, rtol=0)


def test_chunks_do_not_change_the_features(monkeypatch):
    torch.manual_seed(0)
    cnn, pixels = AtariCNN(3), torch.randint(0, 256, (10, 84, 84, 3), dtype=torch.uint8)
    whole, sizes = cnn(pixels), []
    cnn.register_forward_pre_hook(lambda _, inputs: sizes.append(len(inputs[0])))
    monkeypatch.setattr(fast, "CHUNK", 3)
    torch.testing.assert_close(fast.in_chunks(cnn, pixels), whole)
    assert sizes == [3, 3, 3, 1]


def test_batches_are_rounded_up_in_bfloat16_which_changes_nothing():
    torch.manual_seed(0)
    agent = Agent(PIXELS, [4], Args(hidden_size=32, trunk_size=32))
    pixels = torch.randint(0, 256, (16, 1, 84, 84, 3), dtype=torch.uint8)
    obs, sizes, found = {"observation": pixels}, [], []
    agent.encoder.register_forward_pre_hook(lambda _, inputs: sizes.append(len(inputs[0]["observation"])))
    for count in (5, 16):
        agent.zero_grad()
        with torch.autocast("cpu", torch.bfloat16):
            x = fast.encode(agent.encoder, obs, torch.arange(count), fast.first_occurrences(obs))
        assert len(x) == count
        x[:5].square().sum().backward()
        found.append([x[:5], *(parameter.grad for parameter in agent.encoder.parameters())])
    assert sizes == [16, 16]
    for got, want in zip(*found, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=0)


LIST = {"observation": gym.spaces.Box(0, 1, (5,)), "commands": gym.spaces.Box(0, 1, (4, 3))}


@pytest.mark.parametrize(("script", "width"), [(ppo_gru, {"hidden_size": 8}), (ppo_trxl, {"trxl_dim": 8})])
def test_heads_read_a_list_row_by_row(script, width):
    """Attention with a query of the memory's output: a mean of the rows, by the softmax of their normalized scores."""
    torch.manual_seed(0)
    agent = script.Agent(gym.spaces.Dict(LIST), [3], script.Args(**width, trunk_size=6))
    x, lists = torch.randn(7, 8), {"commands": torch.rand(7, 4, 3)}
    hidden, last = agent.heads.scores["commands"][0], agent.heads.scores["commands"][2]
    scores = F.relu(x @ hidden.weight.T + hidden.bias) @ last.weight.T + last.bias
    scores = (scores - scores.mean(1, keepdim=True)) / (scores.var(1, correction=0, keepdim=True) + 1e-5).sqrt()
    weights = scores.exp() / scores.exp().sum(1, keepdim=True)
    read = sum(weights[:, [row]] * lists["commands"][:, row] for row in range(4))
    trunk = agent.heads.trunk
    wanted = F.relu(torch.cat([x, read], 1) @ trunk.weight.T + trunk.bias)
    torch.testing.assert_close(agent.heads(x, lists)[2], wanted)
    torch.testing.assert_close(last.weight @ last.weight.T, torch.eye(4), atol=1e-5, rtol=0)  # gain 1


def test_the_memory_does_not_see_a_list():
    """Nor do weights know of it, where an observation has none."""
    agent = Agent(gym.spaces.Dict(LIST), [3], Args(hidden_size=8))
    obs = {"observation": torch.rand(2, 5), "commands": torch.rand(2, 4, 3)}
    torch.testing.assert_close(agent.encoder(obs), agent.encoder({**obs, "commands": torch.zeros(2, 4, 3)}))
    bare = Agent(gym.spaces.Dict({"observation": LIST["observation"]}), [3], Args(hidden_size=8))
    assert {*agent.state_dict()} - {*bare.state_dict()} == {
        f"heads.scores.commands.{layer}.{kind}" for layer in (0, 2) for kind in ("weight", "bias")
    }


def test_heads_compute_in_float32_with_amp():
    torch.manual_seed(0)
    agent, x = Agent(PIXELS, [4], Args(hidden_size=32, trunk_size=32)), torch.randn(5, 32)
    wanted = agent.heads(x, {})
    with torch.autocast("cpu", torch.bfloat16):
        found = agent.heads(x, {})
    found, wanted = ([policy[0].logits, *others] for policy, *others in (found, wanted))
    for got, want in zip(found, wanted, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=0)


def test_bytes_are_scaled_to_one():
    torch.manual_seed(0)
    cnn, pixels = AtariCNN(3), torch.randint(0, 256, (2, 84, 84, 3), dtype=torch.uint8)
    torch.testing.assert_close(cnn(pixels), cnn(pixels / 255))
