"""ppo_utils.acting: an agent from a file, in a loop of one's own, acts as in its training and its evaluation."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import SCRIPTS
from test_environments import shows

import export_step
import ppo_gru
import ppo_trxl
from ppo_utils import acting, evaluation
from ppo_utils.acting import Player
from ppo_utils.environments import envs_for
from ppo_utils.errors import RunError
from ppo_utils.evaluation import evaluate

EVERYTHING = {"attend_commands": True, "frame_stack": 3, "step_encoding": True, "observe_last_action": True}
NESTED = shows(
    gym.spaces.Dict({"a": gym.spaces.Tuple((gym.spaces.Box(-1, 1, (2,)), gym.spaces.Discrete(3)))}),
    action_space=gym.spaces.MultiDiscrete([2, 3], start=[5, 0]),
)
TASKS = [
    ("MysteryPath-Grid-v0", {}),
    ("MortarMayhemB-v0", EVERYTHING),
    ("CartPole-v1", {**EVERYTHING, "ground_truth_coef": 0.0}),
    (NESTED, {"observe_last_action": True}),
]


@pytest.fixture
def trained(tiny):
    """Train an agent for one iteration, its heads' weights times `scale`; return the path of its model."""

    def train(script, scale=3, **changes):
        path = script.main(tiny(script, total_timesteps=64, save_model=True, **changes)) / "model.pt"
        saved = torch.load(path, weights_only=True)
        for name, weight in saved["weights"].items():
            if name.startswith("heads."):
                weight.mul_(scale)  # the policy then depends on what it sees
        torch.save(saved, path)
        return path

    return train


@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize(("env_id", "changes"), TASKS)
def test_it_acts_as_in_an_evaluation(trained, script, env_id, changes, monkeypatch):
    """The same episodes in single environments as in one lane of a vector environment, over two of them."""
    for module in (acting, evaluation):
        monkeypatch.setattr(module, "MEMORY_STEPS", 5)  # fewer than an episode has
    path, env = trained(script, env_id=env_id, **changes), gym.make(env_id)
    sampling, most_probable = Player(path), Player(path, deterministic=True)
    for player, seed in ((sampling, 3), (sampling, 8), (most_probable, 3)):
        torch.manual_seed(seed)
        expected = evaluate(player.agent, envs_for(player.args, 1), [seed], 100, deterministic=player is most_probable)
        torch.manual_seed(seed)
        observation, _ = env.reset(seed=seed)
        player.reset()
        rewards, done = [], False
        while not done and len(rewards) < 100:
            action = player.act(observation, rewards[-1] if rewards else 0.0)
            assert action in env.action_space
            observation, reward, terminated, truncated, _ = env.step(action)
            rewards.append(reward)
            done = terminated or truncated
        assert (sum(rewards), len(rewards)) == (pytest.approx(expected["return"][0]), expected["length"][0])


def test_auxiliary_heads_do_not_act(trained):
    path = trained(ppo_gru, env_id="MysteryPath-Grid-v0", ground_truth_coef=0.1, reconstruction_coef=0.1)
    player = Player(path)
    observation, _ = gym.make("MysteryPath-Grid-v0").reset(seed=1)
    assert type(player.act(observation)) is int


def test_an_observation_that_is_not_of_the_space(trained):
    player = Player(trained(ppo_gru, env_id="CartPole-v1"))
    with pytest.raises(RunError, match="CartPole-v1: observation has an entry nan"):
        player.act(np.full(4, np.nan, np.float32))


def test_an_observation_of_another_space(trained):
    player = Player(trained(ppo_gru, env_id="MysteryPath-Grid-v0", obs_type="vector"))
    for wrong in (np.zeros((84, 84, 3), np.uint8), {"a": 1}, None):
        with pytest.raises(ValueError, match=r"MysteryPath-Grid-v0: observation is of .* float32, \(16,\); make"):
            player.act(wrong)


@pytest.mark.parametrize(("script", "changes"), [
    (ppo_gru, {"num_layers": 2}), (ppo_gru, {"memory": "lstm"}), (ppo_gru, {"memory": "none"}),
    (ppo_trxl, {"trxl_positional_encoding": "learned", "trxl_query_position": True}),
    (ppo_trxl, {"trxl_positional_encoding": "relative", "trxl_gate": "gru", "trxl_layer_norm": "post"}),
])  # fmt: skip
def test_a_step_is_exported(trained, tmp_path, capsys, script, changes):
    """Over 20 steps of two episodes, a window of 7 included: the agent's own logits and values, to 1e-6."""
    path = str(trained(script, 1, env_id="MysteryPath-Grid-v0", value_init_gain=0.5, **changes))
    export_step.main(export_step.Config(path, str(tmp_path / "step.pt2")))
    written = capsys.readouterr().out.splitlines()[-1]
    step = torch.export.load(tmp_path / "step.pt2").module()
    player = Player(path)
    agent = player.agent
    beginning = export_step.STEPS[type(agent)](agent).beginning()
    assert all(f"{tuple(part.shape)} of {part.dtype}" in written for part in beginning)
    assert all(f"{name} (1, " in written for name in player.envs.observation_space)
    state = beginning
    memory = agent.memory.begin_rollout(agent.memory.initial(1, torch.device("cpu")), 64)
    envs = envs_for(player.args, 1)
    obs, _ = envs.reset(seed=1)
    for t in range(40):
        obs = {name: torch.from_numpy(part) for name, part in obs.items()}
        with torch.no_grad():
            y, hidden = agent.memory.step(memory, agent.encoder(obs))
            agent.memory.advance(memory, hidden)
            policy, value, _ = agent.heads(y, obs)
            found_logits, found_value, *state = step(obs, *state)
        for found_branch, branch in zip(found_logits, policy, strict=True):
            assert found_branch == pytest.approx(branch.logits, abs=1e-6), t
        assert found_value == pytest.approx(value, abs=1e-6), t
        obs, *_ = envs.step(np.array([[t % 4]]))
        if t == 25:  # a new episode: the state begins as it did
            agent.memory.reset(memory, torch.tensor([True]))
            state = beginning


def test_where_a_step_cannot_be_written(trained, tmp_path, monkeypatch):
    """It says so before the work."""
    path = str(trained(ppo_gru, 1, env_id="MysteryPath-Grid-v0"))
    monkeypatch.delattr(torch.export, "export")
    for out in (tmp_path, tmp_path / "none" / "step.pt2"):
        with pytest.raises(ValueError, match=f"^--out is {out}; give a file in a folder that is there$"):
            export_step.main(export_step.Config(path, str(out)))


def test_who_cannot_be_exported(trained, monkeypatch):
    monkeypatch.delitem(export_step.STEPS, ppo_gru.Agent)
    with pytest.raises(ValueError, match=r"only agents of ppo_gru.py and ppo_trxl.py can be exported"):
        export_step.main(export_step.Config(str(trained(ppo_gru, env_id="CartPole-v1"))))


@pytest.mark.parametrize("script", SCRIPTS)
def test_most_probable_actions(played, script):
    """Of each branch, with their log-probabilities; the memory moves on as it does with sampled ones."""
    _, run, *_ = played(script=script, env_id="MysteryPath-v0", weights_scale=3.0)
    agent, fresh = run.agent, run.agent.memory.initial(4, torch.device("cpu"))
    obs = {name: part[0] for name, part in run.rollout.obs.items()}
    states = [agent.memory.begin_rollout(fresh, 2) for _ in range(2)]
    with torch.no_grad():
        policy, values, _ = agent.heads(agent.memory.step(states[0], agent.encoder(obs))[0], obs)
        actions, log_probs, found = agent.get_action_and_value(obs, states[0], deterministic=True)
        agent.get_action_and_value(obs, states[1])
    wanted = [branch.logits.max(-1) for branch in policy]
    assert actions.equal(torch.stack([each.indices for each in wanted], -1))
    assert log_probs.equal(torch.stack([each.values for each in wanted], -1))
    assert found.equal(values)
    for name, part in agent.memory.carry(states[0]).items():
        assert part.equal(agent.memory.carry(states[1])[name])
