"""The invariants of a memory: what the update recomputes is what the rollout saw, and nothing leaks."""

import contextlib
import dataclasses
import math

import numpy as np
import pytest
import torch
from conftest import SMALL
from gymnasium.vector import AutoresetMode
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import ppo_gru
import ppo_trxl

RECURRENT = [
    {"memory": "gru"},
    {"memory": "gru", "num_layers": 2, "seq_len": 5},
    {"memory": "lstm"},
    {"memory": "lstm", "num_layers": 2, "seq_len": 5},
]
TRANSFORMER = [
    {"script": ppo_trxl, "trxl_positional_encoding": "absolute"},
    {"script": ppo_trxl, "trxl_positional_encoding": "relative", "trxl_gate": "gru", "trxl_segment_length": 5},
    {"script": ppo_trxl, "trxl_positional_encoding": "learned", "trxl_memory_length": 40, "trxl_query_position": True},
]
MEMORIES = [*RECURRENT, *TRANSFORMER, {"memory": "none"}]


def recompute(run):
    """Evaluate the whole rollout in one batch of pieces; return the pieces' steps, ratios and values."""
    rollout = run.rollout
    pieces = run.agent.memory.cut(rollout.terminated | rollout.truncated)
    steps = pieces.steps()
    obs = {name: part.flatten(0, 1)[steps] for name, part in rollout.obs.items()}
    policy, values, _ = run.agent.unroll(obs, None, pieces, rollout.memory)
    log_probs = ppo_gru.log_probs_of(policy, rollout.actions.flatten(0, 1)[steps])
    return steps, (log_probs - rollout.log_probs.flatten(0, 1)[steps]).exp(), values


@pytest.mark.parametrize("env_id", ["CueRecall-v0", "MortarMayhemB-Grid-v0", "Endless-MortarMayhem-v0"])
@pytest.mark.parametrize("memory", MEMORIES)
def test_ratio_is_one_for_every_sample(played, env_id, memory):
    # Three rollouts of 16 steps: episodes end inside them and go on from one to the next.
    _, run, *_ = played(iterations=3, weights_scale=3.0, env_id=env_id, **memory)
    rollout = run.rollout
    steps, ratio, values = recompute(run)
    assert (ratio - 1).abs().max() < 1e-5
    played_values = rollout.values.flatten(0, 1)[steps]  # up to 15, as the heads' weights were scaled up
    assert (values - played_values).abs().max() < 1e-5 * played_values.abs().max().clamp(min=1)
    if env_id == "CueRecall-v0":
        assert rollout.terminated.any()
        assert not rollout.terminated[-1].all()


@pytest.mark.parametrize("memory", MEMORIES)
def test_ratio_is_nearly_one_in_bfloat16(played, memory):
    args, run, *_ = played(iterations=3, weights_scale=3.0, env_id="MortarMayhemB-Grid-v0", amp=True, **memory)
    with ppo_gru.autocast(args, torch.device("cpu")):
        _, ratio, values = recompute(run)
    assert (ratio - 1).abs().max() < 5e-2
    assert values.dtype == run.rollout.log_probs.dtype == torch.float32


@pytest.mark.parametrize("script", [ppo_gru, ppo_trxl])
def test_ratio_is_nearly_one_when_compiled(played, script):
    """The rollout's four frames are not compiled, the update's 256 are."""
    changes = {"num_steps": 64, "num_minibatches": 1, "total_timesteps": 256, "weights_scale": 3.0}
    _, run, *_ = played(script=script, env_id="MortarMayhem-Grid-v0", compile=True, **changes)
    assert (recompute(run)[1] - 1).abs().max() < 1e-4
    plain = script.make_agent(run.envs, {}, script.Args(**{**SMALL[script], "cuda": False}), torch.device("cpu"))
    plain.load_state_dict(run.agent.state_dict())  # the same names: a checkpoint does not tell
    x = torch.randint(0, 256, (300, 84, 84, 3), dtype=torch.uint8)
    torch.testing.assert_close(run.agent.encoder({"observation": x}), plain.encoder({"observation": x}))


@pytest.mark.parametrize("memory", MEMORIES[:-1])
def test_ratio_error_sees_a_broken_memory(played, memory):
    """Guards the guard: with what the memory stored lost, the ratios are off."""
    _, run, *_ = played(iterations=3, weights_scale=3.0, env_id="CueRecall-v0", **memory)
    stored = run.rollout.memory
    (stored if memory in RECURRENT else stored.items).zero_()
    assert (recompute(run)[1] - 1).abs().max() > 1e-4


@pytest.mark.parametrize("memory", MEMORIES)
def test_bootstrap_value_is_the_next_step_s_value(played, memory):
    args, run, last_value, _ = played(iterations=2, env_id="CueRecall-v0", **memory)
    memory.get("script", ppo_gru).collect(run.agent, run.envs, run.play, run.rollout, args, None)
    torch.testing.assert_close(run.rollout.values[0], last_value, atol=1e-6, rtol=0)


@pytest.mark.parametrize("memory", RECURRENT)
def test_an_episode_begins_with_an_empty_memory(played, memory):
    rollout = played(env_id="CueRecall-v0", **memory)[1].rollout
    begins = rollout.terminated[:-1]
    assert begins.any()
    assert (rollout.memory[1:][begins] == 0).all()
    assert (rollout.memory[1:][~begins].abs().sum((-1, -2)) > 0).all(), "and goes on where none ended"
    assert (rollout.memory[0] == 0).all()


def gradients(agent):
    return torch.cat([parameter.grad.flatten() for parameter in agent.parameters() if parameter.grad is not None])


@pytest.mark.parametrize("memory", RECURRENT)
@pytest.mark.parametrize("fill", [1e6, float("nan")])
def test_padding_changes_nothing(played, memory, fill, monkeypatch):
    args, run, *_ = played(iterations=2, env_id="CueRecall-v0", **memory)
    run.agent.memory.packed = False  # as on a GPU; packed pieces have no padding
    rollout = run.rollout
    targets = rollout.rewards - rollout.values, rollout.rewards

    def learn():
        pieces = run.agent.memory.cut(rollout.terminated | rollout.truncated)
        assert pieces.length.min() < pieces.length.max(), "there is padding"
        run.agent.zero_grad()
        loss, _ = ppo_gru.minibatch_loss(run.agent, rollout, targets, pieces, 1e-3, args)
        loss.backward()
        return recompute(run)[1:], loss.detach(), gradients(run.agent)

    clean = learn()
    pad = ppo_gru.pad_sequence
    monkeypatch.setattr(ppo_gru, "pad_sequence", lambda x, batch_first: pad(x, batch_first, padding_value=fill))
    filled = learn()
    torch.testing.assert_close(filled[0], clean[0], atol=0, rtol=0)
    torch.testing.assert_close(filled[1], clean[1], atol=0, rtol=0)
    if math.isfinite(fill):  # the weights' gradient is a sum over all rows, and zero times NaN is NaN
        torch.testing.assert_close(filled[2], clean[2], atol=1e-8, rtol=1e-6)


@pytest.mark.parametrize("memory", RECURRENT)
def test_no_gradient_crosses_the_end_of_an_episode(played, memory):
    """The value of an episode's first step depends on that step alone, later ones on all steps of their piece."""
    _, run, *_ = played(env_id="CueRecall-v0", **memory)
    rollout = run.rollout
    pieces = run.agent.memory.cut(rollout.terminated | rollout.truncated)
    x = torch.randn(int(pieces.length.sum()), 32, requires_grad=True)
    y = run.agent.memory.unroll(x, pieces, rollout.memory)
    ends = pieces.length.cumsum(0)
    piece = int((pieces.length > 2).nonzero()[1, 0])
    first, last = int(ends[piece] - pieces.length[piece]), int(ends[piece] - 1)
    for output, inputs in ((first, [first]), (last, list(range(first, last + 1)))):
        (grad,) = torch.autograd.grad(y[output].sum(), x, retain_graph=True)
        assert grad.abs().sum(-1).nonzero()[:, 0].tolist() == inputs


def test_gru_equals_a_loop_over_cells():
    torch.manual_seed(0)
    memory = ppo_gru.Memory(ppo_gru.Args(hidden_size=8)).double()
    cell = torch.nn.GRUCell(8, 8).double()
    cell.load_state_dict({name.removesuffix("_l0"): value for name, value in memory.rnn.state_dict().items()})
    x, live = torch.randn(3, 6, 8).double(), torch.randn(3, 1, 8).double()
    y, after = memory.recur(x, live)
    h = live[:, 0]
    for t in range(6):
        h = cell(x[:, t], h)
        torch.testing.assert_close(y[:, t], h, atol=1e-12, rtol=0)
    torch.testing.assert_close(after[:, 0], h, atol=1e-12, rtol=0)


@pytest.mark.parametrize("memory", TRANSFORMER)
def test_an_episode_s_first_step_is_the_same_whatever_came_before(played, memory):
    _, run, *_ = played(iterations=2, env_id="CueRecall-v0", **memory)
    agent, live = run.agent, run.play.live
    obs = {"observation": torch.randn(4, 3)}
    fresh = agent.act(obs, agent.memory.initial(16, 4, torch.device("cpu")))[1]
    forgotten = agent.memory.reset(live, torch.tensor([True, True, True, False]))
    values = agent.act(obs, forgotten)[1]
    torch.testing.assert_close(values[:3], fresh[:3], atol=1e-6, rtol=0)
    assert (values[3] - fresh[3]).abs() > 1e-6


def test_the_encoder_sees_each_step_once_an_epoch_and_no_padding(played, monkeypatch):
    args, run, last_value, _ = played(env_id="CueRecall-v0")
    rows, runs = [], []
    run.agent.encoder.register_forward_pre_hook(lambda _, inputs: rows.append(len(inputs[0]["observation"])))
    for way in ("recur", "scan"):
        unroll = getattr(run.agent.memory, way)
        monkeypatch.setattr(run.agent.memory, way, lambda *given, unroll=unroll: (runs.append(1), unroll(*given))[1])
    ppo_gru.update(run.agent, run.learn, run.rollout, last_value, 0.0, args)
    assert sum(rows) == args.update_epochs * args.num_envs * args.num_steps
    assert len(runs) == args.update_epochs * args.num_minibatches, "all pieces of a minibatch at once"
    rows.clear()
    ppo_gru.collect(run.agent, run.envs, run.play, run.rollout, args, None)
    assert rows == [args.num_envs] * (args.num_steps + 1), "no loop over lanes"


@pytest.mark.parametrize("env_id", ["MysteryPath-Grid-v0", "MortarMayhemB-Grid-v0"])
def test_what_was_observed_before_is_encoded_once(played, env_id):
    """The same gradient as from every step's own observation, whose equals are found in all of its parts."""
    args, run, *_ = played(env_id=env_id, num_steps=32, reconstruction_coef=0.1)
    rollout, rows = run.rollout, []
    obs = [part.flatten(0, 1).flatten(1) for part in rollout.obs.values()]
    equal = torch.stack([(part[:, None] == part).all(-1) for part in obs]).all(0)  # (R, R)
    assert torch.equal(rollout.alike, equal.int().argmax(-1))
    distinct = len(rollout.alike.unique())
    assert distinct < 0.6 * len(rollout.alike)
    run.agent.encoder.register_forward_pre_hook(lambda _, inputs: rows.append(len(next(iter(inputs[0].values())))))
    pieces = run.agent.memory.cut(rollout.terminated | rollout.truncated)
    targets, found = 2 * (torch.randn(32, 4),), []
    for alike in (rollout.alike, None):
        run.agent.zero_grad()
        loss, _ = ppo_gru.minibatch_loss(
            run.agent, dataclasses.replace(rollout, alike=alike), targets, pieces, 1e-3, args
        )
        loss.backward()
        found.append((loss.detach(), gradients(run.agent)))
    assert rows == [distinct, len(rollout.alike)]
    torch.testing.assert_close(found[0], found[1], atol=1e-6, rtol=1e-4)


def test_a_long_episode_takes_no_more_memory_than_a_short_one(played):
    """5,000 steps of endless episodes: the same storage, bytes for pixels, a live memory of the same size."""
    changes = {"env_id": "Endless-MortarMayhem-v0", "env_options": '{"explosion_delay": [1000]}', "hidden_size": 4}
    args, run, *_ = played(num_envs=1, num_steps=50, num_minibatches=1, **changes)

    def storage():
        parts = {**run.rollout.obs, **{k: v for k, v in vars(run.rollout).items() if isinstance(v, torch.Tensor)}}
        return {name: (part.data_ptr(), part.shape, part.dtype) for name, part in parts.items()}

    before = storage()
    assert before["observation"][1:] == ((50, 1, 84, 84, 3), torch.uint8)
    for _ in range(99):
        ppo_gru.collect(run.agent, run.envs, run.play, run.rollout, args, None)
    assert run.play.lengths[0] > 900
    assert storage() == before
    assert run.play.live.shape == (1, 1, 4)


def test_a_long_episode_takes_no_more_of_the_window_s_memory_than_a_short_one(played):
    """5,000 steps of one endless episode, far beyond the window and the encodings' usual length."""
    changes = {"env_id": "Endless-MortarMayhem-v0", "env_options": '{"explosion_delay": [1000]}'}
    args, run, *_ = played(script=ppo_trxl, num_envs=1, num_steps=50, num_minibatches=1, **changes)
    run.play.live.steps.add_(4050)  # as if the episode had been going on for long; its window is still that of 50 steps

    def storage():
        live, stored = run.play.live, run.rollout.memory
        return [(part.data_ptr(), part.shape) for part in (live.keys, live.values, stored.items, stored.steps)]

    before = storage()
    for _ in range(19):
        ppo_trxl.collect(run.agent, run.envs, run.play, run.rollout, args, None)
        assert recompute(run)[1].sub(1).abs().max() < 1e-5
    assert run.play.live.steps > 5000
    assert storage() == before


def test_truncation_bootstraps_with_the_final_observation_and_the_memory_before_the_reset(played):
    changes = {"env_id": "Endless-MortarMayhem-v0", "env_options": '{"max_steps": 5}', "seed": 3}
    args, run, *_ = played(bootstrap_truncated=True, **changes)
    rollout = run.rollout
    assert rollout.truncated[4].all()
    assert not rollout.terminated.any()
    assert (rollout.truncation_values != 0).equal(rollout.truncated)
    # The same actions played again: the final observation, and the memory that five steps left behind.
    live = torch.zeros_like(rollout.memory[0])
    for t in range(5):
        *_, live, _ = run.agent.act({"observation": rollout.obs["observation"][t]}, live)
    envs = ppo_gru.make_envs(args, args.num_envs)
    ppo_gru.first_reset(envs, args.seed, {"max_steps": 5})
    for t in range(5):
        *_, infos = envs.step(rollout.actions[t].numpy())
    final = {"observation": torch.from_numpy(np.stack(infos["final_obs"]))}
    torch.testing.assert_close(rollout.truncation_values[4], run.agent.act(final, live)[1].detach(), atol=1e-6, rtol=0)
    assert (played(**changes)[1].rollout.truncation_values == 0).all()


def test_update_hands_the_rollout_to_gae(played, monkeypatch):
    args, run, last_value, _ = played(env_id="CueRecall-v0", gamma=0.9, gae_lambda=0.8)
    seen = {}
    gae = ppo_gru.gae
    monkeypatch.setattr(ppo_gru, "gae", lambda **given: (seen.update(given), gae(**given))[1])
    ppo_gru.update(run.agent, run.learn, run.rollout, last_value, 0.0, args)
    names = ("rewards", "values", "terminated", "truncated", "truncation_values")
    assert all(seen[name] is getattr(run.rollout, name) for name in names)
    assert (seen["last_value"] is last_value, seen["gamma"], seen["gae_lambda"]) == (True, 0.9, 0.8)


def test_an_environment_that_resets_in_the_next_step_is_refused(tiny, monkeypatch):
    envs = ppo_gru.gym.make_vec("CueRecall-v0", 4, vectorization_mode="sync")
    monkeypatch.setattr(ppo_gru, "make_envs", lambda *_: envs)
    with pytest.raises(ValueError, match="does not reset an ended episode in the same step"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0"))


def test_autoreset_is_in_the_same_step():
    for env_id in ("MortarMayhem-Grid-v0", "CueRecall-v0", "CartPole-v1"):
        envs = ppo_gru.make_envs(ppo_gru.Args(env_id=env_id), 2)
        assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
        envs.close()


@pytest.mark.parametrize("layers", [1, 2])
def test_the_gru_learns_as_the_library_s(layers):
    ours, library = (of(5, 5, layers, batch_first=True).double() for of in (ppo_gru.GRU, nn.GRU))
    ours.load_state_dict(library.state_dict())
    found = []
    for gru in (ours, library):
        generator = torch.Generator().manual_seed(3)
        shapes = [(length, 5) for length in (3, 9, 1, 9, 4)] + [(layers, 5, 5), (26, 5)]
        *pieces, state, wanted = (
            torch.randn(shape, dtype=torch.float64, generator=generator, requires_grad=True) for shape in shapes
        )
        packed = nn.utils.rnn.pack_sequence(pieces, enforce_sorted=False)
        if gru is ours:  # whose states are in the packed order
            y = gru.scan(packed.data, state[:, packed.sorted_indices], packed.batch_sizes.tolist())
            y = packed._replace(data=y)
        else:
            y, _ = gru(packed, state)
        y = torch.cat(nn.utils.rnn.unpack_sequence(y))
        (y * wanted).sum().backward()
        found.append([y, state.grad, *(piece.grad for piece in pieces), *(weight.grad for weight in gru.parameters())])
    for got, want in zip(*found, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-12)


def test_packed_or_padded_is_the_same(played):
    _, run, *_ = played(iterations=2, env_id="CueRecall-v0", num_layers=2)
    packed = recompute(run)
    run.agent.memory.packed = False
    for got, want in zip(packed, recompute(run), strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-6)


def moved(part, device):
    """A copy on the device of what is on a GPU when there is one."""

    def move(leaf):
        if isinstance(leaf, ppo_trxl.Timeline):
            return ppo_trxl.Timeline(leaf.items.to(device), leaf.steps.to(device))
        return leaf.to(device) if isinstance(leaf, torch.Tensor) else leaf

    return ppo_gru.each_leaf(move, part)


class OneDevice(TorchDispatchMode):
    """Fails where numbers go from the CPU to another device or back."""

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        found = operation(*args, **(kwargs or {}))
        devices = {x.device.type for x in tree_leaves((args, kwargs, found)) if isinstance(x, torch.Tensor)}
        assert len(devices) < 2, f"{operation} is given or returns tensors of {devices}"
        return found


@pytest.mark.parametrize("memory", MEMORIES)
def test_playing_and_learning_wait_for_no_device(played, monkeypatch, memory):
    """On the meta device, which has shapes and no numbers: whatever asked it for one would fail, as would a mixture.

    Nothing is copied to it either, except where the pieces' lengths differ from minibatch to minibatch.
    """
    heads = {"reconstruction_coef": 0.1, "ground_truth_coef": 0.1}
    script = memory.get("script", ppo_gru)
    args, run, *_ = played(env_id="MortarMayhemB-Grid-v0", iterations=2, **heads, **memory)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())  # knows no such device
    pieces = run.agent.memory.cut(run.rollout.terminated | run.rollout.truncated)
    agent = run.agent.to("meta")
    rollout = script.Rollout(**moved(vars(run.rollout) | {"alike": None}, "meta"))
    live, obs = moved(run.play.live, "meta"), {name: part[0] for name, part in rollout.obs.items()}
    if memory.get("trxl_positional_encoding") != "learned":  # it asks whether its table goes on
        with OneDevice(), torch.no_grad():
            agent.choose(obs, live)
    targets, ent_coef = 2 * (torch.zeros(16, 4, device="meta"),), torch.ones((), device="meta")
    optimizer = torch.optim.SGD(agent.parameters())
    for minibatch in pieces.minibatches(2):
        first, lengths = minibatch.first.to("meta"), tuple(minibatch.length.tolist())
        with OneDevice() if minibatch.even() else contextlib.nullcontext():
            script.descend(agent, optimizer, rollout, args, first, lengths, targets, ent_coef)
    assert minibatch.even() == (memory not in RECURRENT and "trxl_segment_length" not in memory)  # 16 is no 3 x 5
    assert all(parameter.grad.device.type == "meta" for parameter in agent.parameters())
