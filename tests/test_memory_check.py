"""ppo_utils/memory_check.py: it names what is wrong in small wrong agents, and finds nothing in right ones."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn

import check_memory
from ppo_utils.memory_adapters import CleanRLAdapter, CleanRLTrXLAdapter, SB3Adapter, TorchRLAdapter
from ppo_utils.memory_check import STEPS, Adapter, check
from ppo_utils.memory_probes import DELAYS

ROOT = Path(__file__).parents[1]


class Right(Adapter):
    """A GRU that acts step by step and learns whole lanes, without a fault."""

    obs_shape = (5,)
    reach = STEPS

    def __init__(self):
        self.cell, self.head = nn.GRUCell(5, 8), nn.Linear(8, 4)
        for parameter in self.head.parameters():
            nn.init.normal_(parameter)

    def initial(self, lanes):
        return torch.zeros(lanes, 8)

    def forget(self, state, begins):
        return torch.where(begins[:, None], 0.0, state)

    def act(self, obs, state, begins):
        state = self.cell(obs, self.forget(state, begins))
        return *self.heads(state), state

    def heads(self, hidden):
        out = self.head(hidden)
        return out[..., :3], out[..., 3]

    def evaluate(self, obs, begins, stored):
        return self.unroll(obs, begins, stored[0])

    def unroll(self, obs, begins, state):
        hidden = []
        for now, begin in zip(obs, begins, strict=True):
            state = self.cell(now, self.forget(state, begin))
            hidden.append(state)
        return self.heads(torch.stack(hidden))

    def value(self, obs, state):
        return self.heads(self.cell(obs, state))[1]

    def reloaded(self):
        other = type(self)()
        other.cell.load_state_dict(self.cell.state_dict())
        other.head.load_state_dict(self.head.state_dict())
        return other


class LateReset(Right):  # as PufferLib #622
    def evaluate(self, obs, begins, stored):
        return self.unroll(obs, torch.cat([torch.zeros_like(begins[:1]), begins[:-1]]), stored[0])


class EarlyReset(Right):  # as JaxMARL #119: the done flag of the step itself, not of the one before
    def evaluate(self, obs, begins, stored):
        return self.unroll(obs, torch.cat([begins[1:], torch.zeros_like(begins[:1])]), stored[0])


class NoResetWhileActing(Right):  # as IsaacLab #3837
    def act(self, obs, state, begins):
        state = self.cell(obs, state)
        return *self.heads(state), state


class NoResetAtAll(NoResetWhileActing):
    def evaluate(self, obs, begins, stored):
        return self.unroll(obs, torch.zeros_like(begins), stored[0])


class FreshSequences(Right):  # as ray #2898: sequences of the update begin with zeros
    def evaluate(self, obs, begins, stored):
        return self.unroll(obs, begins, torch.zeros_like(stored[0]))


class PaddedInFront(Right):  # as ml-agents #5206: the stored state goes through padding first
    def evaluate(self, obs, begins, stored):
        return self.unroll(obs, begins, self.cell(torch.zeros_like(obs[0]), stored[0]))


class ResetOfAllLanes(Right):  # as IsaacLab #888
    def forget(self, state, begins):
        return state * 0 if begins.any() else state


class TimeAndLanesMixedUp(Right):
    def evaluate(self, obs, begins, stored):
        mixed = obs.flatten(0, 1).unflatten(0, obs.shape[1::-1]).transpose(0, 1)
        return self.unroll(mixed, begins, stored[0])


class StatisticsOverLanes(Right):
    def heads(self, hidden):
        return super().heads(hidden - hidden.mean(-2, keepdim=True))


class LeakingGradient(Right):  # values are right, since the state before is subtracted again
    def forget(self, state, begins):
        return state - torch.where(begins[:, None], state.detach(), 0.0)


class CutGradient(Right):
    def unroll(self, obs, begins, state):
        hidden = []
        for now, begin in zip(obs, begins, strict=True):
            state = self.cell(now, self.forget(state, begin).detach())
            hidden.append(state)
        return self.heads(torch.stack(hidden))


class MemoryOfItsOwn(Right):
    kept = None

    def act(self, obs, state, begins):
        if self.kept is None or len(self.kept) != len(obs):
            self.kept = torch.zeros_like(state)
        self.kept = self.cell(obs, self.forget(self.kept, begins))
        return *self.heads(self.kept), self.kept


class LostState(Right):
    def rollout(self, obs, begins, state):
        outputs, values, state, stored = super().rollout(obs, begins, state)
        return outputs, values, torch.zeros_like(state), stored


class ValueAfterReset(Right):
    def value(self, obs, state):
        return self.heads(self.cell(obs, torch.zeros_like(state)))[1]


class ValueMovesOn(Right):  # as rsl_rl #206
    def value(self, obs, state):
        state.copy_(self.cell(obs, state))
        return self.heads(state)[1]


class HalfSaved(Right):
    def reloaded(self):
        other = super().reloaded()
        nn.init.normal_(other.head.bias)
        return other


class NoMemory(Right):
    def initial(self, lanes):
        return torch.zeros(lanes, 8)

    def act(self, obs, state, begins):
        return *self.heads(self.cell(obs, state)), state

    def unroll(self, obs, begins, state):
        return self.heads(torch.stack([self.cell(now, state) for now in obs]))


class ResetOfTheFirstOfTwo(Right):
    """An episode of one step is followed by another that begins: only the first is seen."""

    def evaluate(self, obs, begins, stored):
        rising = begins & ~torch.cat([torch.zeros_like(begins[:1]), begins[:-1]])
        return super().evaluate(obs, rising, stored)


class NoResetAtTheBorder(Right):
    def rollout(self, obs, begins, state):
        within = begins.clone()
        within[0] = False
        return super().rollout(obs, within, state)


class CutGradientOfThePolicy(Right):
    def unroll(self, obs, begins, state):
        outputs, _ = CutGradient.unroll(self, obs, begins, state)
        return outputs, super().unroll(obs, begins, state)[1]


class NoGradient(Right):
    @torch.no_grad()
    def evaluate(self, obs, begins, stored):
        return super().evaluate(obs, begins, stored)


class FaintPolicy(NoResetAtAll):
    """The same fault where values are a thousand times as large as what the policy does."""

    def heads(self, hidden):
        outputs, values = super().heads(hidden)
        return 0.01 * outputs, 300 + 10 * values.detach() * 0


FAULTS = {
    LateReset: {"ratio one", "reset", "ends of episodes", "gradient"},
    EarlyReset: {"ratio one"},
    NoResetWhileActing: {"ratio one", "reset", "ends of episodes"},
    NoResetAtAll: {"reset", "ends of episodes", "gradient"},
    FreshSequences: {"stored state"},
    PaddedInFront: {"stored state"},
    ResetOfAllLanes: {"lanes"},
    TimeAndLanesMixedUp: {"ratio one", "lanes"},
    StatisticsOverLanes: {"lanes"},
    LeakingGradient: {"gradient"},
    CutGradient: {"gradient"},
    MemoryOfItsOwn: {"evaluation"},
    LostState: {"next rollout"},
    ValueAfterReset: {"time limit"},
    ValueMovesOn: {"time limit"},
    HalfSaved: {"saving"},
    NoMemory: {"memory"},
    ResetOfTheFirstOfTwo: {"reset"},
    NoResetAtTheBorder: {"next rollout"},
    CutGradientOfThePolicy: {"gradient"},
    NoGradient: {"gradient"},
    FaintPolicy: {"reset", "ends of episodes"},
}


class LearnedStart(Right):
    def __init__(self):
        super().__init__()
        self.start = nn.Parameter(torch.randn(8))

    def initial(self, lanes):
        return self.start.expand(lanes, -1)

    def forget(self, state, begins):
        return torch.where(begins[:, None], self.start, state)

    reloaded = Adapter.reloaded


class Codes(Right):
    """Observes an integer."""

    obs_shape = ()

    def __init__(self):
        super().__init__()
        self.table = nn.Embedding(7, 5)

    def observations(self, steps, lanes):
        return torch.randint(7, (steps, lanes))

    def act(self, obs, state, begins):
        return super().act(self.table(obs), state, begins)

    def unroll(self, obs, begins, state):
        return super().unroll(self.table(obs), begins, state)

    def value(self, obs, state):
        return super().value(self.table(obs), state)

    reloaded = Adapter.reloaded


class MaskedAction(Right):
    def heads(self, hidden):
        outputs, values = super().heads(hidden)
        return torch.cat([outputs, torch.full_like(values, -torch.inf)[..., None]], -1), 1000 + 0.01 * values


class ThreeStepsAgo(Right):
    """Remembers the observation of three steps ago, and no other."""

    reach = 3

    def initial(self, lanes):
        return torch.zeros(lanes, 4, 5)

    def forget(self, state, begins):
        return state * ~begins[:, None, None]

    def act(self, obs, state, begins):
        state = torch.cat([self.forget(state, begins)[:, 1:], obs[:, None]], 1)
        return *self.seen(state), state

    def seen(self, state):
        return self.heads(torch.tanh(state[:, 0]).repeat(1, 2)[:, :8])

    def unroll(self, obs, begins, state):
        found = []
        for now, begin in zip(obs, begins, strict=True):
            state = torch.cat([self.forget(state, begin)[:, 1:], now[:, None]], 1)
            found.append(self.seen(state))
        return tuple(torch.stack(each) for each in zip(*found, strict=True))

    def value(self, obs, state):
        return self.seen(torch.cat([state[:, 1:], obs[:, None]], 1))[1]


@pytest.fixture
def seeded():
    torch.manual_seed(0)


@pytest.mark.parametrize("kind", FAULTS)
def test_faults_are_named(kind, seeded):
    report = check(kind())
    assert FAULTS[kind] <= {finding.check for finding in report.failed}, str(report)


@pytest.mark.parametrize("kind", [Right, LearnedStart, Codes, MaskedAction, ThreeStepsAgo])
def test_right_agents_have_no_fault(kind, seeded):
    report = check(kind())
    assert not report.failed, str(report)


def test_wrong_shapes_are_told(seeded):
    agent = Right()
    agent.heads = lambda hidden: (hidden, hidden[..., :1])
    with pytest.raises(ValueError, match=r"outputs \(24, 4, 8\) need values \(24, 4\), not \(24, 4, 1\)"):
        check(agent)


def test_how_much_is_remembered(seeded):
    report = check(Right())
    assert report.gradient_reach == STEPS - 1
    assert report.dependence[0] > report.dependence[8] > 0


def test_what_a_report_says(seeded):
    text = str(check(LateReset()))
    assert "FAULT ratio one: the update computes something else (step 1, lane 0" in text
    assert "FAULT reset: in the update, an episode's first step is not that of a fresh agent (step 7, lane 1" in text
    assert "ok    evaluation: " in text
    assert "reaches 0 steps back in lane 0, not 23: what is further away is hardly learned" in str(check(CutGradient()))


def test_a_gradient_that_reaches_further_than_is_meant(seeded):
    adapter = Right()
    adapter.reach = 4
    assert "steps back in lane 0, not 4: it is not cut where it is meant to be" in str(check(adapter))


@pytest.mark.parametrize("critic", ["own", "shared", "without memory"])
def test_sb3_contribs_recurrent_policy_has_no_fault(critic, seeded):
    policies = pytest.importorskip("sb3_contrib.common.recurrent.policies")
    box, actions = gym.spaces.Box(-9, 9, (5,)), gym.spaces.Discrete(3)
    kinds = {"shared_lstm": critic == "shared", "enable_critic_lstm": critic == "own", "lstm_hidden_size": 16}
    policy = policies.RecurrentActorCriticPolicy(box, actions, lambda _: 1e-3, **kinds)
    with torch.no_grad():
        policy.action_net.weight.mul_(100)
    report = check(SB3Adapter(policy))
    assert not report.failed, str(report)
    assert report.gradient_reach == STEPS - 1


class LikeCleanRL(nn.Module):
    """The methods of CleanRL's recurrent agent."""

    def __init__(self):
        super().__init__()
        self.lstm, self.actor, self.critic = nn.LSTM(5, 8), nn.Linear(8, 3), nn.Linear(8, 1)

    def get_states(self, x, state, done):
        lanes, outputs = state[0].shape[1], []
        for now, ended in zip(x.unflatten(0, (-1, lanes)), done.view(-1, lanes), strict=True):
            state = tuple((1 - ended)[None, :, None] * part for part in state)
            y, state = self.lstm(now[None], state)
            outputs.append(y[0])
        return torch.cat(outputs), state

    def get_value(self, x, state, done):
        return self.critic(self.get_states(x, state, done)[0])


def test_an_agent_like_cleanrls_has_no_fault(seeded):
    report = check(CleanRLAdapter(LikeCleanRL(), (5,)))
    assert not report.failed, str(report)


class LikeCleanRLsTransformer(nn.Module):
    """The methods of CleanRL's transformer agent, whose attention weighs all steps equally that the mask leaves.

    empty: what it reads where the mask leaves none: "zeros", or, as CleanRL's, the mean over "all".
    """

    def __init__(self, empty):
        super().__init__()
        self.obs_shape, self.max_episode_steps, self.empty = (5,), 64, empty
        self.transformer = nn.Module()
        self.transformer.transformer_layers = nn.ModuleList([nn.Linear(5, 5)])
        self.actor_branches, self.critic = nn.ModuleList([nn.Linear(5, 3), nn.Linear(5, 2)]), nn.Linear(5, 1)

    def get_action_and_value(self, x, memory, mask, indices):
        hidden = mask if self.empty == "zeros" else mask | ~mask.any(1, keepdim=True)
        weights = hidden / hidden.sum(1, keepdim=True).clamp(min=1)
        read = (memory[:, :, 0] + torch.sin(indices)[..., None]) * weights[..., None]
        self.x = torch.tanh(self.transformer.transformer_layers[0](x + read.sum(1)))
        return None, None, None, self.critic(self.x)[:, 0], x.detach()[:, None]

    def get_value(self, x, memory, mask, indices):
        return self.get_action_and_value(x, memory, mask, indices)[3]


@pytest.mark.parametrize(
    ("empty", "faults"), [("all", {"ratio one", "reset", "time limit"}), ("zeros", {"time limit"})]
)
def test_what_is_wrong_in_cleanrls_transformer(empty, faults, seeded):
    report = check(CleanRLTrXLAdapter(LikeCleanRLsTransformer(empty), 8))
    assert {finding.check for finding in report.failed} == faults, str(report)
    assert "only in episodes' first steps" in str(report) or empty == "zeros"
    assert min(report.dependence[1], report.dependence[4]) > 0 == report.dependence[8], "a window of 7 earlier steps"


def test_what_cleanrls_transformer_averages_at_a_first_step(seeded):
    """What the episode remembers later; acting, nothing."""
    adapter, begins = CleanRLTrXLAdapter(LikeCleanRLsTransformer("all"), 8), torch.tensor([[True], [False], [False]])
    one, other = torch.randn(2, 3, 1, 5)
    other[0] = one[0]
    rollouts = [adapter.rollout(obs, begins, adapter.initial(1)) for obs in (one, other)]
    assert rollouts[0][0][0].equal(rollouts[1][0][0])
    updates = [
        adapter.evaluate(obs, begins, stored)[0] for obs, (*_, stored) in zip((one, other), rollouts, strict=True)
    ]
    assert not torch.allclose(updates[0][0], updates[1][0])


@pytest.mark.parametrize("kind", ["LSTMModule", "GRUModule"])
def test_torchrls_modules_need_states_of_zeros_where_an_episode_begins(kind, seeded):
    modules = pytest.importorskip("torchrl.modules")
    states = ["h", "c"][: 2 if kind == "LSTMModule" else 1]
    keys = {"in_keys": ["obs", *states], "out_keys": ["y", *(("next", name) for name in states)]}
    module = getattr(modules, kind)(input_size=5, hidden_size=8, **keys)
    report = check(TorchRLAdapter(module))
    assert not report.failed, str(report)
    faults = {finding.check for finding in check(TorchRLAdapter(module, primed=False)).failed}
    assert faults == {"ratio one", "stored state", "reset", "ends of episodes"}


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ("ppo_gru.py --hidden-size 16 --trunk-size 16", 0, "ok    ratio one"),
        ("ppo_gru.py --memory none --trunk-size 16 --hidden-size 16", 1, "FAULT memory: no earlier observation"),
    ],
)
def test_the_program(arguments, code, words, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["check_memory.py", *f"{ROOT}/{arguments}".split()])
    assert check_memory.main() == code
    assert words in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("ppo_lru.py", r"^there is no ppo_lru.py; give a script, such as ppo_gru.py$"),
        (f"{ROOT}/ppo_gru.py --hidden-size 0", r"^--hidden-size is 0; it must be 1 or more$"),
    ],
)
def test_the_program_without_a_script_or_with_wrong_flags(arguments, message, monkeypatch):
    monkeypatch.setattr("sys.argv", ["check_memory.py", *arguments.split()])
    with pytest.raises(ValueError, match=message):
        check_memory.main()


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [("ppo_gru.py", ImportError, "^mine$"), ("mygru.py", ValueError, r"mygru\.py must be named ppo_NAME\.py")],
)
def test_the_program_checks_the_script_that_is_named(tmp_path, monkeypatch, name, error, message):
    """Not that of the repository with the same name."""
    (tmp_path / name).write_text("raise ImportError('mine')")
    monkeypatch.setattr("sys.argv", ["check_memory.py", f"{tmp_path}/{name}"])
    monkeypatch.setattr("sys.path", [*sys.path])
    monkeypatch.delitem(sys.modules, "ppo_gru")
    with pytest.raises(error, match=message):
        check_memory.main()


@pytest.mark.parametrize("error", [ValueError, OSError, ImportError])
def test_what_a_memory_raises_keeps_its_traceback(monkeypatch, error):
    def torn(adapter):
        raise error("torn")

    monkeypatch.setattr("sys.argv", ["check_memory.py", f"{ROOT}/ppo_gru.py"])
    monkeypatch.setattr(check_memory, "check", torn)
    with pytest.raises(AssertionError, match=r"ppo_gru\.py has an error$") as raised:
        check_memory.main()
    assert isinstance(raised.value.__cause__, error)


# ---- probes ----


def returns(env_id, policy, episodes=200):
    """The returns of episodes in which policy(observations so far, of all episodes) chooses the action."""
    env, seen, found = gym.make(env_id).unwrapped, [], []
    for episode in range(episodes):
        obs, _ = env.reset(seed=episode)
        total, over = 0.0, False
        while not over:
            seen.append(obs)
            obs, reward, over, _, _ = env.step(policy(seen))
            total += reward
        seen.append(obs)
        found.append(total)
    return np.array(found)


def last_bit(seen, since=0):
    return next((int(obs.argmax()) for obs in reversed(seen[since:]) if obs.any()), 0)


@pytest.mark.parametrize("delay", DELAYS)
def test_recall_needs_as_many_steps_of_memory_as_it_says(delay):
    env_id = f"Recall-{delay}-v0"
    assert (returns(env_id, last_bit, 20) == 1).all()
    guessed = returns(env_id, lambda seen: last_bit(seen, -delay), 100).mean()
    assert abs(guessed - 0.5) < 3 * 0.05  # three standard errors


def test_leak_pays_only_what_the_episode_before_tells():
    assert returns("Leak-v0", last_bit)[1:].all()
    assert abs(returns("Leak-v0", lambda seen: 0).mean() - 0.5) < 0.1
