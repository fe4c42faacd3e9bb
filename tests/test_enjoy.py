"""enjoy.py: what the page holds is what happened, and in a browser it goes where one clicks."""

import base64
import dataclasses
import functools
import importlib
import io
import json
import os
import re
import runpy
import shutil
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from PIL import Image
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.actions.action_builder import ActionBuilder
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait
from test_environments import register

import enjoy
import memory_gym_envs
import ppo_gru
import ppo_trxl
from memory_gym_envs.character import PAD
from memory_gym_envs.mystery_path.state import ROWS
from ppo_utils.environments import as_tensors, envs_for, is_memory_gym
from ppo_utils.errors import RunError
from ppo_utils.evaluation import make_agent
from ppo_utils.scores import own_metric

AGENTS = {
    "GRU": (ppo_gru, {"env_id": "MysteryPath-Grid-v0", "reconstruction_coef": 0.1, "ground_truth_coef": 0.1}),
    "LSTM": (ppo_gru, {"env_id": "MortarMayhemB-v0", "memory": "lstm"}),
    "no memory": (ppo_gru, {"env_id": "MysteryPath-v0", "memory": "none", "frame_stack": 4, "step_encoding": True}),
    "TrXL": (ppo_trxl, {"env_id": "MortarMayhem-Grid-v0", "ground_truth_coef": 0.1}),
    "GTrXL": (ppo_trxl, {"env_id": "SearingSpotlights-v0", "obs_type": "vector", "trxl_gate": "gru", "amp": True}),
    "CartPole": (ppo_gru, {"env_id": "CartPole-v1"}),
}


@pytest.fixture
def saved(tiny):
    """Save an agent with random weights as model.pt, and return its arguments."""

    def save(script=ppo_gru, path="model.pt", **changes):
        args = tiny(script, **{"env_id": "MysteryPath-Grid-v0", **changes})
        torch.manual_seed(1)
        envs = envs_for(args, 1)
        _, infos = envs.reset(seed=1)
        agent = make_agent(script.Agent, envs, infos, args)
        with torch.no_grad():  # the initial policy hardly depends on its input
            for parameter in agent.heads.parameters():
                parameter.mul_(3)
        saved = {"script": script.__name__, "args": dataclasses.asdict(args), "weights": agent.state_dict()}
        torch.save(saved, path)
        return args

    return save


def played(seed=3, max_steps=30, env_options=None):
    agent, envs, _ = enjoy.load("model.pt", env_options)
    return enjoy.play(agent, envs, seed, max_steps)


def data_of(page):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)[1])


def page_of(**config):
    """What the page of this command holds."""
    enjoy.main(enjoy.Config(**{"checkpoint": "model.pt", "seed": 3, "max_steps": 30, **config}))
    return data_of(Path("page.html").read_text())


def command(*words):
    """What the command ends with, which Python prints to stderr, with exit code 1."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["enjoy.py", *words])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(enjoy.__file__, run_name="__main__")
    return end.value.code


def weights_of(page):
    """The attention weights (T, K, H, M) of an episode on the page."""
    attention = page["attention"]
    packed = np.frombuffer(base64.b64decode(attention["weights"]), np.uint8)
    return (packed.reshape(-1, attention["blocks"], attention["heads"], attention["window"]) / 255) ** 2


def state_of(page):
    """The memory's states (P, D, T) of an episode on the page."""
    state = page["state"]
    packed = np.frombuffer(base64.b64decode(state["levels"]), np.uint8).astype(float)
    units = packed.reshape(len(state["largest"]), state["units"], -1)
    return (units - 128) / 127 * np.array(state["largest"])[:, None, None]


def picture(url):
    """The pixels (h, w, 3) of a data URL."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB"))


def frames_of(video):
    """The frames (T, h, w, 3) of a video on the page."""
    shape = (-1, video["height"], video["width"], 3)
    return np.concatenate([picture(sheet).reshape(shape) for sheet in video["sheets"]])


# ---- what is recorded ----
@pytest.mark.parametrize("name", AGENTS)
def test_every_kind_of_agent(name, saved):
    script, changes = AGENTS[name]
    args = saved(script, **changes)
    line = enjoy.main(enjoy.Config("model.pt", seed=3, max_steps=30))
    (page,) = data_of(Path("page.html").read_text())["episodes"]
    steps = page["steps"]
    assert line.startswith(f"page.html: {steps} steps, return {page['facts']['return']}, ")
    assert page["facts"]["memory"].split(",")[0] == ("GRU" if name == "CartPole" else name)
    assert all(len(each) == steps for each in (page["actions"], page["rewards"], *page["lines"].values()))
    names = ["rendered frame" if name in ("GTrXL", "CartPole") else "agent's view"]
    names += ["ground truth"] * (name != "CartPole") + ["reconstruction"] * bool(args.reconstruction_coef)
    assert [video["name"] for video in page["videos"]] == names
    assert all(len(frames_of(video)) == steps for video in page["videos"])
    assert len(page["truth"]) == steps * (name != "CartPole")
    assert len(page["estimate"]) == steps * bool(args.ground_truth_coef)
    assert (page["attention"] is not None) == (script is ppo_trxl)
    assert (page["state"] is not None) == (name in ("GRU", "LSTM", "CartPole"))
    if page["state"]:
        assert state_of(page).shape == (1 + (name == "LSTM"), args.hidden_size, steps)
    for branch in page["branches"]:
        assert np.allclose(np.sum(branch["probabilities"], 1), 1, atol=1e-4)
        assert len(branch["actions"]) == len(branch["probabilities"][0])


@pytest.mark.parametrize("flags", [{}, {"trxl_query_position": True}], ids=str)
def test_the_episode_is_the_agents(flags, saved, monkeypatch):
    """Played again with the agent's own `act`: the same pictures, numbers and attention, step for step."""
    saved(ppo_trxl, env_id="MortarMayhem-Grid-v0", **flags)
    agent, envs, _ = enjoy.load("model.pt")
    episode = enjoy.play(agent, envs, 3, 60)
    page = enjoy.episode_data(episode, "MortarMayhem-Grid-v0", {})
    view, truth = map(frames_of, page["videos"])
    used, forward = [], ppo_trxl.Attention.forward

    def noted(attention, x, keys, values, age, seen):
        used.append(enjoy.attention_weights(attention, x, keys, age, seen)[0, :, 0])
        return forward(attention, x, keys, values, age, seen)

    monkeypatch.setattr(ppo_trxl.Attention, "forward", noted)
    torch.manual_seed(3)
    obs, infos = envs.reset(seed=3)
    memory, cpu = agent.memory.begin_rollout(agent.memory.initial(1, torch.device("cpu")), 60), torch.device("cpu")
    for t, actions in enumerate(episode.actions):
        assert np.array_equal(view[t], obs["observation"][0])
        envs.unwrapped.render_mode = "debug_rgb_array"
        assert np.array_equal(truth[t], envs.render()[0])
        assert np.array_equal(episode.truth[t], infos["ground_truth"][0])
        with torch.no_grad():
            used.clear()
            taken, log_probs, value = agent.get_action_and_value(as_tensors(obs, cpu), memory)
        assert episode.values[t] == value.item()
        assert episode.policy[t][0][actions[0]] == pytest.approx(log_probs.exp().item())
        assert np.array_equal(episode.attention[t], torch.stack(used).numpy())
        assert taken.tolist() == [actions]
        obs, rewards, terminated, truncated, infos = envs.step(taken.numpy())
        assert episode.rewards[t] == rewards[0]
        assert (terminated | truncated)[0] == (episode.finished and t == len(episode.actions) - 1)
    assert episode.finished
    assert episode.final["length"] == len(episode.actions)


def test_the_entropy_is_that_of_all_branches(saved):
    saved(env_id="MortarMayhem-v0", obs_type="vector")
    episode = played()
    for branches, entropy in zip(episode.policy, episode.entropies, strict=True):
        assert len(branches) == 2
        assert entropy == pytest.approx(-sum((p * np.log(p)).sum() for p in branches), rel=1e-5)


MOVES = {"left": (-1, 0), "right": (1, 0), "up": (0, -1), "down": (0, 1), "none": (0, 0)}
FACINGS = {"none": 0, "turn left": 2, "turn right": 6, "forward": 0}  # counter-clockwise from above, in eighths


@pytest.mark.parametrize("env_id", memory_gym_envs.IDS)
def test_actions_do_what_the_page_calls_them(env_id):
    """From the middle of the field, and on a grid from facing up; in Mortar Mayhem once a command has been shown."""
    env = gym.make(env_id).unwrapped
    shown = 5 if "MortarMayhem-" in env_id else 0
    options = {"command_count": [1]} if shown and "Endless" not in env_id else {}
    sizes = getattr(env.action_space, "nvec", [getattr(env.action_space, "n", 0)])
    idle = np.zeros(len(sizes), int)
    names = enjoy.branch_names(env_id, [np.ones(size) for size in sizes])
    for branch, (_, actions) in enumerate(names.items()):
        for action, name in enumerate(actions):
            env.reset(seed=1, options=options)
            for _ in range(shown):
                env.step(idle if len(sizes) > 1 else 0)
            s = env.batch.state
            s.pos[:] = 42 + PAD
            s.facing[:] = 0
            choice = np.where(np.arange(len(sizes)) == branch, action, 0)
            env.step(choice if len(sizes) > 1 else action)
            moved = tuple(np.sign(s.pos[0] - 42 - PAD).tolist())
            if "forward" in actions:
                assert (int(s.facing[0]), moved == (0, -1)) == (FACINGS[name], name == "forward"), name
            else:
                assert moved == MOVES[name], name


@pytest.mark.parametrize("env_id", memory_gym_envs.IDS)
def test_ids_with_their_namespace(env_id):
    name = f"memory_gym_envs/{env_id}"
    assert is_memory_gym(name)
    assert own_metric(name) == own_metric(env_id)
    assert enjoy.family_of(name) == enjoy.family_of(env_id) is not None
    branches = [np.ones(3), np.ones(3)] if "MultiDiscrete" in str(gym.make(env_id).action_space) else [np.ones(4)]
    assert enjoy.branch_names(name, branches) == enjoy.branch_names(env_id, branches)


def test_seed_is_the_level_and_the_actions(saved):
    saved()
    first, again, other = (played(seed).actions for seed in (3, 3, 4))
    assert first == again != other


def test_default_level_was_not_trained_on(saved, tmp_path):
    saved(num_levels=7, start_level=5)
    (page,) = page_of(seed=None, max_steps=2)["episodes"]
    facts = {"agent": f"{tmp_path.name}/model.pt", "memory": "GRU, 1 x 32 units", "actions": "sampled", "seed": 12}
    assert page["facts"] == facts | {"steps": 2, "return": "0", "cut short": "after 2 steps"}


def test_most_probable_actions(saved):
    saved(env_id="MortarMayhem-v0", obs_type="vector")
    (page,) = page_of(deterministic=True, max_steps=40)["episodes"]
    agent, envs, _ = enjoy.load("model.pt")
    obs, _ = envs.reset(seed=3)
    memory = agent.memory.begin_rollout(agent.memory.initial(1, torch.device("cpu")), 40)
    states = []
    for actions in page["actions"]:
        with torch.no_grad():
            taken, *_ = agent.get_action_and_value(as_tensors(obs, torch.device("cpu")), memory, True)
        assert taken.tolist() == [actions]
        states.append(memory.hidden[0].numpy())
        obs, *_ = envs.step(np.array([actions]))
    assert page["state"] == enjoy.packed_states(states)
    assert page["facts"]["actions"] == "most probable"
    assert page_of(max_steps=40)["episodes"][0]["actions"] != page["actions"]


SHORT = {"command_count": [2], "command_show_duration": [1], "command_show_delay": [0]}


def test_options_go_over_those_of_the_training(saved):
    saved(env_id="MortarMayhem-Grid-v0", env_options='{"command_count": [3], "arena_size": 4}')
    page = page_of(env_options=json.dumps(SHORT))
    assert page["options"] == {**SHORT, "arena_size": 4}
    assert page["episodes"][0]["events"]["command shown"] == [0, 1]
    assert page_of()["options"] == {"command_count": [3], "arena_size": 4}
    with pytest.raises(ValueError, match="--env-options is no JSON"):
        page_of(env_options="{")


@pytest.mark.parametrize(
    ("env_id", "name", "value", "shown"),
    [
        ("MortarMayhem-Grid-v0", "carried_out", 1.0, "100 %"),
        ("Endless-MortarMayhem-v0", "carried_out", 1.0, "1"),
        ("SearingSpotlights-v0", "coins_collected", 0.5, "50 %"),
        ("Endless-SearingSpotlights-v0", "coins_collected", 2.0, "2"),
        ("Endless-SearingSpotlights-v0", "agent_health", 0.25, "25 %"),
        ("MysteryPath-v0", "success", 1.0, "1"),
    ],
)
def test_shares_and_counts(env_id, name, value, shown):
    episode = enjoy.Episode(rewards=[1.0], final={name: value, "length": 1.0}, finished=True)
    assert enjoy.outcome(episode, env_id)[name.replace("_", " ")] == shown


def named_truth(env_id, seed):
    """The ground truth of a level's first step by the names on the page, and the state that it is of."""
    env = gym.make(env_id).unwrapped
    _, info = env.reset(seed=seed)
    episode = enjoy.Episode(policy=[[np.ones(3), np.ones(3)]], actions=[[0, 0]], truth=[info["ground_truth"]])
    data = enjoy.episode_data(episode, env_id, {})
    return dict(zip(data["truth_names"], data["truth"][0], strict=True)), env.batch.state


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("env_id", memory_gym_envs.IDS)
def test_what_the_ground_truth_is_called(env_id, seed):
    truth, s = named_truth(env_id, seed)
    if "MortarMayhem" in env_id:
        x, y = s.target_corner[0] - s.target_corner.min()
        assert list(truth) == ["column", "row"]
        assert np.sign(truth["column"] - truth["row"]) == np.sign(x - y)
    elif "MysteryPath" in env_id:
        directions = {ROWS: "right", -1: "up", 1: "down", -ROWS: "left"}
        assert [name for name, hot in truth.items() if hot] == [directions[s.path_cell[0, 2] - s.path_cell[0, 1]]]
    else:
        places = {"agent": s.bodies[:, 0, 0], "coin": s.targets[0, :2], "exit": s.targets[0, 2:]}
        for name, value in truth.items():
            assert value == pytest.approx(places[name[:-2]]["xy".index(name[-1])] / 84, abs=1e-5)


def test_what_sets_agents_apart(tiny):
    """Two transformers have other names if their attention differs."""
    changes = [{}, {"trxl_positional_encoding": "none"}, {"trxl_layer_norm": "post"}]
    changes += [{"trxl_memory_length": 8}, {"trxl_num_heads": 4}, {"frame_stack": 4}, {"trxl_gate": "gru"}]
    names = [enjoy.memory_of(tiny(ppo_trxl, **change)) for change in changes]
    assert names[1] == "TrXL, 2 blocks, 2 heads, width 32, window 7, no positional encoding, pre-norm"
    assert names[2].endswith("absolute positional encoding, post-norm")
    assert names[5].endswith("pre-norm, frame stack 4")
    assert len({*names}) == len(names)
    assert enjoy.memory_of(tiny(ppo_trxl, trxl_num_layers=1)).startswith("TrXL, 1 block, ")


# ---- events ----
def test_commands_and_failures():
    agent, envs, _ = enjoy.load(Path(__file__).parents[1] / "agents/endless-mortar-mayhem-gru.pt")
    episode = enjoy.play(agent, envs, 100_000, 500)
    assert len(episode.events["command completed"]) == episode.final["carried_out"] > 3
    # Three steps each. A sequence also grows by a last command that failed: the episode ends before the next is shown.
    assert len(episode.events["command shown"]) / 3 - episode.final["max_command_sequence"] in (0, 1)
    assert episode.events["failure"] == [len(episode.actions) - 1]


def test_falls(saved):
    saved()
    episode = played(max_steps=500)
    falls = episode.events["fell off"]
    assert episode.final["num_fails"] - len(falls) in (0, 1)  # a last one has no frame
    assert len(falls) > 1
    assert episode.events["failure"] == []


def test_spotlights(saved):
    saved(env_id="SearingSpotlights-v0", env_options='{"agent_health": 10, "light_threshold": 0}')
    for seed in range(20):
        episode = played(seed, 500)
        if episode.final["agent_health"] == 0:
            assert len(episode.events["in a spotlight"]) == 9  # the tenth hit has no frame
            assert episode.events["failure"] == [len(episode.actions) - 1]
            break
    else:
        raise AssertionError("no episode was failed")


def test_rewards_of_other_environments(saved):
    saved(env_id="CartPole-v1")
    episode = played()
    assert episode.events == {"reward": [*range(len(episode.actions))], "negative reward": []}
    saved(env_id=register(lambda **more: gym.wrappers.TransformReward(gym.make("CartPole-v1", **more), float.__neg__)))
    episode = played()
    assert episode.events == {"reward": [], "negative reward": [*range(len(episode.actions))]}


def test_the_ground_truth_of_other_environments(saved):
    class Tells(gym.Wrapper):
        def reset(self, **arguments):
            self.t = 0
            return self.env.reset(**arguments)[0], {"ground_truth": [0.0, 7.0]}

        def step(self, action):
            self.t += 1
            return *self.env.step(action)[:4], {"ground_truth": [self.t, 7.0]}

    saved(env_id=register(lambda **more: Tells(gym.make("CartPole-v1", **more))), ground_truth_coef=0.1)
    (page,) = page_of(max_steps=4)["episodes"]
    assert page["truth"] == [[0, 7], [1, 7], [2, 7], [3, 7]]
    assert np.shape(page["estimate"]) == (4, 2)


def test_an_agent_trained_in_processes_plays_in_this_one(saved):
    saved(env_id="CartPole-v1", async_envs=True)
    _, envs, _ = enjoy.load("model.pt")
    assert not isinstance(envs.unwrapped, gym.vector.AsyncVectorEnv)
    envs.close()


# ---- several episodes ----
def test_agents_and_levels(saved):
    saved(num_levels=5)
    saved(ppo_trxl, "other.pt", num_levels=7)
    page = page_of(others=("other.pt", "model.pt"), levels=2, seed=None, max_steps=5)
    facts = [(each["facts"]["agent"].split("/")[1], each["facts"]["seed"]) for each in page["episodes"]]
    assert facts == [("model.pt", 7), ("other.pt", 7), ("model.pt", 8), ("other.pt", 8)]
    for each, (name, seed) in zip(page["episodes"], facts, strict=True):
        (alone,) = page_of(checkpoint=name, seed=seed, max_steps=5)["episodes"]
        assert alone == each


def test_agents_of_other_tasks(saved):
    saved()
    saved(path="other.pt", env_options='{"max_steps": 9}')
    with pytest.raises(ValueError, match=r"other\.pt plays another task than model\.pt"):
        page_of(others=("other.pt",))
    assert len(page_of(others=("other.pt",), env_options='{"max_steps": 9}')["episodes"]) == 2


# ---- environments of other packages ----
ODD = """
import gymnasium as gym
import numpy as np

FRAMES = {"floats": np.full((2, 3, 3), 0.5), "gray": np.full((2, 3), 127, np.uint8), "list": [[[127] * 3] * 3] * 2}


class Odd(gym.Env):
    metadata = {"render_modes": ["rgb_array"]}
    observation_space, action_space = gym.spaces.Box(0, 1, (1,)), gym.spaces.Discrete(2)

    def __init__(self, render_mode=None, frame=None, reward=1.0):
        self.render_mode, self.frame, self.reward = render_mode, frame, reward

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), float(self.reward), False, False, {}

    def render(self):
        return FRAMES.get(self.frame)


gym.register("Odd-v0", Odd)
"""


@pytest.fixture
def odd(saved):
    """Save the agent of an environment with these arguments."""
    Path("odd_pictures.py").write_text(ODD)
    yield lambda **kwargs: saved(env_id="odd_pictures:Odd-v0", env_kwargs=json.dumps(kwargs))
    sys.modules.pop("odd_pictures", None)
    gym.registry.pop("Odd-v0", None)


@pytest.mark.filterwarnings("ignore::UserWarning")  # Gymnasium's checks of the same
@pytest.mark.parametrize("frame", ["floats", "gray", "list"])
def test_pictures_of_every_kind(frame, odd):
    odd(frame=frame)
    page = page_of(max_steps=2)
    (video,) = page["episodes"][0]["videos"]
    assert frames_of(video).tolist() == np.full((2, 2, 3, 3), 127).tolist()
    assert page["options"] == {"frame": frame}


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_no_pictures(odd):
    odd()
    with pytest.raises(ValueError, match=r"Odd-v0 draws no images \(render_mode rgb_array\)"):
        page_of()


@pytest.mark.filterwarnings("ignore::UserWarning")  # Gymnasium's checks of the same
def test_what_an_environment_does_wrong_is_one_line(odd):
    odd(frame="gray", reward="nan")
    assert command("model.pt").startswith("enjoy.py: Odd-v0: the reward is nan (environment 0, step 1 ")


# ---- how it is packed ----
def test_attention_is_packed_by_age():
    looks = [np.zeros((1, 2, 1)), np.array([[[1.0], [1.0]]]), np.array([[[0.25, 0.75], [0.75, 0.25]]])]
    looks.append(np.array([[[0.0, 1.0], [0.5, 0.5]]]))  # a window of two
    weights = weights_of({"attention": enjoy.packed(looks)})[:, 0]
    rows = [[[0, 0], [0, 0]], [[0, 1], [0, 1]], [[0.25, 0.75], [0.75, 0.25]], [[0, 1], [0.5, 0.5]]]
    assert np.allclose(weights, rows, atol=4e-3)
    assert enjoy.packed([]) is None


def test_states_are_packed_with_similar_units_together():
    wave = np.sin(np.arange(50))
    units = np.stack([wave, -2 * wave, 0 * wave, 1.5 * wave])
    state = state_of({"state": enjoy.packed_states([*np.stack([units, 3 * units]).transpose(2, 0, 1)])})
    order = [1, 2, 0, 3] if np.allclose(state[0, 0], units[1], atol=0.01) else [3, 0, 2, 1]
    assert np.allclose(state[0], units[order], atol=0.01)
    assert np.allclose(np.sort(state[1], 0), np.sort(3 * state[0], 0), atol=0.04)
    assert enjoy.packed_states([]) is None


def test_small_weights_keep_their_digits():
    """Those of a uniform attention to 256 steps still add up to one."""
    weights = weights_of({"attention": enjoy.packed([np.full((1, 1, 256), 1 / 256)])})
    assert weights.sum() == pytest.approx(1, abs=0.02)


def test_displayable():
    stack = np.arange(5, dtype=np.uint8) * np.ones((2, 3, 1), np.uint8)
    shown = enjoy.displayable(stack, stacked=True)
    assert shown.shape == (6, 9)  # three by three, the last four of them black
    assert shown[::2, ::3].tolist() == [[0, 1, 2], [3, 4, 0], [0, 0, 0]]
    colours = np.array([[[0.0, 0.5, 1.0]]])
    assert enjoy.displayable(colours, stacked=False).tolist() == [[[0, 128, 255]]]
    assert enjoy.displayable(colours, stacked=True).tolist() == [[0, 128], [255, 0]]


def test_text_in_the_data_cannot_end_the_script():
    episode = enjoy.Episode(policy=[[np.ones(1)]], actions=[[0]], values=[0.0], entropies=[0.0], rewards=[0.0])
    data = enjoy.episode_data(episode, "CartPole-v1", {"</script>": "<!--"})
    page = enjoy.page({"title": "CartPole-v1", "episodes": [data]}, "")
    assert page.count("</script>") == 3
    assert data_of(page)["episodes"][0]["facts"] == {"</script>": "<!--"}


def test_a_thousand_steps_stay_small(saved):
    options = '{"agent_health": 1000000, "steps_per_coin": 1000000}'
    window = {"trxl_memory_length": 256, "trxl_num_layers": 3, "reconstruction_coef": 0.1}
    saved(ppo_trxl, env_id="Endless-SearingSpotlights-v0", env_options=options, **window)
    assert enjoy.main(enjoy.Config("model.pt", seed=3, max_steps=40)).startswith("page.html: 40 steps")
    library, longest_look = len(enjoy.get_plotlyjs()), 3 * 4 * 256 * 4 / 3  # three blocks, four heads, in base64
    assert library + 25 * (os.path.getsize("page.html") - library) + 1000 * longest_look < 15e6


# ---- in a browser ----
@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless Chromium that logs its console."""
    program, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if not program or not driver:
        pytest.skip("no browser: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    flags = "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking"
    flags += " disable-component-update disable-sync disable-dev-shm-usage window-size=1400,1000"
    for flag in (*flags.split(), f"user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
    yield browser
    browser.quit()


@functools.cache
def first_episode(path):
    """What a page holds, and the frames of its videos."""
    page = data_of(path.read_text())["episodes"][0]
    return page, [frames_of(video) for video in page["videos"]]


@pytest.fixture
def watch(browser, saved, tmp_path_factory):
    """Show the page at a step, a transformer's episode alone or, where loaded, beside a GRU's; return what it holds
    of the first, and its videos' frames.

    In the end there is nothing in the browser's console, and the page has loaded nothing.
    """
    path = tmp_path_factory.getbasetemp() / "watched.html"  # one page for all tests

    def open_page(step, load=False):
        if not path.exists():
            options = '{"command_count": [16]}'  # 64 steps to show them
            agent = f"{'a_long_name_' * 8}/model.pt"
            Path(agent).parent.mkdir()
            saved(ppo_trxl, agent, env_id="MortarMayhem-Grid-v0", trxl_memory_length=128, env_options=options)
            saved(path="other.pt", env_id="MortarMayhem-Grid-v0", env_options=options)
            enjoy.main(enjoy.Config(agent, ("other.pt",), seed=5, out=str(path)))
        if load or not browser.current_url.startswith(path.as_uri()):
            browser.get("about:blank")  # or the same page at another step would not be loaded anew
            browser.get(f"{path.as_uri()}#{step}")
            assert step_of(browser) == step
        if not load:  # which takes a second
            browser.execute_script("find('#view').selectedIndex = 0; find('#first').value = 0;")
            browser.execute_script(f"find('#second').value = 'alone'; newEpisodes(); go({step})")
        return first_episode(path)

    yield open_page
    assert browser.get_log("browser") == []
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0


def wait_until(browser, holds, seconds=10):
    """Wait until something holds, a function of the browser; look more often than Selenium does by itself."""
    WebDriverWait(browser, seconds, poll_frequency=0.05).until(holds)


def step_of(browser):
    return int(browser.find_element("tag name", "output").text.split()[1].strip(","))


def check_step(browser, videos, step):
    """The page says that it is at the step, and every video shows the frame of it, to the pixel."""
    assert step_of(browser) == step
    check_shown(browser, videos, step)


def check_shown(browser, videos, step):
    def is_shown(_):
        urls = browser.execute_script("return [...document.querySelectorAll('canvas')].map(each => each.toDataURL())")
        return all(np.array_equal(picture(url), video[step]) for url, video in zip(urls, videos, strict=True))

    wait_until(browser, is_shown)


def place(browser, selector, index):
    """Where the index-th selected part of the page is in the window: left, top, width, height."""
    script = "const box = document.querySelectorAll(arguments[0])[arguments[1]].getBoundingClientRect();"
    return browser.execute_script(script + "return [box.x, box.y, box.width, box.height]", selector, index)


def point(browser, x, y):
    actions = ActionBuilder(browser, duration=0)
    actions.pointer_action.move_to_location(round(x), round(y))
    actions.perform()


def click(browser, x, y):
    point(browser, x, y)
    ActionChains(browser, 0).click().perform()


def press(browser, *keys):
    ActionChains(browser).send_keys(*keys).perform()


def test_click_on_a_line(browser, watch):
    page, videos = watch(5)
    check_step(browser, videos, 5)
    for line, step in enumerate((31, 12)):
        x, y, width, height = place(browser, "#curves .scatterlayer .js-line", line)
        click(browser, x + width * step / (page["steps"] - 1), y + height / 2)
        check_step(browser, videos, step)


def weights_of_block(block):
    """The marks of a block's highest weights: the rows above it are two curves and the actions."""
    return f"#curves .xy{4 + block} .points .point"


def test_click_on_an_attention_weight(browser, watch):
    page, videos = watch(40)
    weights = weights_of(page).sum(2)
    for block, i in ((0, 0), (1, 9)):
        best = np.argsort(-weights[40, block], kind="stable")[:10] + 40 - page["attention"]["window"]
        x, y, width, height = place(browser, weights_of_block(block), i)
        point(browser, x + width / 2, y + height / 2)
        check_shown(browser, videos, best[i])
        point(browser, 0, 0)
        check_step(browser, videos, 40)
        click(browser, x + width / 2, y + height / 2)
        check_step(browser, videos, best[i])
        press(browser, Keys.HOME)
        ActionChains(browser).key_down(Keys.SHIFT).send_keys(*[Keys.ARROW_RIGHT] * 4).key_up(Keys.SHIFT).perform()
        check_step(browser, videos, 40)


def choose(browser, name, value):
    Select(browser.find_element("id", name)).select_by_value(value)


def trace(browser, row, part, i=0):
    """A part of the i-th trace in a row of the curves, counted from 1."""
    script = "return find('#curves').data.filter(trace => trace.yaxis === arguments[0])[arguments[1]][arguments[2]]"
    return browser.execute_script(script, f"y{row if row > 1 else ''}", i, part)


def test_axis_of_attention_is_that_of_the_step(browser, watch):
    page, _ = watch(5)
    for step in (5, 20, 40):
        browser.execute_script(f"go({step})")
        for block in (0, 1):
            largest = weights_of(page)[step, block].sum(0).max()
            axis = browser.execute_script(f"return find('#curves').layout.yaxis{4 + block}.range")
            assert axis == pytest.approx([0, 1.08 * largest])


@pytest.mark.parametrize(("step", "marks"), [(0, 0), (1, 1), (8, 2), (40, 10), (66, 16)])
def test_highest_weights_are_marked(step, marks, browser, watch):
    watch(step)
    for block in (0, 1):
        points = browser.find_elements("css selector", weights_of_block(block))
        assert [point.value_of_css_property("fill") for point in points] == ["rgb(200, 85, 61)"] * marks
    assert browser.find_element("id", "top").text == "red: the highest quarter, at most 16"


def test_one_head(browser, watch):
    page, _ = watch(40)
    weights = weights_of(page)[40, 1, :, -40:]
    assert np.allclose(trace(browser, 5, "y"), weights.sum(0))
    choose(browser, "head", "1")
    assert np.allclose(trace(browser, 5, "y"), weights[1])
    names = [each.text for each in browser.find_elements("css selector", "#curves .annotation-text")]
    assert names[-2:] == ["attention of block 1, head 2", "attention of block 2, head 2"]


def test_heat_map(browser, watch):
    page, videos = watch(40)
    steps, weights = page["steps"], weights_of(page)[:, 0].sum(1)
    choose(browser, "view", "map")
    shown = trace(browser, 4, "z")
    assert [[each is None for each in row] for row in shown] == [[s >= t for s in range(steps)] for t in range(steps)]
    for t in (1, 40, steps - 1):
        assert np.allclose(shown[t][:t], weights[t, -t:])
    assert not browser.find_element("id", "top").is_displayed()
    assert len(browser.find_elements("css selector", "#curves .colorbar")) == 2  # one for each block
    x, y, width, height = place(browser, "#curves .xy4 .hm image", 0)
    click(browser, x + width * 12.5 / steps, y + height / 2)
    check_step(browser, videos, 12)


def test_events_and_actions(browser, watch):
    page, _ = watch(5)
    shown = page["events"]["command shown"]
    row = [event for event, steps in page["events"].items() if steps].index("command shown") + 1  # below the line
    assert trace(browser, 1, "x", row) == shown
    assert trace(browser, 1, "y", row) == [page["lines"]["state value"][step] for step in shown]
    (branch,) = page["branches"]
    taken = [branch["actions"][action] for (action,) in page["actions"]]
    assert trace(browser, 3, "text") == [taken]
    assert trace(browser, 3, "z") == [[action for (action,) in page["actions"]]]
    legend = browser.find_element("id", "legend").text.split("\n")
    assert "◆ command shown" in legend
    assert legend[-4:] == ["■ none", "■ turn left", "■ turn right", "■ forward"]


def test_the_last_step_is_whole(browser, watch):
    """An event there is not cut at its middle, even where the axis ends."""
    page, _ = watch(5)
    assert page["events"]["failure"] == [page["steps"] - 1]
    browser.execute_script(f"Plotly.relayout('curves', {{'xaxis.range': [0, {page['steps'] - 1}]}})")
    before = sum(len(page["events"][name]) for name in ("command completed", "negative reward"))
    x, y, width, height = place(browser, "#curves .xy .point", before)
    pixels = np.asarray(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("L")).astype(int)
    left, top, right, bottom = map(round, (x, y, x + width, y + height))
    mark = pixels[top:bottom, left:right] < 128
    half = mark.shape[1] // 2
    assert mark[:, -half:].sum() > mark[:, :half].sum() / 2 > 0


def test_two_agents(browser, watch, tmp_path_factory):
    """Both at the same step of the same level; who has ended stays at the end."""
    watch(20, load=True)
    page = data_of((tmp_path_factory.getbasetemp() / "watched.html").read_text())
    assert browser.find_element("css selector", "header > span").text == "actions sampled, command_count [16]"
    episodes = page["episodes"]
    films = [[frames_of(video) for video in each["videos"]] for each in episodes]
    check_step(browser, [*films[0], *films[1]], 20)
    cards = browser.find_elements("class name", "agent")
    for letter, card, each in zip("AB", cards, episodes, strict=True):
        assert card.find_element("tag name", "h2").text == f"{letter} {each['facts']['agent']}"
        assert card.find_element("class name", "facts").text.startswith(f"return {each['facts']['return']} steps ")
        texts = [bar.text for bar in card.find_elements("css selector", ".bartext")]
        assert texts == [f"{each:.2f}" for each in each["branches"][0]["probabilities"][20]]
    for i, each in enumerate(episodes):
        assert trace(browser, 1, "y", i) == each["lines"]["state value"]
    assert np.allclose(trace(browser, 6, "z"), state_of(episodes[1])[0])  # below two blocks of attention
    assert len(browser.find_elements("css selector", "#curves .colorbar")) == 1
    steps = [each["steps"] for each in episodes]
    press(browser, Keys.END)
    assert step_of(browser) == max(steps) - 1
    check_shown(browser, [[video[n - 1]] for film, n in zip(films, steps, strict=True) for video in film], 0)
    ended = [n < max(steps) for n in steps]
    assert ["ended" in card.get_attribute("class") for card in cards] == ended
    choose(browser, "first", "1")
    assert [each.text for each in browser.find_elements("css selector", ".agent h2")] == [episodes[1]["facts"]["agent"]]
    assert not browser.find_element("id", "attention").is_displayed()
    step = step_of(browser)
    press(browser, Keys.ARROW_LEFT)  # of the video, not of the list
    assert step_of(browser) == step - 1


def test_keys(browser, watch):
    page, videos = watch(0)
    press(browser, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    check_step(browser, videos, 2)
    press(browser, Keys.HOME, Keys.ARROW_LEFT)
    check_step(browser, videos, 0)
    press(browser, Keys.END, Keys.ARROW_RIGHT)
    check_step(browser, videos, page["steps"] - 1)
    press(browser, Keys.SPACE)  # plays, from the beginning as it is at the end
    button = browser.find_element("id", "play")
    assert button.text == "Pause"
    wait_until(browser, lambda _: 3 <= step_of(browser) < page["steps"] - 1)
    press(browser, Keys.SPACE)
    assert button.text == "Play"
    check_step(browser, videos, step_of(browser))
    button.click()
    assert browser.switch_to.active_element.tag_name == "body"
    press(browser, Keys.SPACE)  # pauses, and does not press the button again
    assert button.text == "Play"
    choose(browser, "speed", "25")
    press(browser, Keys.END, *[Keys.ARROW_LEFT] * 6)  # of the video, not of the list
    check_step(browser, videos, page["steps"] - 7)
    press(browser, Keys.SPACE)
    wait_until(browser, lambda _: button.text == "Play", 60)  # stops at the end
    check_step(browser, videos, page["steps"] - 1)


def test_bars_and_numbers_are_those_of_the_step(browser, watch):
    page, _ = watch(7)
    texts = [each.text for each in browser.find_elements("css selector", ".probabilities .bartext")]
    assert texts == [f"{each:.2f}" for each in page["branches"][0]["probabilities"][7]]
    colors = browser.execute_script(
        "return [...document.querySelectorAll('.probabilities .point path')].map(bar => bar.style.fill)"
    )
    red, blue = "rgb(200, 85, 61)", "rgb(185, 203, 220)"
    assert colors == [red if action == page["actions"][7][0] else blue for action in range(4)]
    chosen = browser.find_element("css selector", ".policy span")
    assert (chosen.text, chosen.value_of_css_property("color")) == ("■ chosen", "rgba(200, 85, 61, 1)")
    table = [row.text for row in browser.find_elements("css selector", ".truth tr")]
    assert table == ["column row", " ".join(["true", *(f"{each:.3f}" for each in page["truth"][7])])]


def test_other_environments_in_the_browser(browser, saved, tmp_path):
    """Actions are numbers; the page opens at the middle one of the rewards, which are marks on the values."""
    saved(env_id="CartPole-v1")
    (page,) = page_of()["episodes"]
    browser.get((tmp_path / "page.html").as_uri())
    wait_until(browser, lambda _: browser.find_elements("css selector", ".probabilities .xtick"))
    assert [each.text for each in browser.find_elements("css selector", ".probabilities .xtick")] == ["0", "1"]
    assert step_of(browser) == (page["steps"] - 1) // 2
    assert trace(browser, 1, "x", 1) == [*range(page["steps"])]
    assert trace(browser, 1, "text", 1) == ["reward, reward 1"] * page["steps"]


@pytest.mark.parametrize(("width", "height"), [(1920, 1080), (1280, 800), (700, 900), (400, 900)])
def test_every_width(width, height, browser, watch):
    """Nothing is wider than its card: if the window has this width, comes to have it, or the page becomes narrower.

    The whole page fits a wide window; in a narrow one, the videos stay while the curves are scrolled.
    """
    wide = """const right = element => element.getBoundingClientRect().right;
        const parts = card => [...card.querySelectorAll(":scope *:not(svg *)")];
        const spills = card => parts(card).some(part => right(part) > right(card));
        return document.documentElement.scrollWidth > innerWidth ||
            [...document.querySelectorAll("section")].some(spills)"""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    try:
        for _ in range(2):
            watch(3, load=True)
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            wait_until(browser, lambda _: not browser.execute_script(wide))
        browser.execute_script(f"document.body.style.width = '{width - 50}px'")
        wait_until(browser, lambda _: not browser.execute_script(wide))
        browser.execute_script("document.body.style.width = ''")
        left, plots, footer = (place(browser, card, 0) for card in ("#left", "#plots", "footer"))
        if width > 900:
            assert left[2] > 0.3 * width
            assert plots[1] + plots[3] < footer[1]
            assert left[3] > 0.6 * plots[3]
            assert browser.execute_script("return document.documentElement.scrollHeight === innerHeight")
        else:
            assert left[2] == plots[2] > 0.85 * width
        if width == 700:
            assert place(browser, "#curves .xy", 0)[1] < footer[1]
            browser.execute_script("scrollTo(0, 9999)")
            assert place(browser, "canvas", 0)[1] >= 0
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_dark_mode(browser, watch):
    """It begins when the system changes to it; all text and lines then have other colors than the background."""
    script = """const style = selector => getComputedStyle(document.querySelector(selector));
        return [style("body").backgroundColor, style("#plots").backgroundColor, style("h1").color,
            style("#curves .xtick text").fill, style(".probabilities .ytick text").fill,
            style("#curves .js-line").stroke]"""
    watch(3)
    light = browser.execute_script(script)
    dark_mode = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", dark_mode)
    try:
        wait_until(browser, lambda _: browser.execute_script(script)[-1] != light[-1])
        dark = browser.execute_script(script)
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    brightness = [[sum(map(int, re.findall(r"\d+", color)[:3])) for color in colors] for colors in (light, dark)]
    assert min(brightness[0][:2]) - max(brightness[0][2:]) > 200
    assert min(brightness[1][2:]) - max(brightness[1][:2]) > 200


# ---- bad input ----
def test_bad_input_is_one_line(saved):
    saved()
    told = "enjoy.py: there is no file missing.pt; --save-model writes model.pt to the run folder"
    assert command("missing.pt") == told


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"checkpoint": enjoy.__file__}, "enjoy.py is cut short, or neither a model nor a checkpoint"),
        ({"seed": -1}, "--seed is -1; levels must be from 0 to 2 ** 63 - 1"),
        ({"seed": 2**63 - 1, "levels": 2}, "--seed is 9223372036854775807; levels must be from 0 to 2 ** 63 - 1"),
        ({"levels": 0}, "--levels is 0; it must be 1 to 100"),
        ({"max_steps": 0}, "--max-steps is 0; it must be 1 to 100000"),
        ({"out": "nowhere/page.html"}, "--out is nowhere/page.html; it must be a file in a folder that is there"),
        ({"out": "."}, "--out is .; it must be a file in a folder that is there"),
    ],
)
def test_bad_input(config, message, saved):
    saved()
    with pytest.raises((ValueError, OSError), match=re.escape(message)):
        enjoy.main(enjoy.Config(**{"checkpoint": "model.pt", **config}))
    assert not os.path.exists("page.html")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"env_id": "CueRecall-v0"}, r"enjoy\.py needs .* that draws images \(rgb_array\); CueRecall-v0 draws none"),
        ({"env_options": '{"agent_scal": 1}'}, "agent_scal.*agent_scale"),
        ({"obs_type": "vector"}, "holds the weights of another network"),
    ],
)
def test_checkpoint_that_cannot_play(change, message, saved):
    args = saved()
    model = torch.load("model.pt", weights_only=True)
    torch.save({**model, "args": dataclasses.asdict(dataclasses.replace(args, **change))}, "model.pt")
    with pytest.raises(ValueError, match=message):
        enjoy.main(enjoy.Config("model.pt"))


def test_diverged_weights(saved):
    saved()
    model = torch.load("model.pt", weights_only=True)
    model["weights"]["heads.value.2.bias"].fill_(torch.nan)
    torch.save(model, "model.pt")
    with pytest.raises(ValueError, match="holds weights that are not finite: the training diverged"):
        enjoy.main(enjoy.Config("model.pt"))


def test_a_policy_that_is_not_finite(saved):
    """Of finite weights."""
    saved()
    model = torch.load("model.pt", weights_only=True)
    model["weights"]["heads.policy.2.weight"].fill_(3e38)
    torch.save(model, "model.pt")
    with pytest.raises(RunError, match="the policy is not finite"):
        enjoy.main(enjoy.Config("model.pt"))


def test_missing_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    monkeypatch.delitem(sys.modules, "enjoy")
    with pytest.raises(SystemExit, match=re.escape('enjoy.py needs plotly.offline: pip install -e ".[eval]"')):
        importlib.import_module("enjoy")
