"""The invariants of a memory: what the update recomputes is what the rollout saw, and nothing leaks."""

import contextlib
import math
import weakref

import numpy as np
import pytest
import torch
from conftest import OTHERS, SCRIPTS, collect, parse_args
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

import ppo_gru
import ppo_trxl
import train_sps
from ppo_utils import fast
from ppo_utils.environments import envs_for
from ppo_utils.memory_adapters import ScriptAdapter
from ppo_utils.memory_check import STEPS, check

RECURRENT = [
    {"memory": "gru"},
    {"memory": "gru", "num_layers": 2, "seq_len": 5},
    {"memory": "lstm"},
    {"memory": "lstm", "num_layers": 2, "seq_len": 5},
    {"memory": "gru", "embedding": False},
]
TRANSFORMER = [
    {"script": ppo_trxl, "trxl_positional_encoding": "absolute"},
    {"script": ppo_trxl, "trxl_positional_encoding": "relative", "trxl_gate": "gru", "trxl_segment_length": 5},
    {"script": ppo_trxl, "trxl_positional_encoding": "learned", "trxl_memory_length": 40, "trxl_query_position": True},
    {"script": ppo_trxl, "trxl_memory_gradient": True, "trxl_segment_length": 5},
    {"script": ppo_trxl, "trxl_layer_norm": "post", "trxl_segment_length": 5},
]
for script in OTHERS:  # a copy of either script, with another memory
    (TRANSFORMER if hasattr(script.Args, "trxl_segment_length") else RECURRENT).append({"script": script})
WITH_MEMORY = [*RECURRENT, *TRANSFORMER]
# One of each kind: for tests of what lies outside of the memory, as the encoder and the end of an episode do.
FEW = [RECURRENT[1], RECURRENT[2], RECURRENT[4], TRANSFORMER[1], *({"script": script} for script in OTHERS)]
MEMORIES = [*WITH_MEMORY, {"memory": "none"}]


def each_memory(memories):
    """Run a test with each of these memories, named by what they are."""
    return pytest.mark.parametrize("memory", memories, ids=name_of)


def name_of(memory):
    return " ".join(str(getattr(value, "__name__", value)) for value in memory.values())


def recompute(run):
    """Evaluate the whole rollout in one batch of pieces; return the pieces' steps, ratios and values."""
    rollout = run.rollout
    pieces = run.agent.memory.cut(rollout.done.cpu())
    index = pieces.flat_index()
    obs = {name: part.flatten(0, 1)[index] for name, part in rollout.obs.items()}
    actions = rollout.actions.flatten(0, 1)[index]
    _, log_probs, values, _ = run.agent.evaluate_actions(
        run.agent.encoder(obs), obs, actions, pieces, rollout.memory_state
    )
    return index, (log_probs - rollout.log_probs.flatten(0, 1)[index]).exp(), values


@pytest.mark.parametrize("script", SCRIPTS)
def test_presets_and_network_flags_are_flags(script):
    for preset in script.PRESETS:
        parse_args(script, "--preset", preset)
    assert set(script.Memory.flags) <= set(vars(script.Args()))


@pytest.mark.parametrize(
    ("env_id", "obs_type", "memory"),
    [
        *(("CueRecall-v0", "pixels", memory) for memory in MEMORIES),  # episodes end inside a rollout
        *(("Endless-MortarMayhem-v0", "vector", memory) for memory in MEMORIES),  # longer than a window of 40
        *(("MortarMayhemB-Grid-v0", "pixels", memory) for memory in FEW),
        *(("MortarMayhemB-Grid-v0", "vector", {**memory, "attend_commands": True}) for memory in (FEW[0], FEW[3])),
    ],
    ids=lambda value: name_of(value) if isinstance(value, dict) else value,
)
def test_ratio_is_one_for_every_sample(played, env_id, obs_type, memory):
    # Three rollouts of 16 steps: episodes go on from one to the next.
    _, run, *_ = played(iterations=3, weights_scale=3.0, env_id=env_id, obs_type=obs_type, **memory)
    rollout = run.rollout
    index, ratio, values = recompute(run)
    error = (ratio - 1).abs().max()
    assert error < 1e-5, "learning does not recompute what acting computed: is the state before a step stored?"
    played_values = rollout.values.flatten(0, 1)[index]  # up to 15, as the heads' weights were scaled up
    assert (values - played_values).abs().max() < 1e-5 * played_values.abs().max().clamp(min=1)
    if env_id == "CueRecall-v0":
        assert rollout.done.any()
        assert not rollout.done[-1].all()


@each_memory(MEMORIES)
def test_ratio_is_nearly_one_in_bfloat16(played, memory):
    changes = {"env_id": "MortarMayhemB-Grid-v0", "obs_type": "vector", "attend_commands": True, "amp": True}
    _, run, *_ = played(iterations=3, weights_scale=3.0, **changes, **memory)
    with torch.autocast("cpu", torch.bfloat16):
        _, ratio, values = recompute(run)
    assert (ratio - 1).abs().max() < 5e-2
    assert values.dtype == run.rollout.log_probs.dtype == torch.float32


@each_memory(WITH_MEMORY)
def test_ratio_error_sees_a_broken_memory(played, memory):
    """Guards the guard: with what the memory stored lost, the ratios are off."""
    _, run, *_ = played(iterations=3, weights_scale=3.0, env_id="CueRecall-v0", **memory)
    for part in tree_leaves(vars(run.rollout.memory_state)):
        if isinstance(part, torch.Tensor) and part.is_floating_point():
            part.zero_()
    assert (recompute(run)[1] - 1).abs().max() > 1e-4


@each_memory(WITH_MEMORY)
def test_nothing_leaks_and_nothing_is_lost(tiny, memory):
    args = tiny(**memory)
    report = check(ScriptAdapter(memory.get("script", ppo_gru), args))
    assert not report.failed, str(report)
    if memory.get("script") in OTHERS:
        return  # how far the gradient reaches is that memory's own matter
    if hasattr(args, "trxl_segment_length"):
        reach = min(args.trxl_segment_length, STEPS) - 1 if args.trxl_memory_gradient else 0
    else:
        reach = (getattr(args, "seq_len", 0) or STEPS) - 1
    assert report.gradient_reach == reach


@each_memory(MEMORIES)
def test_bootstrap_value_is_the_next_step_s_value(played, memory):
    args, run, last_value, _ = played(iterations=2, env_id="CueRecall-v0", **memory)
    collect(memory.get("script", ppo_gru), run, args)
    torch.testing.assert_close(run.rollout.values[0], last_value, atol=1e-6, rtol=0)


def gradients(agent):
    return torch.cat([parameter.grad.flatten() for parameter in agent.parameters() if parameter.grad is not None])


@each_memory(RECURRENT)
@pytest.mark.parametrize("fill", [1e2, float("nan")])  # the product of 16 is still finite
def test_padding_changes_nothing(played, memory, fill, monkeypatch):
    script = memory.get("script", ppo_gru)
    args, run, *_ = played(iterations=2, env_id="CueRecall-v0", **memory)
    monkeypatch.setattr(script, "packed_gru", train_sps.padded_gru, raising=False)
    rollout = run.rollout
    rollout.advantages, rollout.returns = rollout.rewards - rollout.values, rollout.rewards

    def learn():
        pieces = run.agent.memory.cut(rollout.done)
        if pieces.length.min() == pieces.length.max():
            assert script in OTHERS, "there is padding"
            pytest.skip("its pieces have one length")
        run.agent.zero_grad()
        loss, _ = script.ppo_loss(run.agent, rollout, pieces, 1e-3, args)
        loss.backward()
        return recompute(run)[1:], loss.detach(), gradients(run.agent)

    clean = learn()
    pad = script.pad_sequence
    for module in (script, ppo_gru):  # where Pieces, and where padded_gru's are
        monkeypatch.setattr(module, "pad_sequence", lambda x, batch_first: pad(x, batch_first, padding_value=fill))
    filled = learn()
    assert filled[1].isfinite(), "padding was multiplied by zero, not masked"
    torch.testing.assert_close(filled[0], clean[0], atol=0, rtol=0)
    torch.testing.assert_close(filled[1], clean[1], atol=0, rtol=0)
    if math.isfinite(fill):  # the weights' gradient is a sum over all rows, and zero times NaN is NaN
        torch.testing.assert_close(filled[2], clean[2], atol=1e-8, rtol=1e-6)


def test_gru_equals_a_loop_over_cells():
    torch.manual_seed(0)
    memory = ppo_gru.Memory(ppo_gru.Args(hidden_size=8), 8).double()
    cell = torch.nn.GRUCell(8, 8).double()
    cell.load_state_dict({name.removesuffix("_l0"): value for name, value in memory.rnn.state_dict().items()})
    x, hidden = torch.randn(3, 6, 8).double(), torch.randn(3, 1, 8).double()
    y, after = memory.recur(x, hidden)
    h = hidden[:, 0]
    for t in range(6):
        h = cell(x[:, t], h)
        torch.testing.assert_close(y[:, t], h, atol=1e-12, rtol=0)
    torch.testing.assert_close(after[:, 0], h, atol=1e-12, rtol=0)


@pytest.mark.parametrize("packed", [True, False])
def test_the_encoder_sees_each_step_once_an_epoch_and_no_padding(played, monkeypatch, packed):
    args, run, *_ = played(env_id="CueRecall-v0")
    rows, runs = [], []
    run.agent.encoder.register_forward_pre_hook(lambda _, inputs: rows.append(len(inputs[0]["observation"])))
    unroll = ppo_gru.packed_gru if packed else train_sps.padded_gru
    monkeypatch.setattr(ppo_gru, "packed_gru", lambda *given: (runs.append(1), unroll(*given))[1])
    ppo_gru.update(run.agent, run.optimizers, run.rollout, 0.0, args)
    assert sum(rows) == args.update_epochs * args.num_envs * args.num_steps
    assert len(runs) == args.update_epochs * args.num_minibatches, "all pieces of a minibatch at once"
    rows.clear()
    collect(ppo_gru, run, args)
    assert rows == [args.num_envs] * (args.num_steps + 1), "no loop over lanes"


@pytest.mark.parametrize("env_id", ["MysteryPath-Grid-v0", "MortarMayhemB-Grid-v0"])
def test_equal_observations_are_encoded_once(played, env_id):
    """The same gradient as from every step's own observation; equal ones are so in all of their parts."""
    args, run, *_ = played(env_id=env_id, num_steps=32, reconstruction_coef=0.1)
    rollout, rows = run.rollout, []
    rollout.first_occurrence = fast.first_occurrences(rollout.obs)
    obs = [part.flatten(0, 1).flatten(1) for part in rollout.obs.values()]
    contents = [b"".join(part.numpy().tobytes() for part in parts) for parts in zip(*obs, strict=True)]
    assert rollout.first_occurrence.tolist() == [contents.index(each) for each in contents]
    distinct = len(rollout.first_occurrence.unique())
    assert distinct < 0.6 * len(rollout.first_occurrence)
    run.agent.encoder.register_forward_pre_hook(lambda _, inputs: rows.append(len(next(iter(inputs[0].values())))))
    pieces = run.agent.memory.cut(rollout.done)
    rollout.advantages, rollout.returns, found = *(2 * (torch.randn(32, 4),)), []
    for _ in range(2):
        run.agent.zero_grad()
        loss, _ = ppo_gru.ppo_loss(run.agent, rollout, pieces, 1e-3, args)
        loss.backward()
        found.append((loss.detach(), gradients(run.agent)))
        rollout.first_occurrence = None
    assert rows == [distinct, 128]
    torch.testing.assert_close(found[0], found[1], atol=1e-6, rtol=1e-4)


def test_a_long_episode_takes_no_more_memory_than_a_short_one(played):
    """300 steps of endless episodes: the same storage, bytes for pixels, a hidden state of the same size."""
    changes = {"env_id": "Endless-MortarMayhem-v0", "env_options": '{"explosion_delay": [1000]}', "hidden_size": 4}
    args, run, *_ = played(num_envs=1, num_steps=50, num_minibatches=1, **changes)

    def storage():
        parts = {**run.rollout.obs, **{k: v for k, v in vars(run.rollout).items() if isinstance(v, torch.Tensor)}}
        return {name: (part.shape, part.dtype) for name, part in parts.items() if name not in ("advantages", "returns")}

    before = storage()
    assert before["observation"] == ((50, 1, 84, 84, 3), torch.uint8)
    for _ in range(5):
        collect(ppo_gru, run, args)
    assert run.envs.episode_lengths[0] == 300
    assert storage() == before
    assert run.rollout.memory_state.hidden.shape == (1, 1, 4)


@pytest.mark.parametrize("encoding", ["absolute", "relative", "learned", "none"])
def test_a_long_episode_takes_no_more_of_the_window_s_memory_than_a_short_one(played, encoding):
    """5,000 steps of one endless episode, far beyond the window and the encodings' usual length."""
    changes = {"env_id": "Endless-MortarMayhem-v0", "env_options": '{"explosion_delay": [1000]}'}
    changes |= {"trxl_positional_encoding": encoding, "trxl_query_position": True}
    args, run, *_ = played(script=ppo_trxl, num_envs=1, num_steps=50, num_minibatches=1, **changes)
    # As if the episode had been going on for long; its window is still that of 50 steps.
    run.carry.memory["episode_step"] += 4900

    def storage():
        state, memory = run.rollout.memory_state, run.agent.memory
        parts = (*state.keys, *state.values, state.hidden, state.row_step, *memory.buffers(), *memory.parameters())
        return [part.shape for part in parts]

    before = storage()
    for _ in range(3):
        collect(ppo_trxl, run, args)
        assert recompute(run)[1].sub(1).abs().max() < 1e-5
    assert run.rollout.memory_state.episode_step > 5000
    assert storage() == before


def test_truncation_bootstraps_with_the_final_observation_and_the_memory_before_the_reset(played):
    changes = {"env_id": "Endless-MortarMayhem-v0", "env_options": '{"max_steps": 5}', "seed": 3}
    args, run, *_ = played(bootstrap_truncated=True, **changes)
    rollout = run.rollout
    assert rollout.done[4].all()
    assert (rollout.truncation_values != 0).equal(rollout.done)
    # The same actions played again: the final observation, and the memory that five steps left behind.
    state = run.agent.memory.begin_rollout(run.agent.memory.initial(4, torch.device("cpu")), 16)
    envs = envs_for(args, args.num_envs, seed=args.seed)
    envs.reset()
    with torch.no_grad():
        for t in range(5):
            run.agent.get_action_and_value({"observation": rollout.obs["observation"][t]}, state)
            *_, infos = envs.step(rollout.actions[t].numpy())
        final = {"observation": torch.from_numpy(np.stack([obs["observation"] for obs in infos["final_obs"]]))}
        value = run.agent.get_value(final, state)
    torch.testing.assert_close(rollout.truncation_values[4], value, atol=1e-6, rtol=0)
    assert (played(**changes)[1].rollout.truncation_values == 0).all()


def test_a_step_that_terminated_its_episode_is_not_bootstrapped(tiny, opened, monkeypatch):
    changes = {"env_id": "Endless-MortarMayhem-v0", "env_options": '{"max_steps": 5}', "num_envs": 2, "seed": 3}
    args = tiny(bootstrap_truncated=True, **changes)
    run = opened(ppo_gru, args)
    step = run.envs.step

    def terminate_too(actions):
        obs, rewards, _, truncated, infos = step(actions)
        return obs, rewards, truncated & [True, False], truncated, infos

    monkeypatch.setattr(run.envs, "step", terminate_too)
    collect(ppo_gru, run, args)
    assert run.rollout.done[4].all()
    assert (run.rollout.truncation_values[4] != 0).tolist() == [False, True]


def test_training_hands_the_rollout_to_gae(tiny, opened, monkeypatch):
    args = tiny(env_id="CueRecall-v0", gamma=0.9, gae_lambda=0.8, total_timesteps=64)
    run = opened(ppo_gru, args)
    seen, learned = [], {}
    gae, update = ppo_gru.gae, ppo_gru.update
    monkeypatch.setattr(ppo_gru, "gae", lambda *given: (seen.extend(given), gae(*given))[1])
    monkeypatch.setattr(ppo_gru, "update", lambda *given: (learned.update(vars(given[2])), update(*given))[1])
    ppo_gru.train(args, run)
    rewards, rollout, gamma, gae_lambda = seen
    assert rewards is rollout.rewards
    assert (gamma, gae_lambda) == (0.9, 0.8)
    assert learned["advantages"].equal(gae(*seen))
    assert learned["returns"].equal(gae(*seen) + rollout.values)


@pytest.mark.parametrize("script", SCRIPTS)
def test_one_rollout_at_a_time_is_in_memory(tiny, script, monkeypatch):
    alive, rollouts, collect = [], [], script.collect

    def watched(*given):
        alive.append([rollout() is not None for rollout in rollouts])
        found = collect(*given)
        rollouts.append(weakref.ref(found[0]))
        return found

    monkeypatch.setattr(script, "collect", watched)
    script.main(tiny(script, env_id="CueRecall-v0", total_timesteps=192))
    assert alive == [[], [False], [False, False]]


@pytest.mark.parametrize("layers", [1, 2])
def test_the_packed_gru_learns_as_the_library_s(layers):
    gru, found = nn.GRU(5, 5, layers, batch_first=True).double(), []
    lengths = [3, 9, 1, 9, 4]
    for ours in (True, False):
        generator = torch.Generator().manual_seed(3)
        shapes = [(sum(lengths), 5), (5, layers, 5), (sum(lengths), 5)]
        x, hidden, wanted = (
            torch.randn(shape, dtype=torch.float64, generator=generator, requires_grad=True) for shape in shapes
        )
        gru.zero_grad()
        if ours:
            y = fast.packed_gru(gru, x, torch.tensor(lengths), hidden)
        else:
            packed = nn.utils.rnn.pack_sequence(x.split(lengths), enforce_sorted=False)
            y = torch.cat(nn.utils.rnn.unpack_sequence(gru(packed, hidden.transpose(0, 1).contiguous())[0]))
        (y * wanted).sum().backward()
        found.append([y, hidden.grad, x.grad, *(weight.grad.clone() for weight in gru.parameters())])
    for got, want in zip(*found, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-12)


def test_packed_or_padded_is_the_same(played, monkeypatch):
    _, run, *_ = played(iterations=2, env_id="CueRecall-v0", num_layers=2)
    packed = recompute(run)
    monkeypatch.setattr(ppo_gru, "packed_gru", train_sps.padded_gru)
    for got, want in zip(packed, recompute(run), strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-6)


class NoQuestions(TorchDispatchMode):
    """Fails where the CPU asks the other device for numbers."""

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        found = operation(*args, **(kwargs or {}))
        given, made = ({x.device.type for x in tree_leaves(y) if isinstance(x, torch.Tensor)} for y in (args, found))
        assert not ("meta" in given and "cpu" in made), f"{operation} brings numbers back from {given}"
        return found


@each_memory(MEMORIES)
def test_acting_and_learning_ask_no_device_for_numbers(played, monkeypatch, memory):
    """On the meta device, which has shapes and no numbers: whatever asked it for one would fail."""
    heads = {"reconstruction_coef": 0.1, "ground_truth_coef": 0.1}
    script = memory.get("script", ppo_gru)
    args, run, *_ = played(env_id="MortarMayhemB-Grid-v0", iterations=2, num_steps=8, **heads, **memory)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())  # knows no such device
    pieces, agent = run.agent.memory.cut(run.rollout.done), run.agent.to("meta")
    on_cpu = {"episode_step", "row_step"}  # of the transformer's memory: what shapes depend on

    def moved(parts):
        move = {name: part for name, part in parts.items() if name not in on_cpu}
        return parts | tree_map(lambda part: part.to("meta") if isinstance(part, torch.Tensor) else part, move)

    rollout = run.rollout
    memory = type(rollout.memory_state)(**moved(vars(rollout.memory_state)))
    parts = {**vars(rollout), "memory_state": None, "first_occurrence": None}
    rollout = script.Rollout(**moved(parts) | {"memory_state": memory})
    obs = {name: part[0] for name, part in rollout.obs.items()}
    with NoQuestions(), torch.no_grad():
        state = agent.memory.begin_rollout(agent.memory.carry(memory), 16)
        agent.get_action_and_value(obs, state)
        agent.get_value(obs, state)
    optimizer = torch.optim.SGD(agent.parameters())
    assert fast.first_occurrences(rollout.obs) is None
    minibatch = next(iter(pieces.minibatches(2)))
    with NoQuestions():
        loss, _ = script.ppo_loss(agent, rollout, minibatch, 1e-3, args)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
        optimizer.step()
    assert all(parameter.grad.device.type == "meta" for parameter in agent.parameters())


REFRESHED = {
    "terminated": {"env_id": "CueRecall-v0"},
    "truncated": {"env_id": "Endless-MortarMayhem-v0", "env_options": '{"max_steps": 5}', "obs_type": "vector"},
    "neither": {"env_id": "Endless-MortarMayhem-v0", "obs_type": "vector"},
}


@pytest.mark.parametrize(
    ("ends", "amp", "memory"),
    [
        *(("terminated", False, memory) for memory in MEMORIES),
        *(("neither", False, memory) for memory in MEMORIES),  # longer than a window of 40
        *(("truncated", False, memory) for memory in FEW),
        *(("terminated", True, memory) for memory in FEW),
    ],
    ids=lambda value: name_of(value) if isinstance(value, dict) else str(value),
)
def test_refreshing_with_the_weights_that_acted_changes_nothing(played, ends, amp, memory):
    args, run, *_ = played(iterations=3, amp=amp, **REFRESHED[ends], **memory)
    assert ends == "neither" or run.rollout.done.any()
    before = vars(run.rollout.memory_state)
    refreshed = memory.get("script", ppo_gru).refreshed_state(run.agent, run.rollout, args)
    for name, now in vars(refreshed).items():
        leaves = zip(tree_leaves(now), tree_leaves(before[name]), strict=True)
        same = [each.equal(other) if torch.is_tensor(each) else each == other for each, other in leaves]
        assert all(same), f"{name}: does carry hold all that a rollout begins with?"


@pytest.mark.parametrize("script", SCRIPTS)
def test_the_next_rollout_goes_on_with_the_refreshed_state(tiny, opened, script, monkeypatch):
    refreshed, refreshed_state = [], script.refreshed_state
    monkeypatch.setattr(
        script, "refreshed_state", lambda *given: refreshed.append(refreshed_state(*given)) or refreshed[-1]
    )
    args = tiny(script, env_id="CueRecall-v0", refresh_memory=True, update_epochs=3, total_timesteps=64, init_lr=1e-2)
    run = opened(script, args)
    script.train(args, run)
    for name, part in run.agent.memory.carry(refreshed[-1]).items():
        assert run.carry.memory[name].equal(part)
    one, other = (run.agent.memory.carry(state) for state in refreshed[:2])
    assert any(not part.equal(other[name]) for name, part in one.items())


@each_memory(WITH_MEMORY)
def test_a_refreshed_state_is_that_of_a_rollout_with_the_present_weights(played, memory):
    """The same observations and actions, played again from the same start by the changed agent."""
    script = memory.get("script", ppo_gru)
    args, run, *_ = played(iterations=3, weights_scale=2.0, env_id="CueRecall-v0", **memory)
    rollout, agent = run.rollout, run.agent
    with torch.no_grad():
        for parameter in agent.parameters():
            parameter.mul_(0.9)
    rollout.memory_state = script.refreshed_state(agent, rollout, args)
    _, ratio, values = recompute(run)
    assert not torch.allclose(ratio, torch.ones(()), atol=1e-4), "the policy is another one"
    # Steps one by one, from what was stored before the rollout.
    with torch.no_grad():
        state = agent.memory.begin_rollout(rollout.initial_memory, args.num_steps)
        wanted = []
        for t in range(args.num_steps):
            _, _, value = agent.get_action_and_value({name: part[t] for name, part in rollout.obs.items()}, state)
            wanted.append(value)
            agent.memory.reset(state, rollout.done[t])
    index, _, values = recompute(run)
    torch.testing.assert_close(values, torch.stack(wanted).flatten()[index], rtol=0, atol=1e-5)


@pytest.mark.parametrize("script", SCRIPTS)
def test_memory_is_refreshed_before_every_epoch_but_the_first(tiny, script, monkeypatch):
    calls, refreshed_state, ppo_loss = [], script.refreshed_state, script.ppo_loss
    monkeypatch.setattr(script, "refreshed_state", lambda *given: calls.append("r") or refreshed_state(*given))
    monkeypatch.setattr(script, "ppo_loss", lambda *given: calls.append("l") or ppo_loss(*given))
    changes = {"env_id": "CueRecall-v0", "update_epochs": 3, "total_timesteps": 64}
    script.main(tiny(script, refresh_memory=True, **changes))
    assert "".join(calls) == "llrllrll"


@pytest.mark.parametrize(
    ("reads", "script", "changes"),
    [
        (False, ppo_gru, {}),
        (False, ppo_gru, {"memory": "lstm"}),
        (True, ppo_gru, {"seq_len": 3}),
        (True, ppo_trxl, {}),
        (False, ppo_trxl, {"trxl_memory_gradient": True}),
        (True, ppo_trxl, {"trxl_memory_gradient": True, "trxl_segment_length": 3}),
    ],
)
def test_which_updates_read_refreshed_state(tiny, opened, reads, script, changes):
    """As docs/memory.md says: the first update is another one where it reads what was refreshed."""
    changes |= {"env_id": "Endless-MortarMayhem-v0", "obs_type": "vector", "total_timesteps": 64, "init_lr": 1e-2}
    weights = []
    for refresh in (False, True):
        args = tiny(script, refresh_memory=refresh, num_minibatches=1, **changes)
        run = opened(script, args)
        script.train(args, run)
        weights.append(torch.cat([weight.flatten() for weight in run.agent.state_dict().values()]))
    assert weights[0].equal(weights[1]) == (not reads)
