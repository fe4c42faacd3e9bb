"""The auxiliary heads (5.1.2, 5.1.3): what they compute, which steps they learn from, whom they teach."""

import dataclasses
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch.nn import functional as F

import ppo_gru
import ppo_trxl
from ppo_gru import Agent, Args, Decoder
from ppo_utils.checkpoints import read_model
from ppo_utils.environments import envs_for
from ppo_utils.errors import RunError

HEADS = {"reconstruction_coef": 0.1, "ground_truth_coef": 0.1}
SCRIPTS = pytest.mark.parametrize("script", [ppo_gru, ppo_trxl])
PROBES = pytest.mark.parametrize(("name", "part"), [("ground_truth", "estimator"), ("reconstruction", "decoder")])


def loss_of(script, args, run):
    """The loss of a whole rollout, its logs, and the gradients that it leaves."""
    pieces = run.agent.memory.cut(run.rollout.done)
    run.rollout.advantages.zero_()
    run.rollout.returns.zero_()
    run.agent.zero_grad()
    loss, logs = script.ppo_loss(run.agent, run.rollout, pieces, 0.0, args)
    loss.backward()
    return loss.detach(), logs, {name: p.grad for name, p in run.agent.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("shape", [(84, 84, 3), (84, 84, 16), (64, 64, 1), (61, 90, 3), (36, 37, 2)])
def test_the_decoder_reconstructs_pictures_of_the_observation_s_size(shape):
    decoder = Decoder(32, shape)
    assert decoder(torch.randn(2, 32)).shape == (2, *shape)
    assert [layer.out_channels for layer in decoder if hasattr(layer, "out_channels")] == [64, 32, shape[2]]


def test_the_decoder_is_the_transposed_encoder():
    decoder = Decoder(512, (84, 84, 3))
    sizes, x = [], torch.randn(1, 512)
    for layer in decoder:
        x = layer(x)
        if isinstance(layer, torch.nn.ConvTranspose2d | torch.nn.Unflatten):
            sizes.append(tuple(x.shape[1:]))
    assert sizes == [(64, 7, 7), (64, 9, 9), (32, 20, 20), (3, 84, 84)]


@SCRIPTS
def test_the_losses_are_means_over_real_steps(played, script):
    args, run, *_ = played(script=script, env_id="MortarMayhemB-Grid-v0", **HEADS)
    loss, logs, _ = loss_of(script, args, run)
    pieces = run.agent.memory.cut(run.rollout.done)
    order = pieces.flat_index()
    assert sorted(order.tolist()) == list(range(64))  # every step once, no padding
    obs = {name: part.flatten(0, 1)[order] for name, part in run.rollout.obs.items()}
    with torch.no_grad():
        actions = run.rollout.actions.flatten(0, 1)[order]
        features = run.agent.evaluate_actions(run.agent.encoder(obs), obs, actions, pieces, run.rollout.memory_state)[3]
        drawn = torch.sigmoid(run.agent.decoder(features))
        wanted = obs["visual_observation"] / 255
        truths = run.rollout.ground_truth.flatten(0, 1)[order]
        estimate_loss = (run.agent.estimator(features) - truths).square().mean()
    torch.testing.assert_close(logs["reconstruction_loss"], F.binary_cross_entropy(drawn, wanted))
    torch.testing.assert_close(logs["ground_truth_loss"], estimate_loss)
    parts = ("policy_loss", "value_loss", "reconstruction_loss", "ground_truth_loss")
    policy, value, drawn, estimated = (logs[name] for name in parts)
    torch.testing.assert_close(loss, policy + 0.5 * value + 0.1 * drawn + 0.1 * estimated)


@pytest.mark.parametrize("ends", [{}, {"num_envs": 1}], ids=str)
@SCRIPTS
def test_the_ground_truth_belongs_to_the_observation(played, script, ends):
    """The same actions, played again: what the infos said when an observation was handed out.

    Also where all environments end in the same step, as one does by itself.
    """
    few = {"num_steps": 32, "num_minibatches": 1}
    args, run, *_ = played(script=script, env_id="MortarMayhemB-Grid-v0", **few, **HEADS, **ends)
    assert not ends or run.rollout.done.all(1).any()
    envs = envs_for(args, args.num_envs, seed=args.seed)
    _, infos = envs.reset()
    assert run.rollout.done.any()
    for t in range(32):
        assert run.rollout.ground_truth[t].numpy() == pytest.approx(infos["ground_truth"])
        *_, infos = envs.step(run.rollout.actions[t].numpy())


@SCRIPTS
@PROBES
def test_a_probe_teaches_nobody_else(played, script, name, part):
    changes, found = {"script": script, "env_id": "MortarMayhem-Grid-v0", "num_steps": 6}, {}
    for detach in (False, True):
        args, run, *_ = played(**changes, **{f"{name}_coef": 10.0, "auxiliary_detach": detach})
        found[detach] = loss_of(script, args, run)[2]
    args, run, *_ = played(**changes)
    without = loss_of(script, args, run)[2]
    for name, gradient in without.items():
        assert found[True][name].equal(gradient), name
    assert not found[False]["encoder.embedding.weight"].equal(without["encoder.embedding.weight"])
    assert found[True][f"{part}.0.weight"].abs().sum() > 0


@SCRIPTS
def test_a_run_with_probes_is_the_run_without(tiny, curves, script):
    """To the last bit, however much the probes' losses weigh: the gradient's clipping does not see them."""
    args = tiny(script, env_id="MortarMayhem-Grid-v0", num_steps=8, total_timesteps=64, exp_name="without")
    probes = {"auxiliary_detach": True, "ground_truth_coef": 100.0, "reconstruction_coef": 100.0}
    without = curves(script.main(args))
    probed = curves(script.main(dataclasses.replace(args, exp_name="probed", **probes)))
    assert len(without["losses/loss"]) == 2, "the second one acts with weights that the first has changed"
    assert probed["losses/ground_truth_loss"][0][1] > 0
    assert probed["losses/reconstruction_loss"][0][1] > 0
    for curve in set(without) - {"losses/loss"}:
        assert probed[curve] == without[curve], curve


def test_heads_that_are_off_cost_nothing(played):
    plain = Agent(gym.spaces.Dict(observation=gym.spaces.Box(0, 255, (84, 84, 3), np.uint8)), [4], Args())
    assert plain.decoder is plain.estimator is None
    args, run, *_ = played(env_id="CueRecall-v0")
    assert run.rollout.ground_truth is None
    assert not {name for name in loss_of(ppo_gru, args, run)[1] if "reconstruction" in name or "truth" in name}


def test_a_head_can_be_added_to_a_trained_agent(tiny, opened):
    """A probe after the training (5.1.2): the agent is the saved one, the head is new."""
    (path,) = Path(ppo_gru.main(tiny(env_id="MortarMayhem-Grid-v0", save_model=True))).glob("model.pt")
    run = opened(ppo_gru, tiny(env_id="MortarMayhem-Grid-v0", load_model=str(path), ground_truth_coef=0.1))
    weights = read_model(path)["weights"]
    assert all(run.agent.state_dict()[name].equal(weight) for name, weight in weights.items())


@SCRIPTS
def test_both_losses_fall(tiny, scalars, script):
    changes = {"num_envs": 2, "num_steps": 8, "total_timesteps": 15 * 16, "anneal_steps": 0, "init_lr": 3e-3}
    curves = scalars(script.main(tiny(script, env_id="MortarMayhem-Grid-v0", vf_coef=0.0, **changes, **HEADS)))
    for name in ("reconstruction_loss", "ground_truth_loss"):
        losses = curves[f"losses/{name}"]
        assert np.mean(losses[-3:]) < 0.6 * losses[0], name


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"env_id": "CueRecall-v0", "ground_truth_coef": 0.1},
            "needs ground_truth in every info, of every reset and step; environment 0 reports none; use 0",
        ),
        ({"env_id": "CueRecall-v0", "reconstruction_coef": 0.1}, "needs an observation with one image, not 0"),
        ({"reconstruction_coef": -1.0}, "--reconstruction-coef is -1.0; it must be 0 or more"),
    ],
)
def test_heads_that_cannot_be(tiny, changes, message):
    with pytest.raises((ValueError, RunError), match=message):
        ppo_gru.setup(tiny(**changes))
