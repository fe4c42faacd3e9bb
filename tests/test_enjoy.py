"""enjoy.py: what the page holds is what happened, and in a browser it goes where one clicks."""

import base64
import dataclasses
import io
import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

import enjoy
import ppo_gru
import ppo_trxl

AGENTS = {
    "GRU": (ppo_gru, {"env_id": "MysteryPath-Grid-v0", "reconstruction_coef": 0.1, "ground_truth_coef": 0.1}),
    "LSTM": (ppo_gru, {"env_id": "MortarMayhemB-v0", "memory": "lstm"}),
    "no memory": (ppo_gru, {"env_id": "MysteryPath-v0", "memory": "none", "frame_stack": 4, "step_encoding": True}),
    "TrXL": (ppo_trxl, {"env_id": "MortarMayhem-Grid-v0", "ground_truth_coef": 0.1}),
    "GTrXL": (ppo_trxl, {"env_id": "SearingSpotlights-v0", "obs_type": "vector", "trxl_gate": "gru"}),
    "CartPole": (ppo_gru, {"env_id": "CartPole-v1"}),
}


@pytest.fixture
def saved(tiny):
    """Save an agent with random weights as model.pt, and return its arguments."""

    def save(script=ppo_gru, **changes):
        args = tiny(script, **{"env_id": "MysteryPath-Grid-v0", **changes})
        torch.manual_seed(1)
        envs = script.make_envs(args, 1)
        _, infos = envs.reset(seed=1)
        agent = script.make_agent(envs, infos, args, torch.device("cpu"))
        with torch.no_grad():  # the initial policy hardly depends on its input
            for parameter in agent.heads.parameters():
                parameter.mul_(3)
        script.save_model(agent, args, "model.pt")
        return args

    return save


def played(seed=3, max_steps=60):
    agent, envs, args = enjoy.load("model.pt")
    options = ppo_gru.reset_options(args.env_id, args.env_options)
    return enjoy.play(agent, envs, seed, options, max_steps)


def data_of(page):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)[1])


def frames_of(video):
    """The frames (T, h, w, 3) of a video on the page."""
    sheets = [Image.open(io.BytesIO(base64.b64decode(sheet.split(",")[1]))) for sheet in video["sheets"]]
    return np.concatenate([np.asarray(sheet.convert("RGB")) for sheet in sheets]).reshape(
        -1, video["height"], video["width"], 3
    )


# ---- what is recorded ----
@pytest.mark.parametrize("name", AGENTS)
def test_every_kind_of_agent(name, saved):
    script, changes = AGENTS[name]
    args = saved(script, **changes)
    line = enjoy.main(enjoy.Config("model.pt", seed=3, max_steps=60))
    with open("page.html") as file:
        page = data_of(file.read())
    steps = page["steps"]
    assert line.startswith(f"page.html: {steps} steps, return {page['facts']['return']}, ")
    assert page["facts"]["agent"] == ("GRU" if name == "CartPole" else name)
    assert all(len(page[key]) == steps for key in ("actions",))
    assert all(len(line) == steps for line in page["lines"].values())
    names = ["rendered frame" if name in ("GTrXL", "CartPole") else "agent's view"]
    names += ["ground truth"] * (name != "CartPole") + ["reconstruction"] * bool(args.reconstruction_coef)
    assert [video["name"] for video in page["videos"]] == names
    assert all(len(frames_of(video)) == steps for video in page["videos"])
    assert len(page["truth"]) == steps * (name != "CartPole")
    assert len(page["estimate"]) == steps * bool(args.ground_truth_coef)
    assert (page["attention"] is not None) == (script is ppo_trxl)
    for branch in page["branches"]:
        assert np.allclose(np.sum(branch["probabilities"], 1), 1, atol=1e-4)
        assert len(branch["actions"]) == len(branch["probabilities"][0])


def test_the_episode_is_the_agents(saved):
    """Played again with the agent's own `act`: the same pictures, numbers and attention, step for step."""
    saved(ppo_trxl, env_id="MortarMayhem-Grid-v0")
    agent, envs, _ = enjoy.load("model.pt")
    episode = enjoy.play(agent, envs, 3, None, 60)
    page = enjoy.page_data(episode, "", {}, "MortarMayhem-Grid-v0", 25)
    view, truth = map(frames_of, page["videos"])
    torch.manual_seed(3)
    obs, infos = envs.reset(seed=3)
    live = agent.memory.initial(1, torch.device("cpu"), 60)
    for t, actions in enumerate(episode.actions):
        assert np.array_equal(view[t], obs[0])
        envs.render_mode = "debug_rgb_array"
        assert np.array_equal(truth[t], envs.render()[0])
        assert np.array_equal(episode.truth[t], infos["ground_truth"][0])
        with torch.no_grad():
            looks = agent.memory.attention(agent.encoder(ppo_gru.as_tensors(obs)), live)[0]
            policy, value, live, _ = agent.act(ppo_gru.as_tensors(obs), live)
        assert episode.values[t] == value.item()
        assert np.array_equal(episode.policy[t][0], policy[0].probs[0].numpy())
        assert np.array_equal(episode.attention[t], looks.numpy())
        assert actions == [policy[0].sample().item()]
        obs, rewards, terminated, truncated, infos = envs.step(np.array(actions))
        assert episode.rewards[t] == rewards[0]
        assert (terminated | truncated)[0] == (episode.finished and t == len(episode.actions) - 1)
    assert episode.finished
    assert episode.final["length"] == len(episode.actions)


def test_seed_is_the_level_and_the_actions(saved):
    saved()
    first, again, other = (played(seed).actions for seed in (3, 3, 4))
    assert first == again != other


def test_default_level_was_not_trained_on(saved):
    saved(num_levels=7, start_level=5)
    enjoy.main(enjoy.Config("model.pt", max_steps=2))
    with open("page.html") as file:
        facts = data_of(file.read())["facts"]
    assert facts == {"agent": "GRU", "seed": 12, "steps": 2, "return": "0", "cut short": "after 2 steps"}


# ---- how it is packed ----
def test_attention_is_packed_by_age():
    looks = [np.zeros((1, 2, 1)), np.array([[[1.0], [1.0]]]), np.array([[[0.25, 0.75], [0.75, 0.25]]])]
    looks.append(np.array([[[0.0, 1.0], [0.5, 0.5]]]))  # a window of two
    packed = enjoy.packed(looks)
    scores = np.frombuffer(base64.b64decode(packed["scores"]), "<u2").reshape(4, 1, 2)[:, 0] / 65535 * packed["heads"]
    assert np.allclose(scores, [[0, 0], [0, 2], [1, 1], [0.5, 1.5]], atol=1e-4)
    assert enjoy.packed([]) is None


def test_displayable():
    stack = np.arange(5, dtype=np.uint8) * np.ones((2, 3, 1), np.uint8)
    shown = enjoy.displayable(stack)
    assert shown.shape == (6, 9)  # three by three, the last four of them black
    assert shown[::2, ::3].tolist() == [[0, 1, 2], [3, 4, 0], [0, 0, 0]]
    assert enjoy.displayable(np.array([[[0.0, 0.5, 1.0]]])).tolist() == [[[0, 128, 255]]]


def test_text_in_the_data_cannot_end_the_script():
    episode = enjoy.Episode(policy=[[np.ones(1)]], actions=[[0]], values=[0.0], entropies=[0.0], rewards=[0.0])
    page = enjoy.page(enjoy.page_data(episode, "</script><b>", {"a": "<!--"}, "CartPole-v1", 1), "")
    assert page.count("</script>") == 3
    assert "<title>&lt;/script&gt;&lt;b&gt;</title>" in page
    assert data_of(page)["title"] == "</script><b>"


def test_a_thousand_steps_stay_small(saved):
    options = '{"agent_health": 1000000, "steps_per_coin": 1000000}'
    window = {"trxl_memory_length": 256, "trxl_num_layers": 3, "reconstruction_coef": 0.1}
    saved(ppo_trxl, env_id="Endless-SearingSpotlights-v0", env_options=options, **window)
    assert enjoy.main(enjoy.Config("model.pt", seed=3)).startswith("page.html: 1000 steps")
    assert os.path.getsize("page.html") < 15e6
